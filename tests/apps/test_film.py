"""The video of a completion: path, frames and file."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from command import run
from full_disk import limit_file_size
from gscompleter.apps.report.film import (
    FRAMES_PER_SECOND,
    GAP_PIXELS,
    choose_stops,
    draw_corner_label,
    fit_to_video,
    plan_camera_path,
    render_frame,
    render_frames,
    write_comparison_video,
)
from gscompleter.numerics.geometry import measure_baseline, measure_rotation, resize_camera
from gscompleter.parts import PartOrigin, make_part
from gscompleter.render.loading import load_renderer
from gscompleter.state import Completion, Photo
from gscompleter.system.errors import FullDiskError, InputError
from gscompleter.system.files.video import find_ffmpeg, make_video_error, write_video
from gscompleter.system.progress import show_progress
from gscompleter.target_result import TargetResult
from gscompleter.types import Camera
from scenes import Room, camera_at, half_a_room_of
from target_views import begin_with

UP = torch.tensor([0.0, -1.0, 0.0])
SIZE = 32

imageio_ffmpeg = pytest.importorskip("imageio_ffmpeg", reason="needs gscompleter[film]")


def pitched(camera: Camera, degrees: float) -> Camera:
    """Tilt a camera downwards."""
    angle = math.radians(degrees)
    cos, sin = math.cos(angle), math.sin(angle)
    turn = torch.tensor([[1, 0, 0], [0, cos, sin], [0, -sin, cos]])
    c2w = camera.c2w.clone()
    c2w[:3, :3] = c2w[:3, :3] @ turn.to(c2w)
    return replace(camera, c2w=c2w)


def on_a_circle(degrees: float) -> Camera:
    """Return a camera one unit from the origin that faces it."""
    angle = math.radians(degrees)
    return camera_at(math.sin(angle), 0, -math.cos(angle), -degrees, size=SIZE)


@pytest.fixture(scope="module")
def completion() -> Completion:
    """Return a room whose right half was added at a target beside the only photograph."""
    camera = camera_at(size=SIZE)
    view, context, right = half_a_room_of(Room(), camera)
    target = camera_at(0.4, yaw=6, size=SIZE)
    drawn = load_renderer("reference").render(context, target)
    mask = torch.zeros(SIZE, SIZE, dtype=torch.bool)
    made = TargetResult(target, drawn, drawn, mask, drawn.alpha, 0, False, right)
    return replace(
        begin_with(context, [view]),
        added_parts=(make_part(PartOrigin("target", 1), right),),
        targets=(made,),
        seconds={"total": 0.0},
    )


def decoded(path: Path) -> tuple[dict, np.ndarray]:
    """Read the metadata and the frames [n, h, w, 3] of a video."""
    reader = imageio_ffmpeg.read_frames(str(path))
    meta = next(reader)
    width, height = meta["size"]
    pixels = [np.frombuffer(f, np.uint8).reshape(height, width, 3) for f in reader]
    return meta, np.stack(pixels)


def test_the_way_leads_from_stop_to_stop():
    cameras = [camera_at(size=SIZE), camera_at(1.0, yaw=20, size=SIZE), camera_at(1.0, 1.0)]
    way = plan_camera_path(cameras, [], 12)
    assert len(way) == 25
    for number, stop in zip((0, 12, 24), cameras, strict=True):
        assert measure_baseline(way[number], stop) < 1e-5
        assert measure_rotation(way[number], stop) < 0.1


def test_the_camera_rests_at_each_stop_and_jerks_nowhere():
    way = plan_camera_path([camera_at(x, size=SIZE) for x in (0.0, 1.0, 0.0)], [], 48)
    steps = torch.tensor([measure_baseline(a, b) for a, b in pairwise(way)])
    fastest = steps.max().item()
    assert fastest < 2 / 48  # twice as fast as on the average, at most
    assert max(steps[k].item() for k in (0, 47, 48, 95)) < 0.1 * fastest
    assert (steps[1:] - steps[:-1]).abs().max().item() < 0.15 * fastest


def test_the_horizon_stays_level_between_level_cameras():
    first, second = (pitched(camera_at(yaw=y, size=SIZE), 30) for y in (-40, 40))
    way = plan_camera_path([first, second], [pitched(camera_at(yaw=0, size=SIZE), -20)], 24)
    assert max(abs((camera.c2w[:3, 0] @ UP).item()) for camera in way) < 1e-3


def test_the_way_goes_around_what_was_photographed_and_not_through_it():
    photographs = [on_a_circle(degrees) for degrees in range(-90, 91, 15)]
    ends = [on_a_circle(-90), on_a_circle(90)]
    around, straight = plan_camera_path(ends, photographs, 48), plan_camera_path(ends, [], 48)
    assert min(camera.center.norm().item() for camera in around) > 0.9
    assert min(camera.center.norm().item() for camera in straight) < 0.1


def test_the_way_from_a_stop_to_the_same_pose_stays_there():
    here = camera_at(size=SIZE)
    photographs = [here, camera_at(1.0, size=SIZE), camera_at(2.0, size=SIZE)]
    way = plan_camera_path([here, here], photographs, 12)
    assert max(measure_baseline(camera, here) for camera in way) < 1e-5


def test_targets_that_only_got_new_colours_are_passed(completion):
    (added,) = completion.targets
    recolored = replace(added, added=added.added[:0], num_recolored=7)
    nothing = replace(added, added=added.added[:0])
    targets = tuple(
        replace(result, target=camera_at(x, size=SIZE))
        for result, x in ((nothing, 0.1), (added, 0.2), (recolored, 0.3))
    )
    _, *passed = choose_stops(replace(completion, targets=targets))
    assert [round(camera.center[0].item(), 3) for camera in passed] == [0.2, 0.3]


@pytest.mark.parametrize("size", [(48, 32), (256, 256), (200, 600), (640, 480)])
def test_a_film_is_wide_enough(completion, size):
    width, height = size
    target = resize_camera(completion.targets[0].target, width, height)
    result = replace(completion.targets[0], target=target)
    lens = choose_stops(replace(completion, targets=(result,)))[0]
    assert 2 * lens.width + GAP_PIXELS >= 720
    assert lens.width / lens.height == pytest.approx(width / height, rel=0.02)
    assert max(lens.width, lens.height) <= max(640, 720 * max(height / width, 1))


def test_sides_are_even():
    camera = fit_to_video(resize_camera(camera_at(size=SIZE), 601, 401))
    assert (camera.width, camera.height) == (600, 400)


def test_the_film_starts_at_the_nearest_photograph(completion):
    (view,) = completion.views
    far = replace(view, camera=camera_at(-2.0, size=SIZE))
    first, target = choose_stops(
        replace(completion, photos=(Photo(far), Photo(view)), num_context=2)
    )
    assert torch.equal(first.c2w, view.camera.c2w)
    assert torch.equal(target.c2w, completion.targets[0].target.c2w)


def test_a_frame_shows_before_and_after_side_by_side(completion):
    picture = render_frame(completion, completion.views[0].camera, load_renderer("reference"))
    assert picture.shape == (SIZE, 2 * SIZE + GAP_PIXELS, 3)
    before, gap, after = np.split(picture, (SIZE, SIZE + GAP_PIXELS), axis=1)
    assert (gap == 255).all()
    below = slice(SIZE - 8, SIZE)  # of the labels
    known, hole = slice(0, SIZE // 2 - 4), slice(SIZE // 2 + 4, SIZE)
    assert np.abs(before[below, known].astype(int) - after[below, known]).max() <= 2
    assert before[below, hole].max() < 30 < after[below, hole].max(axis=-1).min()


def test_a_label_can_be_read_on_black_and_on_white():
    for shade in (0, 255):
        picture = draw_corner_label(np.full((256, 256, 3), shade, dtype=np.uint8), "before")
        changed = np.abs(picture.astype(int) - shade).max(axis=-1) > 0
        where = picture[changed]
        assert 0.001 < changed.mean() < 0.05
        assert where.max() > 240
        assert shade == 0 or np.median(where) < 120  # of a dark field


def test_the_way_back_is_the_way_there(completion):
    cameras = [camera_at(x, size=SIZE) for x in (0.0, 0.1, 0.2, 0.3)]
    drawn = list(render_frames(completion, cameras, load_renderer("reference")))
    assert len(drawn) == 6
    assert all((a == b).all() for a, b in zip(drawn[1:], drawn[:0:-1], strict=True))


def test_the_file_holds_the_frames(tmp_path):
    rows, columns = np.mgrid[0:48, 0:64]
    shown = [
        np.stack([rows * 4, columns * 3, np.full_like(rows, 20 * k)], -1).astype(np.uint8)
        for k in range(10)
    ]
    write_video(tmp_path / "a.mp4", shown, FRAMES_PER_SECOND)
    meta, found = decoded(tmp_path / "a.mp4")
    assert (meta["codec"], meta["fps"], meta["size"]) == ("h264", FRAMES_PER_SECOND, (64, 48))
    assert meta["pix_fmt"].startswith("yuv420p")
    assert found.shape == (10, 48, 64, 3)
    assert np.abs(found.astype(int) - np.stack(shown)).mean() < 0.02 * 255


def test_a_player_meets_the_index_first(tmp_path):
    write_video(tmp_path / "a.mp4", [np.zeros((16, 16, 3), np.uint8)] * 3, FRAMES_PER_SECOND)
    content = (tmp_path / "a.mp4").read_bytes()
    assert 0 < content.index(b"moov") < content.index(b"mdat")


def test_a_film_that_cannot_be_written_says_so(tmp_path):
    picture = np.zeros((16, 16, 3), np.uint8)
    with pytest.raises(InputError, match="ffmpeg could not write"):
        write_video(tmp_path / "no such folder" / "a.mp4", [picture] * 200, FRAMES_PER_SECOND)


@pytest.mark.parametrize("name", ["a:b.mp4", "-y.mp4"])
def test_a_film_has_the_name_that_it_is_given(tmp_path, monkeypatch, name):
    """One is the address of a protocol `a` to ffmpeg, and the other an option."""
    monkeypatch.chdir(tmp_path)
    write_video(Path(name), [np.zeros((16, 16, 3), np.uint8)] * 3, FRAMES_PER_SECOND)
    assert len(decoded(tmp_path / name)[1]) == 3


def test_no_frame_is_drawn_for_a_film_that_cannot_be_written(tmp_path):
    drawn = 0

    def draw() -> Iterator[np.ndarray]:
        nonlocal drawn
        for _ in range(5000):
            drawn += 1
            yield np.zeros((128, 128, 3), np.uint8)

    with pytest.raises(InputError, match="ffmpeg could not write"):
        write_video(tmp_path / "no such folder" / "a.mp4", draw(), FRAMES_PER_SECOND)
    assert drawn < 5000


@pytest.mark.linux
def test_a_full_disk_is_no_fault_of_the_film(tmp_path):
    noise = np.random.default_rng(0).integers(0, 255, (20, 128, 128, 3), np.uint8)
    with limit_file_size(50_000), pytest.raises(FullDiskError, match="free some space") as error:
        write_video(tmp_path / "a.mp4", list(noise) * 5, FRAMES_PER_SECOND)
    assert "()" not in str(error.value)


@pytest.mark.parametrize(
    ("messages", "kind"),
    [
        ("[vost#0:0/libx264 @ 0x561075765540] Error muxing: No space left on device\nMore.", True),
        ("[out#0/mp4 @ 0x561075764700] Error opening output x: Permission denied\nMore.", False),
    ],
)
def test_what_ffmpeg_says_is_told_in_one_sentence(messages, kind):
    error = make_video_error(Path("a.mp4"), messages, 1)
    assert isinstance(error, FullDiskError) == kind
    assert "0x" not in str(error)
    assert "More" not in str(error)


def test_whoever_stops_it_leaves_no_ffmpeg_behind(tmp_path, monkeypatch):
    import subprocess

    started = []
    popen = subprocess.Popen

    def noted(*arguments, **named):
        started.append(popen(*arguments, **named))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", noted)

    def stopped():
        yield np.zeros((16, 16, 3), np.uint8)
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "a.mp4", stopped(), FRAMES_PER_SECOND)
    assert started[-1].poll() is not None


def test_no_film_without_a_target(completion, tmp_path):
    nothing = replace(completion, added_parts=(), targets=())
    write_comparison_video(
        tmp_path, nothing, [completion.views[0].camera], load_renderer("reference")
    )
    assert list(tmp_path.iterdir()) == []


@pytest.mark.slow
def test_the_same_completion_gives_the_same_bytes(completion, tmp_path):
    renderer, photographs = load_renderer("cpu"), [view.camera for view in completion.views]
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        with show_progress(None):
            write_comparison_video(tmp_path / name, completion, photographs, renderer)
    first, second = ((tmp_path / name / "video.mp4").read_bytes() for name in ("a", "b"))
    assert first == second
    _, found = decoded(tmp_path / "a" / "video.mp4")
    assert found.shape == (144, 358, 720, 3)


SMALL = ("--context", 0, 1, "--target", 2, "--resolution", 32, "--near", 0.5, "--far", 20)


@pytest.mark.slow
def test_a_completion_writes_a_film_where_it_is_asked(room, tmp_path, monkeypatch, capfd):
    out = tmp_path / "out"
    assert run(monkeypatch, "complete", room, *SMALL, "--video", "--out", out) == 0
    meta, found = decoded(out / "video.mp4")
    assert meta["size"] == (720, 358)
    assert len(found) == 144
    said = capfd.readouterr()
    assert "video 1 of 73" in said.err
    assert str(out / "video.mp4") in said.out


def test_without_the_extra_nothing_is_begun(room, tmp_path, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", None)
    with pytest.raises(InputError, match="imageio-ffmpeg"):
        find_ffmpeg()
    assert run(monkeypatch, "complete", room, *SMALL, "--video", "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "pip install gscompleter[film]" in said
    assert said.count("\n") == 1
    assert not (tmp_path / "out").exists()
