"""The presets feed the published networks what their authors' code feeds them.

The fixtures are batches of the authors' own test data loaders (MVSplat at commit 175b17a6,
DepthSplat at 2dad25a7): images, intrinsics as fractions of the image, camera-to-world, near and
far. Those of drawn scenes are in this repository, those of photographs are in the shared data.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from command import run
from gscompleter.apps.commands.evaluate import EvaluateOptions, decide_evaluation
from gscompleter.apps.evaluating.cases import collect_tasks
from gscompleter.evaluation.cases import SkippedScene
from gscompleter.evaluation.paper import load_paper
from gscompleter.types import View
from network_inputs import Fed, Recorded, record_networks
from paths import FIXTURES

MAX_COLOUR = 1 / 255
"""Another JPEG decoder rounds differently."""
MAX_INTRINSICS = 1e-6
MAX_EXTRINSICS = 2e-6
PRESETS = ("re10k", "acid", "dl3dv")
RANGES = {
    ("re10k", "mvsplat-re10k"): "mvsplat_re10k",
    ("acid", "mvsplat-acid"): "mvsplat_acid",
    ("re10k", "depthsplat-large-re10k"): "depthsplat_re10k",
    ("acid", "depthsplat-large-re10k"): "depthsplat_re10k",
    ("dl3dv", "depthsplat-base-dl3dv-256x448"): "depthsplat_dl3dv",
}
"""Names of near and far in the fixtures, by preset and model."""
VOLSPLAT_RANGE = (0.5, 100.0)
"""In the authors' experiment re10k; no fixture has it."""
DRAWN = FIXTURES / "batches"


def feed(
    monkeypatch: pytest.MonkeyPatch, preset: str, chunks: Path, index: Path, out: Path
) -> Recorded:
    """Run the whole command on all models of a preset, and record what they are fed."""
    recorded = record_networks(monkeypatch)
    words = ("evaluate", chunks, "--preset", preset, "--protocol", index, "--device", "cpu")
    # No case is scored, so that the command ends with "no case of the table was completed".
    assert run(monkeypatch, *words, "--generator", "warp-inpaint", "--out", out, "--quiet") != 0
    return recorded


def list_scenes(recorded: Recorded) -> set[str]:
    return {task.split()[0] for _, task in recorded.tasks}


def check_view(stored: dict[str, Any], frame: int, image: torch.Tensor, K: Any, c2w: Any) -> None:
    """Compare one view [3, h, w] with the authors' one of this frame."""
    (row,) = np.flatnonzero(stored["frames"] == frame)
    if "images" in stored:
        expected = stored["images"][row]
    else:
        # Drawn scenes have every eighth row and column.
        assert tuple(image.shape[1:]) == tuple(stored["image_shape"])
        image, expected = image[:, ::8, ::8], stored["pixels"][row]
    assert image.shape == expected.shape
    assert np.abs(image.numpy() - expected / np.float32(255)).max() <= MAX_COLOUR + 1e-6
    assert np.abs(K.numpy() - stored["intrinsics"][row]).max() <= MAX_INTRINSICS
    assert np.abs(c2w.numpy() - stored["extrinsics"][row]).max() <= MAX_EXTRINSICS


def normalize_intrinsics(view: View) -> torch.Tensor:
    """Return the intrinsics of a view in widths and heights."""
    camera = view.camera
    return camera.K / camera.K.new_tensor([camera.width, camera.height, 1])[:, None]


def check_fed(
    fed: Fed, stored: dict[str, Any], context: list[int], preset: str, model: str
) -> None:
    """Compare context, targets and depth range of a task with the authors' batch."""
    for number, frame in enumerate(context):
        cameras = fed.cameras
        check_view(stored, frame, fed.images[number], cameras.K[0, number], cameras.c2w[0, number])
    for view in fed.targets:
        image = view.image.permute(2, 0, 1)
        check_view(stored, view.frame, image, normalize_intrinsics(view), view.camera.c2w)
    near, far = (np.full(len(context), bound, np.float32) for bound in VOLSPLAT_RANGE)
    name = RANGES.get((preset, model))
    if name is not None and f"near_{name}" in stored:
        near, far = stored[f"near_{name}"], stored[f"far_{name}"]
    elif name is not None:
        # ACID has no arrays of drawn scenes; its constants are those of the photographs.
        assert (preset, model) == ("acid", "mvsplat-acid")
        near, far = stored["near_mvsplat_re10k"], stored["far_mvsplat_re10k"]
    assert np.array_equal(fed.cameras.near[0].numpy(), near)
    assert np.array_equal(fed.cameras.far[0].numpy(), far)
    for view in fed.targets:
        assert (view.camera.near, view.camera.far) == (near[0], far[0])


def check_scene(recorded: Recorded, preset: str, scene: str, path: Path, split: str = "") -> None:
    """Compare a scene with its fixture, for all models of a preset; `split` as in the fixture."""
    stored = dict(np.load(path))
    context = stored[f"{split}context"].tolist()
    for model in load_paper().data_sets[preset].reconstructor:
        for target in stored[f"{split}targets"].tolist():
            name = f"{scene} {'+'.join(map(str, context))}>{target}"
            check_fed(recorded.tasks[model, name], stored, context, preset, model)


def test_every_model_of_a_preset_with_authors_has_its_range():
    pairs = [(p, model) for p in PRESETS for model in load_paper().data_sets[p].reconstructor]
    assert {pair for pair in pairs if pair[1] != "volsplat-re10k"} == set(RANGES)


@pytest.mark.parametrize(
    "preset",
    [pytest.param(p, marks=pytest.mark.slow) if p == "acid" else p for p in PRESETS],
)
def test_drawn_scenes_are_fed_as_by_the_authors(preset, tmp_path, monkeypatch):
    kind = "dl3dv" if preset == "dl3dv" else "re10k"
    recorded = feed(monkeypatch, preset, DRAWN / kind, DRAWN / "index.json", tmp_path)
    for scene in ("central", "offset"):
        check_scene(recorded, preset, scene, DRAWN / f"{kind}_{scene}.npz")
    # DepthSplat's loader of DL3DV leaves out what lies above +1000, on the positive side alone.
    remote = {"far_negative"} if preset == "dl3dv" else {"far", "far_negative"}
    assert list_scenes(recorded) == {"central", "offset", *remote}


# Drawn scenes, above, are fed to the models of acid as well.
@pytest.mark.parametrize("preset", ["re10k", pytest.param("acid", marks=pytest.mark.slow)])
@pytest.mark.parametrize("split", ["", pytest.param("backward_", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    ("chunk", "scene", "stored"),
    [
        ("fixtures/batches/re10k", "fountain", "re10k_fountain.npz"),
        pytest.param(
            "formats/re10k/000000.torch",
            "0d4de33c6888a754",
            "re10k_room.npz",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_photographs_of_re10k_are_fed_as_by_the_authors(
    shared, preset, split, chunk, scene, stored, tmp_path, monkeypatch
):
    batches = shared / "fixtures" / "batches"
    index = batches / ("index_re10k_backward.json" if split else "index_re10k.json")
    recorded = feed(monkeypatch, preset, shared / chunk, index, tmp_path)
    # The square scene of the chunk is left out.
    assert list_scenes(recorded) == {scene}
    check_scene(recorded, preset, scene, batches / stored, split)


@pytest.mark.parametrize("split", ["", "backward_"])
def test_photographs_of_dl3dv_are_fed_as_by_the_authors(shared, split, tmp_path, monkeypatch):
    batches = shared / "fixtures" / "batches"
    index = batches / ("index_dl3dv_backward.json" if split else "index_dl3dv.json")
    recorded = feed(monkeypatch, "dl3dv", batches / "dl3dv", index, tmp_path)
    scenes = {"fountain"} if split else {"fountain", "room"}
    assert list_scenes(recorded) == scenes
    for scene in scenes:
        check_scene(recorded, "dl3dv", scene, batches / f"dl3dv_{scene}.npz", split)


@pytest.mark.parametrize(("preset", "is_looked_for"), [("re10k", False), ("waymo", True)])
def test_ego_vehicles_are_looked_for_where_no_authors_code_is_followed(preset, is_looked_for):
    given = EvaluateOptions(paths=(DRAWN / "re10k",), out=Path("out"), preset=preset)
    request = decide_evaluation(replace(given, protocol=("n-1",)))
    tasks = collect_tasks(request.run.cases, [], [])
    clips = [task.open() for task in tasks]
    assert {frame.vehicle is not None for clip in clips for frame in clip.frames} == {is_looked_for}


def test_another_resolution_than_that_of_a_preset_takes_photographs_of_any_size():
    given = EvaluateOptions(paths=(DRAWN / "re10k",), out=Path("out"), preset="re10k")
    given = replace(given, protocol=(str(DRAWN / "index.json"),))
    for resolution, scenes in ((None, 4), ((128, 128), 5)):
        skipped: list[SkippedScene] = []
        request = decide_evaluation(replace(given, resolution=resolution))
        assert len(collect_tasks(request.run.cases, skipped, [])) == scenes
        square = [skip.reason for skip in skipped if skip.name == "square"]
        assert square == (
            []
            if resolution
            else [
                "frame 0: its 256 × 256 pixels are not the 640 × 360 of this data set (another "
                "resolution takes any)"
            ]
        )
