"""The page of a live session: the scene in the browser, and its buttons.

Scene and page both have OpenCV axes. Page units are scaled so that the photographed surfaces are a
few units away, as the controls and clipping planes of the page expect.
"""

from __future__ import annotations

import errno
import html
import ipaddress
import logging
import math
import os
import re
import socket
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, redirect_stdout
from dataclasses import dataclass
from functools import partial
from io import StringIO
from itertools import cycle
from queue import SimpleQueue
from threading import Lock
from types import MappingProxyType
from typing import Any

import numpy as np
import torch
import viser
from jaxtyping import Float
from websockets.asyncio import server as websockets

from gscompleter.apps.live.box import PageBox, remove_in_box
from gscompleter.apps.live.session import Session, complete_camera, undo_step
from gscompleter.data.photograph_names import name_photograph
from gscompleter.numerics.geometry import estimate_up, quats_to_rotations, rotations_to_quats
from gscompleter.state import NOTHING_ADDED, Completion, TargetResult
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.progress import notify_of_stages
from gscompleter.types import SH_C0, Camera, Gaussians

LOCAL_ORIGIN = re.compile(r"http://(127(\.\d{1,3}){3}|\[::1\]|localhost)(:\d+)?", re.IGNORECASE)
NOTICE_SECONDS = 4.0
SCENE_DISTANCE = 3.0
"""Distance of the middle of the depth range, in page units."""

WELCOME = (
    "Fly to a hole in the scene, then press “Complete what I see”: what is in the middle of the "
    "window, in the shape of a photograph."
)
BUSY = "The last request is still running; press the button again when it is done."
CONTROLS_HELP = (
    "Drag to rotate, drag with the right button to move, scroll to zoom, fly with W A S D Q E."
)

Job = Callable[[viser.ClientHandle], str]
"""Action of a button: takes the browser, returns a sentence for the page."""


@dataclass(frozen=True)
class PagePose:
    """Position, rotation and field of view of a page camera."""

    wxyz: Float[np.ndarray, "4"]
    """Rotation to the world, as a quaternion."""
    position: Float[np.ndarray, "3"]
    """Camera centre, in page units."""
    fov: float
    """Vertical field of view, in radians."""


class Page:
    """A session in all browsers that have the page open.

    Requests arrive in threads of the server. `handle_requests` runs them one at a time; a request
    that arrives meanwhile is refused.
    """

    def __init__(
        self,
        session: Session,
        find_hole: Callable[[Completion], Camera | None],
        save: Callable[[Session], str],
        server: viser.ViserServer,
        files: Mapping[int | None, str] = MappingProxyType({}),
    ) -> None:
        """Build the page; `find_hole` finds the camera with the most to gain, if there is one.

        `files` are those of the photographs by frame.
        """
        self.session = session
        self.server = server
        self._find_hole = find_hole
        self._save = save
        self._first = session.latest.views[0].camera
        self._photographs = cycle(
            [
                (f"Photograph {name_photograph(view.frame, files.get(view.frame))}.", view.camera)
                for view in session.latest.views
            ]
        )
        self._unit = compute_page_unit(self._first)
        self._requests: SimpleQueue[Callable[[], str]] = SimpleQueue()
        self._busy = Lock()
        self._generated: Any = None
        self._build()

    def handle_requests(self) -> None:
        """Run requests until the process is interrupted."""
        while True:
            # Threads of the server hand their requests over; all work is done in this one.
            request = self._requests.get()
            try:
                self.show_message(run_request(request))
            finally:
                self._busy.release()

    def close(self) -> None:
        """Stop the server."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def complete(self, client: viser.ClientHandle) -> str:
        """Complete the scene for the camera of a browser."""
        start = time.perf_counter()
        seen = PagePose(client.camera.wxyz, client.camera.position, client.camera.fov)
        camera = camera_from_page(seen, self._first.height, self._first.width, self._unit)
        with notify_of_stages(lambda stage: self.show_message(f"Completing: {stage} …")):
            session, result = complete_camera(self.session, camera)
        self._change_session(session)
        return describe_outcome(result, time.perf_counter() - start)

    def find(self, client: viser.ClientHandle) -> str:
        """Move a browser to the camera with the most to gain."""
        self.show_message("Searching for a hole …")
        camera = self._find_hole(self.session.latest)
        if camera is None:
            return "No large hole is left around the photographs."
        self._move_browser(client, camera)
        return "The scene has a hole here; press “Complete what I see”."

    def visit_photograph(self, client: viser.ClientHandle) -> str:
        """Move a browser to the next photograph of the context."""
        name, camera = next(self._photographs)
        self._move_browser(client, camera)
        return f"{name} {WELCOME}"

    def remove(self, client: viser.ClientHandle) -> str:
        """Remove what the box contains."""
        corners, rotation = self._box.read(self._unit)
        self.show_message("Removing …")
        session, count = remove_in_box(self.session, corners, rotation)
        self._change_session(session)
        numbers = " ".join(f"{number:.4g}" for number in corners)
        turned = " ".join(f"{number:.4g}" for number in rotation)
        return (
            f"{count:,} Gaussians are removed; complete the hole, or undo.\n"
            f"As options of remove: --box {numbers} --box-rotation {turned}"
        )

    def undo(self, client: viser.ClientHandle) -> str:
        """Undo the last step."""
        self._change_session(undo_step(self.session))
        return f"Undone. Completions left: {len(self.session.cameras)}."

    def save(self, client: viser.ClientHandle) -> str:
        """Write the completed scene."""
        self.show_message("Saving …")
        return self._save(self.session)

    def show_message(self, text: str) -> None:
        """Show a text on the page."""
        lines = "<br>".join(html.escape(line) for line in text.splitlines())
        self._status.content = f'<div role="status" style="padding: 0.5em 1em">{lines}</div>'

    def _build(self) -> None:
        scene = self.server.scene
        gui = self.server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        gui.set_panel_label("gscompleter live")
        cameras = [view.camera for view in self.session.latest.views]
        scene.set_up_direction(estimate_up(cameras).numpy())
        self._set_initial_camera(camera_to_page(self._first, self._unit))
        self._status = gui.add_html("")
        for label, job in (
            ("Complete what I see", self.complete),
            ("Find a hole", self.find),
            ("Next photograph", self.visit_photograph),
            ("Remove what the box contains", self.remove),
            ("Undo", self.undo),
            ("Save", self.save),
        ):
            gui.add_button(label).on_click(partial(self._submit, job))

        ahead = self._first.center + self._first.forward * SCENE_DISTANCE / self._unit
        self._box = PageBox(self.server, ahead.cpu().numpy() * self._unit)
        generated = scene.add_frame("/generated", show_axes=False)
        show_generated = gui.add_checkbox("Generated", initial_value=True)
        show_generated.on_update(lambda _: setattr(generated, "visible", show_generated.value))
        gui.add_markdown(CONTROLS_HELP)
        self._show("/observed", self.session.latest.context)
        self.show_message(WELCOME)

    def _submit(self, job: Job, event: viser.GuiEvent[Any]) -> None:
        """Queue a request, or refuse it while another runs."""
        client = event.client
        if client is None:  # The browser has closed the page.
            return
        if self._busy.acquire(blocking=False):
            self._requests.put(partial(job, client))
        else:
            client.add_notification("Still busy", BUSY, auto_close_seconds=NOTICE_SECONDS)

    def _set_initial_camera(self, pose: PagePose) -> None:
        rotation = viser.transforms.SO3(pose.wxyz).as_matrix()
        start = self.server.initial_camera
        start.position = pose.position
        start.fov = pose.fov
        start.look_at = pose.position + SCENE_DISTANCE * rotation[:, 2]
        start.up = -rotation[:, 1]

    def _move_browser(self, client: viser.ClientHandle, camera: Camera) -> None:
        pose = camera_to_page(camera, self._unit)
        with client.atomic():
            client.camera.position = pose.position
            client.camera.wxyz = pose.wxyz
            client.camera.fov = pose.fov

    def _change_session(self, session: Session) -> None:
        """Show all parts of a session that differ from the one before."""
        before = self.session.latest
        now = session.latest
        self.session = session
        with self.server.atomic():
            if before.rendered_context is not now.rendered_context:
                self._show("/observed", now.kept_context)
            # A splat is replaced as a whole: the page cannot change one in place.
            if self._generated is not None:
                self._generated.remove()
            self._generated = self._show("/generated/splats", now.added)

    def _show(self, name: str, gaussians: Gaussians) -> Any:
        if len(gaussians) == 0:
            return None
        return self.server.scene.add_gaussian_splats(name, **make_page_splat(gaussians, self._unit))


def compute_page_unit(camera: Camera) -> float:
    """Compute page units per scene unit from a camera with a depth range."""
    assert camera.near is not None
    assert camera.far is not None
    # The geometric mean of near and far is the middle of the range in the images.
    return SCENE_DISTANCE / math.sqrt(camera.near * camera.far)


def camera_to_page(camera: Camera, unit: float) -> PagePose:
    """Convert a scene camera to a page pose."""
    c2w = camera.c2w.detach().cpu().double()
    fov = 2 * math.atan(camera.height / 2 / camera.K[1, 1].item())
    return PagePose(rotations_to_quats(c2w[:3, :3]).numpy(), c2w[:3, 3].numpy() * unit, fov)


def camera_from_page(pose: PagePose, height: int, width: int, unit: float) -> Camera:
    """Convert a page pose to a scene camera with the same vertical field of view."""
    c2w = torch.eye(4, dtype=torch.float64)
    c2w[:3, :3] = quats_to_rotations(torch.from_numpy(np.asarray(pose.wxyz, dtype=np.float64)))
    c2w[:3, 3] = torch.from_numpy(np.asarray(pose.position, dtype=np.float64)) / unit
    focal = height / 2 / math.tan(pose.fov / 2)
    K = torch.tensor([[focal, 0.0, width / 2], [0.0, focal, height / 2], [0.0, 0.0, 1.0]])
    return Camera(c2w.float(), K, width, height)


def make_page_splat(gaussians: Gaussians, unit: float) -> dict[str, Any]:
    """Convert one or more Gaussians for the page, without view-dependent colour.

    The page keeps covariances in float16, in which those of a scene in kilometres would vanish, so
    their unit is the median of the largest scales, and the page scales them back by `scale`.
    """
    gaussians = gaussians.to("cpu")
    size = gaussians.scales.amax(dim=1).median().item()
    axes = quats_to_rotations(gaussians.quats) * (gaussians.scales / size)[:, None, :]
    # The page has no SH beyond the constant one.
    rgbs = (0.5 + SH_C0 * gaussians.sh[:, 0]).clamp(0, 1)
    return {
        "centers": (gaussians.means / size).numpy(),
        "covariances": (axes @ axes.transpose(1, 2)).numpy(),
        "rgbs": rgbs.numpy(),
        "opacities": gaussians.opacities[:, None].clamp(0, 1).numpy(),
        "scale": size * unit,
    }


def run_request(request: Callable[[], str]) -> str:
    """Run a request and return its sentence, or the sentence of its error."""
    try:
        return request()
    except InputError as error:
        return str(error)
    # The page stays open and the scene unchanged.
    except Exception as error:
        traceback.print_exc()
        return f"That failed ({type(error).__name__}: {error}); the scene is unchanged."


def describe_outcome(result: TargetResult, seconds: float) -> str:
    """Describe a completion: one sentence, then one line per note."""
    if not len(result.added) and not result.num_recolored:
        return "\n".join(result.notes or (NOTHING_ADDED,))
    text = (
        f"Completed in {seconds:.1f} s: {len(result.added):,} Gaussians are added in a hole of "
        f"{100 * result.hole_fraction:.1f} % of the image."
    )
    return "\n".join((text, *result.notes))


@dataclass(frozen=True)
class Address:
    """An address of this machine, as the system knows it."""

    family: socket.AddressFamily
    host: str
    """Number of the address, in which all spellings of it are the same."""

    @property
    def is_local(self) -> bool:
        """Return True if only programs of this machine can reach it."""
        # An IPv4 address may be written as IPv6, "::ffff:127.0.0.1"; a zone follows after "%".
        number = ipaddress.ip_address(self.host.partition("%")[0])
        return (getattr(number, "ipv4_mapped", None) or number).is_loopback

    def make_url(self, port: int) -> str:
        """Return the address of a page."""
        host = f"[{self.host}]" if self.family == socket.AF_INET6 else self.host
        return f"http://{host}:{port}/"


def resolve_host(host: str) -> Address:
    """Find the address that a host name stands for, or any spelling of an address."""
    try:
        family, *_, place = socket.getaddrinfo(host, 0, type=socket.SOCK_STREAM)[0]
    except (OSError, UnicodeError) as error:
        reason = getattr(error, "strerror", None) or "no name of a host"
        raise InputError(
            f"'{quote_value(host)}' is no address of this machine ({reason}); name another one, "
            "such as 127.0.0.1.",
            "host",
        ) from error
    return Address(family, str(place[0]))


def start_server(host: str, port: int) -> viser.ViserServer:
    """Start a server, which runs in threads of its own."""
    address = resolve_host(host)
    check_bindable(address, host, port)
    # A message that is no message of the page ends its connection, and is not worth a traceback.
    logging.getLogger("websockets.server").setLevel(logging.CRITICAL)
    with redirect_stdout(StringIO()), refuse_foreign_origins(address):  # viser prints a box
        return viser.ViserServer(address.host, port, verbose=False)


def describe_error(error: OSError) -> str:
    """Return the system's words for an error, without those that Python adds to some."""
    return str(error) if error.errno is None else os.strerror(error.errno)


def check_bindable(address: Address, host: str, port: int) -> None:
    """Raise an InputError if a server cannot listen at an address, which `host` stands for."""
    try:
        socket.create_server((address.host, port), family=address.family).close()
    except OSError as error:
        if error.errno in (errno.EADDRINUSE, errno.EACCES):
            raise InputError(
                f"{quote_value(host)} cannot use port {port} ({describe_error(error)}); choose "
                "another port.",
                "port",
            ) from error
        raise InputError(
            f"{quote_value(host)} is no address of this machine ({describe_error(error)}); name "
            "another one, such as 127.0.0.1.",
            "host",
        ) from error


@contextmanager
def refuse_foreign_origins(address: Address) -> Iterator[None]:
    """Make servers started inside refuse pages of other origins if only this machine reaches them.

    Any page in a browser may connect to this machine; only its `Origin` shows its source.
    websockets can check it, but viser has no option for that. Programs send no origin and may
    connect.
    """
    plain = websockets.serve
    if address.is_local:
        websockets.serve = partial(plain, origins=[LOCAL_ORIGIN, None])  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        websockets.serve = plain  # type: ignore[misc]
