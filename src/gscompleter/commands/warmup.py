"""The command `warmup`: compile in advance what the first completion would have to wait for."""

from __future__ import annotations

from dataclasses import dataclass

from gscompleter.commands.options import ComputeOptions


@dataclass(frozen=True, kw_only=True)
class WarmupOptions(ComputeOptions):
    """Compile all kernels for this machine, so that no completion has to: for images of containers
    and nodes of a cluster.

    They lie in numba's cache, beside the package or where NUMBA_CACHE_DIR says, and hold for
    processors of one kind.
    """


def run_warmup(options: WarmupOptions) -> None:
    """Compile what is not compiled yet, and say how long it took and where it lies."""
    # Here, so that `--help` does not wait for torch.
    from rich.console import Console

    from gscompleter.compilation import PARTS, compile_kernels
    from gscompleter.kernels.compiled import cache_folder
    from gscompleter.progress import shown_on

    with shown_on(None if options.quiet else Console(stderr=True)):
        seconds = compile_kernels(list(PARTS))
    if options.quiet:
        return
    if seconds is None:
        print(f"All kernels are compiled already: {cache_folder()}")
    else:
        print(f"All kernels are compiled, in {seconds:.1f} s: {cache_folder()}")
