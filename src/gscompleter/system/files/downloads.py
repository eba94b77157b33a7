"""The folder of what is downloaded once and kept, such as weights."""

from __future__ import annotations

import os
from pathlib import Path

from gscompleter.system.errors import InputError, quote_value


def get_download_folder() -> Path:
    """Return $GSCOMPLETER_HOME, or else ~/.cache/gscompleter.

    Raise InputError if a `~` leads nowhere, as for a user without a home folder in a container.
    """
    named = os.environ.get("GSCOMPLETER_HOME") or "~/.cache/gscompleter"
    try:
        return Path(named).expanduser()
    except RuntimeError as error:
        raise InputError(
            f"There is no home folder for {quote_value(named)}; name a folder for downloads by "
            "the environment variable GSCOMPLETER_HOME."
        ) from error
