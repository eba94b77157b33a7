"""Gaussians in OpenUSD, as prims ParticleField3DGaussianSplat, through usd-core (the extra `usd`).

A prim has arrays of linear scales, opacities in [0, 1], xyzw rotations, and SH coefficients, one
Gaussian after the other, in single or half precision. Written are files of one prim in single
precision, with axes x right, y up, z back; a .usdz is a zip of one .usdc.
"""

from __future__ import annotations

import os
import tempfile
import time
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
SH_NAME = "radiance:sphericalHarmonics"
Z_UP = torch.tensor([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""Transform from axes with z up to those with y up."""
EXTENT = 3
"""Standard deviations of the Gaussians that lie within the bounds of the prim."""
PACKAGED = (2000, 1, 1, 0, 0, 0, 0, 0, -1)
"""Time of the .usdc in a .usdz, so that the same Gaussians give the same bytes."""


def write_usd(path: Path, gaussians: Gaussians) -> None:
    """Write a .usda, .usdc or .usdz, by the name of `path`."""
    _require_usd()
    from pxr import UsdUtils

    stage, ending = _make_stage(rotate_half_turn(gaussians, HALF_TURN_X)), path.suffix.lower()
    with tempfile.TemporaryDirectory() as folder:
        made = layer = Path(folder, f"splat{ending.replace('z', 'c')}")
        stage.GetRootLayer().Export(str(layer))
        if ending == ".usdz":
            os.utime(layer, (time.mktime(PACKAGED),) * 2)
            made = layer.with_suffix(ending)
            UsdUtils.CreateNewUsdzPackage(str(layer), str(made))
        with replace_file(path) as file:
            file.write(made.read_bytes())


def _make_stage(gaussians: Gaussians) -> Usd.Stage:
    """Make a stage of one prim, from Gaussians in its axes."""
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    prim = stage.DefinePrim("/Splat", KIND)
    stage.SetDefaultPrim(prim)
    Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(COLOR_SPACE)
    means, reach = gaussians.means, EXTENT * gaussians.scales.amax(1, keepdim=True)
    values = {
        "extent": torch.stack([(means - reach).amin(0), (means + reach).amax(0)]),
        "positions": means,
        "orientations": torch.nn.functional.normalize(gaussians.quats, dim=1).roll(-1, dims=1),
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        f"{SH_NAME}Coefficients": gaussians.sh.reshape(-1, 3),
    }
    for name, value in values.items():
        prim.GetAttribute(name).Set(np.ascontiguousarray(value.numpy()))
    prim.GetAttribute(f"{SH_NAME}Degree").Set(gaussians.sh_degree)
    return stage


def _require_usd() -> None:
    """Refuse the format without a usd-core that knows Gaussians."""
    try:
        from pxr import UsdVol

        UsdVol.ParticleField3DGaussianSplat  # noqa: B018
    except (ImportError, AttributeError) as error:
        raise InputError(
            "OpenUSD needs usd-core 26.3 or newer: `pip install 'gscompleter[usd]'`."
        ) from error


def read_usd(path: Path) -> Gaussians:
    """Read the Gaussians of all prims on the stage of a file, in the axes of a .ply."""
    _require_usd()
    from pxr import Tf

    content = read_bytes(path)
    with tempfile.TemporaryDirectory() as folder:  # a copy with a name that is understood
        copy = Path(folder, "splat.usdz" if content.startswith(ZIP_MAGIC) else "splat.usd")
        copy.write_bytes(content)
        try:
            return rotate_half_turn(_read_stage(copy), HALF_TURN_X)
        except Tf.ErrorException as error:
            raise ValueError("usd-core finds it damaged") from error


def _read_stage(path: Path) -> Gaussians:
    """Read the Gaussians of a stage that consists of one file, in axes with y up."""
    from pxr import Sdf, Usd, UsdGeom

    layer = Sdf.Layer.FindOrOpen(str(path))
    if layer.GetCompositionAssetDependencies():
        raise ValueError("it is composed of several files, which usdcat --flatten unites")
    stage = Usd.Stage.Open(layer)
    parts = [_read_prim(prim) for prim in stage.Traverse() if prim.GetTypeName() == KIND]
    if not parts:
        raise ValueError(f"it has no prim {KIND}")
    is_z_up = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
    return transform_gaussians(merge(parts), Z_UP) if is_z_up else merge(parts)


def _read_prim(prim: Usd.Prim) -> Gaussians:
    """Read the Gaussians of a prim, in the frame of the stage."""
    from pxr import UsdGeom

    def read(name: str) -> Float[ndarray, "n *k"]:
        values = prim.GetAttribute(name).Get() or prim.GetAttribute(f"{name}h").Get()
        if not values:
            raise ValueError(f"it lacks {name}")
        return np.asarray(values, np.float32)

    means, sh = read("positions"), read(f"{SH_NAME}Coefficients")
    quats = np.roll(read("orientations"), 1, axis=1)
    sh = sh.reshape(len(means), -1, 3)
    gaussians = build_gaussians(means, quats, read("scales"), read("opacities"), sh)
    to_stage = UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0)
    place = torch.from_numpy(np.array(to_stage).T)  # pxr multiplies rows from the left
    require_similarity(place)
    return transform_gaussians(gaussians, place.float())
