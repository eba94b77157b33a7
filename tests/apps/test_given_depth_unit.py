"""The unit of the depth that a scene holds is measured, and one factor is applied."""

import json
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Float
from PIL import Image

from command import run
from exact_room import make_cameras, write_transforms
from gscompleter import InputError
from gscompleter.apps.inputs.given_depth import read_with_depth
from gscompleter.apps.inputs.reading import read_task
from gscompleter.apps.inputs.task import Opened
from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.data.formats import open_photographs
from gscompleter.reconstructors.features.depth_factor import DepthSamples, fit_depth_factor

CAMERAS = make_cameras(3, width=96, height=72, focal=78.0)
RANDOM = np.random.default_rng(0)
TRUE = RANDOM.uniform(2, 6, 400)


def write_depth(path: Path, depth: Float[np.ndarray, "h w"]) -> None:
    """Write a depth map: numbers as they are in .npy and .tif, thousandths in .png."""
    if path.suffix == ".npy":
        np.save(path, depth.astype(np.float32))
    elif path.suffix == ".tif":
        Image.fromarray(depth.astype(np.float32)).save(path)
    else:
        Image.fromarray((depth * 1000 + 0.5).astype(np.uint16)).save(path)


def make_scene(folder: Path, ending: str = "png", change=lambda depth, number: depth) -> Path:
    """Write photographs of the room with depth maps that `change` makes of the true ones."""
    folder.mkdir()
    names = [f"{number}.{ending}" for number in range(len(CAMERAS))]
    for number, (camera, name) in enumerate(zip(CAMERAS, names, strict=True)):
        write_depth(folder / name, change(camera.depth, number))
    return write_transforms(
        folder, CAMERAS, frame_fields=[{"depth_file_path": name} for name in names]
    )


def check_exact(folder: Path, frames: tuple[int, ...] = (0, 1)) -> tuple[str, ...]:
    """Check that the given depth is the true one within 2 %; return the sentences."""
    read = read_with_depth(open_photographs(folder), frames)
    views, notes = read.views, read.notes
    for view, number in zip(views, frames, strict=True):
        given, true = view.given_depth.numpy(), CAMERAS[number].depth
        known = given > 0
        assert known.mean() > 0.5
        assert np.abs(given[known] / true[known] - 1).max() < 0.02
    return notes


def test_exact_depth_is_left_alone(tmp_path):
    assert check_exact(make_scene(tmp_path / "room")) == ()


@pytest.mark.parametrize("factor", [0.3, 2.5])
def test_depth_beside_cameras_of_another_scale_is_scaled(tmp_path, factor):
    (note,) = check_exact(make_scene(tmp_path / "room", "png", lambda z, _: factor * z))
    assert f"is {factor} times what its photographs and points measure" in note


@pytest.mark.parametrize("ending", ["npy", "tif"])
def test_metres_that_are_read_as_millimetres_are_scaled(tmp_path, ending):
    (note,) = check_exact(make_scene(tmp_path / "room", ending))
    assert "is 0.001 times" in note


def test_one_photograph_is_compared_with_the_next(tmp_path):
    scene = make_scene(tmp_path / "room", "png", lambda z, _: 2.5 * z)
    (note,) = check_exact(scene, (0,))
    assert "2.5 times" in note


def test_the_last_photograph_is_compared_with_the_one_before(tmp_path):
    scene = make_scene(tmp_path / "room", "png", lambda z, _: 2.5 * z)
    (note,) = check_exact(scene, (2,))
    assert "2.5 times" in note


@pytest.mark.parametrize("held_out", [(), (1,)], ids=["a target", "held out"])
def test_a_photograph_that_scores_the_result_tells_no_unit(tmp_path, held_out):
    """The unit decides where the result stands. Here the depth of photograph 1 has another one."""
    scene = make_scene(tmp_path / "room", "png", lambda z, number: (2.5, 9, 2.5)[number] * z)
    photographs = open_photographs(scene)
    opened = Opened(SceneRequest(scene), photographs, "nerfstudio", len(photographs), held_out)
    targets = () if held_out else ("1",)
    (note,) = read_task(opened, (0,), targets, "cpu", True, False).depth_notes
    assert "2.5 times" in note


@pytest.mark.parametrize(
    "change",
    [lambda z, number: z * (1, 3, 9)[number], lambda z, _: 8 / z],
    ids=["a factor of each photograph", "inverted"],
)
def test_what_no_factor_explains_is_refused_with_both_ranges(tmp_path, change):
    scene = make_scene(tmp_path / "room", "png", change)
    with pytest.raises(InputError, match=r"contradicts .*\(\d.* to \d.*--no-given-depth") as error:
        read_with_depth(open_photographs(scene), (0, 1))
    assert str(error.value).count(" to ") == 2


def test_depth_that_cannot_be_compared_is_used_and_said(tmp_path):
    block = np.zeros((72, 96))
    block[30:38, 40:48] = 1
    scene = make_scene(tmp_path / "room", "png", lambda z, _: block * z)
    read = read_with_depth(open_photographs(scene), (0, 1))
    views, (note,) = read.views, read.notes
    assert any(view.given_depth.any() for view in views)
    assert "show too little to compare" in note


def test_photographs_of_one_place_whose_coordinates_are_rounded_are_not_compared(tmp_path):
    """Two photographs of a tripod: float32 rounds its place by as much as they seem to be apart."""
    scene = make_scene(tmp_path / "room")
    path = scene / "transforms.json"
    transforms = json.loads(path.read_text())
    for frame, x in zip(transforms["frames"], (2.0, 2.0 + 2**-22, 3.0), strict=True):
        frame["transform_matrix"][0][3] = x
        frame["transform_matrix"][1][3] = 0.0
        frame["transform_matrix"][2][3] = 0.0
    path.write_text(json.dumps(transforms))
    photographs = open_photographs(scene)
    centers = [view.camera.center for view in photographs.views((0, 1))]
    assert (centers[1] - centers[0]).any()
    (note,) = read_with_depth(photographs, (0, 1), scoring=(2,)).notes
    assert "show too little to compare" in note


def test_points_of_the_scene_take_part(tmp_path):
    """Photographs without texture have no matches; the points that the file names remain."""
    scene = make_scene(tmp_path / "room", "png", lambda z, _: 2.5 * z)
    camera = CAMERAS[0]
    rays = camera.compute_rays()[::6, ::6].reshape(-1, 3)
    points = rays * camera.depth[::6, ::6].reshape(-1, 1) @ camera.c2w[:3, :3].T
    points += camera.c2w[:3, 3]
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    header += "".join(f"property float {axis}\n" for axis in "xyz") + "end_header\n"
    rows = "\n".join(" ".join(map(str, point)) for point in points)
    (scene / "points.ply").write_text(header + rows + "\n")
    content = json.loads((scene / "transforms.json").read_text())
    content["ply_file_path"] = "points.ply"
    (scene / "transforms.json").write_text(json.dumps(content))
    for number in range(len(CAMERAS)):
        Image.new("RGB", (96, 72), "grey").save(scene / f"images/photo_{number:03d}.png")
    (note,) = check_exact(scene)
    assert "2.5 times" in note


def sample(given, measured) -> DepthSamples:
    """Compare depths of one photograph."""
    return DepthSamples(given, measured, np.zeros(len(given), int))


def test_noise_of_the_measurement_is_no_factor():
    fit = fit_depth_factor(sample(TRUE, 1.06 * TRUE))
    assert fit.factor == 1.0
    noisy = 1.12 * TRUE * np.exp(0.18 * RANDOM.standard_normal(400))
    assert fit_depth_factor(sample(TRUE, noisy)).factor == 1.0


def test_a_factor_among_noise_is_used_where_1_would_be_refused():
    """Scatter samples by noisy poses as far as the factor is large: most agree with the factor."""
    noise = np.random.default_rng(0).normal(0.27, 0.3, 400)
    fit = fit_depth_factor(sample(TRUE, TRUE * np.exp(noise)))
    assert fit is not None
    assert fit.is_consistent
    assert 1.1 < fit.factor < 1.5


def test_a_flat_wall_is_not_taken_for_inverted_depth():
    """All of it is equally far, so that noise alone orders its depths: here, most in reverse."""
    random = np.random.default_rng(15)
    given = 2 + 0.01 * random.normal(size=24)
    measured = 2 * np.exp(0.05 * random.normal(size=24))
    fit = fit_depth_factor(sample(given, measured))
    assert fit is not None
    assert fit.is_consistent
    # The inverted depth of a scene that is hardly deep has one factor as well, and another order.
    depth = np.sort(random.uniform(1.8, 2.2, 24))
    assert not fit_depth_factor(sample(4 / depth, depth)).is_consistent


def test_false_matches_on_one_side_do_not_move_the_factor():
    measured = np.where(np.arange(400) < 140, TRUE * RANDOM.uniform(1, 4, 400), TRUE) / 2.5
    fit = fit_depth_factor(sample(TRUE, measured))
    assert fit.is_consistent
    assert fit.factor == pytest.approx(0.4, rel=0.01)


@pytest.mark.slow
def test_the_command_prints_the_factor(tmp_path, monkeypatch, capsys):
    scene = make_scene(tmp_path / "room", "png", lambda z, _: 2.5 * z)
    words = ["complete", scene, "--context", 0, 1, "--target", 2, "--out", tmp_path / "out"]
    assert run(monkeypatch, *words, "--dry-run") == 0
    captured = capsys.readouterr()
    assert "is 2.5 times what its photographs" in captured.out + captured.err


@pytest.mark.slow
def test_the_command_prints_no_factor_of_depth_that_it_leaves_out(tmp_path, monkeypatch, capsys):
    scene = make_scene(tmp_path / "room", "png", lambda z, _: 2.5 * z)
    words = ["complete", scene, "--context", 0, 1, "--target", 2, "--out", tmp_path / "out"]
    assert run(monkeypatch, *words, "--dry-run", "--no-given-depth", "--overwrite") == 0
    captured = capsys.readouterr()
    assert "times what its photographs" not in captured.out + captured.err


def test_one_photograph_of_another_unit_is_not_outvoted():
    number = np.repeat(np.arange(10), 40)
    given = np.where(number == 3, 3 * TRUE, TRUE)
    assert not fit_depth_factor(DepthSamples(given, TRUE, number)).is_consistent
    assert fit_depth_factor(DepthSamples(TRUE, TRUE, number)).is_consistent


def test_scattered_depths_of_one_photograph_prove_nothing():
    """Of a pair with a wrong pose hardly any depth agrees, and the others with no factor either."""
    measured = TRUE.copy()
    photograph = np.repeat([0, 1, 2], [150, 150, 100])
    is_scattered = photograph == 2
    measured[is_scattered] *= RANDOM.uniform(1.3, 2.6, 100)
    fit = fit_depth_factor(DepthSamples(TRUE, measured, photograph))
    assert fit is not None
    assert fit.is_consistent
    assert fit.factor == 1.0

    # Inverted depths scatter as well, but in the wrong order.
    inverted = np.where(is_scattered, 20 / TRUE, TRUE)
    fit = fit_depth_factor(DepthSamples(inverted, TRUE, photograph))
    assert fit is not None
    assert not fit.is_consistent
