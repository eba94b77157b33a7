"""Reader and writer of the .ply files of 3DGS.

Written is the standard layout (binary little-endian float32: x y z nx ny nz f_dc_* f_rest_*
opacity scale_* rot_*), then `float generated`, because many readers take every property for a
float. Read are the same properties in any order and type; earlier versions wrote `uchar generated`.
In the file scales are logarithms, opacities are logits, and f_rest_* has all coefficients of red,
then green, then blue. A comment marks antialiased Gaussians: Brush's is written, Postshot's are
read too.

Positions of double that float32 would round are read relative to an origin, and written as double.
Variants are read as ordinary Gaussians. A property `filter_3D` (Mip-Splatting, GOF) is fused into
scales and opacities, as their viewers do. Surfels of 2DGS, which have two scales and the third axis
as their normal, get a thin third scale. Scales and opacities that were written without logarithm
and logit are read as what they are, where that is certain.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64, UInt8
from numpy import ndarray
from torch import Tensor

from gscompleter.numerics.kernels import splat_rows as kernels
from gscompleter.numerics.kernels.parallel import run_calls, share
from gscompleter.numerics.value_checks import LARGEST, check_gaussians, find_finite
from gscompleter.splats.origin import choose_origin, find_step, is_too_far
from gscompleter.splats.packing import DegreeError
from gscompleter.splats.properties import refuse_other_kinds
from gscompleter.splats.provenance import (
    NOTHING_KNOWN,
    Provenance,
    add_comments,
    parse_comments,
)
from gscompleter.splats.splat_format import PLY_MAGIC, FormatTexts, SplatFormat
from gscompleter.system.errors import InputError, quote_value, require_path
from gscompleter.system.files.mapping import release_pages
from gscompleter.system.files.ply import (
    Element,
    PlyFile,
    make_header,
    read_header,
    read_ply_file,
    write_ply_file,
)
from gscompleter.system.files.reading import open_file
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import Gaussians, Origin, merge

MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_NEEDED = (*MEANS, *_DC, "opacity", *_SCALES[:2], *_QUATS)
LABEL_COLUMN = "generated"
LABEL_TYPES = (np.dtype("<f4"), np.dtype(">f4"), np.dtype("u1"))
"""Types of labels in files of ours; earlier ones have bytes."""
FILTER = "filter_3D"
"""Standard deviation of the smoothing filter of Mip-Splatting and GOF, in scene units."""
SURFEL_THICKNESS = 1e-3
"""Thickness of a surfel of 2DGS, relative to its smaller scale."""
SAMPLE_BLOCKS = 64
SAMPLE_ROWS = 1024
"""Rows of each block of a sample."""
MIN_TELLING = 100
"""Fewest Gaussians whose numbers tell how they are stored."""
MIDDLE_QUANTILES = (0.01, 0.99)
"""Quantiles of positions that floaters leave alone."""
LARGE_SIZE = 0.1
"""Largest size of the median Gaussian that is plausible, relative to the extent of the scene."""
SURELY_LARGE = 0.25
"""Size of the median Gaussian that no scene has, relative to its extent."""
ONE_SIZE = 1.35
"""Largest Gaussian of a scene in which all are about one unit large, in scene units."""
SEVERAL_SIZES = 5.0
"""Ratio of the largest to the smallest Gaussian above which they have several sizes."""
_NUM_REST = (0, 9, 24, 45)
"""Number of properties f_rest_* by SH degree."""
_NUM_REST_4 = 72
"""Number of properties f_rest_* of degree 4, which are read without the fourth band on request."""

MODE_COMMENT = "SplatRenderMode: mip"
"""Comment that marks antialiased Gaussians."""
_MODE_LINE = re.compile(
    rb"^(?:comment|obj_info)[ ]+(?:SplatRenderMode|(?:postshot[._])?anti[-_ ]?alias(?:ed|ing)?)"
    rb"[ ]*[:= ][ ]*(\w+)[ \r]*$",
    re.IGNORECASE | re.MULTILINE,
)
_ANTIALIASED = (b"mip", b"antialiased", b"1", b"true")

BLOCK_ROWS = 8192
"""Rows processed at a time, so that all their columns stay in the cache."""
CHUNK_ROWS = 16 * BLOCK_ROWS
"""Rows of a file that are copied at a time."""
SELECTED_ROWS = 32 * BLOCK_ROWS
"""Gaussians that are selected at a time, for which all pages of a mapped scene are read once."""


@dataclass(frozen=True)
class SceneFile(PlyFile):
    """A 3DGS .ply, and what its numbers stand for."""

    has_linear_scales: bool = False
    """True if its scales are sizes in scene units, and not logarithms."""
    has_plain_opacities: bool = False
    """True if its opacities are fractions, and not logits."""
    origin: Origin | None = None
    """Place to which positions are relative once they are decoded; None for zero."""

    @property
    def is_usual(self) -> bool:
        """True if numbers are stored as in a file of 3DGS, so that rows of ours can join them."""
        return not (self.has_linear_scales or self.has_plain_opacities)


@run_in_plain_torch
def load_ply(
    path: Path | str, drop_nonfinite: bool = False, ignore_properties: bool = False
) -> Gaussians:
    """Load the Gaussians of a 3DGS .ply of SH degree 0 to 3.

    A file whose further properties change what is seen, as those of a moving splat, is refused
    unless `ignore_properties` is set. With `drop_nonfinite`, Gaussians with NaN, infinity or a zero
    quaternion are dropped; otherwise the file is refused. Infinite opacity logits are valid:
    converters write them for opacities of 1 and 0.
    """
    path = require_path(path)
    try:
        scene = read_scene(path)
        if not ignore_properties:
            refuse_other_kinds(scene.rows.dtype.names or (), path)
        return require_finite(decode_gaussians(scene), path, drop_nonfinite)
    except MemoryError as error:
        raise make_memory_error(path) from error
    except RuntimeError as error:
        if "can't allocate memory" in str(error):  # PyTorch has no type for it
            raise make_memory_error(path) from error
        raise


def make_memory_error(path: Path) -> InputError:
    """Make the error of a file that needs more memory than there is."""
    return InputError(
        f"{quote_value(path)} needs more memory than there is; close other programs, or thin the "
        "splat."
    )


def find_finite_rows(path: Path) -> Bool[Tensor, "n"]:
    """Mark the Gaussians of a 3DGS .ply that `load_ply` keeps with `drop_nonfinite`."""
    return find_finite(decode_gaussians(read_scene(path)))


def read_scene(path: Path, leaves_out_band_4: bool = False) -> SceneFile:
    """Read the rows of a 3DGS .ply, surfels of 2DGS included, and find out how they are stored."""
    scene = read_ply_file(path, _NEEDED, "3DGS scene", describe_other_content, "Gaussians")
    if count_rest(scene) == _NUM_REST_4:
        if not leaves_out_band_4:
            raise make_band_error(path)
        scene = leave_out_band_4(scene)
    names = scene.rows.dtype.names or ()
    num_rest = count_rest(scene)
    if num_rest not in _NUM_REST or any(f"f_rest_{i}" not in names for i in range(num_rest)):
        raise InputError(
            f"{quote_value(path)} has {num_rest} properties f_rest_*; spherical harmonics of "
            "degree 0 to 3 have 0, 9, 24 or 45, numbered from 0."
        )
    has_linear_scales = find_linear_scales(scene.rows)
    return SceneFile(
        **vars(scene),
        has_linear_scales=has_linear_scales,
        has_plain_opacities=find_plain_opacities(scene.rows, has_linear_scales),
        origin=find_rows_origin(scene.rows, has_linear_scales),
    )


def find_rows_origin(rows: ndarray, has_linear_scales: bool) -> Origin | None:
    """Find the place to which positions are read that float32 would round; None for zero."""
    if not has_doubles(rows):
        return None
    middle = []
    sample = sample_rows(rows)
    for name in MEANS:
        values = sample[name].astype(np.float64)
        finite = values[np.isfinite(values)]
        if len(finite) == 0:
            return None
        middle.append(np.median(finite))
    size = _measure_scales(rows)[1]
    size = size if has_linear_scales else math.exp(min(size, 80))
    return choose_origin(np.array(middle), size)


def has_doubles(rows: ndarray) -> bool:
    """Return True if positions are stored more exactly than by float32."""
    kinds = [rows.dtype[name] for name in MEANS]
    return any(kind.kind == "f" and kind.itemsize == 8 for kind in kinds)


def read_means(rows: ndarray, origin: Origin) -> Float[ndarray, "n 3"]:
    """Read positions relative to an origin, which is taken off in float64."""
    places = zip(MEANS, origin, strict=True)
    columns = [rows[name].astype(np.float64) - place for name, place in places]
    with np.errstate(over="ignore"):
        return np.stack(columns, axis=1).astype(np.float32)


def find_linear_scales(rows: ndarray) -> bool:
    """Return True if the scales of a file are surely sizes, and not logarithms of sizes.

    Some converters forget the logarithm. Then no number is negative, and the median Gaussian is far
    smaller than the scene. As logarithms they would say that it is a large part of the scene, or
    that all Gaussians are about one unit large; no trainer makes such a scene.
    """
    names = [name for name in _SCALES if name in (rows.dtype.names or ())]
    # Most files have a negative logarithm among their first rows, so that no more is read of them.
    if len(rows) < MIN_TELLING or not _are_within(rows, names, math.inf):
        return False
    low, median, high = _measure_scales(rows)
    extent = _measure_extent(rows)
    if not 0 < median <= LARGE_SIZE * extent:
        return False
    is_large = median >= math.log(SURELY_LARGE * extent)
    return is_large or (high <= math.log(ONE_SIZE) and high >= SEVERAL_SIZES * low)


def sample_rows(rows: ndarray) -> ndarray:
    """Take rows from all over a file, in blocks, so that little of a large mapped file is read."""
    if len(rows) <= SAMPLE_BLOCKS * SAMPLE_ROWS:
        return rows
    starts = np.linspace(0, len(rows) - SAMPLE_ROWS, SAMPLE_BLOCKS).astype(np.int64)
    return np.concatenate([rows[start : start + SAMPLE_ROWS] for start in starts])


def _measure_scales(rows: ndarray) -> tuple[float, float, float]:
    """Measure the largest scale of Gaussians as it is stored: low, median and high quantile."""
    names = tuple(name for name in _SCALES if name in (rows.dtype.names or ()))
    largest = read_columns(sample_rows(rows), names).max(axis=1)
    # Between an infinite number and another there is none; who loads the file tells of them.
    with np.errstate(invalid="ignore"):
        low, median, high = np.quantile(largest, (0.01, 0.5, 0.99))
    return float(low), float(median), float(high)


def _measure_extent(rows: ndarray) -> float:
    """Measure the largest side of the box around nearly all Gaussians, in scene units.

    Those whose position is not finite do not count; without any other it is 0.
    """
    means = read_columns(sample_rows(rows), MEANS)
    means = means[np.isfinite(means).all(axis=1)]
    if len(means) == 0:
        return 0.0
    with np.errstate(over="ignore", invalid="ignore"):  # numbers that only float64 would hold
        return float(np.ptp(np.quantile(means, MIDDLE_QUANTILES, axis=0), axis=0).max())


def find_plain_opacities(rows: ndarray, has_linear_scales: bool) -> bool:
    """Return True if the opacities of a file are surely fractions, and not logits of fractions.

    All logits in [0, 1] would be opacities from 50 to 73 %. That is a file of fractions if its
    scales are no logarithms either, or if they fill [0, 1] and never exceed it.
    """
    if len(rows) < MIN_TELLING or not _are_within(rows, ["opacity"], 1.0):
        return False
    low, high = np.quantile(read_columns(rows, ("opacity",)), (0.05, 0.95))
    return has_linear_scales or bool(low <= 0.1 and high >= 0.9)


def _are_within(rows: ndarray, names: Sequence[str], most: float) -> bool:
    """Return True if all values of columns lie from 0 to `most`; the first rows usually tell."""
    for block in iterate_blocks(len(rows)):
        for name in names:
            values = rows[name][block]
            if not ((values >= 0) & (values <= most)).all():  # False for NaN
                return False
    return True


def describe_values(scene: SceneFile) -> list[str]:
    """Describe in sentences what a file stores as no trainer does, and how it is read."""
    return [*_describe_positions(scene), *_describe_forms(scene)]


def _describe_positions(scene: SceneFile) -> list[str]:
    """Describe positions that are far from zero, relative to the size of Gaussians."""
    if scene.origin is not None:
        place = ", ".join(f"{x:.12g}" for x in scene.origin)
        return [
            f"Coordinates of the splat are too large for float; it is read relative to ({place})."
        ]
    rows = scene.rows
    if len(rows) == 0 or has_doubles(rows):
        return []
    with np.errstate(invalid="ignore"):  # an infinite position of either sign
        middle = np.median(read_columns(sample_rows(rows), MEANS), axis=0).astype(np.float64)
    size = _measure_scales(rows)[1]
    size = size if scene.has_linear_scales else math.exp(min(size, 80))
    if not is_too_far(middle, size):
        return []
    step = find_step(float(np.abs(middle).max()))
    return [
        f"Positions of the splat are floats in steps of {step:.3g}, and half of its Gaussians are "
        f"smaller than {size:.3g}: they were rounded when it was written; export it with positions "
        "of double, or near zero."
    ]


def _describe_forms(scene: SceneFile) -> list[str]:
    """Describe scales and opacities in another form than that of a .ply."""
    if len(scene.rows) < MIN_TELLING:
        return []
    sentences = []
    # Sizes may be infinite, and positions all the same; both are told elsewhere.
    median = math.exp(min(_measure_scales(scene.rows)[1], 80))
    share = median / max(_measure_extent(scene.rows), 1e-30)
    if scene.has_linear_scales:
        sentences.append(
            "Scales of the splat are sizes, not their logarithms, and are read as such."
        )
    elif share > LARGE_SIZE:
        sentences.append(
            f"Half of the Gaussians are larger than {100 * share:.3g} % of the scene; their scales "
            "may be no logarithms of sizes, as a .ply has them."
        )
    if scene.has_plain_opacities:
        sentences.append("Opacities of the splat are fractions, not logits, and are read as such.")
    elif _are_within(scene.rows, ["opacity"], 1.0):
        opacities = read_columns(scene.rows, ("opacity",))
        if opacities.min() < opacities.max():
            sentences.append(
                "All opacities of the splat are from 50 to 73 %, as if they had been stored "
                "without the logit that .ply files have; they are read with it."
            )
    return sentences


def make_band_error(path: Path) -> DegreeError:
    """Make the error of a file with harmonics of degree 4."""
    return DegreeError(
        f"{quote_value(path)} has harmonics of SH degree 4, and degrees 0 to 3 are read; leave the "
        "fourth band out with `gscompleter convert`, and name its result."
    )


def leave_out_band_4(scene: PlyFile) -> PlyFile:
    """View the rows of a scene of degree 4 without the nine coefficients of the fourth band."""
    fields: Mapping[str, Any] = scene.rows.dtype.fields or {}
    kept = {}
    for name, (dtype, offset) in ((name, field[:2]) for name, field in fields.items()):
        if not name.startswith("f_rest_"):
            kept[name] = (dtype, offset)
            continue
        # All coefficients of red, then green, then blue.
        channel, number = divmod(int(name.removeprefix("f_rest_")), _NUM_REST_4 // 3)
        if number < _NUM_REST[3] // 3:
            kept[f"f_rest_{channel * (_NUM_REST[3] // 3) + number}"] = (dtype, offset)
    layout: Any = {
        "names": list(kept),
        "formats": [dtype for dtype, _ in kept.values()],
        "offsets": [offset for _, offset in kept.values()],
        "itemsize": scene.rows.dtype.itemsize,
    }
    return replace(scene, rows=scene.rows.view(np.dtype(layout)))


def count_rest(scene: PlyFile) -> int:
    """Count the properties for SH of degree 1 and above."""
    return sum(name.startswith("f_rest_") for name in scene.rows.dtype.names or ())


def has_mode_comment(header: bytes) -> bool:
    """Return True if the last comment on the mode marks the Gaussians as antialiased."""
    modes = _MODE_LINE.findall(header)
    return bool(modes) and modes[-1].lower() in _ANTIALIASED


def decode_gaussians(scene: SceneFile) -> Gaussians:
    """Decode the Gaussians of a .ply, non-finite ones included.

    Blocks of rows are decoded one by one, and their pages of a mapped file are released: the memory
    holds the Gaussians, and not the file as well.
    """
    rows = scene.rows
    count = len(rows)
    names = rows.dtype.names or ()
    arrays = (
        np.empty((count, 3), np.float32),
        np.empty((count, 4), np.float32),
        np.empty((count, 3), np.float32),
        np.empty(count, np.float32),
        np.empty((count, 1 + count_rest(scene) // 3, 3), np.float32),
        np.empty((count, 4), np.float32),
    )
    generated = np.zeros(count, np.uint8)
    columns = find_columns(scene)

    def decode_block(block: slice) -> None:
        part = rows[block]
        table = view_as_table(part) if columns is not None else gather_table(scene, part)
        places = np.arange(table.shape[1]) if columns is None else columns
        if not scene.is_usual:
            table = encode_columns(scene, table, places)
        kernels.decode_rows(0, len(part), block.start, table, places, *arrays)
        if scene.origin is not None:
            arrays[0][block] = read_means(part, scene.origin)
        if LABEL_COLUMN in names:
            generated[block] = read_labels(part)
        release_pages(part)

    run_calls(decode_block, [(block,) for block in iterate_blocks(count)])
    means, quats, scales, opacities, sh, encoded = map(torch.from_numpy, arrays)
    gaussians = Gaussians(
        means=means,
        quats=quats,
        scales=scales,
        opacities=opacities,
        sh=sh,
        generated=torch.from_numpy(generated),
        encoded=encoded,
        is_antialiased=has_mode_comment(scene.header),
        origin=scene.origin,
    )
    if FILTER not in names:
        return gaussians
    return fuse_filter(gaussians, torch.from_numpy(read_columns(rows, (FILTER,)))[:, 0])


def read_labels(rows: ndarray) -> UInt8[ndarray, "n"]:
    """Read the column `generated` of any type, in which labels are whole numbers from 0 to 255."""
    with np.errstate(invalid="ignore"):
        return rows[LABEL_COLUMN].astype(np.uint8)


def name_columns(scene: PlyFile) -> tuple[str, ...]:
    """Name the properties of Gaussians in the order in which kernels take them."""
    rest = (f"f_rest_{i}" for i in range(count_rest(scene)))
    return (*MEANS, *_DC, *rest, "opacity", *_SCALES, *_QUATS)


def find_columns(scene: PlyFile) -> Int64[ndarray, "c"] | None:
    """Find the properties of Gaussians among the float32 of a row.

    None if some are no little-endian float32 at a multiple of four bytes, or are not there.
    """
    fields: Mapping[str, Any] = scene.rows.dtype.fields or {}
    places = []
    for name in name_columns(scene):
        dtype, offset = fields.get(name, (np.dtype(np.uint8), 0))[:2]
        if dtype != np.dtype("<f4") or offset % 4 != 0:
            return None
        places.append(offset // 4)
    return np.array(places)


def view_as_table(part: ndarray) -> Float[ndarray, "n c"]:
    """Copy rows as they are to a table of the float32 that each begins with."""
    width = part.dtype.itemsize // 4
    raw = np.ascontiguousarray(part).view(np.uint8).reshape(len(part), -1)
    return np.ascontiguousarray(raw[:, : 4 * width]).view("<f4").astype(np.float32, copy=False)


def gather_table(scene: SceneFile, part: ndarray) -> Float[ndarray, "n c"]:
    """Gather the properties of Gaussians, of any type, in the order of `name_columns`."""
    names = name_columns(scene)
    if not has_surfels(scene):
        return read_columns(part, names)
    table = read_columns(part, tuple(name for name in names if name != _SCALES[2]))
    # The third scale of a surfel is thinner than the smaller one by a factor.
    place = names.index(_SCALES[2])
    thin = table[:, place - 2 : place].min(axis=1)
    if scene.has_linear_scales:
        thin = thin * np.float32(SURFEL_THICKNESS)
    else:
        thin = thin + np.float32(math.log(SURFEL_THICKNESS))
    return np.insert(table, place, thin, axis=1)


def encode_columns(
    scene: SceneFile, table: Float[ndarray, "n c"], places: Int64[ndarray, "d"]
) -> Float[ndarray, "n c"]:
    """Encode sizes and fractions as the logarithms and logits that a file of 3DGS has.

    `places` are the columns of properties in the order of `name_columns`.
    """
    table = table.copy()  # the file itself may be mapped
    names = name_columns(scene)
    with np.errstate(divide="ignore"):  # sizes of 0, opacities of 0 and 1
        if scene.has_linear_scales:
            scales = places[[names.index(name) for name in _SCALES]]
            table[:, scales] = np.log(table[:, scales])
        if scene.has_plain_opacities:
            opacity = places[names.index("opacity")]
            fractions = table[:, opacity].astype(np.float64)
            table[:, opacity] = np.log(fractions) - np.log1p(-fractions)
    return table


def has_surfels(scene: PlyFile) -> bool:
    """Return True for the file of 2DGS, whose Gaussians have two scales."""
    return _SCALES[2] not in (scene.rows.dtype.names or ())


def fuse_filter(gaussians: Gaussians, radii: Float[Tensor, "n"]) -> Gaussians:
    """Fuse the 3D smoothing filter into scales and opacities (Mip-Splatting, Eq. 7).

    A Gaussian is convolved with an isotropic one of standard deviation `radii`, in scene units, and
    its opacity falls by the growth of its volume. This is what the authors' `fuse_3d_filter` does.
    """
    before = gaussians.scales.double().square()
    after = before + radii.double().square()[:, None]
    # A Gaussian of size zero with a filter of zero stays as it is.
    loss = (before.clamp_min(1e-300) / after.clamp_min(1e-300)).prod(1).sqrt()
    return replace(
        gaussians,
        scales=after.sqrt().float(),
        opacities=(gaussians.opacities.double() * loss).float(),
        encoded=None,
    )


def read_columns(rows: np.ndarray, names: tuple[str, ...]) -> Float[np.ndarray, "n c"]:
    """Read properties as float32; a double beyond its range becomes infinite."""
    table = np.empty((len(rows), len(names)), np.float32)
    with np.errstate(over="ignore"):
        for block in iterate_blocks(len(rows)):
            for column, name in enumerate(names):
                table[block, column] = rows[name][block]
    return table


def require_finite(gaussians: Gaussians, path: Path, drop_nonfinite: bool) -> Gaussians:
    """Refuse non-finite Gaussians of the file `path`, or drop them if some are finite."""
    good = find_finite(gaussians)
    count = int(good.sum())
    check_finite(count, len(good), path, drop_nonfinite)
    return gaussians if count == len(good) else gaussians[good]


def check_finite(count: int, total: int, path: Path, drop_nonfinite: bool) -> None:
    """Raise InputError if not all Gaussians of a file are finite, or if none is."""
    bad = total - count
    if total == 0:
        raise InputError(f"{quote_value(path)} holds no Gaussians; name another file.")
    if count == 0 and drop_nonfinite:
        raise InputError(f"{quote_value(path)} holds no Gaussian that is finite; write it anew.")
    if bad > 0 and not drop_nonfinite:
        raise InputError(
            f"{quote_value(path)} has {bad:,} of {total:,} Gaussians with NaN, infinity, "
            f"numbers above {LARGEST:g} or a rotation of zeros; repair it, or drop what is not "
            "finite.",
            "drop_nonfinite",
        )


def iterate_blocks(count: int) -> Iterator[slice]:
    """Yield slices of `BLOCK_ROWS` rows from 0 to `count`."""
    return (slice(start, start + BLOCK_ROWS) for start in range(0, count, BLOCK_ROWS))


def encode(gaussians: Gaussians) -> Float[Tensor, "n 4"]:
    """Compute log-scales and logit opacities for a file, always finite.

    Values read from a file are reused where they still decode to the values in memory.
    """
    written = np.empty((len(gaussians), 4), np.float32)
    values = (gaussians.scales, gaussians.opacities, gaussians.encoded)
    share(kernels.encode_values, len(gaussians), *map(_to_array, values), written)
    return torch.from_numpy(written)


def _to_array(values: Tensor | None) -> Float[ndarray, "n *c"]:
    """Convert values to a contiguous array; log-scales and logits that are not known are empty."""
    if values is None:
        return np.empty((0, 4), np.float32)
    return values.detach().cpu().float().contiguous().numpy()


@run_in_plain_torch
def save_ply(
    path: Path | str,
    gaussians: Gaussians,
    provenance: bool | None = None,
    made_by: Provenance = NOTHING_KNOWN,
) -> None:
    """Write a standard 3DGS .ply, with `float generated` after the standard properties.

    `provenance` decides if `generated` is written; the default is yes if anything was generated.
    `made_by` becomes comments.
    """
    path = require_path(path)
    check_gaussians(gaussians, "The scene to write")
    if provenance is None:
        provenance = bool((gaussians.generated > 0).any())
    gaussians = gaussians.detach().to("cpu")
    blocks = (make_rows(gaussians, provenance, block) for block in iterate_blocks(len(gaussians)))
    header = add_comments(make_scene_header(gaussians, provenance), made_by)
    write_ply_file(path, header, len(gaussians), blocks)


def save_parts(
    path: Path,
    parts: Sequence[tuple[Gaussians, Int64[Tensor, "_"]]],
    provenance: bool,
    made_by: Provenance = NOTHING_KNOWN,
) -> None:
    """Write rows of several scenes as one 3DGS .ply, some at a time, without merging the scenes.

    Each part is a scene and the Gaussians of it that are written, in their order.
    """
    # Scenes of lower degree are padded to this one, as `merge` does.
    form = merge([scene[:0].to("cpu") for scene, _ in parts])
    for scene, _ in parts:
        check_gaussians(scene, "The scene to write")

    def generate_blocks() -> Iterator[ndarray]:
        for scene, order in parts:
            for chunk in order.split(SELECTED_ROWS):
                rows = scene[chunk.to(scene.means.device)].detach().to("cpu")
                for block in iterate_blocks(len(rows)):
                    yield make_rows(merge([form, rows[block]]), provenance)

    count = sum(len(order) for _, order in parts)
    header = add_comments(make_scene_header(form, provenance), made_by)
    write_ply_file(path, header, count, generate_blocks())


def copy_ply(
    source: Path,
    path: Path,
    drop_nonfinite: bool = False,
    keep_labels: bool = True,
    made_by: Provenance = NOTHING_KNOWN,
    ignore_properties: bool = False,
    edit: Callable[[Gaussians], Gaussians] | None = None,
    leaves_out_band_4: bool = False,
) -> tuple[int, int]:
    """Write what `load_ply` and `save_ply` would, some Gaussians at a time.

    `edit` changes or leaves out Gaussians on the way, and `leaves_out_band_4` reads harmonics of
    degree 4 without the fourth band. Returns the numbers of Gaussians written, and of those of them
    that the file says were generated, whether or not `keep_labels` writes that.
    """
    scene = read_scene(source, leaves_out_band_4)
    if not ignore_properties:
        refuse_other_kinds(scene.rows.dtype.names or (), source)
    total = len(scene.rows)

    def decode_chunks() -> Iterator[tuple[int, Gaussians]]:
        """Yield the number of finite Gaussians of each chunk, and what is written of them."""
        for start in range(0, total, CHUNK_ROWS):
            chunk = decode_gaussians(replace(scene, rows=scene.rows[start : start + CHUNK_ROWS]))
            good = find_finite(chunk)
            finite = chunk if good.all() else chunk[good]
            yield len(finite), finite if edit is None else edit(finite)

    # The header has the number of Gaussians and says if there are labels, so that both are counted
    # before the first is written. Most files have no labels, and all of them is written.
    num_finite = total
    count = total
    num_generated = 0
    has_label_column = LABEL_COLUMN in (scene.rows.dtype.names or ())
    if drop_nonfinite or total == 0 or has_label_column or edit is not None:
        numbers = np.zeros(3, np.int64)
        for finite, chunk in decode_chunks():
            numbers += [finite, len(chunk), int((chunk.generated > 0).sum())]
        num_finite, count, num_generated = numbers.tolist()
        check_finite(num_finite, total, source, drop_nonfinite)
    if count == 0:
        raise InputError(f"No Gaussian of {quote_value(source)} is left; change what is cut off.")

    has_labels = keep_labels and num_generated > 0
    form = decode_gaussians(replace(scene, rows=scene.rows[:0]))
    form = form if edit is None else edit(form)
    seen = 0

    def encode_chunks() -> Iterator[ndarray]:
        nonlocal seen
        for finite, chunk in decode_chunks():
            seen += finite
            yield make_rows(chunk, has_labels)
        # Not before the end is known how many are not finite; the file is then left as it was.
        check_finite(seen, num_finite, source, drop_nonfinite)

    header = add_comments(make_scene_header(form, has_labels), made_by)
    write_ply_file(path, header, count, encode_chunks())
    return count, num_generated


def make_scene_header(gaussians: Gaussians, provenance: bool) -> bytes:
    """Make the header of the standard layout, with or without `generated`."""
    dtype = make_row_type(gaussians, provenance)
    comment = MODE_COMMENT if gaussians.is_antialiased else None
    return make_header({"vertex": (len(gaussians), dtype)}, comment)


def make_row_type(gaussians: Gaussians, provenance: bool) -> np.dtype:
    """Make the type of a row in the standard layout, with or without `generated`."""
    rest = (f"f_rest_{i}" for i in range(3 * (gaussians.sh.shape[1] - 1)))
    names = (*_NORMALS, *_DC, *rest, "opacity", *_SCALES, *_QUATS)
    labels = [(LABEL_COLUMN, "<f4")] if provenance else []
    # Positions that were read as double are written as double.
    kind = "<f4" if gaussians.origin is None else "<f8"
    return np.dtype(
        [*((name, kind) for name in MEANS), *((name, "<f4") for name in names), *labels]
    )


def make_rows(gaussians: Gaussians, provenance: bool, block: slice | None = None) -> np.ndarray:
    """Make one row per Gaussian, or per one of a block, in the standard layout."""
    block = slice(0, len(gaussians)) if block is None else block
    start, stop, _ = block.indices(len(gaussians))
    properties = (
        *(gaussians.means, gaussians.quats, gaussians.scales, gaussians.opacities),
        *(gaussians.sh, gaussians.encoded),
    )
    plain = make_row_type(replace(gaussians, origin=None), provenance=False)
    table = np.empty((stop - start, len(plain.names or ())), np.float32)
    kernels.encode_rows(0, len(table), start, *map(_to_array, properties), table)
    rows = table.astype("<f4", copy=False).view(plain)[:, 0]
    if gaussians.origin is not None:
        rows = restore_positions(rows, gaussians.origin, make_row_type(gaussians, provenance=False))
    if not provenance:
        return rows
    dtype = make_row_type(gaussians, provenance=True)
    return append_labels(rows, dtype, gaussians.generated[block].cpu().numpy())


def restore_positions(rows: ndarray, origin: Origin, dtype: np.dtype) -> ndarray:
    """Add an origin to the positions of rows, in float64; all else stays."""
    restored = np.empty(len(rows), dtype)
    for name in dtype.names or ():
        restored[name] = rows[name]
    for name, place in zip(MEANS, origin, strict=True):
        restored[name] += place
    return restored


def append_labels(rows: ndarray, dtype: np.dtype, labels: UInt8[ndarray, "n"]) -> ndarray:
    """Append labels to rows, or replace those that they end in: `dtype` ends in `generated`."""
    kind = dtype[LABEL_COLUMN]
    raw = np.empty((len(rows), dtype.itemsize), np.uint8)
    width = dtype.itemsize - kind.itemsize
    raw[:, :width] = np.ascontiguousarray(rows).view(np.uint8).reshape(len(rows), -1)[:, :width]
    raw[:, width:] = labels.astype(kind)[:, None].view(np.uint8)
    return raw.view(dtype)[:, 0]


def describe_other_content(elements: Sequence[Element], missing: Sequence[str]) -> str | None:
    """Describe what a .ply without Gaussians holds, and what to name instead; None if unknown."""
    if _DC[0] not in missing:
        return None
    columns = {name for element in elements for name in element.dtype.names or ()}
    if any(name.startswith(("f_offset_", "f_anchor_feat_")) for name in columns):
        return (
            "anchors of Scaffold-GS, whose Gaussians a network makes for each camera; export its "
            "Gaussians, or train a splat of plain 3DGS"
        )
    if not columns.issuperset(MEANS) or _DC[0] in columns:
        return None
    if any(element.name == "face" for element in elements):
        return "a mesh; train a splat from photographs, and name its .ply"
    return (
        "a point cloud; name the .ply that the training of the splat wrote (often "
        "point_cloud/iteration_N/point_cloud.ply or splat.ply)"
    )


def read_ply_record(path: Path) -> object:
    """Read the record in the comments of a .ply, or None if there is none."""
    with open_file(path) as file:
        return parse_comments(read_header(file, path)[0], quote_value(path))


def is_packed(head: bytes) -> bool:
    """Check whether the start of a .ply is that of a compressed one."""
    return b"packed_position" in head


PLY = SplatFormat(
    name="ply",
    endings=(".ply",),
    texts=FormatTexts(
        title="3DGS",
        read="any property order, type and byte order, ASCII, SH degree 0 to 3; vertices are the "
        "first element",
        written="binary little-endian",
        precision="bit for bit",
        axes="x right, y down, z forward",
        places={
            "holds_labels": "property `float generated`, the last one (`uchar` in earlier files)",
            "read_record": "after it, one `comment gscompleter-provenance/1 {…}` for each run, in "
            "JSON",
            "holds_origin": "positions of `double`",
            "marks_antialiased": "`SplatRenderMode: mip`, `antialiased 1` or "
            "`postshot.anti_aliasing=1` in a comment",
            "list_names": "yes",
        },
    ),
    read=load_ply,
    starts=(PLY_MAGIC,),
    recognize=lambda path, head: not is_packed(head),
    write=save_ply,
    read_record=read_ply_record,
    holds_labels=True,
    holds_origin=True,
    marks_antialiased=True,
)
