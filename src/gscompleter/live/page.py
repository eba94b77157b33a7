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

from gscompleter.completer import NOTHING_ADDED, STAGES
from gscompleter.errors import InputError
from gscompleter.live.poses import DISTANCE, Pose, camera_of, pose_of, unit_of
from gscompleter.live.serving import serving
from gscompleter.live.session import Session, completed, undone
from gscompleter.live.splat import splat_of
from gscompleter.progress import stages_heard_by
from gscompleter.stages.candidates import spacing, upward
from gscompleter.types import Camera, Completion, Gaussians, TargetCompletion, View

FRUSTUM, SHARE_OF_STEP = 0.1, 0.2
"""Largest length of a camera pyramid, in page units and as a fraction of camera spacing."""
CLEARANCE = 6.0
"""Photographs nearer than this many pyramid lengths are hidden; they would cover the scene."""
GREY, GREEN = (150, 150, 150), (80, 220, 120)
NOTICE = 4.0

WELCOME = "Fly to a hole in the scene, then press “Complete what I see”."
BUSY = "The last request is still running; press the button again when it is done."
NO_HOLE = "No large hole is left around the photographs."
FLYING = (
    "Drag to rotate, drag with the right button to move, scroll to zoom, fly with W A S D Q E. "
    "Click a photograph to go to its camera."
)

Job = Callable[[viser.ClientHandle, Pose], str]
"""Action of a button: takes the browser and its camera, returns a sentence for the page."""


@dataclass(frozen=True)
class Subject:
    """Everything a page needs besides its address."""

    session: Session
    photographs: Sequence[View]
    """Small images, with their cameras in the frame of the result."""
    find: Callable[[Completion], Camera | None]
    """Returns the camera with the most to gain, or None."""
    save: Callable[[Session], str]


class Page:
    """A session in all browsers that have the page open.

    Requests arrive in threads of the server. `handle_requests` runs them one at a time; a request
    that arrives meanwhile is refused.
    """

    def __init__(self, subject: Subject, host: str, port: int) -> None:
        self.subject, self.session = subject, subject.session
        self.server = serving(host, port)
        self._first = subject.session.begun.views[0].camera
        self._unit = unit_of(self._first)
        self._length = frustum_length(subject.photographs, self._unit)
        self._requests: SimpleQueue[Callable[[], str]] = SimpleQueue()
        self._busy, self._drawing = Lock(), Lock()
        self._generated: Any = None
        self._photographs: list[Any] = []
        self._targets: list[Any] = []
        self._open()

    def work(self) -> None:
        """Run requests until the process is interrupted."""
        while True:
            request = self._requests.get()
            try:
                self.say(answer(request))
            finally:
                self._busy.release()

    def close(self) -> None:
        """Stop the server."""
        with redirect_stdout(StringIO()):
            self.server.stop()

    def complete(self, client: viser.ClientHandle, seen: Pose) -> str:
        """Complete the scene for the camera of a browser."""
        start = time.perf_counter()
        camera = camera_of(seen, self._first.height, self._first.width, self._unit)
        before = self.session
        with stages_heard_by(lambda stage: self.say(stages_at(stage))):
            self.session, result = completed(before, camera)
        self._draw(before)
        return outcome(result, time.perf_counter() - start)

    def find(self, client: viser.ClientHandle, seen: Pose) -> str:
        """Move a browser to the camera with the most to gain."""
        self.say("Searching for a hole …")
        camera = self.subject.find(self.session.now)
        if camera is None:
            return NO_HOLE
        self._jump(client, pose_of(camera, self._unit))
        return "The scene has a hole here; press “Complete what I see”."

    def undo(self, client: viser.ClientHandle, seen: Pose) -> str:
        """Undo the last step."""
        before = self.session
        self.session = undone(before)
        self._draw(before)
        left = len(self.session.steps)
        return f"Undone: {left} {'completion is' if left == 1 else 'completions are'} left."

    def save(self, client: viser.ClientHandle, seen: Pose) -> str:
        """Write the completed scene."""
        self.say("Saving …")
        return self.subject.save(self.session)

    def say(self, text: str) -> None:
        """Show a text on the page, its first line in bold."""
        first, *others = (html.escape(line) for line in text.splitlines())
        self._status.content = (
            '<div role="status" style="padding: 0.5em 1em">'
            f"{'<br>'.join((f'<b>{first}</b>', *others))}</div>"
        )

    def _open(self) -> None:
        scene, gui = self.server.scene, self.server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        gui.set_panel_label("gscompleter live")
        scene.set_up_direction(upward([v.camera for v in self.subject.photographs]).numpy())
        self._stand_at(pose_of(self._first, self._unit))
        self._status = gui.add_html("")
        self._add_buttons()
        self._show("/observed", self.session.now.context, tinted=False)
        self._show_photographs()
        self.say(WELCOME)

    def _add_buttons(self) -> None:
        gui = self.server.gui
        for label, job in (
            ("Complete what I see", self.complete),
            ("Find a hole", self.find),
            ("Undo", self.undo),
            ("Save", self.save),
        ):
            gui.add_button(label).on_click(partial(self._ask, job))
        self._look = gui.add_dropdown("Generated", ("show", "tint", "hide"))
        self._look.on_update(lambda _: self._show_generated())
        cameras = gui.add_checkbox("Cameras", initial_value=True)
        cameras.on_update(lambda _: self._show_cameras(cameras.value))
        gui.add_markdown(FLYING)

    def _ask(self, job: Job, event: viser.GuiEvent[Any]) -> None:
        """Queue a request, or refuse it while another runs."""
        client = event.client
        if client is None:  # The browser has closed the page.
            return
        seen = Pose(client.camera.wxyz, client.camera.position, client.camera.fov)
        if self._busy.acquire(blocking=False):
            self._requests.put(partial(job, client, seen))
        else:
            client.add_notification("Still busy", BUSY, auto_close_seconds=NOTICE)

    def _stand_at(self, pose: Pose) -> None:
        rotation = viser.transforms.SO3(pose.wxyz).as_matrix()
        start = self.server.initial_camera
        start.position, start.fov = pose.position, pose.fov
        start.look_at, start.up = pose.position + DISTANCE * rotation[:, 2], -rotation[:, 1]

    def _jump(self, client: viser.ClientHandle, pose: Pose) -> None:
        self._make_way(pose)
        with client.atomic():
            client.camera.position, client.camera.wxyz = pose.position, pose.wxyz
            client.camera.fov = pose.fov

    def _make_way(self, pose: Pose) -> None:
        """Hide the photographs near a pose and show all others."""
        for frustum in self._photographs:
            apart = np.linalg.norm(frustum.position - pose.position)
            frustum.visible = bool(apart > CLEARANCE * self._length)

    def _draw(self, before: Session) -> None:
        """Show all parts of the session that differ from `before`."""
        with self.server.atomic():
            now = self.session.now
            if before.now.num_kept != now.num_kept:
                self._show("/observed", now.observed, tinted=False)
            self._show_generated()
            for frustum in self._targets:
                frustum.remove()
            cameras = [step.completion.targets[-1].target for step in self.session.steps]
            self._targets = [
                self._frustum(f"/cameras/target {number}", camera, GREEN)
                for number, camera in enumerate(cameras, start=1)
            ]

    def _show_generated(self) -> None:
        with self._drawing:
            added, look = self.session.now.added, self._look.value
            if self._generated is not None:
                self._generated.remove()
            shown = len(added) and look != "hide"
            self._generated = self._show("/generated", added, look == "tint") if shown else None

    def _show(self, name: str, gaussians: Gaussians, tinted: bool) -> Any:
        if len(gaussians) == 0:
            return None
        splat = splat_of(gaussians, tinted)
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
            frustum = self._frustum(f"/cameras/photograph {number}", view.camera, GREY, view)
            pose = pose_of(view.camera, self._unit)
            frustum.on_click(lambda event, pose=pose: self._jump(event.client, pose))
            self._photographs.append(frustum)
        self._make_way(pose_of(self._first, self._unit))

    def _show_cameras(self, visible: bool) -> None:
        self._cameras.visible = visible

    def _frustum(
        self, name: str, camera: Camera, color: tuple[int, int, int], view: View | None = None
    ) -> Any:
        pose = pose_of(camera, self._unit)
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


def frustum_length(photographs: Sequence[View], unit: float) -> float:
    """Compute the length of camera pyramids, in page units."""
    apart = spacing([view.camera for view in photographs]) * unit
    return min(FRUSTUM, SHARE_OF_STEP * apart) if apart > 0 else FRUSTUM


def answer(request: Callable[[], str]) -> str:
    """Run a request and return its sentence, or the sentence of its error."""
    try:
        return request()
    except InputError as error:
        return str(error)
    # The page stays open and the scene unchanged.
    except Exception as error:
        traceback.print_exc()
        return f"That failed ({type(error).__name__}: {error}); the scene is unchanged."


def stages_at(stage: str) -> str:
    """Format the progress line with the current stage in brackets."""
    return "Completing …\n" + " → ".join(f"[{s}]" if s == stage else s for s in STAGES)


def outcome(result: TargetCompletion, seconds: float) -> str:
    """Describe a completion: one sentence, then one line per note."""
    if not len(result.added):
        return "\n".join(result.notes or (NOTHING_ADDED,))
    text = (
        f"Completed in {seconds:.1f} s: {len(result.added):,} Gaussians are added in a hole of "
        f"{100 * result.hole_fraction:.1f} % of the image."
    )
    return "\n".join((text, *result.notes))
