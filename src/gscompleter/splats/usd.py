"""Gaussians in OpenUSD, as prims ParticleField3DGaussianSplat, through usd-core (the extra `usd`).

A prim has arrays of linear scales, opacities in [0, 1], rotations, and SH coefficients of one
Gaussian after the other, in single or half precision. Files are written in single precision, with
axes x right, y up, z back; a .usdz is a zip of one .usdc.
"""

from __future__ import annotations

import io
import struct
import tempfile
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from gscompleter.errors import InputError
from gscompleter.io.files import replace_file
from gscompleter.io.reading import read_bytes
from gscompleter.splats.glb import COLOR_SPACE
from gscompleter.splats.packing import ZIP_MAGIC, build_gaussians
from gscompleter.splats.transform import (
    HALF_TURN_X,
    require_similarity,
    rotate_half_turn,
    transform_gaussians,
)
from gscompleter.types import Gaussians, merge

if TYPE_CHECKING:
    from pxr import Usd

KIND = "ParticleField3DGaussianSplat"
Z_UP = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Transform from axes with z up to those with y up."""
EXTENT = 3
"""Standard deviations of the Gaussians that lie within the bounds of the prim."""
ZIP_HEADER_BYTES, ZIP_ALIGNMENT = 30, 64
PADDING_FIELD = 0x1986
"""Number of the field in the header of a zip entry that aligns its content, as usd-core's."""


def write_usd(path: Path, gaussians: Gaussians) -> None:
    """Write a .usda, .usdc or .usdz, by the name of `path`."""
    stage, ending = _make_stage(rotate_half_turn(gaussians, HALF_TURN_X)), path.suffix.lower()
    with tempfile.TemporaryDirectory() as folder:
        layer = Path(folder, f"splat{ending.replace('z', 'c')}")
        stage.GetRootLayer().Export(str(layer))
        content = layer.read_bytes()
    with replace_file(path) as file:
        file.write(_package(content) if ending == ".usdz" else content)


def _make_stage(gaussians: Gaussians) -> Usd.Stage:
    """Make a stage of one prim, from Gaussians in its axes."""
    _require_usd()
    from pxr import Usd, UsdGeom, UsdVol, Vt

    def vectors(values: Float[ndarray, "*n 3"]) -> Vt.Vec3fArray:
        return Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(values.reshape(-1, 3)))

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    splat = UsdVol.ParticleField3DGaussianSplat.Define(stage, "/Splat")
    stage.SetDefaultPrim(splat.GetPrim())
    Usd.ColorSpaceAPI.Apply(splat.GetPrim()).CreateColorSpaceNameAttr(COLOR_SPACE)
    means, reach = gaussians.means, EXTENT * gaussians.scales.amax(1, keepdim=True)
    bounds = torch.stack([(means - reach).amin(0), (means + reach).amax(0)])
    unit = torch.nn.functional.normalize(gaussians.quats, dim=1)
    xyzw = np.ascontiguousarray(unit.roll(-1, dims=1).numpy())
    splat.CreateExtentAttr(vectors(bounds.numpy()))
    splat.CreatePositionsAttr(vectors(means.numpy()))
    splat.CreateOrientationsAttr(Vt.QuatfArray.FromNumpy(xyzw))
    splat.CreateScalesAttr(vectors(gaussians.scales.numpy()))
    splat.CreateOpacitiesAttr(Vt.FloatArray.FromNumpy(gaussians.opacities.numpy()))
    splat.CreateRadianceSphericalHarmonicsDegreeAttr(gaussians.sh_degree)
    splat.CreateRadianceSphericalHarmonicsCoefficientsAttr(vectors(gaussians.sh.numpy()))
    return stage


def _package(content: bytes) -> bytes:
    """Pack a .usdc into a .usdz: a zip without compression, whose content starts at 64 bytes."""
    info = zipfile.ZipInfo("splat.usdc")  # without the time of writing
    start = ZIP_HEADER_BYTES + len(info.filename) + 4
    padding = -start % ZIP_ALIGNMENT
    info.extra = struct.pack("<HH", PADDING_FIELD, padding) + bytes(padding)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as bundle:
        bundle.writestr(info, content)
    return file.getvalue()


def _require_usd() -> None:
    """Refuse the format without a usd-core that knows Gaussians."""
    try:
        from pxr import UsdVol

        found = hasattr(UsdVol, KIND)
    except ImportError:
        found = False
    if not found:
        raise InputError("OpenUSD needs usd-core 26.3 or newer: `pip install 'gscompleter[usd]'`.")


def read_usd(path: Path) -> Gaussians:
    """Read the Gaussians of all prims on the stage of a file, in the axes of a .ply."""
    _require_usd()
    from pxr import UsdGeom

    content = read_bytes(path)
    with tempfile.TemporaryDirectory() as folder:  # a copy alone, whose name usd-core understands
        copy = Path(folder, "splat.usdz" if content.startswith(ZIP_MAGIC) else "splat.usd")
        copy.write_bytes(content)
        stage = _open_stage(copy)
        parts = [_read_prim(prim) for prim in stage.Traverse() if prim.GetTypeName() == KIND]
        is_z_up = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    if not parts:
        raise ValueError(f"it has no prim {KIND}")
    merged = transform_gaussians(merge(parts), Z_UP) if is_z_up else merge(parts)
    return rotate_half_turn(merged, HALF_TURN_X)


def _open_stage(path: Path) -> Usd.Stage:
    """Open a stage that lies in one file."""
    from pxr import Tf, Usd, UsdUtils

    delegate = UsdUtils.CoalescingDiagnosticDelegate()  # keeps warnings from being printed
    try:
        stage = Usd.Stage.Open(str(path))
    except Tf.ErrorException as error:
        raise ValueError("usd-core finds it damaged") from error
    finally:
        del delegate
    places = [layer.realPath for layer in stage.GetUsedLayers() if not layer.anonymous]
    if not all(place.startswith(str(path.resolve())) for place in places):
        raise ValueError("it refers to other files")
    return stage


def _read_prim(prim: Usd.Prim) -> Gaussians:
    """Read the Gaussians of a prim, in the frame of the stage."""
    from pxr import UsdGeom

    def read(name: str) -> Float[ndarray, "n *k"]:
        """Read an attribute, in half precision if there is no other."""
        found = (prim.GetAttribute(it).Get() for it in (name, f"{name}h"))
        values = next((it for it in found if it is not None), None)
        if values is None:
            raise ValueError(f"it lacks {name}")
        return np.asarray(values, np.float32)

    means = read("positions")
    gaussians = build_gaussians(
        means,
        np.roll(read("orientations"), 1, axis=1),
        read("scales"),
        read("opacities"),
        read("radiance:sphericalHarmonicsCoefficients").reshape(len(means), -1, 3),
    )
    to_stage = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)
    place = torch.from_numpy(np.array(to_stage).T)  # pxr multiplies rows from the left
    require_similarity(place)
    return transform_gaussians(gaussians, place.float())
