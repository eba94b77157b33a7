"""Input of `complete`: sizes, chosen frames, the printed summary, and a user's splat."""

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from command import run
from gscompleter import InputError, load_cameras, load_ply
from gscompleter.apps.commands.complete import decide_completion
from gscompleter.apps.commands.evaluate import decide_evaluation
from gscompleter.apps.completing import complete as command
from gscompleter.apps.completing import keeping, preparation
from gscompleter.apps.completing.keeping import describe_size
from gscompleter.apps.evaluating.cases import collect_tasks
from gscompleter.apps.inputs.memory import estimate_memory
from gscompleter.apps.inputs.reading import read_task
from gscompleter.apps.inputs.selection import select_near_and_far
from gscompleter.apps.inputs.task import CompletionTask, Opened
from gscompleter.apps.requests.scene import decide_resolution
from gscompleter.apps.viewer.exhibit import load_viewer_completion
from gscompleter.cli import parse_command
from gscompleter.data.formats import open_photographs
from gscompleter.data.scene import write_cameras
from gscompleter.splats.formats import load_splat
from gscompleter.types import View
from pose_files import write_colmap_text, write_photographs
from scenes import camera_at, photographed

SIZE = 64
PLACES = ((-0.3, 0), (0.1, 0), (0.7, 12), (0.6, 180), (-0.1, 0))
TARGET = 2


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Return a room photographed from five places, of which frame 3 shows the other side."""
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
    return photographed(tmp_path_factory.mktemp("door"), cameras)


def complete(scene: Path, out: Path, *more: object) -> list[object]:
    return ["complete", scene, "--target", TARGET, "--out", out, *more]


@pytest.fixture(scope="module")
def chosen(scene, tmp_path_factory) -> tuple[Path, list[str]]:
    """Return the output without named context, and the lines before the work."""
    out = tmp_path_factory.mktemp("runs") / "out"
    with pytest.MonkeyPatch.context() as monkeypatch:
        said: list[str] = []
        monkeypatch.setattr(command, "print_lines", lambda _console, *lines: said.extend(lines))
        assert run(monkeypatch, *complete(scene, out, "--resolution", 48, "--far", 20)) == 0
    return out, said


def summary_of(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def test_the_longer_side_is_shrunk_and_never_enlarged(tmp_path):
    wide = replace(camera_at(), width=160, height=80)
    photographs = open_photographs(photographed(tmp_path / "room", [wide, camera_at(0.3)]))
    for frame, size in ((0, (40, 80)), (1, (80, 80))):
        (view,) = photographs.views([frame], 80)
        assert view.image.shape[:2] == (view.camera.height, view.camera.width) == size
    assert torch.allclose(photographs.camera(0, 80).K[:2], wide.K[:2] / 2)
    own = photographs.camera(0)
    for resolution in (160, 1000):
        assert torch.equal(photographs.camera(0, resolution).K, own.K)
    with pytest.raises(InputError, match="resolution 0 is impossible"):
        photographs.camera(0, 0)
    write_cameras(tmp_path / "targets.json", [wide])
    (target,) = load_cameras(tmp_path / "targets.json", 80)
    assert (target.width, target.height) == (80, 40)


def test_the_longer_side_has_640_pixels_unless_another_size_is_asked_for():
    assert decide_resolution(None) == 640
    words = ["complete", "SCENE", "--target", "8", "--out", "OUT"]
    sizes = {(): None, ("full",): "full", ("300",): 300, ("300", "200"): (300, 200)}
    for given, size in sizes.items():
        asked = [*words, "--resolution", *given] if given else words
        assert parse_command(asked).resolution == size


def test_without_a_context_the_frames_that_matter_are_taken(chosen):
    summary = summary_of(chosen[0])
    frames = [row["frame"] for row in summary["context"]]
    assert frames == [0, 1, 4]  # neither the target nor the one that looks away
    assert summary["settings"]["context"] is None
    (target,) = summary["targets"]
    assert target["psnr_after"] > target["psnr_before"] + 1


def test_four_lines_come_before_the_work(scene, chosen):
    out, (opened, found, plan, memory) = chosen
    assert opened == f"Opened: {scene}, nerfstudio, 5 of 5 photographs."
    assert found.startswith("Found: the frame of the photographs; depths from ")
    assert found.endswith(" to 20; worked at 48 x 48 (--resolution changes it).")
    assert plan == (
        "To do: complete the scene from photographs 0 (0.png), 1 (1.png), 4 (4.png) for "
        "photograph 2 (2.png) by plane-sweep and warp-inpaint on cpu, written to "
        f"{out}."
    )
    assert re.fullmatch(r"Memory: up to 1 GB of [0-9,]+ GB\.", memory)


def opened_with(scene: Path, *words: object) -> CompletionTask:
    """Open `scene` with these options; nothing is completed."""
    options = parse_command([str(word) for word in ("complete", scene, *words, "--out", "OUT")])
    photographs = open_photographs(scene, near=0.5, far=20.0)
    request = decide_completion(options)
    opened = Opened(request.source.scene, photographs, "nerfstudio", 5)
    named = request.targets.named
    return read_task(opened, request.source.context, named, "cpu", False, False)


def test_a_context_that_is_named_is_the_one_that_is_taken(scene):
    task = opened_with(scene, "--target", TARGET, "--context", 0, 4)
    assert [view.frame for view in task.views] == [0, 4]


def test_the_estimated_memory_grows_with_pixels(scene):
    task = opened_with(scene, "--target", TARGET, "--context", 0, 4)
    cameras = [replace(view.camera, width=1000, height=1000) for view in task.views]
    image = torch.zeros(1, 1, 3).expand(1000, 1000, 3)
    large = replace(task, views=[View(image, camera) for camera in cameras])
    assert estimate_memory(task, None) < 1e9 < 3e9 < estimate_memory(large, None) < 5e9


def test_the_summary_says_what_was_opened_and_between_which_depths(chosen):
    summary = summary_of(chosen[0])
    assert summary["scene"] == {
        "format": "nerfstudio",
        "photographs": 5,
        "used": 3,
        "fitted": 0,
        "splat": None,
        "refined_poses": None,
        "renders_from": None,
        "notes": [],
    }
    depths = summary["depth_range"]
    assert depths["from"] == {"near": "features", "far": "given"}
    assert 0 < depths["near"] < depths["far"] == 20


def test_photographs_that_are_missing_are_named_where_too_few_are_left(
    scene, tmp_path, monkeypatch, capsys
):
    copy = Path(shutil.copytree(scene, tmp_path / "copy"))
    for number in range(4):
        (copy / f"{number}.png").unlink()
    assert run(monkeypatch, "complete", copy, "--out", tmp_path / "out", "--resolution", 48) == 2
    said = capsys.readouterr().err
    assert "4 of 5 photographs are missing, such as 0.png, and too few are left: 1 context" in said


def test_too_few_photographs_beside_the_targets_are_refused(scene, tmp_path, monkeypatch, capsys):
    words = ["complete", scene, "--out", tmp_path / "out", "--target", 0, 1, 2, 3]
    assert run(monkeypatch, *words) == 2
    assert ("1 context view was given, and stereo needs at least 2;") in capsys.readouterr().err
    assert run(monkeypatch, *words, 4) == 2
    assert (
        "The context needs photographs, and without the targets none is left;"
    ) in capsys.readouterr().err


SMALL = ("--resolution", 32, "--quiet")
"""Options of fast runs whose result does not matter."""


def foreign(given: Path, path: Path) -> Path:
    """Write the Gaussians like another program: a comment, normals, extra columns."""
    vertex = plyfile.PlyData.read(str(given))["vertex"].data
    names = list(vertex.dtype.names)
    rows = np.zeros(len(vertex), [("label", "<i4"), *((name, "<f4") for name in reversed(names))])
    for name in names:
        rows[name] = vertex[name]
    rows["nx"], rows["label"] = 0.6, np.arange(len(rows))
    element = plyfile.PlyElement.describe(rows, "vertex")
    plyfile.PlyData([element], comments=["of another program"]).write(str(path))
    return path


@pytest.mark.slow
def test_a_splat_of_another_program_is_completed_in_its_own_layout(
    scene, chosen, tmp_path, monkeypatch
):
    given = foreign(chosen[0] / "context.ply", tmp_path / "given.ply")
    for number, splat in enumerate((given, tmp_path / "out0" / "completed.ply")):
        out = tmp_path / f"out{number}"
        assert run(monkeypatch, *complete(scene, out, *SMALL, "--scene", splat)) == 0
        names = plyfile.PlyData.read(str(out / "completed.ply"))["vertex"].data.dtype.names
        assert names == ("label", *plyfile_names(given)[1:], "generated")
        assert summary_of(out)["scene"]["splat"] == str(splat)
        assert summary_of(out)["depth_range"]["from"] == {"near": "splat", "far": "splat"}
        back = tmp_path / f"back{number}.ply"
        assert run(monkeypatch, "strip", out / "completed.ply", "--out", back, "--quiet") == 0
        assert back.read_bytes() == given.read_bytes()
    assert (load_ply(tmp_path / "out0" / "completed.ply").generated > 0).any()


def plyfile_names(path: Path) -> tuple[str, ...]:
    return plyfile.PlyData.read(str(path))["vertex"].data.dtype.names


@pytest.mark.slow
def test_rows_that_were_dropped_stay_out_of_the_users_layout(scene, chosen, tmp_path, monkeypatch):
    gaussians = load_ply(chosen[0] / "context.ply")
    content = plyfile.PlyData.read(str(chosen[0] / "context.ply"), mmap=False)
    content["vertex"].data["x"][[2, 9]] = float("nan")
    content.write(str(tmp_path / "ours.ply"))
    given = foreign(tmp_path / "ours.ply", tmp_path / "given.ply")
    more = ("--scene", given, "--drop-nonfinite", "--no-recolor")
    assert run(monkeypatch, *complete(scene, tmp_path / "out", *SMALL, *more)) == 0
    rows = plyfile.PlyData.read(str(tmp_path / "out" / "completed.ply"))["vertex"].data
    labels = rows["label"][rows["generated"] == 0].tolist()
    assert labels == [n for n in range(len(gaussians)) if n not in (2, 9)]


@pytest.mark.slow
def test_a_splat_with_infinite_logits_keeps_its_bytes(scene, chosen, tmp_path, monkeypatch):
    """Such Gaussians are opaque, and the file keeps its rows."""
    given = foreign(chosen[0] / "context.ply", tmp_path / "given.ply")
    data = plyfile.PlyData.read(str(given), mmap=False)
    data["vertex"].data["opacity"][[3, 8]] = np.inf, -np.inf
    data.write(str(given))
    out, back = tmp_path / "out", tmp_path / "back.ply"
    words = (*SMALL, "--no-recolor", "--scene", given)
    assert run(monkeypatch, *complete(scene, out, *words)) == 0
    rows = plyfile.PlyData.read(str(out / "completed.ply"))["vertex"].data
    assert rows["opacity"][rows["generated"] == 0].tobytes() == data["vertex"]["opacity"].tobytes()
    assert load_ply(out / "context.ply").opacities[[3, 8]].tolist() == pytest.approx([1, 0])
    assert run(monkeypatch, "strip", out / "completed.ply", "--out", back, "--quiet") == 0
    assert back.read_bytes() == given.read_bytes()


def test_an_interrupt_leaves_a_sentence(scene, tmp_path, monkeypatch, capsys):
    def open_scene(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(preparation, "open_scene", open_scene)
    assert run(monkeypatch, *complete(scene, tmp_path / "out")) == 130
    assert "interrupted; no unfinished result was written." in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_evaluate_tells_the_notes_of_what_it_opens_once(tmp_path):
    room = tmp_path / "room"
    write_photographs(room / "images")
    write_colmap_text(room / "sparse")
    (room / "images" / "4.png").unlink()
    (note,) = open_photographs(room).notes
    row = {"scene": "room", "context": [0, 1], "target": 2}
    missing = {**row, "scene": "nowhere"}
    content = {"resolution": [32, 32], "cases": [row, {**row, "target": 3}, missing]}
    (tmp_path / "cases.json").write_text(json.dumps(content))
    for words in ([tmp_path / "cases.json"], [room, "--protocol", "sequence-1"]):
        options = parse_command([*map(str, ["evaluate", *words, "--out", tmp_path / "out"])])
        notes: list[str] = []
        assert collect_tasks(decide_evaluation(options).cases, [], notes)
        assert notes == [note]


# `test_near_plane.py` finds the plane.
@pytest.mark.slow
def test_a_near_plane_behind_what_the_photographs_show_is_told_once(
    scene, tmp_path, monkeypatch, capsys
):
    """The nearer box stands at 2.2."""
    out = tmp_path / "out"
    more = ("--context", 0, 1, "--near", 2.9, "--far", 20)
    assert run(monkeypatch, *complete(scene, out, *more)) == 0
    told = " ".join(capsys.readouterr().err.split())
    assert told.count("nearer than the near plane at 2.9: the depth range was widened to") == 1
    depths = summary_of(out)["depth_range"]
    assert depths["from"] == {"near": "features", "far": "given"}
    assert depths["near"] < 2.0
    assert depths["far"] == 20


def test_a_splat_is_doubted_by_photographs_that_are_near_and_by_some_from_everywhere():
    """Half of the check views are near the target, the others spread over a long path."""
    path = {2 * n: camera_at(0.1 * n) for n in range(60)}
    chosen = select_near_and_far([camera_at(0.45)], path, 16)
    assert chosen == sorted(set(chosen))
    assert len(chosen) == 16
    assert set(range(2, 18, 2)) <= set(chosen)
    assert max(b - a for a, b in zip(chosen, [*chosen[1:], 118], strict=True)) < 118 / 4
    assert select_near_and_far([camera_at(0.45)], path, 60) == list(path)
    assert select_near_and_far([camera_at(0.45)], {}, 16) == []


# `test_map_coordinates.py` and `test_kept_files.py` keep results.
@pytest.mark.slow
def test_a_result_is_kept_small_with_its_labels_and_without_a_copy_of_the_input(
    scene, chosen, tmp_path, monkeypatch
):
    given = chosen[0] / "context.ply"
    out = tmp_path / "out"
    words = (*SMALL, "--no-recolor", "--scene", given)
    assert run(monkeypatch, *complete(scene, out, *words, "--save-as", ".spz")) == 0
    assert describe_size(out, can_be_smaller=True) == "The results take 1 MB."
    monkeypatch.setattr(keeping, "LARGE_BYTES", 1)
    assert "--save-as .spz" in describe_size(out, can_be_smaller=True)
    assert "--save-as" not in describe_size(out, can_be_smaller=False)
    assert not (out / "completed.ply").exists()
    assert not (out / "context.ply").exists()
    assert (out / "generated.ply").is_file()
    summary = summary_of(out)
    assert summary["scene"]["context"] == str(given.resolve())
    assert {"completed.spz", "completed.spz.generated.json"} <= set(summary["files"])
    labels = load_splat(out / "completed.spz").generated
    assert int((labels > 0).sum()) == summary["gaussians"]["added"] > 0
    # What reads a result finds both scenes.
    content = load_viewer_completion(out, drop_nonfinite=False)
    assert len(content.after) == len(labels)
    assert len(content.before) == summary["gaussians"]["context"]
