"""Settings by name and from YAML."""

import re
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import yaml

from gscompleter.config import (
    ABLATIONS,
    AlignmentConfig,
    CompleterConfig,
    HoleConfig,
    RefineConfig,
    get_named_config,
    load_config,
)
from gscompleter.config.settings import validate
from gscompleter.config.yaml_file import read_yaml
from gscompleter.evaluation.methods import METHODS
from gscompleter.system.errors import InputError
from paths import ROOT

OTHER_STEPS = (
    "recolor", "trust_settings", "dynamic_masks", "depth_agreement", "free_space", "psnr_guard",
    "next_best_view",
)  # fmt: skip
"""Settings of steps that the paper does not have."""
UNREAD = {"paper": "registration.", "ours": "paper_registration."}
"""Settings that each registration does not read."""


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """List settings by their full names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        is_group = isinstance(value, dict)
        flat |= flatten(value, f"{prefix}{name}.") if is_group else {prefix + name: value}
    return flat


def read_table(heading: str) -> list[list[str]]:
    """Read the rows of the table below a heading of docs/paper.md."""
    section = (ROOT / "docs" / "paper.md").read_text("utf-8").split(f"\n## {heading}\n")[1]
    lines = [line for line in section.split("\n## ")[0].splitlines() if line.startswith("|")]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in lines[2:]]


def parse_value(text: str, name: str) -> Any:
    """Parse a value as the table writes it."""
    if name == "guards":
        return () if text == "none" else tuple(text.split(", "))
    # `none` is a name in `alignment.align_at`, and else no value.
    named = {"true": True, "false": False} | (
        {} if name == "alignment.align_at" else {"none": None}
    )
    return named[text] if text in named else yaml.safe_load(text)


def parse_changes(text: str) -> dict[str, Any]:
    """Parse `name` value, `name` value, ...."""
    pairs = re.findall(r"`([a-z_.]+)` ([^,]+)", text)
    return {name: parse_value(value.strip(), name) for name, value in pairs}


@pytest.mark.parametrize(("column", "config"), [(1, "paper"), (2, "default")])
def test_every_setting_is_that_of_the_table_in_the_documentation(column, config):
    rows = read_table("Settings")
    names = [row[0].strip("`") for row in rows]
    settings = flatten(asdict(get_named_config(config)))
    expected = {n: v for n, v in settings.items() if n.split(".")[0] not in OTHER_STEPS}
    assert names == list(dict.fromkeys(names))
    assert set(names) == set(expected)
    for name, row in zip(names, rows, strict=True):
        if row[column] == "not read":
            # The registration that the preset does not name.
            assert name.startswith(UNREAD[settings["registration_method"]])
        else:
            assert parse_value(row[column], name) == expected[name], name


def test_settings_of_other_steps_are_the_same_in_the_paper():
    for group in OTHER_STEPS:
        assert getattr(CompleterConfig.paper(), group) == getattr(CompleterConfig(), group)


@pytest.mark.parametrize("base", ["paper", "default"])
@pytest.mark.parametrize("name", ABLATIONS)
def test_every_ablation_changes_what_the_documentation_says_and_no_more(name, base):
    changes = {row[0].strip("`"): parse_changes(row[2]) for row in read_table("Ablations")}
    own = {"paper": "paper_registration.", "default": "registration."}[base]
    changed = {n.replace("registration.", own): value for n, value in changes[name].items()}
    expected = flatten(asdict(get_named_config(base))) | changed
    if name == "no-mv":
        expected["guards"] = tuple(guard for guard in expected["guards"] if guard != "psnr")
    assert flatten(asdict(get_named_config(f"{base}/{name}"))) == expected
    assert set(changes) == set(ABLATIONS)


def test_methods_of_an_evaluation_are_the_ablations_by_their_names():
    for name in ABLATIONS:
        method = "unconstrained" if name == "3-dof" else name
        assert {method, f"paper/{method}"} <= set(METHODS)


def test_a_yaml_file_names_only_what_differs(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("base: paper\nholes: {dilation: 5}\nalignment: {align_at: none}\n")
    config = load_config(str(file))
    assert config.holes == HoleConfig(dilation=5, candidate_radius=None)
    assert config.alignment == AlignmentConfig("none", min_agreement=0.0)
    assert config.registration_method == "paper"


def test_a_whole_number_is_a_float_and_an_empty_file_changes_nothing(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("margin: 1")
    assert load_config(str(file)).margin == 1.0
    file.write_text("")
    assert load_config(str(file)) == CompleterConfig()


@pytest.mark.parametrize(
    "text", ["1e-3", "1E-3", "+1e-3", "0.1e-2", "1.0e-3", "1_0e-4", ".1e-2", "00.001"]
)
def test_a_small_number_is_written_in_any_way(tmp_path, text):
    file = tmp_path / "mine.yaml"
    file.write_text(f"margin: {text}")
    assert load_config(str(file)).margin == pytest.approx(0.001)


def test_a_name_that_begins_as_a_number_is_a_name(tmp_path):
    file = tmp_path / "mine.yaml"
    file.write_text("guards: [3e4_guards.py:Guard, 1e5abc]")
    assert read_yaml(file) == {"guards": ["3e4_guards.py:Guard", "1e5abc"]}


def refused(path: Path, text: str, sentence: str) -> None:
    """Check that the file is refused with one short sentence."""
    path.write_text(text)
    with pytest.raises(InputError, match=sentence) as told:
        load_config(str(path))
    assert len(str(told.value)) < 250 + len(str(path))
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (
            "holes: {dilatation: 5}",
            "no setting 'holes.dilatation'; choose one of max_alpha, min_covered, dil",
        ),
        ("holes: {dilation: many}", "holes.dilation must be a valid integer, got 'many'"),
        ("holes: {dilation: '5'}", "holes.dilation must be a valid integer, got '5'"),
        ("holes: {dilation: 2.5}", "holes.dilation must be a valid integer, got 2.5"),
        ("holes: {dilation: -1}", "holes.dilation must be greater than or equal to 0, got -1"),
        ("holes: {dilation: [1, 2]}", r"holes.dilation must be a valid integer, got \[1, 2\]"),
        ("holes: 3", "holes is a group of settings, got 3"),
        ("holes: [1]", r"holes is a group of settings, got \[1\]"),
        ("holes:", "holes is a group of settings, got None"),
        (
            "registration: {hole_depth: tiny}",
            "registration.hole_depth must be 'lifted' or 'scene', got",
        ),
        ("paper_registration: {iterations: 7}", "paper_registration are changed, and the regis"),
        ("base: paper\nregistration: {iterations: 7}", "registration are changed, and the regis"),
        ("registration: {iterations: 1000000000000}", "iterations must be less than or equal to"),
        ("registration: {learning_rate: 0}", "learning_rate must be greater than 0, got 0"),
        ("psnr_guard: {max_drop: true}", "psnr_guard.max_drop must be a valid number, got True"),
        ("psnr_guard: {max_trials: 0}", "no setting 'psnr_guard.max_trials'; choose one of max_"),
        ("margin: .nan", "margin must be a finite number, got nan"),
        ("margin: .inf", "margin must be a finite number, got inf"),
        ("margin: -0.5", "margin must be greater than or equal to 0, got -0.5"),
        ("margin: 1e9", "margin must be less than or equal to 4, got 1000000000.0"),
        ("margin: 1.0e+9", "margin must be less than or equal to 4, got 1000000000.0"),
        ("margin: 2024-01-31", "margin must be a valid number, got '2024-01-31'"),
        ("1: 2", "no setting '1'"),
        ("margin: 1\nmargin: 2", "is not YAML: 'margin' is there twice in line 2"),
        ("holes: {kind: all}\nmargin: 1\nholes: {dilation: 2}", "'holes' is there twice in line 3"),
        (
            "holes:\n  dilation: 2\n  kind: all\n  'dilation': 3",
            "'dilation' is there twice in line 4",
        ),
        ("holes: {dilation: 010}", "is not YAML: 010 is no decimal number in line 1"),
        ("holes: {dilation: 1:30}", "is not YAML: 1:30 is no decimal number"),
        ("margin: 1:30.5", "is not YAML: 1:30.5 is no decimal number"),
        ('guards: ["\\ud800"]', "A setting has characters that are no Unicode; write it again"),
        ("2024-01-31: 2", "is not YAML"),
        ("margin: 2024-13-45", "is not YAML: month must be in 1..12"),
        ("- 1", "must map settings to values"),
        ("0", "must map settings to values"),
        ("a: [", "is not YAML"),
        ("a: \x07", "is not YAML"),
        ("a: !!python/object/apply:os.getcwd []", "is not YAML: could not determine a constructor"),
        ("base: papper", "no config 'papper'"),
        ("base: [paper]", "no config"),
    ],
)
def test_a_wrong_setting_gets_a_sentence(tmp_path, text, sentence):
    refused(tmp_path / "mine.yaml", text, sentence)


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("margin: " + "9" * 400, "margin must be a finite number"),
        ("margin: " + "9" * 5000, "is not YAML: Exceeds the limit"),
        ("margin: 0x" + "f" * 9000, "is not YAML: Exceeds the limit"),
        ("margin: " + "[" * 20000 + "]" * 20000, "nested too deeply"),
        ("a: " * 2000 + "1", "is not YAML"),
        ("margin: " + "x" * 10**6, "at most 65,536 are read"),
        ("x" * 1000 + ": 1", "There is no setting 'xxx"),
        ("margin: " + "x" * 60000, "margin must be a valid number, got 'xxx"),
        ("<<: 1", "is not YAML: expected a mapping"),
        ("<<: [1]", "is not YAML: expected a mapping"),
        ("margin: {<<: [[1]]}", "is not YAML: expected a mapping"),
        ("margin: 0x_", "is not YAML"),
        ("margin: 0b_", "is not YAML"),
        ("margin: 1:", "is not YAML"),
        ("margin: 1" + ":59" * 20000, "is not YAML"),
        ("margin: =", "is not YAML: could not determine"),
        ("? {a: 1}\n: 2", "is not YAML"),
        ("margin: !!float x", "is not YAML"),
        ("margin: !!bool x", "is not YAML"),
        ("margin: !!int ''", "is not YAML"),
        ("margin: !!timestamp x", "is not YAML"),
        ("\n".join(f"a{i}: &a{i} [{f'*a{i - 1},' * 9 if i else 1}]" for i in range(20)), "aliases"),
    ],
    ids=lambda text: text[:24],
)
def test_a_hostile_file_is_refused_at_once(tmp_path, text, sentence):
    refused(tmp_path / "mine.yaml", text, sentence)


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "mine.yaml").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="is not YAML"):
        load_config(str(tmp_path / "mine.yaml"))


@pytest.mark.parametrize("name", ["default", "paper", *ABLATIONS])
def test_every_named_config_is_within_its_ranges(name):
    assert validate(get_named_config(name)) == get_named_config(name)


@pytest.mark.parametrize(
    ("config", "name"),
    [
        (CompleterConfig(margin=float("nan")), "margin"),
        (CompleterConfig(refine=RefineConfig(iterations=-1)), "refine.iterations"),
    ],
)
def test_python_is_checked_alike_and_the_argument_is_named(config, name):
    with pytest.raises(InputError, match=name) as told:
        validate(config, "config.")
    assert told.value.argument == f"config.{name}"


def test_an_unknown_name_or_missing_file_gets_a_sentence():
    with pytest.raises(InputError, match="no config 'no-xy'"):
        load_config("no-xy")
    with pytest.raises(InputError, match="missing.yaml cannot be read: No such file"):
        load_config("missing.yaml")
