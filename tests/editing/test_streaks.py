"""Streaks: long Gaussians beside which nothing lies, however many of them there are."""

from __future__ import annotations

import json
import re

import pytest
import torch

from command import run
from gscompleter.config import FloaterConfig
from gscompleter.editing.floaters import find_floaters
from gscompleter.editing.streaks import find_streaks
from gscompleter.render.loading import load_renderer
from gscompleter.render.outside import measure_extent
from gscompleter.splats import load_splat, save_splat
from gscompleter.system.files.image import read_image
from gscompleter.types import Gaussians, make_observed, merge, sh_from_rgb
from solids import ALL_FACES, chair, room

RENDERER = load_renderer("cpu")
CHAIR = chair(step=0.03)
CLOSED_ROOM = room(ALL_FACES)
NUM_STREAKS = 400


def streaks(scene: Gaussians, spread: float, count: int = NUM_STREAKS) -> Gaussians:
    """Make white streaks in all directions around the middle of a scene, and through it."""
    extent = measure_extent(scene)
    generator = torch.Generator().manual_seed(0)
    means = extent.center + spread * extent.radius * torch.randn(count, 3, generator=generator)
    scales = torch.empty(count, 3)
    scales[:, 0] = extent.radius * (0.1 + 0.5 * torch.rand(count, generator=generator))
    scales[:, 1:] = scales[:, :1] / 40
    quats = torch.nn.functional.normalize(torch.randn(count, 4, generator=generator), dim=1)
    white = sh_from_rgb(torch.ones(count, 3))
    return make_observed(means, quats, scales, torch.full((count,), 0.6), white)


NEEDLES = merge([CHAIR, streaks(CHAIR, 0.5)])


def find_all(scene: Gaussians, strength: float = 1.0) -> torch.Tensor:
    reasons = find_floaters(scene, FloaterConfig().strengthen(strength))
    return torch.stack([*reasons.values()]).any(dim=0)


def test_an_object_among_hundreds_of_streaks_is_freed():
    """By neighbours alone, a quarter of them stayed, as their neighbours are streaks."""
    gone = find_all(NEEDLES)
    assert not gone[: len(CHAIR)].any()
    assert gone[len(CHAIR) :].float().mean() > 0.85


def test_a_room_full_of_streaks_is_freed():
    """They lie within its silhouettes: only what lies along them tells."""
    scene = merge([CLOSED_ROOM, streaks(CLOSED_ROOM, 0.3)])
    gone = find_all(scene)
    assert not gone[: len(CLOSED_ROOM)].any()
    assert gone[len(CLOSED_ROOM) :].float().mean() > 0.85


@pytest.mark.slow
def test_more_strength_takes_more_of_them_and_nothing_of_the_object():
    shares = []
    for strength in (0.5, 1.0, 2.0):
        gone = find_all(NEEDLES, strength)
        assert not gone[: len(CHAIR)].any()
        shares.append(gone[len(CHAIR) :].float().mean())
    assert shares[0] < shares[1] < shares[2]
    assert shares[2] > 0.9


def test_what_sticks_out_of_an_object_goes_by_its_renders():
    """Half of such a streak lies along the object, so that its length alone does not tell."""
    seat = torch.tensor([[0.0, 0.0, 0.05 * z] for z in range(-3, 4)])
    turn = torch.tensor([[0.7071, 0.0, 0.0, 0.7071]])
    along = make_observed(
        seat,
        turn.repeat(len(seat), 1),
        torch.tensor([[0.3, 0.005, 0.005]]).repeat(len(seat), 1),
        torch.full((len(seat),), 0.8),
        sh_from_rgb(torch.ones(len(seat), 3)),
    )
    # Their means lie in the seat, and their longest axis is x, turned to y: up and down.
    scene = merge([CHAIR, along])
    by_length = find_streaks(scene, FloaterConfig(max_uncovered=1.0, max_free=0.9), RENDERER)
    by_renders = find_streaks(scene, FloaterConfig(max_free=0.9), RENDERER)
    assert not by_length.any()
    assert by_renders[len(CHAIR) :].any()
    assert not by_renders[: len(CHAIR)].any()


def test_edges_and_strings_that_lie_along_others_stay():
    """Long ones side by side, as the strings of a guitar or the legs of a chair."""
    step = 0.01
    x = torch.arange(-0.5, 0.5, 0.1)
    y = torch.arange(-0.2, 0.2, step)
    places = torch.cartesian_prod(x, y)
    board = make_observed(
        torch.nn.functional.pad(places, (0, 1)),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(len(places), 1),
        torch.tensor([[0.1, step, 0.1 * step]]).repeat(len(places), 1),
        torch.full((len(places),), 0.9),
        sh_from_rgb(torch.rand(len(places), 3, generator=torch.Generator().manual_seed(0))),
    )
    assert not find_streaks(board, FloaterConfig(), RENDERER).any()


def test_generated_streaks_stay():
    ours = streaks(CHAIR, 0.5)
    ours = type(ours)(**{**vars(ours), "generated": torch.ones_like(ours.generated)})
    assert not find_all(merge([CHAIR, ours])).any()


def test_the_unit_and_the_frame_of_the_scene_hardly_matter():
    gone = find_streaks(NEEDLES, FloaterConfig(), RENDERER)
    values = {**vars(NEEDLES), "means": 1000 * NEEDLES.means, "scales": 1000 * NEEDLES.scales}
    large = find_streaks(Gaussians(**values), FloaterConfig(), RENDERER)
    assert (gone != large).float().mean() < 1e-3


@pytest.fixture(scope="module")
def splat(tmp_path_factory):
    path = tmp_path_factory.mktemp("needles") / "needles.splat"
    save_splat(path, NEEDLES)
    return path


def test_the_command_shows_what_goes_and_says_which_file_is_the_splat(
    splat, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    assert run(monkeypatch, "clean", "--scene", splat, "--out", out) == 0
    said, log = capsys.readouterr()
    lines = said.splitlines()
    assert re.search(r"\d+ streaks", lines[0])
    assert "removed.png shows it in red" in lines[1]
    assert lines[-1] == f"The cleaned splat: {out / 'completed.ply'}"
    assert log.splitlines()[0] == "reading the scene"
    summary = json.loads((out / "summary.json").read_text())
    assert summary["seen_from_outside"] > 0.5
    assert "removed.png" in summary["files"]

    # Before, what goes, and after, from two directions. What goes is red and nothing else is.
    picture = (255 * read_image(out / "removed.png")).round()
    parts = picture.split(picture.shape[1] // 3 + 1, dim=1)
    reds = [((p[..., 0] > 2 * p[..., 1]) & (p[..., 0] > 60)).float().mean().item() for p in parts]
    assert max(reds[0], reds[2]) < 0.01
    assert reds[1] > 0.05


def test_a_dry_run_says_that_nothing_was_cleaned(splat, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    options = ("--dry-run", "--strength", 0.5)
    assert run(monkeypatch, "clean", "--scene", splat, "--out", out, *options) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("Dry run: ")
    assert " Gaussians would be removed, found in " in lines[0]
    assert "would go" in lines[1]
    assert lines[-1] == "Nothing was cleaned; leave out --dry-run to write completed.ply."
    assert not (out / "completed.ply").exists()
    summary = json.loads((out / "summary.json").read_text())
    assert summary["settings"]["strength"] == 0.5
    assert summary["gaussians"]["removed"] == len(load_splat(out / "removed.ply"))
