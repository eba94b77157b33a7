"""The command `warmup`: compile all kernels in advance."""

from __future__ import annotations

from dataclasses import dataclass

from gscompleter.apps.commands.options import ComputeOptions


@dataclass(frozen=True, kw_only=True)
class WarmupOptions(ComputeOptions):
    """Compile all kernels for this machine, for container images and cluster nodes.

    They are stored in numba's cache, beside the package or in NUMBA_CACHE_DIR, and are valid for
    one type of processor.
    """


def run_warmup(options: WarmupOptions) -> None:
    """Compile missing kernels, and print the time and the folder."""
    # Imported here so that `--help` does not wait for torch.
    from rich.console import Console

    from gscompleter.apps.warmup.compilation import PARTS, compile_kernels
    from gscompleter.kernels.compiled import get_cache_folder
    from gscompleter.progress import show_progress

    with show_progress(None if options.quiet else Console(stderr=True)):
        seconds = compile_kernels(list(PARTS))
    if options.quiet:
        return
    if seconds is None:
        print(f"All kernels are compiled already: {get_cache_folder()}")
    else:
        print(f"All kernels are compiled, in {seconds:.1f} s: {get_cache_folder()}")
