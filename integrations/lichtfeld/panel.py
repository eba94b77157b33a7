"""The panel of the plug-in: two buttons, what they work with, and how far they are."""

from __future__ import annotations

import traceback

import lichtfeld as lf

from .job import Job, find_command, is_missing
from .scene import HealError
from .session import Request, Sent, Session, find_photographs


class State:
    """Hold the fields and the state of the panel, beside it: the program may make panels anew."""

    def __init__(self) -> None:
        self.session = Session()
        self.command = find_command()
        self.photographs = ""
        self.uses_photographs = True
        self.sees_from_here = True
        self.message = ""
        self.is_error = False
        self.job: Job | None = None
        self.sent: Sent | None = None


STATE = State()


class HealPanel(lf.ui.Panel):
    """Repair or remove what is selected."""

    id = "gscompleter_heal.panel"
    label = "gscompleter"
    space = lf.ui.PanelSpace.MAIN_PANEL_TAB
    order = 220
    height_mode = lf.ui.PanelHeightMode.CONTENT
    update_interval_ms = 200

    @classmethod
    def poll(cls, context: object) -> bool:
        """Show the panel once a scene is loaded."""
        return lf.has_scene()

    def on_update(self, doc: object) -> bool:
        """Take a result that is ready; returns True to draw anew while something runs."""
        had_job = STATE.job is not None
        finish()
        return had_job

    def draw(self, ui: object) -> None:
        """Draw the panel, and do what its buttons ask for."""
        ui.heading("Heal what is selected")
        _, STATE.command = ui.input_text("gscompleter", STATE.command)
        ui.set_tooltip("The command: a path, or words such as: python -m gscompleter")
        _, STATE.uses_photographs = ui.checkbox("Use photographs", STATE.uses_photographs)
        if STATE.uses_photographs:
            STATE.photographs = STATE.photographs or find_photographs()
            _, STATE.photographs = ui.path_input("Photographs", STATE.photographs)
        _, STATE.sees_from_here = ui.checkbox("Fill as seen from here", STATE.sees_from_here)
        ui.set_tooltip("Off, 'Remove' finds cameras around the place; 'Repair' is always from here")
        if STATE.job is None:
            if ui.button_styled("Repair", "primary"):
                start("repair")
            ui.same_line()
            if ui.button("Remove"):
                start("remove")
        else:
            ui.text_wrapped(f"{STATE.job.line} ({STATE.job.seconds} s)")
            if ui.button("Cancel"):
                STATE.job.cancel()
        if STATE.message:
            color = (1.0, 0.4, 0.3, 1.0) if STATE.is_error else (0.4, 0.9, 0.5, 1.0)
            ui.text_colored("Not done" if STATE.is_error else "Done", color)
            ui.text_wrapped(STATE.message)

    @staticmethod
    def stop() -> None:
        """End a command that runs."""
        if STATE.job is not None:
            STATE.job.cancel()


def start(command: str) -> None:
    """Send what is selected, and start gscompleter; whatever is wrong becomes the message."""
    STATE.message = ""
    try:
        if is_missing(STATE.command):
            raise HealError(
                "gscompleter was not found; install it (pip install gscompleter) and name its "
                "command above."
            )
        photographs = STATE.photographs if STATE.uses_photographs else ""
        sent = STATE.session.send(Request(command, photographs, STATE.sees_from_here))
        STATE.job = Job(STATE.command, list(sent.words))
        STATE.sent = sent
    except (HealError, OSError) as error:
        tell(str(error), is_error=True)


def finish() -> None:
    """Show the result of a command that has ended; on the thread of the interface."""
    job, sent = STATE.job, STATE.sent
    if job is None or sent is None or job.is_running():
        return
    STATE.job = STATE.sent = None
    error = job.get_error()
    if error:
        tell(error, is_error=True)
        return
    try:
        name = STATE.session.receive(sent)
    except HealError as wrong:
        tell(str(wrong), is_error=True)
    except Exception as unexpected:  # the program would only log it, and the panel stay silent
        lf.log.error(traceback.format_exc())
        tell(f"The result in {sent.out} could not be shown: {unexpected}", is_error=True)
    else:
        tell(f"{job.get_headline()} It is the layer '{name}'; {sent.out} has the report.")


def tell(message: str, is_error: bool = False) -> None:
    """Keep a message for the panel, and log it."""
    STATE.message = message.strip()
    STATE.is_error = is_error
    (lf.log.error if is_error else lf.log.info)(STATE.message)
