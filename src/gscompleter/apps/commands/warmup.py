"""The command `warmup`: compile all kernels in advance."""

from __future__ import annotations

from rich.console import Console

from gscompleter.apps.commands.options import WarmupOptions
from gscompleter.apps.warmup import PARTS, compile_kernels
from gscompleter.kernels.compiled import get_cache_folder
from gscompleter.progress import show_progress


def run_warmup(options: WarmupOptions) -> None:
    """Compile missing kernels, and print the time and the folder."""
    with show_progress(Console(stderr=True, quiet=options.quiet)):
        seconds = compile_kernels(list(PARTS))
    if not options.quiet:
        done = " already" if seconds is None else f", in {seconds:.1f} s"
        print(f"All kernels are compiled{done}: {get_cache_folder()}")
