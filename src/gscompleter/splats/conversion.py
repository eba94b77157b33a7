"""Conversion of splats to the format that a name ends in."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from jaxtyping import Float
from torch import Tensor

from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.formats import (
    decode_splat,
    describe_losses,
    detect_splat_format,
    drop_labels,
    load_splat,
    read_provenance,
    save_splat,
)
from gscompleter.splats.morton import argsort_all
from gscompleter.splats.ply import PLY, copy_ply
from gscompleter.splats.provenance import NOTHING_KNOWN, Provenance
from gscompleter.splats.table import get_written_format
from gscompleter.types import Gaussians


@dataclass(frozen=True)
class Rounding:
    """The largest change of numbers by a format."""

    position: float
    """Largest change of a coordinate, in scene units."""
    size: tuple[float, float]
    """Standard deviation that changed by the largest factor, before and after, likewise."""

    def describe(self) -> str:
        """Describe it in a line."""
        before, after = self.size
        return (
            f"Largest rounding: {self.position:.2g} of a coordinate, and a size of {before:.3g} "
            f"became {after:.3g}."
        )


@dataclass(frozen=True)
class Conversion:
    """What was written."""

    gaussians: int
    generated: int
    """Gaussians that were generated, whether or not the file says so."""
    notes: tuple[str, ...] = ()
    """Sentences on what the file does not hold."""
    rounding: Rounding | None = None
    """None if it was not measured, or the format keeps positions and sizes as they are."""


def convert_splat(
    source: Path,
    out: Path,
    drop_nonfinite: bool = False,
    keep_labels: bool = True,
    ignore_properties: bool = False,
) -> Conversion:
    """Convert a file of Gaussians to the format given by the extension of `out`."""
    source = resolve_splat(source)
    if is_ply_to_ply(source, out):
        return convert_rows(source, out, drop_nonfinite, keep_labels, ignore_properties)
    made_by = read_provenance(source) if keep_labels else NOTHING_KNOWN
    gaussians = load_splat(source, drop_nonfinite, ignore_properties)
    return write_converted(out, gaussians, made_by, keep_labels)


def is_ply_to_ply(source: Path, out: Path) -> bool:
    """Check whether a .ply becomes a .ply, of which some Gaussians can be in memory at a time."""
    return get_written_format(out) is PLY and detect_splat_format(source) == PLY.name


def convert_rows(
    source: Path,
    out: Path,
    drop_nonfinite: bool,
    keep_labels: bool,
    ignore_properties: bool,
    edit: Callable[[Gaussians], Gaussians] | None = None,
    leaves_out_band_4: bool = False,
) -> Conversion:
    """Convert a .ply to a .ply, some Gaussians at a time; `edit` changes or leaves out some."""
    made_by = read_provenance(source) if keep_labels else NOTHING_KNOWN
    num_written, num_generated = copy_ply(
        source,
        out,
        drop_nonfinite,
        keep_labels,
        made_by,
        ignore_properties,
        edit,
        leaves_out_band_4,
    )
    return Conversion(num_written, num_generated)


def write_converted(
    out: Path, gaussians: Gaussians, made_by: Provenance, keep_labels: bool
) -> Conversion:
    """Write Gaussians, with their labels unless these are dropped, and say what is lost."""
    num_generated = int((gaussians.generated > 0).sum())
    if not keep_labels:
        gaussians = drop_labels(gaussians)
    save_splat(out, gaussians, made_by)
    return Conversion(len(gaussians), num_generated, tuple(describe_losses(out, gaussians)))


def measure_rounding(
    path: Path, means: Float[Tensor, "n 3"], scales: Float[Tensor, "n 3"]
) -> Rounding | None:
    """Read a file again, and compare it with the positions and sizes that were to be written."""
    row = get_written_format(path)
    if not row.rounds_geometry:
        return None
    if row.is_sorted:
        order = argsort_all(means)
        means = means[order]
        scales = scales[order]
    read = decode_splat(path)
    factors = read.scales.clamp_min(1e-30).log() - scales.clamp_min(1e-30).log()
    worst = factors.abs().flatten().argmax()
    sizes = scales.flatten()[worst].item(), read.scales.flatten()[worst].item()
    return Rounding((read.means - means).abs().max().item(), sizes)
