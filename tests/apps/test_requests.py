"""What commands decide on: requests, and refusals of options that exclude each other."""

import pickle
from dataclasses import fields, is_dataclass, replace
from pathlib import Path

import pytest

from gscompleter.apps.command_line import words as command_line
from gscompleter.apps.commands.batch import decide_batch
from gscompleter.apps.commands.batch_rows import decide_row
from gscompleter.apps.commands.clean import decide_cleaning
from gscompleter.apps.commands.complete import decide_completion
from gscompleter.apps.commands.convert import decide_conversion
from gscompleter.apps.commands.evaluate import decide_evaluation
from gscompleter.apps.commands.live import decide_live
from gscompleter.apps.commands.remove import decide_removal
from gscompleter.apps.commands.repair import decide_repair
from gscompleter.apps.commands.update import decide_update
from gscompleter.apps.commands.view import decide_view
from gscompleter.apps.requests.completion import (
    CompletionRequest,
    ExportRequest,
    PlanRequest,
    RemovalRequest,
    RepairRequest,
    UpdateRequest,
)
from gscompleter.apps.requests.scene import AloneRequest, PhotographsRequest
from gscompleter.cli import parse_command
from gscompleter.config import CompleterConfig
from gscompleter.config.settings import validate
from gscompleter.splats.ply import save_ply
from gscompleter.system.errors import InputError
from scenes import random_gaussians

DECIDE = {
    "batch": decide_batch,
    "complete": decide_completion,
    "remove": decide_removal,
    "repair": decide_repair,
    "update": decide_update,
    "live": lambda options: decide_live(options).session.completion,
    "clean": decide_cleaning,
    "convert": decide_conversion,
    "evaluate": decide_evaluation,
    "view": decide_view,
}


@pytest.fixture(scope="module")
def splat(tmp_path_factory) -> Path:
    path = tmp_path_factory.mktemp("splat") / "splat.ply"
    save_ply(path, random_gaussians(3))
    return path


@pytest.fixture
def decide(splat, tmp_path, monkeypatch):
    """Return a function from a command line, in which SPLAT is a file, to its request.

    SCENE is an empty folder.
    """
    monkeypatch.chdir(tmp_path)
    (tmp_path / "SCENE").mkdir()

    def decide(line: str) -> object:
        words = [str(splat) if word == "SPLAT" else word for word in line.split()]
        return DECIDE[words[0]](validate(parse_command(words)))

    return decide


def test_a_command_line_is_parsed_once(splat, monkeypatch):
    """Words that tell the preset, such as a splat alone with masks, need no second reading."""
    asked = []
    call = command_line.call_tyro
    monkeypatch.setattr(
        command_line, "call_tyro", lambda *given: asked.append(given[0]) or call(*given)
    )
    words = ["complete", str(splat), "--target", "c.json", "--mask", "m.png", "--out", "out"]
    parse_command([*words, "--config", "no-sa", "--config.holes.dilation", "7"])
    assert len(asked) == 1


@pytest.mark.parametrize(
    ("line", "preset"),
    [
        ("complete SCENE --out out", CompleterConfig()),
        ("complete SCENE --scene SPLAT --out out", CompleterConfig.splat()),
        ("complete SPLAT --out out", CompleterConfig.bare()),
        ("complete SPLAT --config paper --out out", CompleterConfig.paper()),
        (
            "complete SPLAT --target c.json --mask m.png --out out",
            CompleterConfig.bare().for_marks(),
        ),
        (
            "repair SCENE --scene SPLAT --target 0 --mask m.png --out out",
            CompleterConfig.splat().for_marks(),
        ),
        ("remove --scene SPLAT --sphere 0 0 0 1 --out out", CompleterConfig.bare().for_removal()),
        ("remove SPLAT --sphere 0 0 0 1 --out out", CompleterConfig.bare().for_removal()),
        ("live SPLAT", CompleterConfig.bare()),
        ("update SCENE --scene SPLAT --out out", CompleterConfig.splat()),
    ],
)
def test_the_preset_follows_the_input_and_what_is_done(decide, line, preset):
    request = decide(line)
    completion = getattr(request, "completion", request)
    assert completion.work.config == preset


def test_a_setting_that_is_typed_wins_over_any_preset(decide):
    """Also one that is the default of another preset."""
    (default,) = {CompleterConfig().holes.padding}
    assert CompleterConfig.bare().holes.padding != default
    for name in ("default", "paper"):
        line = f"complete SPLAT --config {name} --config.holes.padding {default} --out out"
        assert decide(line).work.config.holes.padding == default
    with pytest.raises(InputError, match=r"config\.holes\.dilation must be less than") as error:
        decide("complete SPLAT --config.holes.dilation 5000 --out out")
    assert error.value.argument == "config.holes.dilation"


def test_holes_are_those_of_the_option_or_of_the_setting(decide, tmp_path):
    (tmp_path / "object.yaml").write_text("holes: {kind: enclosed}")
    (tmp_path / "scene.yaml").write_text("holes: {kind: all}")
    for words, kind in (
        ("", "auto"),
        ("--holes all", "all"),
        ("--config.holes.kind all", "all"),
        ("--config.holes.kind enclosed", "enclosed"),
        ("--config object.yaml", "enclosed"),
        ("--config scene.yaml", "all"),
        ("--config paper", "auto"),
        ("--config object.yaml --holes enclosed", "enclosed"),
    ):
        assert decide(f"complete SPLAT {words} --out out").source.holes == kind
        config = decide(f"complete SCENE {words} --out out").work.config
        assert config.holes.kind == ("enclosed" if kind == "enclosed" else "all")
        assert ("hull" in config.guards) == (kind == "enclosed")
    for words in (
        "--config.holes.kind all --holes enclosed",
        "--config object.yaml --holes all",
        "--config scene.yaml --holes enclosed",
    ):
        for scene in ("SPLAT", "SCENE"):
            with pytest.raises(InputError, match=r"--holes is \w+, and the setting holes\.kind is"):
                decide(f"complete {scene} {words} --out out")


def test_a_setting_of_a_file_wins_over_what_the_command_does(decide, tmp_path):
    (tmp_path / "mine.yaml").write_text("holes: {max_alpha: 0.61}")
    line = "remove SPLAT --sphere 0 0 0 1 --config mine.yaml --out out"
    config = decide(line).completion.work.config
    preset = CompleterConfig.bare().for_removal()
    assert config == replace(preset, holes=replace(preset.holes, max_alpha=0.61))
    line = "repair SPLAT --target c.json --mask m.png --config mine.yaml --out out"
    config = decide(line).completion.work.config
    assert (config.holes.max_alpha, config.holes.forces_removed) == (0.61, True)


def test_each_command_makes_a_request_of_its_own(decide):
    assert type(decide("complete SCENE --out out")) is CompletionRequest
    assert type(decide("complete SCENE --dry-run --out out")) is PlanRequest
    assert type(decide("complete SCENE --export-holes holes --out out")) is ExportRequest
    marked = decide("complete SPLAT --target c.json --mask m.png --out out")
    assert type(marked) is RepairRequest
    removal = decide("remove SCENE --scene SPLAT --mask masks --invert-masks --out out")
    assert type(removal) is RemovalRequest
    # Masks of the removal are turned, and not those of photographs.
    assert removal.selection.mask_reading.is_inverted
    assert not removal.completion.source.scene.masks.is_inverted
    update = decide("update SCENE --scene SPLAT --hold-out 3 --out out")
    assert type(update) is UpdateRequest
    assert (update.hold_out, hasattr(update, "targets")) == (3, False)


def test_what_is_decided_has_no_auto_device_and_no_splat_in_place_of_photographs(decide, splat):
    alone = decide("complete SPLAT --device auto --out out")
    assert isinstance(alone.source, AloneRequest)
    assert alone.work.splat.path == alone.source.scene.folder == splat
    assert alone.work.models.device in ("cpu", "cuda")
    scene = decide("complete SCENE --scene SPLAT --context 3 1 --target 0 --out out")
    assert isinstance(scene.source, PhotographsRequest)
    assert scene.source.poses.named == (3, 1, "0")
    assert scene.source.scene.follows_training


def is_frozen(value: object) -> bool:
    if not is_dataclass(value):
        return True
    inner = [getattr(value, field.name) for field in fields(value)]
    return value.__dataclass_params__.frozen and all(map(is_frozen, inner))


@pytest.mark.parametrize(
    "line",
    [
        "remove SCENE --scene SPLAT --box 0 0 0 1 1 1 --out out",
        "update SCENE --scene SPLAT --out out",
        "clean --scene SPLAT --out out",
        "evaluate data --protocol n-10 --out out",
        "convert SPLAT b.spz --decimate 25%",
        "view SPLAT",
    ],
)
def test_a_request_does_not_change_and_can_be_sent_to_a_worker(decide, line):
    request = decide(line)
    assert is_frozen(request)
    assert pickle.loads(pickle.dumps(request)) == request


def test_a_row_of_a_batch_is_the_request_of_its_command_line(decide, tmp_path):
    by_row = decide_row({"folder": "SCENE", "target": "4", "seed": 3}, tmp_path / "out")
    line = f"complete SCENE --target 4 --seed 3 --out {tmp_path / 'out'} --overwrite --quiet"
    assert by_row == decide(line)


@pytest.mark.parametrize(
    ("line", "sentence"),
    [
        ("complete --out out", "Nothing is named that is to be completed"),
        ("complete SPLAT --scene SPLAT --out out", "Two splats are named"),
        ("complete SPLAT --scene . --out out", "SCENE, and the splat with --scene"),
        ("update SPLAT --scene SPLAT --out out", "Two splats are named"),
        ("update SPLAT --scene . --out out", "SCENE, and the splat with --scene"),
        ("complete SCENE --up 0 1 0 --out out", "leave --up out"),
        ("complete SPLAT --frames 9 --out out", "There are no photographs to apply this to"),
        ("complete SCENE --mask m.png --out out", "there is nothing that could be marked"),
        ("repair SCENE --target 1 --mask m.png --out out", "there is nothing that could be marked"),
        ("repair none.ply --target 1 --mask m.png --out out", "There is no none.ply"),
        ("remove none.ply --sphere 0 0 0 1 --out out", "There is no none.ply"),
        ("complete SPLAT --mask m.png --out out", "name the camera of each with --target"),
        ("remove SCENE --sphere 0 0 0 1 --out out", "there is nothing that could be removed"),
        ("remove --sphere 0 0 0 1 --out out", "Nothing is named that is to be completed"),
        ("complete SCENE --target 1 --auto 2 --out out", "--target and --auto are both given"),
        ("complete SCENE --painter me --out out", "--painter names who painted --images"),
        ("complete SCENE --path --out out", "--path is a video of what --export-holes writes"),
        ("complete SCENE --generator painted --out out", "needs painted images"),
        (
            "repair SPLAT --target c.json --mask m.png --generator painted --out out",
            "which `complete --images` names",
        ),
        ("complete SCENE --generator-steps 3 --out out", "has no setting steps"),
        ("complete SCENE --reconstructor none-such --out out", "no reconstructor"),
        ("complete SCENE --context 1 1 --out out", "--context names no frame, or one twice"),
        ("update SCENE --scene SPLAT --config paper --out out", "config.add_observed off"),
        ("clean --scene SPLAT --near 1 --out out", "There are no photographs to apply this to"),
        ("convert SPLAT b.ply --decimate half", "is no number of Gaussians"),
        ("evaluate data --reconstructor a a --out out", "A reconstructor is named twice"),
        ("batch SCENE --each near=1 near=2 --out out", "near is given twice; give it once"),
        ("view SPLAT --save page.txt", "is no .html file"),
    ],
)
def test_options_that_exclude_each_other_are_refused_before_anything_is_opened(
    decide, line, sentence
):
    with pytest.raises(InputError) as error:
        decide(line)
    assert sentence in str(error.value)
