"""OpenUSD: what is written is read back by usd-core itself, by its schema, and by ours."""

import os
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch

from command import run
from gscompleter import Gaussians, InputError, load_splat, save_splat
from gscompleter.splats.labels_file import get_labels_path
from gscompleter.splats.transform import HALF_TURN_X, rotate_half_turn
from gscompleter.splats.usd import SH_NAME
from gscompleter.types import make_observed
from paths import SUPPORT
from splat_files import covariances, plausible

NAMES = ["scene.usda", "scene.usdc", "scene.usd", "scene.usdz"]


@pytest.fixture
def pxr():
    return pytest.importorskip("pxr", reason="needs usd-core (the extra usd)")


def read_stage(path) -> tuple:
    """Read the stage and its one prim of Gaussians with usd-core."""
    from pxr import Usd, UsdVol

    stage = Usd.Stage.Open(str(path))
    splat = UsdVol.ParticleField3DGaussianSplat(stage.GetDefaultPrim())
    assert splat
    return stage, splat


def read_gaussians(path) -> Gaussians:
    """Read the Gaussians through the getters of the schema, in the axes of a .ply."""
    _, splat = read_stage(path)
    quats = splat.GetOrientationsAttr().Get()
    sh = np.array(splat.GetRadianceSphericalHarmonicsCoefficientsAttr().Get())
    count = (splat.GetRadianceSphericalHarmonicsDegreeAttr().Get() + 1) ** 2
    arrays = [
        np.array(splat.GetPositionsAttr().Get()),
        np.array([[q.GetReal(), *q.GetImaginary()] for q in quats], np.float32),
        np.array(splat.GetScalesAttr().Get()),
        np.array(splat.GetOpacitiesAttr().Get()),
        sh.reshape(-1, count, 3),
    ]
    return rotate_half_turn(make_observed(*map(torch.from_numpy, arrays)), HALF_TURN_X)


# `test_ply.py` limits the size of a file so.
@pytest.mark.slow
@pytest.mark.linux
@pytest.mark.parametrize("name", NAMES)
def test_a_full_disk_is_a_sentence_and_leaves_nothing(pxr, tmp_path, name):
    """A limit of the size of files stands for it; the temporary folder is not used."""
    code = (
        "import resource, signal, sys\n"
        "import torch\n"
        "from gscompleter import save_splat\n"
        "from gscompleter.system.errors import FullDiskError\n"
        "from splat_files import plausible\n"
        "signal.signal(signal.SIGXFSZ, signal.SIG_IGN)\n"
        "resource.setrlimit(resource.RLIMIT_FSIZE, (2000, 2000))\n"
        "try:\n"
        "    save_splat(sys.argv[1], plausible(2000, 3))\n"
        "except FullDiskError as error:\n"
        "    print(error)\n"
    )
    environment = {**os.environ, "TMPDIR": "/proc/none"}
    environment["PYTHONPATH"] = os.pathsep.join([str(SUPPORT), *sys.path])
    command = [sys.executable, "-c", code, str(tmp_path / name)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.stdout.startswith(f"Cannot write {tmp_path / name}: File too large"), done.stderr
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize("reader", [read_gaussians, load_splat], ids=["pxr", "ours"])
@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("name", NAMES)
def test_usd_keeps_every_number(pxr, tmp_path, name, degree, reader):
    gaussians = plausible(40, degree)
    save_splat(tmp_path / name, gaussians)
    read = reader(tmp_path / name)
    for field in ("means", "scales", "opacities", "sh"):
        assert torch.equal(getattr(read, field), getattr(gaussians, field))
    assert torch.allclose(covariances(read), covariances(gaussians), atol=1e-6)


def test_a_stage_has_its_axes_units_bounds_and_colour_space(pxr, tmp_path):
    from pxr import Usd, UsdGeom

    gaussians = plausible(40, 1)
    gaussians.means[0] = torch.tensor([1.0, 2.0, 30.0])  # right, down, forward
    save_splat(tmp_path / "scene.usda", gaussians)
    stage, splat = read_stage(tmp_path / "scene.usda")
    assert UsdGeom.GetStageUpAxis(stage) == "Y"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1
    positions = np.array(splat.GetPositionsAttr().Get())
    assert positions[0].tolist() == [1, -2, -30]
    low, high = np.array(splat.GetExtentAttr().Get())
    reach = 3 * np.array(splat.GetScalesAttr().Get()).max(1, keepdims=True)
    assert np.allclose(low, (positions - reach).min(0))
    assert np.allclose(high, (positions + reach).max(0))
    space = Usd.ColorSpaceAPI(splat.GetPrim()).GetColorSpaceNameAttr().Get()
    assert space == "srgb_rec709_display"


@pytest.mark.parametrize("name", NAMES)
def test_the_validators_of_openusd_find_nothing(pxr, tmp_path, name):
    validation = pytest.importorskip("pxr.UsdValidation", reason="needs gscompleter[usd]")
    save_splat(tmp_path / name, plausible(10, 1))
    validators = validation.ValidationRegistry().GetOrLoadAllValidators()
    errors = validation.ValidationContext(validators).Validate(read_stage(tmp_path / name)[0])
    assert [error.GetMessage() for error in errors] == []


def test_a_package_is_aligned_uncompressed_and_the_same_every_time(pxr, tmp_path):
    for name in ("a.usdz", "b.usdz"):
        save_splat(tmp_path / name, plausible(50, 2))
    data = (tmp_path / "a.usdz").read_bytes()
    assert data == (tmp_path / "b.usdz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.usdz") as package:
        (entry,) = package.infolist()
    assert entry.compress_type == zipfile.ZIP_STORED
    assert data.index(b"PXR-USDC") % 64 == 0


@pytest.mark.parametrize("name", NAMES)
def test_usd_is_recognised_without_its_ending(pxr, tmp_path, name):
    save_splat(tmp_path / name, plausible(5, 0))
    os.rename(tmp_path / name, tmp_path / "unnamed")
    assert len(load_splat(tmp_path / "unnamed")) == 5


def change_stage(path, change) -> None:
    """Write a scene of two Gaussians, and let `change` edit its stage and prim."""
    from pxr import Usd

    save_splat(path, plausible(2, 1))
    stage = Usd.Stage.Open(str(path))
    change(stage, stage.GetDefaultPrim())
    stage.GetRootLayer().Save()


def test_prims_are_read_at_their_places_in_the_world(pxr, tmp_path):
    """A prim that is turned, twice as large and moved, beside one that is not."""
    from pxr import Gf, Sdf, UsdGeom

    def add_second(stage, prim) -> None:
        stage.DefinePrim("/World")
        Sdf.CopySpec(stage.GetRootLayer(), "/Splat", stage.GetRootLayer(), "/World/Second")
        xform = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Second"))
        xform.AddTranslateOp().Set(Gf.Vec3d(1, 2, 3))
        xform.AddRotateYOp().Set(90.0)
        xform.AddScaleOp().Set(Gf.Vec3f(2, 2, 2))

    path = tmp_path / "scene.usda"
    change_stage(path, add_second)
    read = load_splat(path)
    first = rotate_half_turn(read[:2], HALF_TURN_X)
    second = rotate_half_turn(read[2:], HALF_TURN_X)
    # By hand: y up, a quarter turn about it takes z to x and x to -z.
    x, y, z = first.means.T
    expected = torch.stack([2 * z + 1, 2 * y + 2, -2 * x + 3], dim=1)
    assert torch.allclose(second.means, expected, atol=1e-5)
    assert torch.allclose(second.scales, 2 * first.scales)
    turn = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]).double()
    turned = 4 * turn @ covariances(first) @ turn.T
    assert torch.allclose(covariances(second), turned, rtol=1e-4, atol=1e-6)


def test_a_stage_with_z_up_is_turned(pxr, tmp_path):
    from pxr import UsdGeom

    save_splat(tmp_path / "y.usda", plausible(2, 1))
    change_stage(
        tmp_path / "z.usda", lambda stage, _: UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    )
    before, after = (load_splat(tmp_path / name).means for name in ("y.usda", "z.usda"))
    # What was y (up is -y in a .ply) is depth now, and what was back is up.
    assert torch.allclose(after, torch.stack([before[:, 0], before[:, 2], -before[:, 1]], 1))


def test_half_precision_is_read_where_there_is_no_other(pxr, tmp_path):
    from pxr import Sdf, Vt

    def halve(stage, prim) -> None:
        for name, kind in (("positions", "Point3hArray"), ("opacities", "HalfArray")):
            values = np.array(prim.GetAttribute(name).Get())
            prim.RemoveProperty(name)
            array = Vt.Vec3hArray if values.ndim == 2 else Vt.HalfArray
            half = prim.CreateAttribute(f"{name}h", getattr(Sdf.ValueTypeNames, kind))
            half.Set(array.FromNumpy(values.astype(np.float16)))

    change_stage(tmp_path / "scene.usdc", halve)
    read, exact = load_splat(tmp_path / "scene.usdc"), plausible(2, 1)
    assert torch.allclose(read.means, exact.means, rtol=1e-3)
    assert torch.allclose(read.opacities, exact.opacities, rtol=1e-3)
    assert torch.equal(read.scales, exact.scales)


UNREADABLE = {
    "prim that mirrors": lambda stage, prim: mirror(prim),
    "without Gaussians": lambda stage, prim: prim.SetTypeName("Mesh"),
    "without scales": lambda stage, prim: prim.RemoveProperty("scales"),
    "SH degree 4": lambda stage, prim: prim.GetAttribute(f"{SH_NAME}Degree").Set(4),
    "cannot be read": lambda stage, prim: prim.GetAttribute("opacities").Set([0.5]),
    "opacity outside": lambda stage, prim: prim.GetAttribute("opacities").Set([0.5, 7.0]),
    "linear space": lambda stage, prim: set_space(prim, "lin_rec709_scene"),
    "the linear space lin_ap1_scene": lambda stage, prim: set_own_space(prim, "lin_ap1_scene"),
}


def mirror(prim) -> None:
    from pxr import Gf, UsdGeom

    UsdGeom.Xformable(prim).AddScaleOp().Set(Gf.Vec3f(1, 1, -1))


def set_space(prim, name: str) -> None:
    from pxr import Usd

    Usd.ColorSpaceAPI(prim).GetColorSpaceNameAttr().Set(name)


def set_own_space(prim, name: str) -> None:
    """Set the colour space of the attribute of colours, which counts before that of its prim."""
    prim.GetAttribute(f"{SH_NAME}Coefficients").SetColorSpace(name)


def test_colours_with_a_space_of_their_own_are_not_in_that_of_their_prim(pxr, tmp_path):
    def set_both(stage, prim) -> None:
        set_space(prim, "lin_rec709_scene")
        set_own_space(prim, "srgb_rec709_display")

    change_stage(tmp_path / "scene.usda", set_both)
    assert torch.equal(load_splat(tmp_path / "scene.usda").sh, plausible(2, 1).sh)


@pytest.mark.parametrize("sentence", UNREADABLE)
def test_what_is_no_splat_of_ours_is_one_sentence(pxr, tmp_path, sentence, capfd):
    change_stage(tmp_path / "scene.usda", UNREADABLE[sentence])
    with pytest.raises(InputError, match=sentence) as caught:
        load_splat(tmp_path / "scene.usda")
    assert len(str(caught.value)) < 300


@pytest.mark.parametrize("name", NAMES)
def test_a_damaged_file_is_one_sentence(pxr, tmp_path, name):
    save_splat(tmp_path / name, plausible(20, 0))
    data = (tmp_path / name).read_bytes()
    for share in (0.2, 0.6, 0.95):
        (tmp_path / name).write_bytes(data[: int(len(data) * share)])
        with pytest.raises(InputError, match="cannot be read|is OpenUSD without"):
            load_splat(tmp_path / name)


def test_openusd_is_not_read_without_usd_core(tmp_path, monkeypatch):
    (tmp_path / "a.usda").write_text("#usda 1.0\n")
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(InputError, match=r"pip install 'gscompleter\[usd\]'"):
        load_splat(tmp_path / "a.usda")


def test_labels_are_in_a_file_of_usd(pxr, tmp_path, monkeypatch, capsys):
    gaussians = plausible(9, 0)
    gaussians.generated[4] = 1
    save_splat(tmp_path / "a.ply", gaussians)
    assert run(monkeypatch, "convert", tmp_path / "a.ply", tmp_path / "B.USDZ") == 0
    assert "9 Gaussians, 1 of them generated" in capsys.readouterr().out.replace("\n", " ")
    assert not get_labels_path(tmp_path / "B.USDZ").exists()
    _, splat = read_stage(tmp_path / "B.USDZ")
    assert list(splat.GetPrim().GetAttribute("generated").Get()) == [0] * 4 + [1] + [0] * 4
    assert load_splat(tmp_path / "B.USDZ").generated.tolist() == [0] * 4 + [1] + [0] * 4


@pytest.mark.parametrize(("kind", "value"), [("Bool", True), ("String", "by a scanner")])
def test_what_another_program_calls_generated_is_no_label(pxr, tmp_path, kind, value):
    from pxr import Sdf

    def name_generated(stage, prim) -> None:
        prim.CreateAttribute("generated", getattr(Sdf.ValueTypeNames, kind)).Set(value)

    change_stage(tmp_path / "scene.usda", name_generated)
    assert load_splat(tmp_path / "scene.usda").generated.tolist() == [0, 0]


def test_without_usd_core_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pxr", None)
    with pytest.raises(InputError, match=r"pip install 'gscompleter\[usd\]'"):
        save_splat(tmp_path / "scene.usdz", plausible(5, 0))
    assert os.listdir(tmp_path) == []
