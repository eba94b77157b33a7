"""What lies compiled in numba's cache: a mark stands beside it for each part that was rehearsed."""

import hashlib
import sys
from pathlib import Path

import numba
from llvmlite.binding import get_host_cpu_features, get_host_cpu_name

from gscompleter.kernels import variation


def is_compiled(part):
    """Whether the kernels of a part lie compiled for this machine, as they are now."""
    return _mark(part).is_file()


def note_compiled(part):
    """Remember that they do."""
    _mark(part).touch()


def cache_folder():
    """Where numba keeps what it compiled."""
    return Path(variation.advance.stats.cache_path)


def _mark(part):
    return cache_folder() / f"{part}-{_state()}.compiled"


def _state():
    """A word that changes where numba compiles anew: with a source, a version or the processor."""
    sources = sorted(Path(__file__).parent.glob("*.py"))
    stamps = [(s.name, s.stat().st_mtime_ns, s.stat().st_size) for s in sources]
    machine = (get_host_cpu_name(), get_host_cpu_features().flatten())
    state = repr((stamps, machine, numba.__version__, sys.version))
    return hashlib.sha256(state.encode()).hexdigest()[:16]
