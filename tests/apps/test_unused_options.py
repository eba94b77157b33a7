"""Options that only photographs can follow, or only a splat, are refused by name without them."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path

import pytest

from command import run
from gscompleter import save_ply
from gscompleter.apps.commands.clean import CleanOptions
from gscompleter.apps.commands.shared_decisions import SPLAT_OPTIONS
from gscompleter.apps.commands.shared_options import CompletingOptions, SceneOptions
from scenes import Room, camera_at, gaussians_of, view_of

WORDS = {
    "context": ("0",),
    "format": ("colmap",),
    "frames": ("7",),
    "resolution": ("64",),
    "near": ("0.5",),
    "far": ("9",),
    "no_given_depth": (),
    "no_refine_poses": (),
    "no_masks": (),
    "invert_masks": (),
    "large_masks": (),
    "ignore": ("masks",),
    "forget_edits": (),
}
"""A value of each option of photographs."""
OF_SPLATS = {
    *("folder", "scene", "out", "overwrite", "quiet", "json", "device", "threads"),
    *("drop_nonfinite", "ignore_properties", "config"),
}
"""Options that a splat alone can follow."""
OF_RENDERS = {"context", "resolution", "near", "far", "no_given_depth"}
"""Options that renders of a splat follow as photographs do."""
REFUSED = ("There are no photographs", "There are no masks")


@pytest.fixture(scope="module")
def splat(tmp_path_factory) -> Path:
    path: Path = tmp_path_factory.mktemp("alone") / "splat.ply"
    save_ply(path, gaussians_of(view_of(Room(), camera_at(size=24))))
    return path


def check_refusal(monkeypatch, capsys, name: str, *words: object) -> None:
    option = f"--{name.replace('_', '-')}"
    assert run(monkeypatch, *words, option, *WORDS[name]) == 2
    said = capsys.readouterr().err
    assert any(sentence in said for sentence in REFUSED), said
    assert option in said


def list_names(options: type) -> set[str]:
    return {field.name for field in fields(options)}


def test_clean_refuses_all_of_them(splat, tmp_path, monkeypatch, capsys):
    """An option that is new has to be added here, to the one or the other."""
    names = list_names(CleanOptions) - OF_SPLATS - {"strength", "dry_run"}
    assert names == set(WORDS)
    for name in sorted(names):
        words = ("clean", "--scene", splat, "--out", tmp_path / "out")
        check_refusal(monkeypatch, capsys, name, *words)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "setting", ["tolerance 0.5", "min-ratio 2", "idle 2", "probes 4", "floaters.max-gap 9"]
)
def test_clean_refuses_settings_of_what_does_not_decide(
    splat, tmp_path, monkeypatch, capsys, setting
):
    option, value = f"--config.{setting}".split()
    scene = [splat.parent] if "floaters" in option else []
    words = ("clean", *scene, "--scene", splat, "--out", tmp_path / "out", option, value)
    assert run(monkeypatch, *words) == 2
    assert option in capsys.readouterr().err


@pytest.mark.parametrize(
    "words",
    [
        ("complete",),
        pytest.param(("live",), marks=pytest.mark.slow),
        pytest.param(("remove", "--sphere", 0, 0, 0, 1), marks=pytest.mark.slow),
    ],
    ids=lambda words: words[0],
)
def test_commands_that_complete_refuse_what_renders_cannot_follow(
    splat, tmp_path, monkeypatch, capsys, words
):
    names = list_names(SceneOptions) - OF_SPLATS - OF_RENDERS
    assert names <= list_names(CompletingOptions)
    for name in sorted(names):
        given = ("--scene", splat) if words[0] == "remove" else (splat,)
        command = (words[0], *given, *words[1:], "--out", tmp_path / "out")
        check_refusal(monkeypatch, capsys, name, *command)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", SPLAT_OPTIONS)
def test_what_only_a_splat_can_follow_is_refused_for_photographs(
    tmp_path, monkeypatch, capsys, name
):
    option = f"--{name.replace('_', '-')}"
    assert run(monkeypatch, "complete", tmp_path / "room", option, "--out", tmp_path / "out") == 2
    said = capsys.readouterr().err
    assert "There is no splat to apply this to" in said
    assert option in said
