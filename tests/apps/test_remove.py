"""`gscompleter remove`: selections, results that `strip` undoes, and refusals."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from command import run
from gscompleter import InputError, load_ply, save_ply
from gscompleter.apps.inputs.removal import (
    describe_masks_in_vain,
    describe_parts_in_vain,
    find_by_position,
    find_equal_positions,
    find_in_boxes,
    find_in_masks,
    find_in_region,
    find_masks_of,
    require_chosen,
    widen_regions,
)
from gscompleter.apps.report.removal_pictures import find_largest
from gscompleter.apps.requests.splat import Selection
from gscompleter.data.formats import open_photographs
from gscompleter.evaluation.verdict.outcome import round_count
from gscompleter.numerics.geometry import axis_angle_to_matrix, rotations_to_quats
from gscompleter.parts import NOT_INVENTED
from gscompleter.render.loading import load_renderer
from gscompleter.system.files.image import read_image, write_image
from gscompleter.types import merge
from scenes import Room, camera_at, cast, gaussians_of, photographed, random_gaussians, view_of
from splat_files import write_supersplat

SIZE = 48
CAMERAS = [
    camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((-0.6, 6), (-0.2, 2), (0.2, -2), (0.6, -6))
]
TARGET = camera_at(0.0, 0.05, size=SIZE)
ROOM = Room()
EMPTY = Room((ROOM.boxes[0], ROOM.boxes[2]))
"""The room without the box in its middle."""
CRATE = (-0.6, 0.2, 2.1, 0.4, 1.47, 3.1)
UPRIGHT = (1.0, 0.0, 0.0, 0.0)
RENDERER = load_renderer("cpu")


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Write photographs of the room, and a splat of what they show."""
    folder = photographed(tmp_path_factory.mktemp("remove") / "room", CAMERAS)
    save_ply(folder / "splat.ply", merge([gaussians_of(view_of(ROOM, c)) for c in CAMERAS]))
    return folder


def remove(scene: Path, out: Path, *others: object) -> tuple[object, ...]:
    """Return the words of a command."""
    size = ("--resolution", SIZE, SIZE, "--near", 0.5, "--far", 20, "--quiet")
    return ("remove", scene, "--scene", scene / "splat.ply", "--out", out, *size, *others)


EXACT = (-0.5, 0.3, 2.2, 0.3, 1.5, 3.0)
"""The box as it stands in the room."""


def test_a_box_drawn_exactly_on_an_object_takes_its_faces(scene):
    """Half of the Gaussians of a face lie before it, as depths are not exact."""
    splat = load_ply(scene / "splat.ply")
    noise = torch.randn(len(splat), generator=torch.Generator().manual_seed(0))
    noisy = replace(splat, means=splat.means * (1 + 0.002 * noise)[:, None])
    truly = find_in_boxes(splat.means, EXACT, UPRIGHT, 1e-3)
    given = Selection(EXACT, UPRIGHT)
    origin = np.zeros(3)
    widened = widen_regions(given, noisy, origin)
    points = noisy.means.double()
    taken = find_in_region(points, given) & truly
    taken_wide = find_in_region(points, widened) & truly
    assert taken.sum() < 0.8 * truly.sum()
    assert taken_wide.sum() > 0.95 * truly.sum()
    # One Gaussian, and never much of the region.
    assert 0.001 < widened.margin < 0.05
    assert widen_regions(given, replace(noisy, scales=100 * noisy.scales), origin).margin == (
        pytest.approx(0.05 * 0.8)
    )
    # What is selected by masks or a file has no margin.
    assert widen_regions(Selection(), noisy, origin).margin == 0


def test_a_sphere_reaches_as_far(scene):
    splat = load_ply(scene / "splat.ply")
    widened = widen_regions(Selection(sphere=(-0.1, 0.9, 2.6, 0.6)), splat, np.zeros(3))
    beyond = torch.tensor([[-0.1, 0.9, 2.6 - 0.6 - 0.9 * widened.margin]], dtype=torch.float64)
    assert find_in_region(beyond, widened).all()
    assert not find_in_region(beyond, replace(widened, margin=0.0)).any()


def write_masks(folder: Path) -> Path:
    """Write masks of the crate for two of the photographs."""
    folder.mkdir()
    for number in (0, 3):
        shown = cast(ROOM, CAMERAS[number])[1] < cast(EMPTY, CAMERAS[number])[1] - 0.01
        write_image(folder / f"{number}.png", shown)
    return folder


def test_the_crate_goes_its_place_is_filled_and_strip_brings_it_back(
    scene, tmp_path, monkeypatch, capsys
):
    out, camera = tmp_path / "out", tmp_path / "camera"
    photographed(camera, [TARGET])
    words = remove(scene, out, "--box", *CRATE, "--target", camera / "transforms.json")
    assert run(monkeypatch, *words) == 0
    given, completed = load_ply(scene / "splat.ply"), load_ply(out / "completed.ply")
    left = completed[completed.generated == 0]
    assert not find_in_boxes(left.means, CRATE, UPRIGHT).any()
    counts = json.loads((out / "summary.json").read_text())["gaussians"]
    # Pieces of what was cut at the border of the box have the label of photographs, and are counted
    # apart from what these showed.
    num_labelled = int((completed.generated == NOT_INVENTED).sum())
    assert counts["pieces"] > 0
    assert counts["from_photographs"] + counts["pieces"] == num_labelled
    capsys.readouterr()
    assert run(monkeypatch, "inspect", out / "completed.ply", "--json") == 0
    origins = json.loads(capsys.readouterr().out)["origins"]
    assert origins["given"] == len(left)
    assert origins["piece"] == counts["pieces"]
    assert origins.get("photographs", 0) == counts["from_photographs"]
    assert sum(origins.values()) == len(completed)
    # Nobody invented these pieces, of which they are parts.
    made = counts["added"] - counts["from_photographs"] - counts["pieces"]
    headline = json.loads((out / "summary.json").read_text())["outcome"]["headline"]
    assert f"; {round_count(made)} Gaussians invented." in headline
    assert counts["removed"] == len(given) - len(left) == len(load_ply(out / "removed.ply")) > 100
    assert (out / "context.ply").read_bytes() == (scene / "splat.ply").read_bytes()
    summary = json.loads((out / "summary.json").read_text())
    (row,) = summary["targets"]
    assert row["added"] > 0
    rest = summary["removal"]
    assert rest["frame"] in range(len(CAMERAS))
    assert 0.03 < rest["shown"] < 0.5
    assert rest["continued"] < 0.03
    images = {name: read_image(out / f"images/removal_{name}.png") for name in ("after", "outline")}
    painted = (images["after"] != images["outline"]).any(-1)
    assert 0.01 < painted.float().mean() < 0.2
    depth, crate = (cast(room, TARGET)[1] for room in (EMPTY, ROOM))
    after = RENDERER.render(completed, TARGET)
    hole = (RENDERER.render(left, TARGET).alpha < 0.5) & (crate < 0.95 * depth)
    assert hole.float().mean() > 0.03
    assert (after.alpha[hole] > 0.5).float().mean() > 0.9
    error, as_before = ((d / depth - 1).abs()[hole].median() for d in (after.depth, crate))
    assert error < 0.5 * as_before
    again = tmp_path / "again.ply"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", again, "--quiet") == 0
    assert again.read_bytes() == (scene / "splat.ply").read_bytes()


@pytest.mark.slow
def test_half_of_an_object_that_is_left_is_reported(scene, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    half = (*CRATE[:4], 0.9, CRATE[5])
    words = [word for word in remove(scene, out, "--box", *half, "--auto", 1) if word != "--quiet"]
    assert run(monkeypatch, *words) == 0
    left = json.loads((out / "summary.json").read_text())["removal"]
    assert left["continued"] > 0.1
    assert f"Along {100 * left['continued']:.0f} % of the outline" in capsys.readouterr().out
    page = (out / "report.html").read_text()
    assert f"What was removed, in photograph {left['frame']}" in page
    mask = read_image(out / "images" / "removal_outline.png")
    magenta = (mask == torch.tensor([1.0, 0.0, 1.0])).all(-1)
    assert magenta.any()


def test_the_photograph_that_shows_something_whole_is_chosen():
    small, large, empty = torch.zeros(3, 20, 20, dtype=torch.bool)
    small[5:8, 5:8] = True
    large[0:10, 3:9] = True
    assert find_largest([empty, large, small]) == 2
    assert find_largest([empty, large]) == 1
    assert find_largest([empty]) is None


# The test before removes a box, and the next one plans a target.
@pytest.mark.slow
def test_targets_are_photographs_and_what_shows_the_crate_is_not_scored(
    scene, tmp_path, monkeypatch
):
    out, masks = tmp_path / "out", write_masks(tmp_path / "masks")
    assert run(monkeypatch, *remove(scene, out, "--mask", masks, "--auto", 1)) == 0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["mask"] == str(masks)
    (target,) = summary["targets"]
    assert target["derived_from"] in range(len(CAMERAS))
    assert target["hole_fraction"] > 0.02
    assert target["added"] > 0
    for row in summary["context"]:
        assert 0.02 < row["ignored"] < 0.6
        assert row["psnr_after"] > row["psnr_before"] - 0.05
    ignored = read_image(out / "images" / "context1_ignored.png")
    shown = cast(ROOM, CAMERAS[0])[1] < cast(EMPTY, CAMERAS[0])[1] - 0.01
    assert (ignored == torch.tensor([1.0, 0.0, 1.0])).all(-1)[shown].float().mean() > 0.95


@pytest.mark.slow
def test_a_plan_names_a_photograph_and_the_hole_that_is_left(scene, tmp_path, monkeypatch, capsys):
    splat = load_ply(scene / "splat.ply")
    save_ply(tmp_path / "selected.ply", splat[find_in_boxes(splat.means, CRATE, UPRIGHT)])
    words = [*remove(scene, tmp_path / "out", "--select", tmp_path / "selected.ply", "--dry-run")]
    words.remove("--quiet")
    assert run(monkeypatch, *words) == 0
    (row,) = [line for line in capsys.readouterr().out.splitlines() if "1: near photograph" in line]
    assert 2 < float(row.split()[-2]) < 40
    names = sorted(path.name for path in (tmp_path / "out").iterdir())
    assert names == ["images", "summary.json", "targets.json"]


def test_boxes_are_rotated_about_their_centres():
    points = torch.tensor([[1.0, 1, 1], [2.2, 1, 1], [1.8, 1.8, 1], [1, 1, 2.1]])
    box = (0.0, 0.0, 0.0, 2.0, 2.0, 2.0)
    assert find_in_boxes(points, box, UPRIGHT).tolist() == [True, False, True, False]
    turn = rotations_to_quats(axis_angle_to_matrix(torch.tensor([0.0, 0, 1]), torch.pi / 4))
    assert find_in_boxes(points, box, turn.tolist()).tolist() == [True, True, False, False]
    both = (*box, 1.5, 0.5, 1.5, 2.5, 1.5, 2.5)
    assert find_in_boxes(points, both, (2.0, 0.0, 0.0, 0.0)).tolist() == [True, False, True, False]
    assert find_in_boxes(points, (0.0, 0.0, 0.0, 1.0, 1.0, 3.0, *box), UPRIGHT)[3]


def test_masks_choose_what_lies_in_them(scene, tmp_path):
    photographs, splat = open_photographs(scene), load_ply(scene / "splat.ply")
    cameras = {number: photographs.camera(number) for number in range(len(CAMERAS))}
    masks = find_masks_of(photographs, write_masks(tmp_path / "masks"))
    assert sorted(masks) == [0, 3]
    chosen = find_in_masks(masks, splat, photographs, cameras, None, RENDERER)
    crate = find_in_boxes(splat.means, CRATE, UPRIGHT)
    assert chosen[crate].float().mean() > 0.8
    assert chosen[~crate].float().mean() < 0.05


def test_masks_of_photographs_without_a_camera_are_said(scene, tmp_path):
    photographs = open_photographs(scene)
    folder = write_masks(tmp_path / "masks")
    (folder / "typo.png").write_bytes(b"")
    cameras = {number: photographs.camera(number) for number in (0, 1)}
    (line,) = describe_masks_in_vain(photographs, cameras, folder)
    assert line.endswith("are named as no photograph with a camera: 3.png, typo.png.")


def test_advice_after_an_empty_selection_is_of_what_was_given():
    splat = random_gaussians(5)
    nothing = torch.zeros(5, dtype=torch.bool)
    with pytest.raises(InputError, match="is selected; mark in masks the whole of"):
        require_chosen(nothing, Selection(masks=Path("masks")), splat, np.zeros(3))


def test_a_selection_is_found_by_position():
    splat = random_gaussians(50)
    splat.means[3] = splat.means[7]
    found = find_equal_positions(splat.means, splat[torch.tensor([7, 20])].means)
    assert torch.nonzero(found)[:, 0].tolist() == [3, 7, 20]
    moved = random_gaussians(50, seed=1)
    assert not find_equal_positions(splat.means, moved.means).any()


def test_a_selection_of_supersplat_is_found(tmp_path):
    """In another order, at positions of any size, and without the labels."""
    splat = replace(
        random_gaussians(500, sh_degree=1), generated=torch.zeros(500, dtype=torch.uint8)
    )
    splat.means[:100] *= 1e4
    splat.means[100:200] *= 1e-6
    chosen = torch.randperm(500)[:200]
    file = write_supersplat(tmp_path / "selection.ply", splat[chosen])
    found = find_by_position(Selection(file=file), splat, np.zeros(3))
    assert torch.nonzero(found)[:, 0].tolist() == sorted(chosen.tolist())


def test_parts_of_a_selection_that_select_nothing_are_said(scene, tmp_path):
    """As a box with a typing error beside one that is right."""
    splat = load_ply(scene / "splat.ply")
    nowhere = (50.0, 50.0, 50.0, 51.0, 51.0, 51.0)
    given = Selection(boxes=(*CRATE, *nowhere), sphere=(60.0, 0.0, 0.0, 1.0))
    assert describe_parts_in_vain(given, splat, np.zeros(3)) == [
        "Box 2 of 2 contains no Gaussian.",
        "The sphere contains no Gaussian.",
    ]
    # Three Gaussians of the splat, and five that somebody moved.
    three = replace(splat[:3], generated=torch.zeros(3, dtype=torch.uint8))
    moved = random_gaussians(5, sh_degree=three.sh_degree)
    save_ply(tmp_path / "some.ply", merge([three, moved]))
    (line,) = describe_parts_in_vain(Selection(file=tmp_path / "some.ply"), splat, np.zeros(3))
    assert line.startswith("5 of 8 Gaussians of ")
    # Where nothing is selected, the error says so.
    assert describe_parts_in_vain(Selection(boxes=nowhere), splat, np.zeros(3)) == []
    assert describe_parts_in_vain(Selection(boxes=CRATE), splat, np.zeros(3)) == []


@pytest.mark.parametrize(
    ("selection", "said"),
    [
        ((), "Nothing is named"),
        (("--box", 0, 0, 0, 1, 1), "six numbers"),
        (("--box", 0, 0, 0, 1, -1, 1), "six numbers"),
        (("--box", 50, 50, 50, 51, 51, 51), "No Gaussian of the splat"),
        (("--box", -50, -50, -50, 50, 50, 50), "Nothing would be left"),
        (("--sphere", 0, 0, 0, -1), "positive radius"),
        (("--sphere", 0, 0, 1, 1, "--box-rotation", 0, 0, 0, 0), "quaternion"),
        (("--sphere", 0, 0, 1, 1, "--box-rotation", 1, 0, 0, 1), "There is no box to rotate"),
        (("--mask", "nowhere"), "There is no folder"),
        (("--mask", "EMPTY"), "no mask that is named as a photograph"),
        (("--select", "MOVED"), "No Gaussian of the splat"),
        (("--select", "nowhere.ply"), "nowhere.ply"),
    ],
)
def test_wrong_selections_are_refused(scene, tmp_path, monkeypatch, capsys, selection, said):
    (tmp_path / "EMPTY").mkdir()
    save_ply(tmp_path / "MOVED", random_gaussians(5))
    monkeypatch.chdir(tmp_path)
    assert run(monkeypatch, *remove(scene, tmp_path / "out", *selection)) == 2
    error = capsys.readouterr().err.strip()
    assert said in error
    assert len(error) <= 300 + len("gscompleter: ")
    assert "\n" not in error
    assert not (tmp_path / "out").exists()


@pytest.fixture
def fox(shared) -> Path:
    folder = shared / "splats" / "fox"
    if not folder.is_dir():
        pytest.skip(f"needs the splat of another trainer, and there is no folder {folder}")
    return folder


FOX_BOX = (0.221, -3.331, 1.068, 3.621, 2.619, 4.318, 1.44, -0.987, 3.908, 4.54, 2.613, 4.098)
FOX_ROTATION = (-0.3356, -0.0044, 0.9419, -0.0123)


@pytest.mark.slow
def test_the_fox_is_removed_and_brought_back(fox, tmp_path, monkeypatch):
    out, again, few_photographs = tmp_path / "out", tmp_path / "again.ply", tmp_path / "fox"
    (few_photographs / "images").mkdir(parents=True)
    (few_photographs / "sparse").symlink_to(fox / "sparse")
    for number in (1, 12, 21, 30, 42):
        name = f"images/{number:04}.jpg"
        (few_photographs / name).symlink_to(fox / name)
    boxes = ("--box", *FOX_BOX, "--box-rotation", *FOX_ROTATION)
    few = ("--resolution", 96, "--auto", 1, "--quiet")
    words = ("remove", few_photographs, "--scene", fox / "splat.ply", *boxes, *few, "--out", out)
    assert run(monkeypatch, *words) == 0
    completed = load_ply(out / "completed.ply")
    left = completed[completed.generated == 0]
    assert not find_in_boxes(left.means, FOX_BOX, FOX_ROTATION).any()
    (row,) = json.loads((out / "summary.json").read_text())["targets"]
    assert row["hole_fraction"] > 0.1
    assert row["added"] > 0
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", again, "--quiet") == 0
    assert again.read_bytes() == (fox / "splat.ply").read_bytes()


def test_masks_of_the_fox_choose_the_fox(fox, tmp_path):
    photographs, splat = open_photographs(fox), load_ply(fox / "splat.ply")
    cameras = {number: photographs.camera(number, 160) for number in (0, 12, 20, 26)}
    inside = find_in_boxes(splat.means, FOX_BOX, FOX_ROTATION)
    for number, camera in cameras.items():
        weight = RENDERER.freeze(splat, camera).splat(inside.float())
        name = Path(photographs.frames[number].name).stem
        write_image(tmp_path / f"{name}.png", weight > 0.5)
    masks = find_masks_of(photographs, tmp_path)
    chosen = find_in_masks(masks, splat, photographs, cameras, 160, RENDERER)
    seen = torch.zeros(len(splat))
    for camera in cameras.values():
        seen += RENDERER.freeze(splat, camera).backproject(
            torch.ones(camera.height, camera.width, 3)
        )[:, 0]
    visible = seen > 1
    both, either = (chosen & inside & visible).sum(), ((chosen | inside) & visible).sum()
    assert both > 0.7 * either


@pytest.mark.slow
def test_the_hole_of_what_was_removed_can_be_painted(scene, tmp_path, monkeypatch):
    """With the same selection both times; `strip` gives the splat back."""
    out, holes = tmp_path / "out", tmp_path / "holes"
    target = photographed(tmp_path / "camera", [TARGET]) / "transforms.json"
    words = remove(scene, out, "--box", *CRATE, "--target", target)
    assert run(monkeypatch, *words, "--export-holes", holes) == 0
    assert not out.exists()
    mask = read_image(holes / "target1_mask.png")[..., 0] > 0.5
    assert 0.03 < mask.float().mean() < 0.5
    image = read_image(holes / "target1.png")
    behind, _ = cast(EMPTY, TARGET)
    write_image(holes / "target1.png", torch.where(mask[..., None], behind, image))

    words = remove(scene, out, "--box", *CRATE, "--images", holes, "--painter", "me")
    assert run(monkeypatch, *words) == 0
    completed = load_ply(out / "completed.ply")
    after = RENDERER.render(completed, TARGET).image
    left = RENDERER.render(completed[completed.generated == 0], TARGET)
    hole = left.alpha < 0.5
    assert (after - behind).abs()[hole].mean() < 0.3 * (left.image - behind).abs()[hole].mean()
    (row,) = json.loads((out / "summary.json").read_text())["targets"]
    assert row["painter"] == "me"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", tmp_path / "back.ply") == 0
    assert (tmp_path / "back.ply").read_bytes() == (scene / "splat.ply").read_bytes()


@pytest.mark.slow
def test_without_photographs_renders_around_the_place_take_their_part(
    scene, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    words = ("remove", "--scene", scene / "splat.ply", "--box", *CRATE, "--resolution", 96)
    assert run(monkeypatch, *words, "--auto", 1, "--out", out) == 0
    assert "cameras around what is removed take their place" in capsys.readouterr().err
    summary = json.loads((out / "summary.json").read_text())
    assert summary["scene"]["renders_from"] == "place"
    assert summary["settings"]["config"]["trust"] == "full"
    assert "removal" in summary["settings"]["config"]["guards"]
    assert summary["gaussians"]["removed"] > 100
    assert 2 <= len(summary["context"]) <= 6
    # Its place is filled at the camera that shows it best, which is one of the renders.
    assert summary["targets"][0]["added"] > 50
    back = tmp_path / "back.ply"
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", back, "--quiet") == 0
    assert back.read_bytes() == (scene / "splat.ply").read_bytes()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--mask", "MASKS"), "Masks are named as photographs, and there are none"),
        (("--sphere", 90, 90, 90, 1), "No Gaussian of the splat"),
        (("--box", *CRATE, "--no-masks"), "There are no photographs to apply this to"),
    ],
)
def test_what_needs_photographs_is_refused_without(
    scene, tmp_path, monkeypatch, capsys, words, sentence
):
    masks = write_masks(tmp_path / "masks")
    words = [masks if word == "MASKS" else word for word in words]
    out = tmp_path / "out"
    splat = scene / "splat.ply"
    assert run(monkeypatch, "remove", "--scene", splat, *words, "--out", out, "--quiet") == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()
