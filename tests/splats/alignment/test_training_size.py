"""Size that a splat was trained at, from the files that trainers leave, and the working size."""

from __future__ import annotations

import io
import json
from pathlib import Path

import pytest
from PIL import Image
from rich.console import Console

from gscompleter import save_ply
from gscompleter.apps.commands.complete import decide_completion
from gscompleter.apps.completing.preparation import open_input
from gscompleter.cli import parse_command
from gscompleter.data.formats import open_photographs
from gscompleter.splats.alignment.training_size import TrainingSize, find_training_size
from scenes import camera_at, photographed, random_gaussians

SIDE = 64


@pytest.fixture
def scene(tmp_path) -> Path:
    return photographed(tmp_path / "scene", [camera_at(x, size=SIDE) for x in (0.0, 0.2, 0.4)])


def write_list(path: Path, side: int, names: tuple[str, ...] = ("0.png", "1.png")) -> None:
    """Write a list of cameras as Inria's trainer and OpenSplat do."""
    rotation, focal = [[1, 0, 0], [0, 1, 0], [0, 0, 1]], 0.9 * side
    entries = [
        {
            "id": number,
            "img_name": name,
            "width": side,
            "height": side,
            "position": [0.2 * number, 0, 0],
            "rotation": rotation,
            "fx": focal,
            "fy": focal,
        }
        for number, name in enumerate(names)
    ]
    path.write_text(json.dumps(entries))


def find(splat: Path, scene: Path) -> TrainingSize | None:
    splat.parent.mkdir(parents=True, exist_ok=True)
    return find_training_size(splat, scene, open_photographs(scene), (0, 1, 2))


def test_nothing_is_known_without_a_record(scene, tmp_path):
    assert find(tmp_path / "run" / "splat.ply", scene) is None


def test_a_list_of_cameras_says_the_size(scene, tmp_path):
    splat = tmp_path / "run" / "splat.ply"
    splat.parent.mkdir()
    write_list(splat.with_name("cameras.json"), SIDE // 2)
    assert find(splat, scene) == TrainingSize(SIDE // 2, "cameras.json")
    write_list(splat.with_name("cameras.json"), SIDE)
    assert find(splat, scene) is None  # that of the photographs
    write_list(splat.with_name("cameras.json"), SIDE // 2, ("other.png", "another.png"))
    assert find(splat, scene) is None  # of other photographs
    splat.with_name("cameras.json").write_text("[{}]")
    assert find(splat, scene) is None


@pytest.mark.parametrize(
    ("images", "resolution", "width", "expected"),
    [
        ("images", -1, 64, None),
        ("images", 2, 64, 32),
        ("images_4", -1, 64, 16),
        ("images_2", 2, 64, 16),
        ("images", 48, 64, 48),
        ("images", -1, 3200, 1600),
        ("images_2", -1, 3200, 1600),
        ("images_2", -1, 2000, 1000),
        ("images", 1, 3200, None),
    ],
)
def test_inria_says_it_in_its_settings(tmp_path, images, resolution, width, expected):
    scene = photographed(tmp_path / "scene", [camera_at(x, size=SIDE) for x in (0.0, 0.2)])
    content = json.loads((scene / "transforms.json").read_text())
    for number in range(2):  # flat images of another size: only their sizes are read
        Image.new("RGB", (width, width)).save(scene / f"{number}.png")
    (scene / "transforms.json").write_text(json.dumps({**content, "w": width, "h": width}))
    splat = tmp_path / "model" / "point_cloud" / "iteration_7000" / "point_cloud.ply"
    splat.parent.mkdir(parents=True)
    settings = f"Namespace(data_device='cuda', images='{images}', resolution={resolution}, sh=3)"
    (tmp_path / "model" / "cfg_args").write_text(settings)
    trained = find_training_size(splat, scene, open_photographs(scene), (0, 1))
    assert trained == (None if expected is None else TrainingSize(expected, "cfg_args"))


def test_gsplat_says_it_beside_the_folder_of_its_files(scene, tmp_path):
    splat = tmp_path / "garden" / "ply" / "point_cloud_29999.ply"
    splat.parent.mkdir(parents=True)
    (tmp_path / "garden" / "cfg.yml").write_text("batch_size: 1\ndata_factor: 4\nmax_steps: 3\n")
    assert find(splat, scene) == TrainingSize(SIDE // 4, "cfg.yml")


@pytest.mark.parametrize(
    ("side", "words", "expected", "said"),
    [
        (32, (), 32, "trained at 32 px (cameras.json), which is the working size"),
        (32, ("--resolution", "48"), 48, ""),
        (900, (), 640, "trained at 900 px (cameras.json); the working size stays 640 px unless"),
        (SIDE, (), 640, ""),
    ],
)
def test_the_working_size_follows_unless_it_is_given(scene, tmp_path, side, words, expected, said):
    splat = tmp_path / "splat.ply"
    save_ply(splat, random_gaussians(3))
    write_list(splat.with_name("cameras.json"), side)
    options = parse_command(
        ["complete", str(scene), "--scene", str(splat), "--out", str(tmp_path / "o"), *words]
    )
    console = Console(file=io.StringIO(), width=1000)
    request = decide_completion(options)
    opened = open_input(request.source, request.work.splat, console, lambda: None)
    assert opened.request.resolution == expected
    printed = console.file.getvalue()
    assert said in printed
    assert bool(printed) == bool(said)
