"""Folder of downloaded files."""

from __future__ import annotations

import os
from pathlib import Path


def get_download_folder() -> Path:
    """Return $GSCOMPLETER_HOME, or else ~/.cache/gscompleter."""
    home = os.environ.get("GSCOMPLETER_HOME")
    return Path(home).expanduser() if home else Path.home() / ".cache" / "gscompleter"
