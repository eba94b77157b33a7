"""The command `warmup`: compile all kernels in advance."""

from __future__ import annotations

from dataclasses import dataclass

from gscompleter.apps.command_line.answers import print_answer
from gscompleter.apps.commands.shared_options import ComputeOptions
from gscompleter.system.errors import InputError
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class WarmupOptions(ComputeOptions):
    """Compile all kernels for this processor and its GPU into the caches of numba and torch.

    NUMBA_CACHE_DIR and TORCH_EXTENSIONS_DIR name these folders.

    Example: gscompleter warmup
    """


def run_warmup(options: WarmupOptions) -> None:
    """Compile missing kernels, and print the time and the folder."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.warmup import PARTS, compile_gsplat, compile_kernels
        from gscompleter.numerics.kernels.cache import CACHE
        from gscompleter.numerics.kernels.compiled import get_cache_folder
        from gscompleter.system.console import make_console
        from gscompleter.system.progress import show_progress

    # Without a folder for the cache, compiled kernels would end with this process.
    if get_cache_folder() is None:
        raise InputError(str(CACHE.note))
    with show_progress(make_console(stderr=True, quiet=options.quiet)):
        seconds = compile_kernels(list(PARTS))
        about_gpu = compile_gsplat()
    done = " already" if seconds is None else f", in {seconds:.1f} s"
    lines = [f"All kernels are compiled{done}: {get_cache_folder()}"]
    lines += [] if about_gpu is None else [about_gpu]
    content = {"folder": str(get_cache_folder()), "seconds": seconds, "gpu": about_gpu}
    print_answer(options.answer, content, lines)
