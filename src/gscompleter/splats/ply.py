"""Reader and writer of the .ply files of 3DGS.

Written is the standard layout (binary little-endian float32: x y z nx ny nz f_dc_* f_rest_*
opacity scale_* rot_*), then `uchar generated`. Read are the same properties in any order and
type. In the file scales are logarithms, opacities are logits, and f_rest_* has all coefficients
of red, then green, then blue. A comment marks antialiased Gaussians: Brush's is written,
Postshot's are read too.

Two variants are read as ordinary Gaussians. A property `filter_3D` (Mip-Splatting, GOF) is fused
into scales and opacities, as their viewers do. Surfels of 2DGS, which have two scales and the third
axis as their normal, get a thin third scale.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float
from numpy.lib.recfunctions import require_fields
from torch import Tensor

from gscompleter.numerics.kernels.parallel import map_in_parallel
from gscompleter.numerics.value_checks import LARGEST, check_gaussians, find_finite
from gscompleter.splats.provenance import NOTHING_KNOWN, Provenance, add_comments
from gscompleter.system.errors import InputError, quote_value, require_path
from gscompleter.system.files.ply import (
    Element,
    PlyFile,
    make_header,
    read_ply_file,
    write_ply_file,
)
from gscompleter.types import Gaussians

MEANS = ("x", "y", "z")
_NORMALS = ("nx", "ny", "nz")
_DC = ("f_dc_0", "f_dc_1", "f_dc_2")
_SCALES = ("scale_0", "scale_1", "scale_2")
_QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
_NEEDED = (*MEANS, *_DC, "opacity", *_SCALES[:2], *_QUATS)
FILTER = "filter_3D"
"""Standard deviation of the smoothing filter of Mip-Splatting and GOF, in scene units."""
SURFEL_THICKNESS = 1e-3
"""Thickness of a surfel of 2DGS, relative to its smaller scale."""
_NUM_REST = (0, 9, 24, 45)
"""Number of properties f_rest_* by SH degree."""

_MAX_LOGIT = 30.0
"""Opacities of 0 are written as this logit, negated."""

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


def load_ply(path: Path | str, drop_nonfinite: bool = False) -> Gaussians:
    """Load the Gaussians of a 3DGS .ply of SH degree 0 to 3.

    With `drop_nonfinite`, Gaussians with NaN, infinity or a zero quaternion are dropped; otherwise
    the file is refused. Infinite opacity logits are valid: converters write them for opacities of 1
    and 0.
    """
    path = require_path(path)
    try:
        return require_finite(decode_gaussians(read_scene(path)), path, drop_nonfinite)
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


def read_scene(path: Path) -> PlyFile:
    """Read the rows of a 3DGS .ply, surfels of 2DGS included."""
    scene = read_ply_file(path, _NEEDED, "3DGS scene", describe_other_content)
    names = scene.rows.dtype.names or ()
    num_rest = count_rest(scene)
    if num_rest not in _NUM_REST or any(f"f_rest_{i}" not in names for i in range(num_rest)):
        raise InputError(
            f"{path} has {num_rest} properties f_rest_*; spherical harmonics of degree 0 to 3 "
            "have 0, 9, 24 or 45, numbered from 0."
        )
    return scene


def count_rest(scene: PlyFile) -> int:
    """Count the properties for SH of degree 1 and above."""
    return sum(name.startswith("f_rest_") for name in scene.rows.dtype.names or ())


def has_mode_comment(header: bytes) -> bool:
    """Return True if the last comment on the mode marks the Gaussians as antialiased."""
    modes = _MODE_LINE.findall(header)
    return bool(modes) and modes[-1].lower() in _ANTIALIASED


def decode_gaussians(scene: PlyFile) -> Gaussians:
    """Decode the Gaussians of a .ply, non-finite ones included."""
    rows = scene.rows
    num_rest = count_rest(scene)
    names = rows.dtype.names or ()
    rests = tuple(f"f_rest_{i}" for i in range(num_rest))
    logs = (*(name for name in _SCALES if name in names), "opacity")
    rest, means, quats, encoded, dc = map_in_parallel(
        lambda columns: torch.from_numpy(read_columns(rows, columns)),
        [rests, MEANS, _QUATS, logs, _DC],
    )
    # The file has all coefficients of red, then green, then blue.
    rest = rest.view(len(rows), 3, num_rest // 3).transpose(1, 2)
    # Logarithms of scales: the third one of a surfel is thinner than the smaller one by a factor.
    if has_surfels(scene):
        thin = encoded[:, :2].amin(1) + math.log(SURFEL_THICKNESS)
        encoded = torch.cat([encoded[:, :2], thin[:, None], encoded[:, 2:]], dim=1)
    generated = np.zeros(len(rows), np.uint8)
    if "generated" in names:
        with np.errstate(invalid="ignore"):
            generated = rows["generated"].astype(np.uint8)
    gaussians = Gaussians(
        means=means,
        quats=quats,
        scales=_decode_scales(encoded),
        opacities=_decode_opacities(encoded),
        sh=torch.cat([dc[:, None], rest], dim=1).contiguous(),
        generated=torch.from_numpy(generated),
        encoded=encoded,
        is_antialiased=has_mode_comment(scene.header),
    )
    if FILTER not in names:
        return gaussians
    return fuse_filter(gaussians, torch.from_numpy(read_columns(rows, (FILTER,)))[:, 0])


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
    bad = int((~good).sum())
    if bad == len(good) and (bad == 0 or drop_nonfinite):
        raise InputError(f"{quote_value(path)} holds no Gaussian that is finite; write it anew.")
    if bad > 0 and not drop_nonfinite:
        raise InputError(
            f"{quote_value(path)} has {bad:,} of {len(good):,} Gaussians with NaN, infinity, "
            f"numbers above {LARGEST:g} or a rotation of zeros; repair it, or drop what is not "
            "finite.",
            "drop_nonfinite",
        )
    return gaussians[good] if bad > 0 else gaussians


def iterate_blocks(count: int) -> Iterator[slice]:
    """Yield slices of `BLOCK_ROWS` rows from 0 to `count`."""
    return (slice(start, start + BLOCK_ROWS) for start in range(0, count, BLOCK_ROWS))


def _decode_scales(encoded: Float[Tensor, "n 4"]) -> Float[Tensor, "n 3"]:
    return encoded[:, :3].double().exp_().float()


def _decode_opacities(encoded: Float[Tensor, "n 4"]) -> Float[Tensor, "n"]:
    return encoded[:, 3].double().sigmoid_().float()


def encode(gaussians: Gaussians) -> Float[Tensor, "n 4"]:
    """Compute log-scales and logit opacities for a file, always finite.

    Values read from a file are reused where they still decode to the values in memory.
    """
    tiny = torch.finfo(torch.float32).tiny
    scales = gaussians.scales.double().clamp_min(tiny).log()
    # The largest float32 below 1 has a logit of 16.6; a larger one could not be read back.
    opacities = gaussians.opacities.double().clamp(0, 1 - 2**-24).logit()
    anew = torch.cat([scales, opacities.clamp_min(-_MAX_LOGIT)[:, None]], dim=1).float()
    if gaussians.encoded is None:
        return anew
    from_file = gaussians.encoded
    same_scales = _decode_scales(from_file) == gaussians.scales
    same_opacities = _decode_opacities(from_file) == gaussians.opacities
    same = torch.cat([same_scales, same_opacities[:, None]], dim=1)
    return torch.where(same & from_file.isfinite(), from_file, anew)


def save_ply(
    path: Path | str,
    gaussians: Gaussians,
    provenance: bool | None = None,
    made_by: Provenance = NOTHING_KNOWN,
) -> None:
    """Write a standard 3DGS .ply, with `uchar generated` after the standard properties.

    `provenance` decides if `generated` is written; the default is yes if anything was generated.
    Some readers (such as gsply 0.4) misread rows that end in a byte; False writes the plain layout.
    `made_by` becomes comments.
    """
    path = require_path(path)
    check_gaussians(gaussians, "The scene to write")
    if provenance is None:
        provenance = bool((gaussians.generated > 0).any())
    gaussians = gaussians.detach().to("cpu")
    blocks = (make_rows(gaussians[block], provenance) for block in iterate_blocks(len(gaussians)))
    header = add_comments(make_scene_header(gaussians, provenance), made_by)
    write_ply_file(path, header, len(gaussians), blocks)


def make_scene_header(gaussians: Gaussians, provenance: bool) -> bytes:
    """Make the header of the standard layout, with or without `generated`."""
    dtype = make_rows(gaussians[:0], provenance).dtype
    comment = MODE_COMMENT if gaussians.is_antialiased else None
    return make_header({"vertex": (len(gaussians), dtype)}, comment)


def make_rows(gaussians: Gaussians, provenance: bool) -> np.ndarray:
    """Make one row per Gaussian in the standard layout, with or without `generated`."""
    rest = gaussians.sh[:, 1:].transpose(1, 2).flatten(1)
    encoded = encode(gaussians)
    columns = {
        MEANS: gaussians.means,
        _NORMALS: torch.zeros_like(gaussians.means),
        _DC: gaussians.sh[:, 0],
        tuple(f"f_rest_{i}" for i in range(rest.shape[1])): rest,
        ("opacity",): encoded[:, 3:],
        _SCALES: encoded[:, :3],
        _QUATS: gaussians.quats,
    }
    dtype = [(name, "<f4") for names in columns for name in names]
    table = torch.cat(list(columns.values()), dim=1).detach().float().numpy()
    rows = np.ascontiguousarray(table, "<f4").view(dtype)[:, 0]
    if provenance:
        rows = require_fields(rows, [*dtype, ("generated", "u1")])
        rows["generated"] = gaussians.generated.numpy()
    return rows


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
