"""`evaluate` scores what `complete` writes, byte for byte."""

from dataclasses import replace

import pytest
import torch

from command import run
from gscompleter import GSCompleter
from gscompleter.data.scene import write_cameras
from gscompleter.evaluation.cases import Case
from gscompleter.evaluation.protocols import make_case_task
from gscompleter.evaluation.runner import RunConfig, evaluate, prepare_task
from gscompleter.evaluation.store import get_step_path, get_task_folder, load_prediction
from gscompleter.splats.formats import read_provenance
from gscompleter.splats.ply import save_ply
from gscompleter.system.files.image import write_image
from moving_object import CAMERAS, ROOM, SIZE, photographed
from scenes import camera_at, view_of

TARGET = camera_at(0.5, -0.5, yaw=10, size=SIZE)


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """Make a room with an object that moves between frames 0 and 1; frame 2 is the target."""
    folder = tmp_path_factory.mktemp("moving")
    views = [*photographed()[0], view_of(ROOM, TARGET)]
    names = [f"{number}.png" for number in range(len(views))]
    for name, view in zip(names, views, strict=True):
        write_image(folder / name, view.image)
    write_cameras(folder / "transforms.json", [*CAMERAS, TARGET], names)
    return folder


# `test_runs.py` compares the method `full` with a completion in memory.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "config"),
    [("full", "default"), ("paper", "paper")],
)
def test_a_case_gives_the_bytes_of_complete(method, config, scene, tmp_path, monkeypatch):
    out = tmp_path / "out"
    frames = ("--context", 0, 1, "--target", 2, "--near", 0.5, "--far", 20, "--resolution", 96, 96)
    assert run(monkeypatch, "complete", scene, *frames, "--config", config, "--out", out) == 0

    results = tmp_path / "results"
    task = make_case_task(Case(scene, (0, 1), 2, (), (SIZE, SIZE), 0.5, 20.0))
    evaluate([task], ["context", method], results)
    folder = get_task_folder(results, task.name)
    context = prepare_task(task, folder, RunConfig()).context
    prediction = load_prediction(get_step_path(folder, method, 1), context)
    # The file of a completion says who made it.
    made_by = read_provenance(out / "completed.ply")
    save_ply(tmp_path / "evaluated.ply", prediction.scene, provenance=True, made_by=made_by)
    assert (tmp_path / "evaluated.ply").read_bytes() == (out / "completed.ply").read_bytes()


@pytest.mark.slow
def test_the_order_of_the_context_does_not_matter(scene, tmp_path, monkeypatch):
    written = []
    for order in ((0, 1), (1, 0)):
        out = tmp_path / f"{order[0]}-first"
        frames = ("--context", *order, "--target", 2, "--resolution", 96, 96)
        assert run(monkeypatch, "complete", scene, *frames, "--out", out) == 0
        written.append((out / "completed.ply").read_bytes())
    assert written[0] == written[1]


def test_a_completer_sorts_its_views_by_frame(scene):
    views = [replace(view, frame=frame) for frame, view in enumerate(photographed()[0])]
    scenes = [GSCompleter().begin(order).scene for order in (views, views[::-1])]
    assert torch.equal(scenes[0].means, scenes[1].means)
    assert torch.equal(scenes[0].sh, scenes[1].sh)
