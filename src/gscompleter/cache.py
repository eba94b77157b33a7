"""Where files that were fetched once are kept for all later runs."""

from __future__ import annotations

import os
from pathlib import Path


def cache_folder() -> Path:
    """Our cache: the folder $GSCOMPLETER_HOME, or else ~/.cache/gscompleter."""
    home = os.environ.get("GSCOMPLETER_HOME")
    return Path(home).expanduser() if home else Path.home() / ".cache" / "gscompleter"
