"""Markers in numba's cache for the parts whose kernels are compiled for this machine."""

import hashlib
import sys
from contextlib import suppress
from pathlib import Path

import numba
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

from gscompleter.numerics.kernels.cache import CACHE


def get_cache_folder():
    """Return the folder of numba's cache; None if no folder can be written."""
    return CACHE.folder


def is_compiled(part):
    """Return True if the current kernels of a part are compiled here."""
    return get_cache_folder() is not None and find_marker(part).is_file()


def mark_compiled(part):
    """Record that the current kernels of a part are compiled, as far as there is a cache."""
    if get_cache_folder() is not None:
        with suppress(OSError):
            find_marker(part).touch()


def find_marker(part):
    """Return the file that exists if the current kernels of a part are compiled here."""
    sources = sorted(Path(__file__).parent.glob("*.py"))
    stamps = [(s.name, s.stat().st_mtime_ns, s.stat().st_size) for s in sources]
    machine = (get_host_cpu_name(), get_host_cpu_features().flatten())
    state = repr((stamps, machine, numba.__version__, sys.version))
    code = hashlib.sha256(state.encode()).hexdigest()[:16]
    return get_cache_folder() / f"{part}-{code}.compiled"
