"""PE-Field's transformer with random weights: positions per head against plain ones of FLUX.

    python benchmarks/bench_pe_field.py                        # one block per kind, on a CPU
    python benchmarks/bench_pe_field.py --device cuda --compile # all blocks, on a GPU

If not all blocks are built, their time is scaled to 19 double and 38 single ones, and the table
says so. Needs `pip install 'gscompleter[diffusion]'`.
"""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any, Literal

import torch
import tyro
from rich.console import Console
from rich.table import Table

from bench_render import read_clock
from gscompleter.models.diffusion.kontext import find_nearest_size
from gscompleter.models.diffusion.placing import select_dtype
from gscompleter.models.diffusion.position_ids import compute_target_ids
from gscompleter.models.diffusion.published import PE_FIELD_TRANSFORMER
from gscompleter.models.diffusion.rotary import enable_per_head_positions

BLOCKS = (PE_FIELD_TRANSFORMER["num_layers"], PE_FIELD_TRANSFORMER["num_single_layers"])
"""Double and single blocks of the published transformer."""
TOKEN, TEXT = 16, 512
"""Side of a token in pixels; tokens of the prompt."""
PAPER_SECONDS = 1.73
"""Time in the paper for 4 steps at 256 x 448 with encoding and decoding, on its GPU."""


@dataclass(frozen=True)
class Options:
    height: int = 256
    """Height of the target."""
    width: int = 448
    """Width of the target."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device; bfloat16 on a GPU, float32 on a CPU, as in the generator."""
    blocks: tuple[int, int] | None = None
    """Double and single blocks to build; default: all on a GPU, one of each on a CPU."""
    steps: int = 4
    """Evaluations of the transformer."""
    images: int = 1
    """Targets that are denoised together."""
    repetitions: int = 3
    """Number of passes of which the median is taken."""
    compile: bool = False
    """Time torch.compile too."""


@dataclass(frozen=True)
class Pass:
    seconds: float
    """Seconds of one evaluation of all 57 blocks."""
    peak_bytes: int | None
    """Peak memory of the GPU; None on a CPU."""


def build_transformer(blocks: tuple[int, int], device: str) -> Any:
    """Build FLUX's transformer with random weights."""
    from diffusers import FluxTransformer2DModel

    with torch.device("meta"):
        model = FluxTransformer2DModel(
            **{**PE_FIELD_TRANSFORMER, "num_layers": blocks[0], "num_single_layers": blocks[1]}
        )
    model = model.to(select_dtype(device)).to_empty(device=device)
    torch.manual_seed(0)
    with torch.no_grad():
        for parameter in model.parameters():
            parameter.normal_(std=0.02)
    return model.eval()


def make_call(model: Any, options: Options, numbers: int) -> Callable[[], None]:
    """Make a function that evaluates the transformer; `numbers` is the length of a position."""
    size = find_nearest_size(options.height, options.width)
    grid = (size[0] // TOKEN, size[1] // TOKEN)
    ids = compute_target_ids(size, grid)[:, :numbers].repeat(2, 1).to(options.device)
    if numbers > 3:
        ids = ids.repeat(1, options.images)
    device, dtype, b = options.device, next(model.parameters()).dtype, options.images

    def once() -> None:
        model(
            hidden_states=torch.zeros(b, len(ids), 64, device=device, dtype=dtype),
            timestep=torch.full((b,), 0.5, device=device, dtype=dtype),
            guidance=torch.full((b,), 3.5, device=device),
            pooled_projections=torch.zeros(b, 768, device=device, dtype=dtype),
            encoder_hidden_states=torch.zeros(b, TEXT, 4096, device=device, dtype=dtype),
            txt_ids=ids.new_zeros(TEXT, ids.shape[1]),
            img_ids=ids,
            return_dict=False,
        )

    return once


class Stopwatch:
    """Seconds spent in some blocks of a network."""

    def __init__(self, blocks: Iterable[torch.nn.Module]) -> None:
        self.seconds = 0.0
        self.hooks = []
        for block in blocks:
            self.hooks.append(block.register_forward_pre_hook(self.start))
            self.hooks.append(block.register_forward_hook(self.stop))

    def start(self, *_: Any) -> None:
        self.seconds -= read_clock()

    def stop(self, *_: Any) -> None:
        self.seconds += read_clock()

    def remove(self) -> None:
        for hook in self.hooks:
            hook.remove()


def measure_pass(model: Any, once: Callable[[], None], options: Options) -> Pass:
    """Measure the median pass, with missing blocks estimated from those that are built."""
    kinds = (model.transformer_blocks, model.single_transformer_blocks)
    missing = [all_of_them / len(b) - 1 for b, all_of_them in zip(kinds, BLOCKS, strict=True)]
    once()
    if options.device == "cuda":
        torch.cuda.reset_peak_memory_stats()
    passes = []
    for _ in range(options.repetitions):
        watches = [Stopwatch(blocks) for blocks in kinds] if any(missing) else []
        start = read_clock()
        once()
        seconds = read_clock() - start
        for watch, share in zip(watches, missing, strict=False):
            watch.remove()
            seconds += share * watch.seconds
        passes.append(seconds)
    peak = torch.cuda.max_memory_allocated() if options.device == "cuda" else None
    return Pass(statistics.median(passes), peak)


@torch.inference_mode()
def main() -> None:
    """Print the table."""
    options = tyro.cli(Options, description=__doc__)
    if options.device == "cuda" and not torch.cuda.is_available():
        raise SystemExit("--device cuda needs a GPU, and there is none; leave it out.")
    built = options.blocks or ((1, 1) if options.device == "cpu" else BLOCKS)
    model = build_transformer(built, options.device)
    rows = {"plain positions": measure_pass(model, make_call(model, options, 3), options)}
    enable_per_head_positions(model)
    rows["a position for each head"] = measure_pass(model, make_call(model, options, 63), options)
    if options.compile:
        compiled = torch.compile(model)
        once = make_call(compiled, options, 63)
        rows["the same, compiled"] = measure_pass(model, once, options)
    size = find_nearest_size(options.height, options.width)
    tokens = 2 * (size[0] // TOKEN) * (size[1] // TOKEN) + TEXT
    table = Table(
        "",
        "one pass",
        f"{options.steps} steps",
        "ratio",
        "GPU memory",
        title=f"{options.height} x {options.width}, worked on at {size[0]} x {size[1]}: "
        f"{tokens:,} tokens, {options.images} at once, {options.device}",
    )
    first = next(iter(rows.values()))
    for name, one in rows.items():
        memory = "–" if one.peak_bytes is None else f"{one.peak_bytes / 2**30:.1f} GiB"
        table.add_row(
            name,
            f"{one.seconds:.2f} s",
            f"{options.steps * one.seconds:.1f} s",
            f"{one.seconds / first.seconds:.2f}",
            memory,
        )
    console = Console()
    console.print(table)
    if built != BLOCKS:
        console.print(f"{built} blocks were run; their time stands for all {BLOCKS}.")
    console.print(
        f"The paper states {PAPER_SECONDS} s for 4 steps, with encoding and decoding, on its GPU."
    )


if __name__ == "__main__":
    main()
