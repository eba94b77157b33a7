"""Every command on a CUDA device that is none (`support/fake_cuda.py`): no two devices meet in it.

The sides of the images are as small as the commands take them; what the commands compute is tested
on the CPU.
"""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from rich.console import Console

from batch_jobs import open_here
from command import run
from fake_cuda import Counts, FakeCudaTensor, get_device
from fake_gsplat import WHEEL, fake_gsplat, find_gsplat
from gscompleter import load_renderer
from gscompleter.apps.batch import engine
from gscompleter.apps.command_line.chosen_config import ChosenConfig
from gscompleter.apps.commands.live import LiveOptions, decide_live
from gscompleter.apps.completing import complete
from gscompleter.apps.live import saving
from gscompleter.apps.live.session import SessionStep, apply_step, save_camera
from gscompleter.data.scene import write_cameras
from gscompleter.evaluation.metrics.coverage import sample_held_out_cameras
from gscompleter.evaluation.store import list_row_paths
from gscompleter.reconstructors.plane_sweep.depth_devices import DEPTH_DEVICES, CpuDepth
from gscompleter.splats.formats import load_splat
from gscompleter.splats.ply import load_ply, save_ply
from gscompleter.system.files.image import write_image
from gscompleter.types import merge
from scenes import Room, camera_at, gaussians_of, photographed, room_without_a_box, view_of

pytestmark = [
    pytest.mark.skipif(find_gsplat() is None, reason=f"needs {WHEEL}, which `make test` fetches"),
    pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU"),
]

SIZE = 24
CAMERAS = [camera_at(0.3 * i - 0.6, y=0.1 * (i % 2), yaw=4 - 2 * i, size=SIZE) for i in range(5)]
FINE = [camera_at(0.3 * i - 0.6, yaw=4 - 2 * i, size=SIZE) for i in (0, 4)]
"""Cameras of the pixels that the splats are made of."""
ASIDE = replace(camera_at(0.02, size=SIZE), near=None, far=None)
"""A camera that no photograph has."""
BESIDE = camera_at(0.8, yaw=16, size=SIZE)
"""A camera at a hole of the splat."""
SPOT = (slice(9, 15), slice(10, 17))
"""Rows and columns of the image at that camera which the mask marks."""
COMMON = ("--device", "cuda", "--resolution", SIZE, SIZE, "--quiet")
RANGE = ("--near", 0.5, "--far", 20)
FEW = [
    word
    for name in ("registration.iterations", "refine.iterations", "refine.color-rounds")
    for word in (f"--config.{name}", 2)
]
"""Few steps of the stages: an operation on the wrong device fails in the first one."""


MOST = {
    "complete": (3240, 1_967_000),
    "complete, alone": (1320, 6_500_000),
    "complete, mask": (2070, 6_000_000),
    "complete, painted": (1350, 1_550_000),
    "update": (1190, 1_230_000),
    "repair": (2040, 2_250_000),
    "remove, mask": (1800, 1_900_000),
    "remove, box": (1980, 5_120_000),
    "clean": (570, 560_000),
    "clean, alone": (56, 1_250_000),
    "live, repair": (2280, 2_670_000),
    "live, remove, complete": (3290, 10_400_000),
    "batch": (830, 2_120_000),
    "evaluate": (920, 2_110_000),
}
"""Most waits of the host for the device in a command, and most bytes that it holds at once.

Of `live` they are those of a session with one or two steps, of `batch` of a row, and of `evaluate`
of a case.

A twentieth more than was counted: work that moves to the host, or what a stage does not free.
"""
NUM_ASIDE = 2
"""Cameras beside the photographs at which the coverage is measured."""


@pytest.fixture(autouse=True)
def device(monkeypatch) -> Iterator[Counts]:
    # All 32 cameras take as long as the rest of a command.
    few = partial(sample_held_out_cameras, count=NUM_ASIDE)
    monkeypatch.setattr(complete, "sample_held_out_cameras", few)
    # Photographs are matched by the kernels: on tensors (`test_depth_devices.py`) this holds more
    # than all else of such small images, and takes thousands of launches.
    monkeypatch.setitem(DEPTH_DEVICES, "cuda", lambda _: CpuDepth())
    with fake_gsplat() as counts:
        yield counts


@pytest.fixture(scope="module")
def room(tmp_path_factory) -> Path:
    """Write a splat, photographs of it, and what else the commands read.

    `cut.ply` is the splat without the box near the middle of the room.
    """
    folder = tmp_path_factory.mktemp("device") / "room"
    folder.mkdir()
    whole = merge([gaussians_of(view_of(Room(), camera)) for camera in FINE])
    save_ply(folder / "splat.ply", whole)
    save_ply(folder / "cut.ply", room_without_a_box(FINE))
    names = [f"{number}.png" for number in range(len(CAMERAS))]
    for name, camera in zip(names, CAMERAS, strict=True):
        write_image(folder / name, load_renderer("cpu").render(whole, camera).image)
    write_cameras(folder / "transforms.json", CAMERAS, names)
    write_cameras(folder / "aside.json", [ASIDE])
    write_cameras(folder / "beside.json", [replace(BESIDE, near=None, far=None)])
    mask = torch.zeros(SIZE, SIZE)
    mask[SPOT] = 1.0
    write_image(folder / "mask.png", mask)
    (folder / "selection").mkdir()
    write_image(folder / "selection" / "2.png", mask)
    return folder


def read_summary(out: Path) -> dict:
    return json.loads((out / "summary.json").read_text())


def check_result(out: Path, num_added: int) -> dict:
    """Check a result of the device, to which Gaussians were added; return its summary."""
    summary = read_summary(out)
    assert summary["device"] == "cuda"
    assert summary["gaussians"]["added"] > num_added
    assert load_ply(out / "completed.ply").means.isfinite().all()
    return summary


def assert_bounded(device: Counts, command: str) -> None:
    """Check that a command waited for the device, and held there, no more than it has to."""
    most_waits, most_bytes = MOST[command]
    assert sum(device.waits.values()) <= most_waits, device.waits.most_common(20)
    memory = get_device().memory
    stage, peak = memory.peaks.most_common(1)[0]
    assert peak <= most_bytes, f"{stage}:\n{memory.largest[stage]}"


@pytest.mark.slow
def test_a_splat_is_completed_where_photographs_and_a_search_find_holes(
    room, tmp_path, monkeypatch, device
):
    words = ("complete", room, "--scene", room / "cut.ply", "--auto", 1, *RANGE, *FEW, *COMMON)
    assert run(monkeypatch, *words, "--context", 0, 4, "--out", tmp_path / "out") == 0
    summary = check_result(tmp_path / "out", 10)
    assert len(summary["targets"]) == 1
    assert [row["frame"] for row in summary["held_out"]] == [1, 2, 3]
    assert_bounded(device, "complete")


@pytest.mark.slow
def test_holes_of_a_splat_alone_are_completed(room, tmp_path, monkeypatch, device):
    words = ("complete", room / "splat.ply", "--target", room / "beside.json", *FEW, *COMMON)
    assert run(monkeypatch, *words, "--out", tmp_path / "out") == 0
    check_result(tmp_path / "out", 10)
    assert_bounded(device, "complete, alone")


@pytest.mark.slow
def test_what_a_mask_marks_in_a_splat_alone_is_completed(room, tmp_path, monkeypatch, device):
    words = ("complete", room / "splat.ply", "--target", room / "aside.json")
    mask = ("--mask", room / "mask.png")
    assert run(monkeypatch, *words, *mask, *FEW, *COMMON, "--out", tmp_path / "out") == 0
    assert check_result(tmp_path / "out", 10)["gaussians"]["removed"] > 10
    assert_bounded(device, "complete, mask")


@pytest.mark.slow
def test_holes_are_exported_and_painted_images_come_back(room, tmp_path, monkeypatch, device):
    words = ("complete", room, "--context", 0, 1, "--target", 3, *RANGE, *FEW, *COMMON)
    out, holes = tmp_path / "out", tmp_path / "holes"
    assert run(monkeypatch, *words, "--out", out, "--export-holes", holes) == 0
    shutil.copyfile(room / "3.png", holes / "target1.png")
    assert run(monkeypatch, *words, "--out", out, "--images", holes) == 0
    check_result(out, 10)
    assert_bounded(device, "complete, painted")


# The one command that completes in short; what others do beside it runs on the CPU alone there.
def test_photographs_update_a_splat_and_others_are_kept_back(room, tmp_path, monkeypatch, device):
    words = ("update", room, "--scene", room / "cut.ply", "--hold-out", 1, "--far", 20)
    assert run(monkeypatch, *words, *FEW, *COMMON, "--out", tmp_path / "out") == 0
    summary = check_result(tmp_path / "out", 10)
    assert summary["gaussians"]["from_photographs"] == summary["gaussians"]["added"]
    (row,) = summary["held_out"]
    assert row["psnr_after"] > row["psnr_before"] + 3
    assert_bounded(device, "update")


@pytest.mark.parametrize(
    ("source", "free"),
    [
        ("photographs", 10**6),
        # The splat fits, and the costs of its photographs do not.
        pytest.param("photographs", 5 * 10**7, marks=pytest.mark.slow),
        pytest.param("splat alone", 10**6, marks=pytest.mark.slow),
    ],
)
def test_a_splat_that_does_not_fit_on_the_gpu_is_refused_before_anything_is_computed(
    room, tmp_path, monkeypatch, capsys, source, free
):
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda *_: (free, 2 * free))
    words = {
        "photographs": ("update", room, "--scene", room / "cut.ply", "--far", 20),
        "splat alone": ("complete", room / "splat.ply", "--target", room / "beside.json"),
    }
    assert run(monkeypatch, *words[source], *COMMON, "--out", tmp_path / "out") == 2
    sentence = capsys.readouterr().err
    assert "on the GPU, and 1 GB are free there" in sentence
    assert "--renderer-device" in sentence
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_new_photographs_are_placed_and_update_a_splat(tmp_path, monkeypatch):
    pytest.importorskip("pycolmap", reason="needs gscompleter[poses]")
    cameras = [camera_at(0.25 * i - 0.875, 0.1 * (i % 3), size=128) for i in range(8)]
    room = photographed(tmp_path / "room", [cameras[i] for i in (0, 1, 2, 4, 6, 7)])
    save_ply(tmp_path / "cut.ply", room_without_a_box([cameras[i] for i in (0, 4, 7)]))
    (tmp_path / "new").mkdir()
    for number in (3, 5):
        write_image(tmp_path / "new" / f"{number}.png", view_of(Room(), cameras[number]).image)
    words = ("update", room, "--scene", tmp_path / "cut.ply", "--photos", tmp_path / "new")
    given = ("--device", "cuda", "--far", 20, "--hold-out", 1, "--quiet")
    assert run(monkeypatch, *words, *given, "--out", tmp_path / "out") == 0
    summary = check_result(tmp_path / "out", 100)
    assert summary["scene"]["photographs"] == 8
    assert len(summary["held_out"]) == 1


@pytest.mark.slow
def test_what_a_mask_marks_is_repaired_with_photographs(room, tmp_path, monkeypatch, device):
    marked = ("--target", room / "aside.json", "--mask", room / "mask.png")
    words = ("repair", room, "--scene", room / "splat.ply", *marked, "--context", 0, 2, 4)
    assert run(monkeypatch, *words, *FEW, *COMMON, "--out", tmp_path / "out") == 0
    summary = check_result(tmp_path / "out", 10)
    assert summary["gaussians"]["removed"] > 10
    # Photographs that were not needed test it.
    assert [row["frame"] for row in summary["held_out"]] == [1, 3]
    assert_bounded(device, "repair")


# `test_remove.py` removes, and `update`, above, completes on the device.
@pytest.mark.slow
@pytest.mark.parametrize("by", ["mask", "box"])
def test_something_is_removed(room, tmp_path, monkeypatch, device, by):
    selected = {
        "mask": ("--mask", room / "selection"),
        "box": ("--box", -0.6, 0.2, 2.1, 0.4, 1.47, 3.1),
    }
    words = ("remove", room, "--scene", room / "splat.ply", *selected[by], "--target", 2)
    assert run(monkeypatch, *words, *RANGE, *FEW, *COMMON, "--out", tmp_path / "out") == 0
    check_result(tmp_path / "out", 10)
    assert len(load_ply(tmp_path / "out" / "removed.ply")) > 30
    assert_bounded(device, f"remove, {by}")


@pytest.mark.parametrize("with_photographs", [True, False])
def test_a_splat_is_cleaned(room, tmp_path, monkeypatch, device, with_photographs):
    out = tmp_path / "out"
    places = (room,) if with_photographs else ()
    # Without photographs there is no size to work at.
    common = COMMON if with_photographs else ("--device", "cuda", "--quiet")
    words = ("clean", *places, "--scene", room / "splat.ply", *common, "--out", out)
    assert run(monkeypatch, *words) == 0
    counts = read_summary(out)["gaussians"]
    assert 0 < counts["kept"] == len(load_splat(out / "completed.ply"))
    if with_photographs:
        assert read_summary(out)["device"] == "cuda"
    assert_bounded(device, "clean" if with_photographs else "clean, alone")


# `tests/apps/test_live.py` has sessions, and `update`, above, completes on the device.
@pytest.mark.slow
@pytest.mark.parametrize("actions", [("repair",), ("remove", "complete")])
def test_a_session_in_the_browser_is_saved(room, tmp_path, device, actions):
    options = LiveOptions(
        folder=room,
        scene=room / "splat.ply",
        out=tmp_path / "out",
        device="cuda",
        resolution=(SIZE, SIZE),
        quiet=True,
    )
    # Few steps of the stages, as in the other tests.
    few = {"registration": {"iterations": 2}, "refine": {"iterations": 2, "color_rounds": 2}}
    options = replace(options, config=ChosenConfig(changes=few))
    ready = saving.prepare_session(decide_live(options).session, Console(quiet=True))
    session = saving.begin_session(ready)
    pixels = np.zeros((SIZE, SIZE), np.uint8)
    pixels[SPOT] = 255
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    camera = save_camera(session, ASIDE.to("cuda"))
    aside = save_camera(session, BESIDE.to("cuda"))
    steps = {
        "repair": SessionStep("repair", camera, file.getvalue()),
        "remove": SessionStep("remove", camera, box=(-0.6, 0.2, 2.1, 0.4, 1.47, 3.1)),
        "complete": SessionStep("complete", aside),
    }
    for action in actions:
        session, _ = apply_step(session, steps[action])
        assert isinstance(session.latest.scene.means, FakeCudaTensor)
    assert session.steps
    saving.save_session(ready, session)
    check_result(tmp_path / "out", 10)
    assert_bounded(device, f"live, {', '.join(actions)}")


@pytest.mark.slow
def test_photographs_are_completed_in_a_batch_and_unused_ones_score_it(
    room, tmp_path, monkeypatch, device
):
    row = {"folder": str(room), "context": [0, 1], "target": [3], "near": 0.5, "far": 20}
    manifest = tmp_path / "manifest.jsonl"
    manifest.write_text(json.dumps(row | {"resolution": SIZE, "device": "cuda"}) + "\n")
    # This process alone has the device.
    monkeypatch.setattr(engine, "open_local", open_here)
    out = tmp_path / "out"
    words = ("batch", manifest, "--out", out, "--workers", 1, "--quiet")
    assert run(monkeypatch, *words) == 0
    (path,) = out.rglob("summary.json")
    held_out = check_result(path.parent, 10)["held_out"]
    assert [row["frame"] for row in held_out] == [2, 4]
    assert all(row["psnr_after"] > 10 for row in held_out)
    assert_bounded(device, "batch")


@pytest.mark.slow
def test_methods_are_evaluated(room, tmp_path, monkeypatch, device):
    case = {"scene": "room", "context": [0, 2], "target": 3, "neighbours": [1]}
    case |= {"near": 0.5, "far": 20.0}
    content = {"resolution": [SIZE, SIZE], "cases": [case]}
    cases = room.parent / "cases.json"
    cases.write_text(json.dumps(content))
    words = ("evaluate", cases, "--methods", "full", "--device", "cuda", "--quiet")
    assert run(monkeypatch, *words, "--out", tmp_path / "out") == 0
    for path in list_row_paths(tmp_path / "out"):
        (step,) = json.loads(path.read_text())["steps"]
        assert step["scores"]["target_after"]["psnr"] > 10, path.name
    assert_bounded(device, "evaluate")
