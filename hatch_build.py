"""Add the JavaScript of the viewer to the build, so that `view` fetches nothing."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PLACE = "gscompleter/apps/viewer/libraries.json"
"""Path in the wheel that `gscompleter.apps.viewer.packages` reads."""


class ViewerLibraries(BuildHookInterface[Any]):
    """Packs the pinned npm packages into wheel and sdist; the same lock gives the same bytes."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Fetch them, and say so where that cannot be: `view` does the same when it first runs.

        Of an sdist, which has them, a wheel is built without a connection.
        """
        if version == "editable":
            return
        place = PLACE if self.target_name == "wheel" else f"src/{PLACE}"
        packed = Path(self.root) / "src" / PLACE
        if packed.is_file() or (packed := self.fetched()) is not None:
            build_data["force_include"][str(packed)] = place

    def fetched(self) -> Path | None:
        """Return a file of the libraries; None, with a warning, where they cannot be had."""
        sys.path.insert(0, str(Path(self.root) / "src"))
        from gscompleter.apps.viewer.packages import write_libraries
        from gscompleter.errors import InputError

        self.folder = tempfile.TemporaryDirectory()
        packed = Path(self.folder.name) / "libraries.json"
        try:
            write_libraries(packed)
        except InputError as error:
            self.app.display_warning(
                f"This {self.target_name} comes without the viewer's libraries: {error}"
            )
            return None
        return packed
