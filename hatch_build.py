"""Add the JavaScript of the viewer to the build, so that `view` fetches nothing."""

from __future__ import annotations

import json
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
        """Take the libraries of an sdist or fetch them; without a connection, warn only."""
        if version == "editable":
            return
        packed = Path(self.root) / "src" / PLACE
        if not packed.is_file():
            self.folder = tempfile.TemporaryDirectory()
            packed = Path(self.folder.name) / "libraries.json"
            self.fetch(packed)
        if packed.is_file():
            place = PLACE if self.target_name == "wheel" else f"src/{PLACE}"
            build_data["force_include"][str(packed)] = place

    def fetch(self, path: Path) -> None:
        """Write the libraries to a file, or warn that `view` will fetch them when it first runs."""
        sys.path.insert(0, str(Path(self.root) / "src"))
        from gscompleter.apps.viewer.packages import LOCK_FILE, extract_libraries
        from gscompleter.system.errors import InputError

        try:
            libraries = extract_libraries(LOCK_FILE)
        except InputError as error:
            self.app.display_warning(f"This {self.target_name} has no viewer libraries: {error}")
        else:
            text = json.dumps(vars(libraries), sort_keys=True, ensure_ascii=False)
            path.write_text(text, encoding="utf-8")
