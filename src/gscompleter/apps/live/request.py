"""Parse the requests of a page: JSON that is validated before anything is done."""

from __future__ import annotations

from base64 import b64decode
from binascii import Error as Base64Error
from dataclasses import dataclass, replace
from typing import Any, Literal

from gscompleter.apps.inputs.removal import check_selection
from gscompleter.apps.requests.splat import Selection
from gscompleter.data.scene import parse_camera
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.typed_json import parse_typed_json
from gscompleter.types import Camera

PAGE_ADVICE = "load the page again"


class BusyError(Exception):
    """Another request still runs."""


@dataclass(frozen=True)
class PageCamera:
    """Camera of the page, as a `transforms.json` with one frame, in the frame of the result."""

    frames: tuple[dict[str, Any], ...]
    """Has what `describe_camera` writes."""
    camera_model: Literal["PINHOLE"] = "PINHOLE"


@dataclass(frozen=True)
class PageRequest:
    """A button that was pressed, and what the page shows."""

    action: str
    client: str = ""
    """The page that asks, among all that are open."""
    camera: PageCamera | None = None
    """Where the page stands; None if the action needs no camera."""
    mask: str | None = None
    """PNG of the marks in base64; None without any."""
    box: tuple[float, float, float, float, float, float] | None = None
    """Smallest x, y and z, then largest, in the coordinates of the result; None without one."""
    box_rotation: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def check_box(self) -> None:
        """Refuse a box without an inside, or a rotation that is none."""
        if self.box is not None:
            check_selection(Selection(self.box, self.box_rotation))

    def read_mask(self) -> bytes | None:
        """Decode the PNG of the marks."""
        try:
            return None if self.mask is None else b64decode(self.mask, validate=True)
        except Base64Error as error:
            raise InputError(f"The mask is no base64 ({error}); {PAGE_ADVICE}.") from error

    def read_camera(self) -> Camera:
        """Read where the page stands, as a file with this camera would be read."""
        if self.camera is None:
            raise InputError(f"The request has no camera; {PAGE_ADVICE}.")
        if len(self.camera.frames) != 1:
            raise InputError(f"The request has {len(self.camera.frames)} cameras; {PAGE_ADVICE}.")
        return replace(parse_camera(self.camera.frames[0], "the camera"), near=None, far=None)


def parse_request(body: bytes, actions: tuple[str, ...]) -> PageRequest:
    """Parse and validate a request; `actions` are those that there are."""
    request = parse_typed_json(PageRequest, body, "The request", PAGE_ADVICE)
    if request.action not in actions:
        raise InputError(f"There is no action '{quote_value(request.action)}'; {PAGE_ADVICE}.")
    return request
