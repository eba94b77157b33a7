"""The page of a live session: what its buttons do, one request at a time."""

from __future__ import annotations

import json
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from queue import SimpleQueue
from threading import Lock
from typing import Any

import numpy as np

from gscompleter.apps.live.channel import Channel
from gscompleter.apps.live.difference import PageScene
from gscompleter.apps.live.journal import Journal
from gscompleter.apps.live.request import BusyError, PageRequest, parse_request
from gscompleter.apps.live.session import (
    PERFORM,
    Session,
    SessionStep,
    apply_step,
    redo_step,
    save_camera,
    undo_step,
)
from gscompleter.data.scene import describe_camera
from gscompleter.system.errors import InputError
from gscompleter.system.progress import notify_of_stages
from gscompleter.types import Camera

GOES_ON = "{} steps of the session are done again; go on, or undo them."
GOES_ON_ONE = "1 step of the session is done again; go on, or undo it."
ALL_UNDONE = "All steps are undone: there is nothing to save, and the last Save stays as it is."
NOT_KEPT = "This step is not kept on the disk: {}"
WELCOME = "Fly to a hole and press “Complete here”, or paint over what is wrong and press “Repair”."
BUSY = "The last request is still running; press the button again when it is done."
NO_HOLE = "No large hole is left around the cameras."
NAMES = {
    "complete": "Completing",
    "fill": "Filling",
    "remove": "Removing",
    "repair": "Repairing",
    "undo": "Undoing",
    "redo": "Redoing",
    "find": "Searching for a hole",
    "save": "Saving",
}
"""Word for each action while it runs."""
FOUND_HOLE = "The scene has a hole here; press “Complete here”."


@dataclass(frozen=True)
class Outcome:
    """Tell what a request did."""

    text: str
    camera: Camera | None = None
    """Camera to go to, in the frame of the result; None to stay."""


FindHole = Callable[[Session], Camera | None]
Save = Callable[[Session], str]


class LivePage:
    """A session in all browsers that have the page open.

    Requests arrive in threads of the server. `handle_requests` runs them one at a time; a request
    that arrives meanwhile is refused.
    """

    def __init__(
        self,
        session: Session,
        content: bytes,
        scene: PageScene,
        find_hole: FindHole,
        save: Save,
        journal: Journal,
    ) -> None:
        """Begin with the page as it is first shown; `find_hole` finds the most to gain, if any.

        `journal` keeps each step as it is done.
        """
        self.session = session
        self.content = content
        self.channel = Channel()
        self._scene = scene
        self._find_hole = find_hole
        self._save = save
        self._journal = journal
        self._requests: SimpleQueue[PageRequest] = SimpleQueue()
        self._busy = Lock()
        # Revision 0 is the scene as it was given, which a page holds. What a session begins with
        # may be another one, also without steps: photographs add to a splat and recolour it.
        self._revision = 1
        self._actions: dict[str, Callable[[PageRequest], Outcome]] = {
            **dict.fromkeys(PERFORM, self.do_step),
            "undo": self.undo,
            "redo": self.redo,
            "find": self.find,
            "save": self.save,
        }
        self._describe_scene()
        count = len(session.steps)
        greetings = {0: WELCOME, 1: GOES_ON_ONE}
        self.tell(greetings.get(count, GOES_ON.format(count)), is_busy=False)

    def get_chunk(self, name: str) -> bytes | None:
        """Return Gaussians that a step brought, as .spz; None if there is no such chunk."""
        return self._scene.get_chunk(name)

    def submit(self, body: bytes) -> None:
        """Queue a request; raise BusyError while another one runs, or InputError."""
        request = parse_request(body, tuple(self._actions))
        if not self._busy.acquire(blocking=False):
            raise BusyError(BUSY)
        self._requests.put(request)

    def handle_requests(self) -> None:
        """Run requests until the process is interrupted."""
        while True:
            # Threads of the server hand their requests over; all work is done in this one.
            self.handle(self._requests.get())

    def handle(self, request: PageRequest) -> None:
        """Run one request, and tell all browsers what came of it."""
        name = NAMES[request.action]
        self.tell(f"{name} …")
        try:
            with notify_of_stages(lambda stage: self.tell(f"{name}: {stage} …")):
                outcome = run_page_request(lambda: self._actions[request.action](request))
        finally:
            self._busy.release()
        self.tell(outcome.text, False, outcome.camera, request.client)

    def do_step(self, request: PageRequest) -> Outcome:
        """Complete, fill, remove or repair at the camera of a page."""
        request.check_box()
        box = request.box
        if box is not None:
            # The page counts from the origin of the result, a step from that of the splat's file.
            origin = self.session.splat_origin
            box = tuple((np.array(box) + np.tile(origin, 2)).tolist())
        camera = save_camera(self.session, request.read_camera())
        action: Any = request.action  # one of `PERFORM`
        step = SessionStep(action, camera, request.read_mask(), box, request.box_rotation)
        session, text = apply_step(self.session, step)
        return Outcome(self._change_session(session, text))

    def undo(self, request: PageRequest) -> Outcome:
        """Take the last step back."""
        session = undo_step(self.session)
        text = f"Undone. Steps left: {len(session.steps)}."
        return Outcome(self._change_session(session, text))

    def redo(self, request: PageRequest) -> Outcome:
        """Do the last step that was undone again."""
        session = redo_step(self.session)
        text = f"Done again. Steps: {len(session.steps)}."
        return Outcome(self._change_session(session, text))

    def find(self, request: PageRequest) -> Outcome:
        """Find the camera with the most to gain, for the page that asks."""
        camera = self._find_hole(self.session)
        return Outcome(NO_HOLE) if camera is None else Outcome(FOUND_HOLE, camera)

    def save(self, request: PageRequest) -> Outcome:
        """Write the completed scene."""
        if not self.session.steps and self._journal.has_saved:
            raise InputError(ALL_UNDONE)
        try:
            text = self._save(self.session)
        except KeyboardInterrupt as stop:
            # With a message it came after the result was complete (`defer_interrupts`).
            if stop.args:
                self._journal.set_saved(self.session)
            raise
        self._journal.set_saved(self.session)
        return Outcome(text)

    def tell(
        self, text: str, is_busy: bool = True, camera: Camera | None = None, client: str = ""
    ) -> None:
        """Show a text on all pages, and where the session is; only `client` goes to `camera`."""
        self.channel.send(
            {
                "text": text,
                "busy": is_busy,
                "revision": self._revision,
                "steps": len(self.session.steps),
                "undone": len(self.session.undone),
                "saved": self._journal.is_saved(self.session),
                "camera": None if camera is None else describe_camera(camera),
                "client": client,
            }
        )

    def _change_session(self, session: Session, text: str) -> str:
        """Show and keep a session; return the text on it, with what went wrong on the disk."""
        if session is self.session:
            return text
        if session.latest is not self.session.latest:
            self._revision += 1
        self.session = session
        self._describe_scene()
        try:
            self._journal.write(session)
        except InputError as error:
            return f"{text}\n{NOT_KEPT.format(error)}"
        return text

    def _describe_scene(self) -> None:
        difference = self._scene.describe(self.session.latest)
        self.difference = json.dumps({"revision": self._revision, **difference}).encode()


def run_page_request(request: Callable[[], Outcome]) -> Outcome:
    """Run a request and return what came of it, or the sentence of its error."""
    try:
        return request()
    except InputError as error:
        return Outcome(str(error))
    # The page stays open and the scene unchanged.
    except Exception as error:
        traceback.print_exc()
        # The words of libraries may name files.
        return Outcome(
            f"That failed ({type(error).__name__}, see the terminal); the scene is unchanged."
        )
