"""`--ignore`: masks in a folder that the user names, white where a photograph is left out."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from rich.console import Console

from command import run
from gscompleter import save_ply
from gscompleter.apps.inputs.opening import open_scene
from gscompleter.apps.requests.scene import PosesRequest, SceneRequest
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.sfm.poses import FoundPoses
from scenes import Room, camera_at, gaussians_of, photographed, view_of

SIZE = 48
CAMERAS = [camera_at(x, size=SIZE) for x in (-0.3, 0.0, 0.3)]
HIDDEN_ROWS = SIZE // 4


def write_masks(folder: Path, is_white: bool) -> Path:
    """Write masks whose upper quarter is white, or black."""
    mask = np.full((SIZE, SIZE), 0 if is_white else 255, np.uint8)
    mask[:HIDDEN_ROWS] = 255 - mask[:HIDDEN_ROWS]
    folder.mkdir()
    for number in range(len(CAMERAS)):
        Image.fromarray(mask).save(folder / f"{number}.png")
    return folder


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    """Write photographs with masks beside them that hide other parts, and masks to name."""
    home = tmp_path_factory.mktemp("ignored")
    scene = photographed(home / "scene", CAMERAS)
    (scene / "masks").mkdir()
    lower = np.full((SIZE, SIZE), 255, np.uint8)
    lower[-HIDDEN_ROWS:] = 0
    for number in range(len(CAMERAS)):
        Image.fromarray(lower).save(scene / "masks" / f"{number}.png")
    photographed(home / "plain", CAMERAS)
    write_masks(home / "white", is_white=True)
    write_masks(home / "black", is_white=False)
    save_ply(home / "splat.ply", gaussians_of(view_of(Room(), CAMERAS[1])))
    return home


def open_with(home: Path, scene: str, reading: MaskReading) -> np.ndarray:
    """Open a scene, and return what is ignored of its first photograph."""
    request = SceneRequest(home / scene, resolution=SIZE, masks=reading)
    opened = open_scene(request, PosesRequest(home / "out"), Console(quiet=True))
    ignored = opened.photographs.views([0])[0].ignore_mask
    assert ignored is not None
    return ignored.numpy()


@pytest.mark.parametrize("scene", ["scene", "plain"])
@pytest.mark.parametrize(("masks", "is_inverted"), [("white", False), ("black", True)])
def test_white_is_left_out_in_place_of_masks_beside_photographs(home, scene, masks, is_inverted):
    ignored = open_with(home, scene, MaskReading(is_inverted, folder=home / masks))
    assert ignored[:HIDDEN_ROWS].all()
    assert not ignored[HIDDEN_ROWS:].any()


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("complete", "scene", "--ignore", "black"), "Masks hide 75 % of the photographs (black)"),
        (("complete", "scene", "--ignore", "black"), "where what is white is ignored; if it is t"),
        (("complete", "scene", "--ignore", "white", "--invert-masks"), "what is black is ignored"),
        (("complete", "scene", "--ignore", "none"), "has no mask that is named as a photograph"),
        (("complete", "scene", "--ignore", "white", "--no-masks"), "give one of both.\n"),
        (("complete", "splat.ply", "--ignore", "white"), "There are no photographs to apply this"),
        (("clean", "--scene", "splat.ply", "--ignore", "white"), "There are no photographs to ap"),
        (("update", "scene", "--scene", "splat.ply", "--ignore", "black"), "Masks hide 75 %"),
        (("clean", "scene", "--scene", "splat.ply", "--ignore", "black"), "Masks hide 75 %"),
    ],
)
def test_wrong_folders_are_refused(home, tmp_path, monkeypatch, capsys, words, sentence):
    monkeypatch.chdir(home)
    out = tmp_path / "out"
    assert run(monkeypatch, *words, "--out", out) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


def test_cameras_are_searched_for_without_what_is_ignored(home, tmp_path, monkeypatch, capsys):
    """The search is given the folder; what it cannot use is refused before the search."""
    bare = tmp_path / "bare"
    bare.mkdir()
    for path in (home / "plain").rglob("*.png"):
        shutil.copyfile(path, bare / path.name)
    given: list[object] = []

    def search(*words: object) -> FoundPoses:
        given.extend(words)
        raise KeyboardInterrupt

    monkeypatch.setattr("gscompleter.apps.inputs.opening.find_poses", search)
    words = ("complete", bare, "--out", tmp_path / "out", "--ignore")
    assert run(monkeypatch, *words, home / "white") == 130
    assert given[-1] == MaskReading(folder=home / "white")

    shutil.copytree(home / "white", bare / "parts")
    assert run(monkeypatch, *words, bare / "parts") == 2
    assert "lies among the photographs, and would be taken for some" in capsys.readouterr().err
    assert run(monkeypatch, *words, tmp_path / "nowhere") == 2
    assert "has no mask that is named as a photograph" in capsys.readouterr().err
