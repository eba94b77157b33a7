"""The page of a live session: the scene in the browser, and its buttons."""

from __future__ import annotations

import html
import time
import traceback
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from functools import partial
from io import StringIO
from queue import SimpleQueue
from threading import Lock
from typing import Any

import numpy as np
import viser

from gscompleter.apps.live.poses import (
    SCENE_DISTANCE,
    PagePose,
    camera_from_page,
    camera_to_page,
    compute_page_unit,
)
from gscompleter.apps.live.serving import start_server
from gscompleter.apps.live.session import Session, complete_camera, undo_step
from gscompleter.apps.live.splat import make_page_splat
from gscompleter.errors import InputError
from gscompleter.geometry import compute_spacing, estimate_up
from gscompleter.progress import notify_of_stages
from gscompleter.state import NOTHING_ADDED, Completion, TargetResult
from gscompleter.timing import STAGES
from gscompleter.types import Camera, Gaussians, View

MAX_FRUSTUM_LENGTH, MAX_SPACING_FRACTION = 0.1, 0.2
"""Largest length of a camera pyramid, in page units and as a fraction of camera spacing."""
CLEARANCE_LENGTHS = 6.0
"""Photographs nearer than this many pyramid lengths are hidden; they would cover the scene."""
PHOTOGRAPH_COLOR, TARGET_COLOR = (150, 150, 150), (80, 220, 120)
NOTICE_SECONDS = 4.0

WELCOME = "Fly to a hole in the scene, then press “Complete what I see”."
BUSY = "The last request is still running; press the button again when it is done."
NO_HOLE = "No large hole is left around the photographs."
CONTROLS_HELP = (
    "Drag to rotate, drag with the right button to move, scroll to zoom, fly with W A S D Q E. "
    "Click a photograph to go to its camera."
)

Job = Callable[[viser.ClientHandle, PagePose], str]
"""Action of a button: takes the browser and its camera, returns a sentence for the page."""


@dataclass(frozen=True)
class PageServices:
    """Everything a page needs besides its address."""

    session: Session
    photographs: Sequence[View]
    """Small images, with their cameras in the frame of the result."""
    find_hole: Callable[[Completion], Camera | None]
    """Returns the camera with the most to gain, or None."""
    save: Callable[[Session], str]


class Page:
    """A session in all browsers that have the page open.

    Requests arrive in threads of the server. `handle_requests` runs them one at a time; a request
    that arrives meanwhile is refused.
    """

    def __init__(self, subject: PageServices, host: str, port: int) -> None:
        self.subject, self.session = subject, subject.session
        self.server = start_server(host, port)
        self._first = subject.session.initial.views[0].camera
        self._unit = compute_page_unit(self._first)
        self._length = compute_frustum_length(subject.photographs, self._unit)
        self._requests: SimpleQueue[Callable[[], str]] = SimpleQueue()
        self._busy, self._generated_lock = Lock(), Lock()
        self._generated: Any = None
        self._photographs: list[Any] = []
        self._targets: list[Any] = []
        self._build_page()

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
        with notify_of_stages(lambda stage: self.show_message(format_progress(stage))):
            self.session, result = complete_camera(before, camera)
        self._show_changes(before)
        return describe_outcome(result, time.perf_counter() - start)

    def find(self, client: viser.ClientHandle, seen: PagePose) -> str:
        """Move a browser to the camera with the most to gain."""
        self.show_message("Searching for a hole …")
        camera = self.subject.find_hole(self.session.latest)
        if camera is None:
            return NO_HOLE
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
        return self.subject.save(self.session)

    def show_message(self, text: str) -> None:
        """Show a text on the page, its first line in bold."""
        first, *others = (html.escape(line) for line in text.splitlines())
        self._status.content = (
            '<div role="status" style="padding: 0.5em 1em">'
            f"{'<br>'.join((f'<b>{first}</b>', *others))}</div>"
        )

    def _build_page(self) -> None:
        scene, gui = self.server.scene, self.server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        gui.set_panel_label("gscompleter live")
        scene.set_up_direction(estimate_up([v.camera for v in self.subject.photographs]).numpy())
        self._set_initial_camera(camera_to_page(self._first, self._unit))
        self._status = gui.add_html("")
        self._add_buttons()
        self._show("/observed", self.session.latest.context, tinted=False)
        self._show_photographs()
        self.show_message(WELCOME)

    def _add_buttons(self) -> None:
        gui = self.server.gui
        for label, job in (
            ("Complete what I see", self.complete),
            ("Find a hole", self.find),
            ("Undo", self.undo),
            ("Save", self.save),
        ):
            gui.add_button(label).on_click(partial(self._submit, job))
        self._generated_mode = gui.add_dropdown("Generated", ("show", "tint", "hide"))
        self._generated_mode.on_update(lambda _: self._show_generated())
        cameras = gui.add_checkbox("Cameras", initial_value=True)
        cameras.on_update(lambda _: self._show_cameras(cameras.value))
        gui.add_markdown(CONTROLS_HELP)

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
        for frustum in self._photographs:
            apart = np.linalg.norm(frustum.position - pose.position)
            frustum.visible = bool(apart > CLEARANCE_LENGTHS * self._length)

    def _show_changes(self, before: Session) -> None:
        """Show all parts of the session that differ from `before`."""
        with self.server.atomic():
            now = self.session.latest
            if before.latest.parts[0] is not now.parts[0]:
                self._show("/observed", now.recolored_context, tinted=False)
            self._show_generated()
            for frustum in self._targets:
                frustum.remove()
            cameras = [step.completion.targets[-1].target for step in self.session.steps]
            self._targets = [
                self._add_frustum(f"/cameras/target {number}", camera, TARGET_COLOR)
                for number, camera in enumerate(cameras, start=1)
            ]

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
        splat = make_page_splat(gaussians, tinted)
        return self.server.scene.add_gaussian_splats(
            name,
            splat.centers,
            splat.covariances,
            splat.rgbs,
            splat.opacities,
            scale=splat.size * self._unit,
        )

    def _show_photographs(self) -> None:
        self._cameras = self.server.scene.add_frame("/cameras", show_axes=False)
        for number, view in enumerate(self.subject.photographs):
            frustum = self._add_frustum(
                f"/cameras/photograph {number}", view.camera, PHOTOGRAPH_COLOR, view
            )
            pose = camera_to_page(view.camera, self._unit)
            frustum.on_click(lambda event, pose=pose: self._move_browser(event.client, pose))
            self._photographs.append(frustum)
        self._hide_near_photographs(camera_to_page(self._first, self._unit))

    def _show_cameras(self, visible: bool) -> None:
        self._cameras.visible = visible

    def _add_frustum(
        self, name: str, camera: Camera, color: tuple[int, int, int], view: View | None = None
    ) -> Any:
        pose = camera_to_page(camera, self._unit)
        image = None if view is None else (255 * view.image.clamp(0, 1)).byte().cpu().numpy()
        return self.server.scene.add_camera_frustum(
            name,
            pose.fov,
            camera.width / camera.height,
            scale=self._length,
            thickness=1.5,
            thickness_units="screen",
            color=color,
            image=image,
            wxyz=pose.wxyz,
            position=pose.position,
        )


def compute_frustum_length(photographs: Sequence[View], unit: float) -> float:
    """Compute the length of camera pyramids, in page units."""
    apart = compute_spacing([view.camera for view in photographs]) * unit
    return (
        min(MAX_FRUSTUM_LENGTH, MAX_SPACING_FRACTION * apart) if apart > 0 else MAX_FRUSTUM_LENGTH
    )


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


def format_progress(stage: str) -> str:
    """Format the progress line with the current stage in brackets."""
    return "Completing …\n" + " → ".join(f"[{s}]" if s == stage else s for s in STAGES)


def describe_outcome(result: TargetResult, seconds: float) -> str:
    """Describe a completion: one sentence, then one line per note."""
    if not len(result.added) and not result.num_recolored:
        return "\n".join(result.notes or (NOTHING_ADDED,))
    text = (
        f"Completed in {seconds:.1f} s: {len(result.added):,} Gaussians are added in a hole of "
        f"{100 * result.hole_fraction:.1f} % of the image."
    )
    return "\n".join((text, *result.notes))
