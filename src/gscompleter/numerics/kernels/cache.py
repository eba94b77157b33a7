"""Choice of the folder in which numba keeps compiled kernels.

numba takes NUMBA_CACHE_DIR, else the folder of the sources, else the user's cache. Where none of
them can be written (a read-only installation and no home), compiled kernels are kept in a temporary
folder of this user, or in none.
"""

import getpass
import logging
import os
import stat
import tempfile
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numba

VARIABLE = "NUMBA_CACHE_DIR"


@dataclass(frozen=True)
class KernelCache:
    """The folder of compiled kernels."""

    folder: Path | None
    """Folder, or None if none can be written."""
    note: str | None = None
    """Sentence on why it is not the usual folder."""


def njit(**options):
    """Compile a kernel as `numba.njit` does, and keep it in the cache if there is one."""
    return numba.njit(cache=CACHE.folder is not None, **options)


def _choose_cache():
    wanted = os.environ.get(VARIABLE)
    folder = _find_cache_folder()
    if folder is not None:
        if not wanted or Path(os.path.abspath(wanted)) in Path(os.path.abspath(folder)).parents:
            return KernelCache(folder)
        return KernelCache(folder, f"{_explain_no_cache(wanted)}; they are kept in {folder}.")
    reason = _explain_no_cache(wanted or "the user's cache, nor the installation")
    # Other users must not be able to put compiled code there.
    temporary = _make_private_folder()
    if temporary is not None:
        os.environ[VARIABLE] = numba.config.CACHE_DIR = str(temporary)
        folder = _find_cache_folder()
    if folder is not None:
        return KernelCache(folder, f"{reason}; they are kept in {folder} for now.")
    return KernelCache(None, f"{reason}; they are compiled again in each run.")


def _explain_no_cache(place):
    return f"Compiled kernels cannot be written to {place} (set {VARIABLE} to a folder)"


def _probe():
    """Do nothing; the function is never compiled."""


def _find_cache_folder():
    """Find the folder in which numba would keep a function of this package; None if in none."""
    try:
        return Path(numba.njit(cache=True)(_probe).stats.cache_path)
    except (RuntimeError, OSError):
        return None


def _make_private_folder():
    """Make a temporary folder that only this user can write; None if that fails."""
    try:
        name = f"gscompleter-kernels-{os.getuid() if hasattr(os, 'getuid') else getpass.getuser()}"
        folder = Path(tempfile.gettempdir(), name)
        with suppress(FileExistsError):
            folder.mkdir(mode=0o700)
        status = folder.lstat()
    except (OSError, KeyError, ImportError):
        return None
    is_private = os.name == "nt" or (status.st_uid == os.getuid() and not status.st_mode & 0o022)
    return folder if stat.S_ISDIR(status.st_mode) and is_private else None


CACHE = _choose_cache()

if CACHE.note is not None:
    logging.getLogger("gscompleter").warning("gscompleter: %s", CACHE.note)
