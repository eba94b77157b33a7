"""Requests of a page of `live`: JSON that is validated before anything is done.

A page is another program: whatever it sends, what is wrong with it raises InputError.
"""

from __future__ import annotations

from base64 import b64decode
from dataclasses import dataclass, replace
from typing import Any, Literal

from gscompleter.apps.inputs.removal import check_selection
from gscompleter.apps.requests.splat import Selection
from gscompleter.data.scene import parse_camera
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.typed_json import parse_typed_json
from gscompleter.types import Camera

PAGE_ADVICE = "load the page again"
"""What to do about a request that no page of ours sends."""


class BusyError(Exception):
    """Another request still runs."""


@dataclass(frozen=True)
class PageCamera:
    """Camera of a page, as a `transforms.json` with one frame, in the frame of the result."""

    frames: tuple[dict[str, Any], ...]
    """One entry, with the keys that `describe_camera` writes: pixels, and OpenGL axes."""
    camera_model: Literal["PINHOLE"] = "PINHOLE"
    """Any other is refused."""


@dataclass(frozen=True)
class PageRequest:
    """A button that was pressed on a page, where that stands, and what is marked on it."""

    action: str
    """Name of the button, such as "fill" or "undo"."""
    client: str = ""
    """Name of the page that asks, among all that are open."""
    camera: PageCamera | None = None
    """Where the page stands; None if the action needs no camera."""
    mask: str | None = None
    """PNG of the marks at the camera in base64, white where marked; None without any."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Smallest x, y and z, then largest, in the coordinates of the result; None without one."""
    box_rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    """Rotation of the box about its centre, as a quaternion wxyz; only a box has one."""

    def check_box(self) -> None:
        """Refuse a box without an inside, or a rotation that is none."""
        if self.box is not None:
            check_selection(Selection(self.box, self.box_rotation))

    def read_mask(self) -> bytes | None:
        """Decode the bytes of the PNG of the marks, which are not looked at; None without any."""
        try:
            return None if self.mask is None else b64decode(self.mask, validate=True)
        except ValueError as error:  # `binascii.Error` is one, and letters beyond ASCII raise it
            raise InputError(f"The mask is no base64 ({error}); {PAGE_ADVICE}.") from error

    def read_camera(self) -> Camera:
        """Read where the page stands, as a file with this camera would be read.

        It has no depth range, which is that of the session.
        """
        if self.camera is None:
            raise InputError(f"The request has no camera; {PAGE_ADVICE}.")
        if len(self.camera.frames) != 1:
            raise InputError(f"The request has {len(self.camera.frames)} cameras; {PAGE_ADVICE}.")
        return replace(parse_camera(self.camera.frames[0], "the camera"), near=None, far=None)


def parse_request(body: bytes, actions: tuple[str, ...]) -> PageRequest:
    """Parse the request `body`, and check that its action is one of `actions`.

    Mask, box and camera are checked where they are used, as most actions need none.
    """
    request = parse_typed_json(PageRequest, body, "The request", PAGE_ADVICE)
    if request.action not in actions:
        raise InputError(f"There is no action '{quote_value(request.action)}'; {PAGE_ADVICE}.")
    return request
