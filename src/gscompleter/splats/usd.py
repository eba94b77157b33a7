"""Gaussians in OpenUSD, written through usd-core (the extra `usd`).

A prim ParticleField3DGaussianSplat has arrays of linear scales, opacities in [0, 1], rotations, and
SH coefficients, one Gaussian after the other. Axes are x right, y up, z back. A .usdz is a zip of
one .usdc.
"""

from __future__ import annotations

import json
import os
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch

from gscompleter.splats.glb import COLOR_SPACE
from gscompleter.splats.provenance import KEY, NOTHING_KNOWN, Provenance
from gscompleter.splats.transform import HALF_TURN_X, rotate_half_turn
from gscompleter.system.errors import InputError, OutputError, quote_value
from gscompleter.system.files.unfinished import make_unfinished_name
from gscompleter.system.files.writing import convert_write_errors, replace_file
from gscompleter.types import Gaussians

if TYPE_CHECKING:
    from pxr import Usd

KIND = "ParticleField3DGaussianSplat"
SH_NAME = "radiance:sphericalHarmonics"
LABELS = "generated"
"""Attribute of the labels, if anything was generated; ours alone."""
PROBE_BYTES = 2**20
"""Bytes that are written to find out why OpenUSD could not."""
EXTENT = 3
"""Standard deviations of the Gaussians that lie within the bounds of the prim."""
PACKAGED = (2000, 1, 1, 0, 0, 0, 0, 0, -1)
"""Time of the .usdc in a .usdz, so that the same Gaussians give the same bytes."""


def write_usd(path: Path, gaussians: Gaussians, made_by: Provenance = NOTHING_KNOWN) -> None:
    """Write a .usda, .usdc or .usdz, by the name of `path`."""
    _require_usd()
    from pxr import UsdUtils

    stage = _make_stage(rotate_half_turn(gaussians, HALF_TURN_X))
    if made_by.runs:
        # OpenUSD has no lists of dictionaries there, so that the record is a text.
        stage.GetRootLayer().customLayerData = {KEY: json.dumps(made_by.to_json())}
    ending = path.suffix.lower()
    with _make_folder_beside(path) as folder:
        # A .usdz is made of a .usdc.
        layer = folder / f"splat{ending.replace('z', 'c')}"
        result = layer
        with _convert_usd_errors(path, folder):
            stage.GetRootLayer().Export(str(layer))
            if ending == ".usdz":
                # A zip stores the time of its files.
                os.utime(layer, (time.mktime(PACKAGED),) * 2)
                result = layer.with_suffix(ending)
                UsdUtils.CreateNewUsdzPackage(str(layer), str(result))
        with replace_file(path) as file:
            file.write(result.read_bytes())


@contextmanager
def _make_folder_beside(path: Path) -> Iterator[Path]:
    """Make a folder for files of OpenUSD on the disk of `path`, which has space for the result."""
    target = Path(os.path.realpath(path))
    folder = target.with_name(make_unfinished_name(target.name))
    with convert_write_errors(path):
        folder.mkdir()
    try:
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _convert_usd_errors(path: Path, folder: Path) -> Iterator[None]:
    """Convert the errors of OpenUSD, which have no numbers, by trying to write as much."""
    try:
        yield
    except Exception as error:
        with convert_write_errors(path):
            size = sum(file.stat().st_size for file in folder.iterdir())
            with (folder / "probe").open("wb") as probe:
                probe.write(bytes(max(size, PROBE_BYTES)))
                probe.flush()
                os.fsync(probe.fileno())
        reason = quote_value(" ".join(str(error).split()), 120)
        raise OutputError(
            f"Cannot write {quote_value(path)}: OpenUSD says {reason}; choose another place."
        ) from error


def _make_stage(gaussians: Gaussians) -> Usd.Stage:
    """Make a stage of one prim, from Gaussians in its axes."""
    from pxr import Sdf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    prim = stage.DefinePrim("/Splat", KIND)
    stage.SetDefaultPrim(prim)
    Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(COLOR_SPACE)
    means = gaussians.means
    reach = EXTENT * gaussians.scales.amax(1, keepdim=True)
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
    if gaussians.generated.any():
        labels = prim.CreateAttribute(LABELS, Sdf.ValueTypeNames.UCharArray, custom=True)
        labels.Set(Vt.UCharArray.FromNumpy(gaussians.generated.numpy()))
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
