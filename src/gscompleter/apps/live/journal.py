"""The steps of a running session in its folder, written after each of them.

A program that is killed loses no step: `live OUT` does them again (`opening.py`).
"""

from __future__ import annotations

from pathlib import Path

from gscompleter.apps.live.session import Session, SessionStep
from gscompleter.apps.live.strokes import (
    Began,
    digest_steps,
    encode_strokes,
    list_steps,
    name_mask,
    write_masks,
)
from gscompleter.system.files.output_folder import list_session
from gscompleter.system.files.writing import STROKES_FILE, convert_write_errors, replace_file


class Journal:
    """Keeps `strokes.json` and its masks in the output folder of a session."""

    def __init__(
        self,
        folder: Path,
        began: Began,
        saved: str | None = None,
        known: tuple[SessionStep, ...] = (),
    ) -> None:
        """Begin with the steps that the folder has already, and the digest of those saved there."""
        self.folder = folder
        self._began = began
        self._saved = saved
        self._known = known

    def write(self, session: Session) -> None:
        """Write the steps of a session; a program that is killed meanwhile leaves those before."""
        steps = list_steps(session)
        same = count_same(self._known, steps)
        path = self.folder / STROKES_FILE
        with convert_write_errors(path):
            self.folder.mkdir(parents=True, exist_ok=True)
            # A mask takes the place of another one only once no step has that one. Without the
            # file beside them, masks would be taken for files of somebody else.
            if same < len(self._known) or not path.exists():
                self._write_file(encode_strokes(session, self._began, self._saved, same))
                self._known = steps[:same]
            write_masks(self.folder, steps, same)
            self._write_file(encode_strokes(session, self._began, self._saved))
            self._known = steps
            named = {name_mask(index) for index in range(len(steps))}
            for name in list_session(self.folder) - {STROKES_FILE, *named}:
                (self.folder / name).unlink(missing_ok=True)

    def set_saved(self, session: Session) -> None:
        """Remember that the completed scene in the folder has the steps of a session."""
        self._saved = digest_steps(session.steps)
        self._known = list_steps(session)

    def is_saved(self, session: Session) -> bool:
        """Return True if the folder has what a session shows, or nothing was done."""
        if self._saved is None:
            return not session.steps
        return digest_steps(session.steps) == self._saved

    @property
    def has_saved(self) -> bool:
        """True if the folder has a completed scene of the session."""
        return self._saved is not None

    def _write_file(self, content: bytes) -> None:
        with replace_file(self.folder / STROKES_FILE) as file:
            file.write(content)


def count_same(before: tuple[SessionStep, ...], after: tuple[SessionStep, ...]) -> int:
    """Count the steps at the beginning that are the same values in both."""
    pairs = zip(before, after, strict=False)
    different = (index for index, (one, other) in enumerate(pairs) if one is not other)
    return next(different, min(len(before), len(after)))
