"""The compiled kernels of gsplat: whether a GPU can be drawn on, and what is missing if not."""

from __future__ import annotations

import importlib.util
import logging
import os
import shutil
from collections.abc import Iterator
from contextlib import suppress
from functools import cache
from pathlib import Path

import torch

from gscompleter.system.errors import quote_value
from gscompleter.system.progress import stage

COMPILED_GSPLAT = "gsplat_cuda"
"""Name of the module, and of its folder, that gsplat compiles at its first use."""
DEFAULT_COMPILERS = 10
"""Number of compilers that gsplat starts at once unless MAX_JOBS says otherwise."""
MAX_QUOTED = 60
"""Most characters of a message or a path that a sentence quotes."""


def explain_missing_gpu() -> str | None:
    """Explain why torch sees no GPU of NVIDIA or AMD; None if it sees one."""
    if torch.cuda.is_available():
        return None
    if torch.version.cuda is None and torch.version.hip is None:
        return f"torch {torch.__version__} is built for the CPU alone"
    # A build is for the GPUs of one maker, and has the version of that maker's platform alone.
    cuda = torch.version.cuda
    platform = f"ROCm {torch.version.hip}" if cuda is None else f"CUDA {cuda}"
    return f"torch sees no GPU; there is none, or its driver is older than {platform}"


@cache
def explain_missing_renderer() -> str | None:
    """Explain why gsplat cannot draw on a GPU; None if it can. It is tried once in a process."""
    reason = explain_missing_gpu()
    if reason is not None:
        return reason
    if importlib.util.find_spec("gsplat") is None:
        return "gsplat is not installed (pip install 'gscompleter[cuda]')"
    # Without its tools nothing is compiled, and gsplat says so at once.
    if has_compiled_gsplat() or any(find_missing_tools()):
        return load_gsplat()
    with stage("compiling gsplat for this GPU, once"):
        logging.getLogger("gscompleter").warning(
            "gscompleter: gsplat is compiled for this GPU, once; it takes minutes with %s "
            "compilers (MAX_JOBS).",
            os.environ.get("MAX_JOBS", DEFAULT_COMPILERS),
        )
        return load_gsplat()


def load_gsplat() -> str | None:
    """Load gsplat's kernels, compiled if they are not yet; return what is missing, or None.

    Without nvcc gsplat imports well, with None in place of its kernels. If a compiler fails, it
    raises whatever error the loading of the file raises that the compiler did not write.
    """
    try:
        from gsplat.cuda._backend import _C
    except Exception as error:
        missing = ", ".join(find_missing_tools())
        reason = f"; missing: {missing}" if missing else ""
        first_line = str(error).strip().partition("\n")[0]
        return f"gsplat could not be compiled ({quote_value(first_line, MAX_QUOTED)}){reason}"
    if _C is None:
        missing = ", ".join(find_missing_tools()) or "a CUDA toolkit that it finds"
        return f"gsplat has no compiled kernels and lacks what compiles them: {missing}"
    return None


def has_compiled_gsplat() -> bool:
    """Return True if gsplat's kernels are compiled: in its package, or in torch's cache."""
    # This imports gsplat itself. If that fails, `load_gsplat` meets the same error and says it.
    with suppress(Exception):
        if importlib.util.find_spec("gsplat.csrc") is not None:
            return True
    from torch.utils import cpp_extension

    root = os.environ.get("TORCH_EXTENSIONS_DIR") or cpp_extension.get_default_build_root()
    # Below a folder for the versions of Python and CUDA, unless the user names the root.
    patterns = (
        f"{COMPILED_GSPLAT}/{COMPILED_GSPLAT}.*",
        f"*/{COMPILED_GSPLAT}/{COMPILED_GSPLAT}.*",
    )
    return any(
        file.suffix in (".so", ".lib", ".pyd")
        for pattern in patterns
        for file in Path(root).glob(pattern)
    )


def find_missing_tools() -> Iterator[str]:
    """Find what is missing on this machine to compile CUDA kernels."""
    from torch.utils import cpp_extension

    home = cpp_extension.CUDA_HOME
    if home is None:
        yield "nvcc of a CUDA toolkit (set CUDA_HOME to its folder)"
    elif not (Path(home) / "bin" / "nvcc").is_file():
        yield f"nvcc (CUDA_HOME is {quote_value(str(home), MAX_QUOTED)}, which has none)"
    if not cpp_extension.is_ninja_available():
        yield "ninja (pip install ninja)"
    if shutil.which(os.environ.get("CXX", "c++")) is None:
        yield "a C++ compiler (g++)"
