"""The door of `complete`: sizes, chosen frames, what is said first, and a user's own file."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile
import pytest
import torch

from command import run
from gscompleter import InputError, load_cameras, load_ply, save_ply
from gscompleter.cli import parsed
from gscompleter.commands import complete as command
from gscompleter.commands.evaluate import chosen_tasks
from gscompleter.data.formats import open_photographs
from gscompleter.data.scene import write_cameras
from pose_files import write_colmap_text, write_photographs
from scenes import camera_at, photographed

SIZE = 64
PLACES = ((-0.3, 0), (0.1, 0), (0.7, 12), (0.6, 180), (-0.1, 0))
TARGET = 2


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """A room photographed from five places, of which frame 3 shows the other side."""
    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in PLACES]
    return photographed(tmp_path_factory.mktemp("door"), cameras)


def complete(scene: Path, out: Path, *more: object) -> list[object]:
    return ["complete", scene, "--target", TARGET, "--out", out, *more]


@pytest.fixture(scope="module")
def chosen(scene, tmp_path_factory) -> tuple[Path, list[str]]:
    """The output where no context was named, and what was said before the work."""
    out = tmp_path_factory.mktemp("runs") / "out"
    with pytest.MonkeyPatch.context() as monkeypatch:
        said: list[str] = []
        monkeypatch.setattr(command, "say", lambda _console, *lines: said.extend(lines))
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
    words = ["complete", "SCENE", "--target", "8", "--out", "OUT"]
    sizes = {(): 640, ("full",): "full", ("300",): 300, ("300", "200"): (300, 200)}
    for given, size in sizes.items():
        asked = [*words, "--resolution", *given] if given else words
        assert parsed(asked).resolution == size


def test_without_a_context_the_frames_that_matter_are_taken(chosen):
    summary = summary_of(chosen[0])
    frames = [row["frame"] for row in summary["context"]]
    assert frames == [0, 1, 4]  # neither the target nor the one that looks away
    assert summary["settings"]["context"] is None
    (target,) = summary["targets"]
    assert target["psnr_after"] > target["psnr_before"] + 1


def test_three_lines_come_before_the_work(scene, chosen):
    out, (opened, found, plan) = chosen
    assert opened == (
        f"Opened: {scene}, nerfstudio, 5 photographs, 1 camera with no lens distortion, no points."
    )
    assert found.startswith("Found: the frame of the photographs; depths from ")
    assert "to 20 (by matched features and as given); worked at 48 x 48 (the photog" in found
    assert "have 64 x 64; --resolution full keeps that)." in found
    assert plan == (
        "To do: context from frames 0, 1, 4 (chosen), completed for frame 2 by plane-sweep and "
        f"warp-inpaint on cpu, written to {out}."
    )


def test_the_summary_says_what_was_opened_and_between_which_depths(chosen):
    summary = summary_of(chosen[0])
    assert summary["scene"] == {
        "format": "nerfstudio",
        "photographs": 5,
        "used": 3,
        "splat": None,
    }
    depths = summary["depth_range"]
    assert depths["from"] == {"near": "features", "far": "given"}
    assert 0 < depths["near"] < depths["far"] == 20


def test_too_few_photographs_beside_the_targets_are_refused(scene, tmp_path, monkeypatch, capsys):
    words = ["complete", scene, "--out", tmp_path / "out", "--target", 0, 1, 2, 3]
    assert run(monkeypatch, *words) == 2
    assert (
        "Besides the targets there is 1 photograph that can be used, and at least 2 are needed;"
    ) in capsys.readouterr().err
    assert run(monkeypatch, *words, 4) == 2
    assert (
        "Besides the targets there are 0 photographs that can be used, and at least 2 are needed;"
    ) in capsys.readouterr().err


SMALL = ("--resolution", 32, "--config.reconcile.iterations", 10, "--quiet", "--keep-unsupported")
"""Where what is completed matters less than that it is."""


def foreign(given: Path, path: Path) -> Path:
    """The same Gaussians as another program writes them: a comment, normals, columns of its own."""
    vertex = plyfile.PlyData.read(str(given))["vertex"].data
    names = list(vertex.dtype.names)
    rows = np.zeros(len(vertex), [("label", "<i4"), *((name, "<f4") for name in reversed(names))])
    for name in names:
        rows[name] = vertex[name]
    rows["nx"], rows["label"] = 0.6, np.arange(len(rows))
    element = plyfile.PlyElement.describe(rows, "vertex")
    plyfile.PlyData([element], comments=["of another program"]).write(str(path))
    return path


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


def test_rows_that_were_dropped_stay_out_of_the_users_layout(scene, chosen, tmp_path, monkeypatch):
    gaussians = load_ply(chosen[0] / "context.ply")
    damaged = replace(gaussians, means=gaussians.means.clone())
    damaged.means[[2, 9]] = torch.nan
    save_ply(tmp_path / "ours.ply", damaged)
    given = foreign(tmp_path / "ours.ply", tmp_path / "given.ply")
    more = ("--scene", given, "--drop-nonfinite")
    assert run(monkeypatch, *complete(scene, tmp_path / "out", *SMALL, *more)) == 0
    rows = plyfile.PlyData.read(str(tmp_path / "out" / "completed.ply"))["vertex"].data
    labels = rows["label"][rows["generated"] == 0].tolist()
    assert labels == [n for n in range(len(gaussians)) if n not in (2, 9)]


def test_an_interrupt_says_what_it_leaves(scene, tmp_path, monkeypatch, capsys):
    def stopped_after(*written: str):
        def open_scene(*_: object) -> None:
            for name in written:
                (tmp_path / "out" / name).parent.mkdir(parents=True, exist_ok=True)
                (tmp_path / "out" / name).write_text("{}")
            raise KeyboardInterrupt

        return open_scene

    sentences = {
        (): "interrupted; nothing was written.",
        ("colmap/summary.json",): "interrupted; nothing was written but the cameras that were "
        f"found: {tmp_path / 'out' / 'colmap'}.",
        ("summary.json",): f"interrupted; the result is written: {tmp_path / 'out'}.",
    }
    for written, sentence in sentences.items():
        monkeypatch.setattr(command, "open_scene", stopped_after(*written))
        assert run(monkeypatch, *complete(scene, tmp_path / "out")) == 130
        assert sentence in capsys.readouterr().err


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
        options = parsed([*map(str, ["evaluate", *words, "--out", tmp_path / "out"])])
        notes: list[str] = []
        assert chosen_tasks(options, [], notes)
        assert notes == [note]
