"""Gaussians in OpenUSD, written through usd-core (the extra `usd`).

A prim ParticleField3DGaussianSplat has arrays of linear scales, opacities in [0, 1], rotations, and
SH coefficients, one Gaussian after the other. Axes are x right, y up, z back. A .usdz is a zip of
one .usdc.
"""

from __future__ import annotations

import os
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from gscompleter.errors import InputError, quote_value
from gscompleter.io.files import replace_file
from gscompleter.splats.glb import COLOR_SPACE
from gscompleter.splats.transform import HALF_TURN_X, rotate_half_turn
from gscompleter.types import Gaussians

if TYPE_CHECKING:
    from pxr import Usd

KIND = "ParticleField3DGaussianSplat"
SH_NAME = "radiance:sphericalHarmonics"
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
        sentence = "OpenUSD needs usd-core 26.3 or newer: `pip install 'gscompleter[usd]'`."
        raise InputError(sentence) from error


def refuse_usd(path: Path) -> Gaussians:
    """Refuse to read OpenUSD, which is only written."""
    raise InputError(f"{quote_value(path)} is OpenUSD, which is not read; export it as .ply.")
