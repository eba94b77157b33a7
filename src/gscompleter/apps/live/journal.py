"""The steps of a running session in its folder, written after each of them.

A program that is killed loses no step: `live OUT` does them again (`opening.py`).
"""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

from gscompleter.apps.live.session import Session, SessionStep
from gscompleter.apps.live.strokes import (
    SessionStart,
    digest_steps,
    encode_strokes,
    list_steps,
    name_mask,
    write_masks,
)
from gscompleter.system.files.output_folder import list_session
from gscompleter.system.files.result_names import STROKES_FILE
from gscompleter.system.files.writing import convert_write_errors, replace_file


class Journal:
    """Keeps `strokes.json` and its masks in the output folder of a session."""

    def __init__(self, folder: Path, start: SessionStart, saved: str | None = None) -> None:
        """Begin with what the folder has already, which may be the steps of another session.

        `saved` is the digest of the steps that its completed scene has; None without a scene.
        """
        self.folder = folder
        self._start = start
        self._saved = saved
        self._kept: Session | None = None

    def write(self, session: Session) -> None:
        """Write the steps of a session, so that at any time the file has masks for all its steps.

        A program that is killed meanwhile leaves the steps that both states begin with, or more.
        """
        steps = list_steps(session)
        path = self.folder / STROKES_FILE
        with convert_write_errors(path):
            self.folder.mkdir(parents=True, exist_ok=True)
            # Masks are numbered by step, so a new one may replace that of a step which is gone:
            # the file drops those steps first. It is also written before the first mask, since
            # masks without it would be taken for files of somebody else.
            num_kept = self._count_kept(steps)
            if num_kept < len(steps):
                self._write_file(encode_strokes(session, self._start, self._saved, num_kept))
                write_masks(self.folder, steps, num_kept)
            self._write_file(encode_strokes(session, self._start, self._saved))
            # Masks that no step has any more.
            named = {name_mask(index) for index, step in enumerate(steps) if step.mask is not None}
            for name in list_session(self.folder) - {STROKES_FILE, *named}:
                (self.folder / name).unlink(missing_ok=True)
        self._kept = session

    def set_saved(self, session: Session) -> None:
        """Remember that the folder has a session as it was saved there, with its `strokes.json`."""
        self._saved = digest_steps(session.steps)
        self._kept = session

    def is_saved(self, session: Session) -> bool:
        """Return True if the folder has what a session shows, or no step is left to be saved."""
        if self._saved is None:
            return not session.steps
        return digest_steps(session.steps) == self._saved

    def has_steps(self, session: Session) -> bool:
        """Return True if the last change of a session is written, or there was none."""
        return session is self._kept or not list_steps(session)

    @property
    def has_begun(self) -> bool:
        """True if the folder has a state of the session with which another program goes on."""
        return self.has_saved or self._kept is not None

    @property
    def has_saved(self) -> bool:
        """True if the folder has a completed scene of the session."""
        return self._saved is not None

    def _count_kept(self, steps: tuple[SessionStep, ...]) -> int:
        """Count the steps at the beginning whose masks the folder has."""
        for index, step in enumerate(steps):
            found = None
            if step.mask is not None:
                with suppress(OSError):
                    found = (self.folder / name_mask(index)).read_bytes()
            if found != step.mask:
                return index
        return len(steps)

    def _write_file(self, content: bytes) -> None:
        with replace_file(self.folder / STROKES_FILE) as file:
            file.write(content)
