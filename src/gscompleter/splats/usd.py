"""Gaussians in OpenUSD, through usd-core (the extra `usd`).

A prim ParticleField3DGaussianSplat has arrays of linear scales, opacities in [0, 1], rotations, and
SH coefficients, one Gaussian after the other. Axes are x right, y up, z back. A .usdz is a zip of
one .usdc. Read are all such prims of a stage, each with its transform to the world, in single or
half precision; a stage with z up is turned.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
from jaxtyping import Float
from numpy import ndarray

from gscompleter.splats.glb import COLOR_SPACE
from gscompleter.splats.packing import (
    NUM_SH_REST,
    ZIP_MAGIC,
    UnsupportedError,
    build_gaussians,
    with_labels,
)
from gscompleter.splats.provenance import KEY, NOTHING_KNOWN, Provenance
from gscompleter.splats.splat_format import FormatTexts, SplatFormat, list_zip
from gscompleter.splats.transform import (
    HALF_TURN_X,
    merge_placed,
    place_gaussians,
    require_similarity,
    rotate_half_turn,
)
from gscompleter.system.damage import DamagedError
from gscompleter.system.errors import InputError, OutputError, quote_value
from gscompleter.system.files.unfinished import make_unfinished_name
from gscompleter.system.files.writing import convert_write_errors, replace_file
from gscompleter.types import Gaussians

if TYPE_CHECKING:
    from pxr import Usd

KIND = "ParticleField3DGaussianSplat"
"""Type of the prims of Gaussians."""
SH_NAME = "radiance:sphericalHarmonics"
"""Start of the names of the attributes of their colours."""
LABELS_NAME = "generated"
"""Attribute of the labels, an array of bytes, if anything was generated; ours alone."""
PROBE_BYTES = 2**20
"""Fewest bytes that are written to find out why OpenUSD could not."""
LAYER_ENDINGS = (".usdc", ".usda", ".usd")
USD_ENDINGS = (*LAYER_ENDINGS, ".usdz")
LINEAR = "lin_"
"""Start of the names of linear colour spaces."""
Y_FROM_Z_UP = ((1, 0, 0, 0), (0, 0, 1, 0), (0, -1, 0, 0), (0, 0, 0, 1))
"""Turn from z up to y up, about x; acts on columns."""
EXTENT = 3
"""Standard deviations of each Gaussian that lie within the bounds of the prim."""
PACKAGED = (2000, 1, 1, 0, 0, 0, 0, 0, -1)
"""Local time of the .usdc in a .usdz, as of `time.mktime`: the first of January 2000, in every run,
so that the same Gaussians give the same bytes."""


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
        # A .usdz is a package of one .usdc.
        layer = folder / ("splat.usdc" if ending == ".usdz" else f"splat{ending}")
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
    """Convert the errors of OpenUSD, which do not tell a full disk from others.

    The system tells, when as many bytes as OpenUSD had written are written once more.
    """
    try:
        yield
    except Exception as error:
        # Ends with the error of the system, if it has one.
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
    """Make a stage of one prim from Gaussians with y up, whose unit is taken for a metre."""
    from pxr import Gf, Sdf, Usd, UsdGeom, Vt

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    UsdGeom.SetStageMetersPerUnit(stage, 1)
    prim = stage.DefinePrim("/Splat", KIND)
    stage.SetDefaultPrim(prim)
    Usd.ColorSpaceAPI.Apply(prim).CreateColorSpaceNameAttr(COLOR_SPACE)
    if gaussians.origin is not None:
        UsdGeom.Xformable(prim).AddTranslateOp().Set(Gf.Vec3d(*gaussians.origin))
    means = gaussians.means
    # The largest deviation reaches as far in any direction, however a Gaussian is turned.
    reach = EXTENT * gaussians.scales.amax(1, keepdim=True)
    # From wxyz: in its arrays, OpenUSD has the real part last.
    quats = torch.nn.functional.normalize(gaussians.quats, dim=1).roll(-1, dims=1)
    values = {
        "extent": torch.stack([(means - reach).amin(0), (means + reach).amax(0)]),
        "positions": means,
        "orientations": quats,
        "scales": gaussians.scales,
        "opacities": gaussians.opacities,
        f"{SH_NAME}Coefficients": gaussians.sh.reshape(-1, 3),
    }
    for name, value in values.items():
        prim.GetAttribute(name).Set(np.ascontiguousarray(value.numpy()))
    prim.GetAttribute(f"{SH_NAME}Degree").Set(gaussians.sh_degree)
    if gaussians.generated.any():
        labels = prim.CreateAttribute(LABELS_NAME, Sdf.ValueTypeNames.UCharArray, custom=True)
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


def read_usd(path: Path) -> Gaussians:
    """Read all Gaussians of a stage, in the axes of a .ply and the unit of the stage."""
    _require_usd()
    from pxr import Usd, UsdGeom

    with _open_stage(path) as stage:
        prims = [
            prim
            for prim in Usd.PrimRange(stage.GetPseudoRoot(), Usd.TraverseInstanceProxies())
            if prim.GetTypeName() == KIND
        ]
        if not prims:
            raise UnsupportedError(f"is OpenUSD without Gaussians ({KIND})")
        has_z_up = UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.z
        parts = [_read_prim(prim, has_z_up) for prim in prims]
    return rotate_half_turn(merge_placed(parts), HALF_TURN_X)


def read_usd_record(path: Path) -> object:
    """Read the record in the `customLayerData` of a stage, or None if there is none."""
    _require_usd()
    with _open_stage(path) as stage:
        text = stage.GetRootLayer().customLayerData.get(KEY)
    return None if text is None else json.loads(text)


@contextmanager
def _open_stage(path: Path) -> Iterator[Usd.Stage]:
    """Open a stage; OpenUSD knows the format of a file by its ending alone.

    Raise DamagedError where it is found damaged, which may be when its arrays are read.
    """
    from pxr import Tf, Usd, UsdUtils

    with ExitStack() as stack:
        place = path
        if path.suffix.lower() not in USD_ENDINGS:
            # On Windows, a file that OpenUSD still maps cannot be removed.
            temporary = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
            folder = stack.enter_context(temporary)
            starts = path.open("rb").read(len(ZIP_MAGIC))
            ending = {b"PXR-": ".usdc", ZIP_MAGIC: ".usdz"}.get(starts, ".usda")
            place = Path(shutil.copyfile(path, Path(folder) / f"splat{ending}"))
        # Its warnings would be lines of their own; what matters raises an error.
        delegate = UsdUtils.CoalescingDiagnosticDelegate()
        stack.callback(delegate.TakeUncoalescedDiagnostics)
        try:
            yield Usd.Stage.Open(str(place))
        except Tf.ErrorException as error:  # its message names source files of OpenUSD
            raise DamagedError("OpenUSD finds it damaged") from error


def _read_prim(prim: Usd.Prim, has_z_up: bool) -> Gaussians:
    """Read the Gaussians of a prim, in the world with y up and the unit of the stage."""
    from pxr import Sdf, Usd, UsdGeom

    space = _find_color_space(_find_array(prim, f"{SH_NAME}Coefficients"))
    if space.startswith(LINEAR):
        raise UnsupportedError(f"has colours in the linear space {quote_value(space)}")
    positions = _read_prim_array(prim, "positions", 3)
    count = len(positions)
    degree = int(prim.GetAttribute(f"{SH_NAME}Degree").Get(Usd.TimeCode.EarliestTime()))
    if not 0 <= degree < len(NUM_SH_REST):
        raise UnsupportedError(f"has SH degree {degree}, and degree 0 to 3 is read")
    width = 1 + NUM_SH_REST[degree]
    gaussians = build_gaussians(
        positions,
        np.roll(_read_prim_array(prim, "orientations", 4), 1, axis=1),
        _read_prim_array(prim, "scales", 3),
        _read_prim_array(prim, "opacities", 1)[:, 0],
        _read_prim_array(prim, f"{SH_NAME}Coefficients", 3).reshape(count, width, 3),
    )
    labels = prim.GetAttribute(LABELS_NAME)
    # Other programs may use that name for something else.
    is_ours = bool(labels) and labels.GetTypeName() == Sdf.ValueTypeNames.UCharArray
    if is_ours and labels.HasAuthoredValue():
        gaussians = with_labels(gaussians, np.asarray(labels.Get(Usd.TimeCode.EarliestTime())))

    # Matrices of OpenUSD act on rows.
    matrix = UsdGeom.XformCache(Usd.TimeCode.EarliestTime()).GetLocalToWorldTransform(prim)
    place = torch.tensor(np.array(matrix)).T
    if has_z_up:
        place = torch.tensor(Y_FROM_Z_UP, dtype=torch.float64) @ place
    require_similarity(place, "prim")
    return place_gaussians(gaussians, place)


def _find_color_space(colors: Usd.Attribute) -> str:
    """Find the name of the colour space of an attribute; empty for none.

    It is that of the attribute itself, or else of its prim or the nearest one above.
    """
    from pxr import Usd

    if colors.HasColorSpace():
        return str(colors.GetColorSpace())
    # Not by `ComputeColorSpaceName`, which prints a warning about names that it does not know.
    prim = colors.GetPrim()
    while prim:
        attribute = Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr()
        if attribute and attribute.HasAuthoredValue():
            return str(attribute.Get())
        prim = prim.GetParent()
    return ""


def _find_array(prim: Usd.Prim, name: str) -> Usd.Attribute:
    """Find an array of a prim, that of single precision if there are both."""
    for attribute in (prim.GetAttribute(name), prim.GetAttribute(f"{name}h")):
        if attribute and attribute.HasAuthoredValue():
            return attribute
    raise UnsupportedError(f"has Gaussians without {name}")


def _read_prim_array(prim: Usd.Prim, name: str, width: int) -> Float[ndarray, "n w"]:
    """Read an array of a prim as rows of `width` numbers."""
    from pxr import Usd

    values = _find_array(prim, name).Get(Usd.TimeCode.EarliestTime())
    return np.asarray(values, np.float32).reshape(-1, width)


def is_usdz(path: Path, head: bytes) -> bool:
    """Check that a .zip is a package of OpenUSD."""
    names = list_zip(path)
    if not names:
        # The reader says what is wrong with a damaged one.
        return path.suffix.lower() == ".usdz"
    return any(name.lower().endswith(LAYER_ENDINGS) for name in names)


USDZ = SplatFormat(
    name="usdz",
    endings=(".usdz",),
    texts=FormatTexts(
        title="OpenUSD",
        read="all prims `ParticleField3DGaussianSplat`, of single or half precision, with "
        "rotation, uniform scale and shift, `upAxis` Y or Z; the first of animated values",
        written="a prim `ParticleField3DGaussianSplat`, `upAxis` Y, one metre per unit, "
        "`srgb_rec709_display`",
        precision="bit for bit, rotations normalised",
        axes="x right, y up, z back",
        places={
            "holds_labels": "attribute `uchar[] generated` of the prim",
            "read_record": "`customLayerData`, `provenance`: a string of JSON",
            "holds_origin": "the shift of a node",
        },
    ),
    read=read_usd,
    starts=(ZIP_MAGIC,),
    recognize=is_usdz,
    write=write_usd,
    read_record=read_usd_record,
    holds_labels=True,
    holds_origin=True,
    is_y_up=True,
    has_json=True,
    extra="usd",
)
USD = replace(
    USDZ,
    name="usd",
    endings=LAYER_ENDINGS,
    starts=(b"PXR-USDC", b"#usda"),
    recognize=None,
)
