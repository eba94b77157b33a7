"""What the build of a wheel adds: the viewer's JavaScript, so that `view` has to fetch nothing."""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

PLACE = "gscompleter/viewer/libraries.json"
"""Where `gscompleter.viewer.packages` looks for it in the wheel."""


class ViewerLibraries(BuildHookInterface[Any]):
    """Packs the pinned npm packages into the wheel; the same lock gives the same bytes."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Fetch them, and say so where that cannot be: `view` does the same when it first runs."""
        if version == "editable":
            return
        sys.path.insert(0, str(Path(self.root) / "src"))
        from gscompleter.errors import InputError
        from gscompleter.viewer.packages import write_libraries

        self.folder = tempfile.TemporaryDirectory()
        packed = Path(self.folder.name) / "libraries.json"
        try:
            write_libraries(packed)
        except InputError as error:
            self.app.display_warning(f"This wheel comes without the viewer's libraries: {error}")
            return
        build_data["force_include"][str(packed)] = PLACE
