"""The page of a live session: the scene in the browser, and its buttons."""

from __future__ import annotations

import html
import re
import socket
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, redirect_stdout
from functools import partial
from io import StringIO
from queue import SimpleQueue
from threading import Lock
from typing import Any

import numpy as np
import viser
from websockets.asyncio import server as websockets

from gscompleter.apps.live.conversion import (
    SCENE_DISTANCE,
    PagePose,
    camera_from_page,
    camera_to_page,
    compute_page_unit,
    make_page_splat,
)
from gscompleter.apps.live.session import Session, complete_camera, undo_step
from gscompleter.errors import InputError
from gscompleter.geometry import compute_spacing, estimate_up
from gscompleter.progress import notify_of_stages
from gscompleter.state import NOTHING_ADDED, Completion, TargetResult
from gscompleter.types import Camera, Gaussians, View

LOCAL_HOSTS = ("127.0.0.1", "localhost")
LOCAL_ORIGIN = re.compile(r"http://(127\.0\.0\.1|localhost)(:\d+)?")
MAX_FRUSTUM_LENGTH, MAX_SPACING_FRACTION = 0.1, 0.2
"""Largest length of a camera pyramid, in page units and as a fraction of camera spacing."""
CLEARANCE_LENGTHS = 6.0
"""Photographs nearer than this many pyramid lengths are hidden; they would cover the scene."""
NOTICE_SECONDS = 4.0

WELCOME = "Fly to a hole in the scene, then press “Complete what I see”."
BUSY = "The last request is still running; press the button again when it is done."
CONTROLS_HELP = (
    "Drag to rotate, drag with the right button to move, scroll to zoom, fly with W A S D Q E. "
    "Click a photograph to go to its camera."
)

Job = Callable[[viser.ClientHandle, PagePose], str]
"""Action of a button: takes the browser and its camera, returns a sentence for the page."""


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
    ) -> None:
        """Build the page; `find_hole` finds the camera with the most to gain, if there is one."""
        self.session, self.server = session, server
        self._find_hole, self._save = find_hole, save
        self._photographs = session.initial.views
        self._first = self._photographs[0].camera
        self._unit = compute_page_unit(self._first)
        self._length = compute_frustum_length(self._photographs, self._unit)
        self._requests: SimpleQueue[Callable[[], str]] = SimpleQueue()
        self._busy, self._generated_lock = Lock(), Lock()
        self._generated: Any = None
        self._frustums: list[viser.CameraFrustumHandle] = []
        self._build()

    def handle_requests(self) -> None:
        """Run requests until the process is interrupted."""
        while True:
            request = self._requests.get()
            try:
                self.show_message(run_request(request))
            finally:
                self._busy.release()

    def close(self) -> None:
        """Stop the server."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def complete(self, client: viser.ClientHandle, seen: PagePose) -> str:
        """Complete the scene for the camera of a browser."""
        start = time.perf_counter()
        camera = camera_from_page(seen, self._first.height, self._first.width, self._unit)
        before = self.session
        with notify_of_stages(lambda stage: self.show_message(f"Completing: {stage} …")):
            self.session, result = complete_camera(before, camera)
        self._show_changes(before)
        return describe_outcome(result, time.perf_counter() - start)

    def find(self, client: viser.ClientHandle, seen: PagePose) -> str:
        """Move a browser to the camera with the most to gain."""
        self.show_message("Searching for a hole …")
        camera = self._find_hole(self.session.latest)
        if camera is None:
            return "No large hole is left around the photographs."
        self._move_browser(client, camera_to_page(camera, self._unit))
        return "The scene has a hole here; press “Complete what I see”."

    def undo(self, client: viser.ClientHandle, seen: PagePose) -> str:
        """Undo the last step."""
        before = self.session
        self.session = undo_step(before)
        self._show_changes(before)
        left = len(self.session.steps)
        return f"Undone: {left} {'completion is' if left == 1 else 'completions are'} left."

    def save(self, client: viser.ClientHandle, seen: PagePose) -> str:
        """Write the completed scene."""
        self.show_message("Saving …")
        return self._save(self.session)

    def show_message(self, text: str) -> None:
        """Show a text on the page."""
        lines = "<br>".join(html.escape(line) for line in text.splitlines())
        self._status.content = f'<div role="status" style="padding: 0.5em 1em">{lines}</div>'

    def _build(self) -> None:
        scene, gui = self.server.scene, self.server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        gui.set_panel_label("gscompleter live")
        scene.set_up_direction(estimate_up([view.camera for view in self._photographs]).numpy())
        self._set_initial_camera(camera_to_page(self._first, self._unit))
        self._status = gui.add_html("")
        for label, job in (
            ("Complete what I see", self.complete),
            ("Find a hole", self.find),
            ("Undo", self.undo),
            ("Save", self.save),
        ):
            gui.add_button(label).on_click(partial(self._submit, job))
        self._generated_mode = gui.add_dropdown("Generated", ("show", "tint", "hide"))
        self._generated_mode.on_update(lambda _: self._show_generated())
        cameras = scene.add_frame("/cameras", show_axes=False)
        show_cameras = gui.add_checkbox("Cameras", initial_value=True)
        show_cameras.on_update(lambda _: setattr(cameras, "visible", show_cameras.value))
        gui.add_markdown(CONTROLS_HELP)
        self._show("/observed", self.session.latest.context, tinted=False)
        self._show_photographs()
        self.show_message(WELCOME)

    def _submit(self, job: Job, event: viser.GuiEvent[Any]) -> None:
        """Queue a request, or refuse it while another runs."""
        client = event.client
        if client is None:  # The browser has closed the page.
            return
        seen = PagePose(client.camera.wxyz, client.camera.position, client.camera.fov)
        if self._busy.acquire(blocking=False):
            self._requests.put(partial(job, client, seen))
        else:
            client.add_notification("Still busy", BUSY, auto_close_seconds=NOTICE_SECONDS)

    def _set_initial_camera(self, pose: PagePose) -> None:
        rotation = viser.transforms.SO3(pose.wxyz).as_matrix()
        start = self.server.initial_camera
        start.position, start.fov = pose.position, pose.fov
        start.look_at, start.up = pose.position + SCENE_DISTANCE * rotation[:, 2], -rotation[:, 1]

    def _move_browser(self, client: viser.ClientHandle, pose: PagePose) -> None:
        self._hide_near_photographs(pose)
        with client.atomic():
            client.camera.position, client.camera.wxyz = pose.position, pose.wxyz
            client.camera.fov = pose.fov

    def _hide_near_photographs(self, pose: PagePose) -> None:
        """Hide the photographs near a pose and show all others."""
        for frustum in self._frustums:
            apart = np.linalg.norm(frustum.position - pose.position)
            frustum.visible = bool(apart > CLEARANCE_LENGTHS * self._length)

    def _show_changes(self, before: Session) -> None:
        """Show all parts of the session that differ from `before`."""
        with self.server.atomic():
            now = self.session.latest
            if before.latest.parts[0] is not now.parts[0]:
                self._show("/observed", now.recolored_context, tinted=False)
            self._show_generated()

    def _show_generated(self) -> None:
        with self._generated_lock:
            added, look = self.session.latest.added, self._generated_mode.value
            if self._generated is not None:
                self._generated.remove()
            shown = len(added) and look != "hide"
            self._generated = self._show("/generated", added, look == "tint") if shown else None

    def _show(self, name: str, gaussians: Gaussians, tinted: bool) -> Any:
        if len(gaussians) == 0:
            return None
        splat = make_page_splat(gaussians, self._unit, tinted)
        return self.server.scene.add_gaussian_splats(name, **splat)

    def _show_photographs(self) -> None:
        for number, view in enumerate(self._photographs):
            pose = camera_to_page(view.camera, self._unit)
            frustum = self.server.scene.add_camera_frustum(
                f"/cameras/photograph {number}",
                pose.fov,
                view.camera.width / view.camera.height,
                scale=self._length,
                thickness=1.5,
                thickness_units="screen",
                color=(150, 150, 150),
                image=(255 * view.image.clamp(0, 1)).byte().cpu().numpy(),
                wxyz=pose.wxyz,
                position=pose.position,
            )
            frustum.on_click(lambda event, pose=pose: self._move_browser(event.client, pose))
            self._frustums.append(frustum)
        self._hide_near_photographs(camera_to_page(self._first, self._unit))


def compute_frustum_length(photographs: Sequence[View], unit: float) -> float:
    """Compute the length of camera pyramids, in page units."""
    apart = compute_spacing([view.camera for view in photographs]) * unit
    if apart == 0:
        return MAX_FRUSTUM_LENGTH
    return min(MAX_FRUSTUM_LENGTH, MAX_SPACING_FRACTION * apart)


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


def start_server(host: str, port: int) -> viser.ViserServer:
    """Start a server, which runs in threads of its own."""
    try:
        socket.create_server((host, port)).close()
    except OSError as error:
        raise InputError(
            f"{host} cannot use port {port} ({error.strerror}); choose another port.",
            "port",
        ) from error
    with redirect_stdout(StringIO()), refuse_foreign_origins(host):  # viser prints a box
        return viser.ViserServer(host, port, verbose=False)


@contextmanager
def refuse_foreign_origins(host: str) -> Iterator[None]:
    """Make servers started inside refuse pages of other origins if `host` is this machine.

    Any page in a browser may connect to this machine; only its `Origin` shows its source.
    websockets can check it, but viser has no option for that. Programs send no origin and may
    connect.
    """
    plain = websockets.serve
    if host in LOCAL_HOSTS:
        websockets.serve = partial(plain, origins=[LOCAL_ORIGIN, None])  # type: ignore[misc, assignment]
    try:
        yield
    finally:
        websockets.serve = plain  # type: ignore[misc]
