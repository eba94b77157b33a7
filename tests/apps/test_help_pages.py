"""Help pages: what a switch says is what it does, and what they name is there."""

from __future__ import annotations

import ast
import re
import shlex
import subprocess
import sys
from dataclasses import fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import get_type_hints

import pytest

from command import run
from gscompleter import __version__
from gscompleter.apps.command_line.help_pages import HELP_GROUPS, LAST
from gscompleter.apps.command_line.words import list_options, show_config
from gscompleter.cli import COMMANDS, OptionClasses, parse_command
from gscompleter.config import CompleterConfig
from gscompleter.splats.ply import save_ply
from paths import TESTS
from scenes import random_gaussians
from sources import list_nodes, parse_package

ROOT = TESTS.parent
NEGATIONS = ("ignore", "instead of", "keep", "without", "leave out")
"""Words of which the help of an option `--no-X` has one."""
OF_OTHERS = {
    *("--index-url", "--pre", "--force-reinstall", "--help", "--help-all", "--version", "--config"),
}
"""Options in texts that belong to pip, to every command, or to the name of a config."""


@cache
def help_of(command: str, *more: str) -> str:
    """Return a help page, wide enough that each option has one line."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("COLUMNS", "100")
        said: list[str] = []
        patch.setattr("sys.stdout.write", lambda text: said.append(text) or len(text))
        with pytest.raises(SystemExit):
            parse_command([command, *(more or ("--help-all",))])
    return "".join(said)


def rows_of(page: str) -> dict[str, str]:
    """Return the text of each option and positional argument of a page."""
    rows: dict[str, str] = {}
    name = ""
    for line in page.splitlines():
        inside = re.fullmatch(r"│ (.*) │", line)
        if inside is None:
            continue
        if found := re.match(r"(?:-h, )?(--[\w.-]+|[A-Z]+\b)", inside[1]):
            name = found[1]
            rows[name] = ""
        rows[name] = f"{rows.get(name, '')} {inside[1].strip()}"
    return rows


def list_switches(kind: type) -> list[tuple[str, object]]:
    """List the switches of a command with their defaults, but not settings of the method."""
    found = []
    for field in fields(kind):
        if is_dataclass(field.default) and field.name != "config":
            found += list_switches(type(field.default))
        elif get_type_hints(kind)[field.name] is bool:
            found.append((field.name, field.default))
    return found


@pytest.mark.parametrize("command", COMMANDS)
def test_a_switch_is_off_and_does_what_its_row_says(command):
    """Of a switch that is on, tyro makes `--no-X` with the sentence and the default of X."""
    switches = list_switches(OptionClasses()[command])
    assert [name for name, default in switches if default is not False] == []
    rows = rows_of(help_of(command))
    for name, text in rows.items():
        if name.startswith("--no-"):
            assert "(default: True)" not in text, name
            assert any(word in text.lower() for word in NEGATIONS), (name, text)
            assert name.replace("--no-", "--") not in rows


@pytest.mark.parametrize("command", COMMANDS)
def test_a_page_has_an_example_that_is_understood(command):
    (line,) = re.findall(r"^Example: gscompleter (.*)$", help_of(command), re.M)
    words = shlex.split(line)
    assert words[0] == command
    assert isinstance(parse_command(words), OptionClasses()[command])


@pytest.mark.parametrize("command", COMMANDS)
def test_no_default_is_empty_and_none_is_true(command):
    assert not re.search(r"\(default: (|True|None)\)", help_of(command, "--help"))


def test_options_stand_in_groups():
    page = help_of("remove", "--help")
    titles = re.findall(r"^╭─ ([\w ]+) ─", page, re.M)
    assert titles == [
        *("positional arguments", "options", "input options", "computing options"),
        "synthesis options",
    ]
    boxes = dict(zip(titles, page.split("╭─ ")[1:], strict=True))
    assert "--scene PATH" in boxes["input options"]
    assert "--seed INT" in boxes["computing options"]
    assert "--box" in boxes["options"]
    assert boxes["options"].index("--out") < boxes["options"].index("--quiet")


def test_groups_name_options_that_there_are_and_each_once():
    names = [name for group in HELP_GROUPS for name in group.options] + [*LAST]
    assert len(names) == len(set(names))
    known = {f.name for kind in OptionClasses().values() for f in fields(kind)}
    assert set(names) <= known


def test_the_scene_is_explained_for_the_command():
    for command in ("repair", "live", "remove"):
        assert rows_of(help_of(command))["SCENE"].split("SCENE ")[1].strip().startswith("The splat")
    for command in ("update", "clean"):
        text = " ".join(rows_of(help_of(command))["SCENE"].split())
        assert "photographs of the splat" in text, command
    assert "leave SCENE out" not in help_of("remove")


def test_the_list_of_commands_has_the_version_and_a_sentence_for_each(monkeypatch, capsys):
    monkeypatch.setenv("COLUMNS", "100")
    assert run(monkeypatch, "--help") == 0
    said = capsys.readouterr().out
    assert "--version" in said
    assert "Example" not in said
    assert said.count("\n") < 50
    assert run(monkeypatch, "--version") == 0
    assert capsys.readouterr().out.strip() == __version__


@pytest.mark.parametrize("command", COMMANDS)
def test_a_page_names_options_that_there_are(command):
    """Those of the command itself, or after the name of another in backticks."""
    own = {f"--{name}" for name in list_options(OptionClasses()[command])} | OF_OTHERS
    for name, text in rows_of(help_of(command)).items():
        sentence = text.split(name, 1)[1]
        for code in re.findall(r"`([^`]*--[^`]*)`", sentence):
            other, *words = code.split()
            options = own if other.startswith("--") else options_of(other)
            for word in [other, *words]:
                if word.startswith("--"):
                    assert word.partition("=")[0] in options, (name, code)
        for word in re.findall(r"(?<![\w`-])--[a-z][\w.-]*", re.sub(r"`[^`]*`", "", sentence)):
            assert word.rstrip(".") in own, (name, word)


def test_a_page_shows_the_config_of_the_command_that_asks_for_it(tmp_path):
    splat = tmp_path / "splat.ply"
    save_ply(splat, random_gaussians(3))
    alone = CompleterConfig.bare()
    for words, config in (
        (["complete", "photographs"], CompleterConfig()),
        (["complete", "photographs", "--scene", "s.ply"], CompleterConfig.splat()),
        (["complete", str(splat)], alone),
        (["live", str(splat)], alone),
        (["complete", "--scene", "s.ply"], alone),
        (["complete", "--scene", "s.ply", "--resolution", "480", "640"], alone),
        (["remove", str(splat), "--mask", "m.png"], alone.for_removal()),
        (["complete", str(splat), "--mask", "m.png"], alone.for_marks()),
        (["repair", str(splat)], alone.for_marks()),
        (["remove", str(splat)], alone.for_removal()),
        (["remove", "photographs"], CompleterConfig.splat().for_removal()),
    ):
        assert show_config([*words, "--help-all"])[0] == config, words


@pytest.mark.parametrize("command", COMMANDS)
def test_what_settings_hold_in_common_is_no_option(command):
    """Variables of their classes, such as `__pydantic_config__`."""
    for name in list_options(OptionClasses()[command]):
        assert re.fullmatch(r"[a-z][a-z0-9-]*(\.[a-z][a-z0-9-]*)*", name)


def options_of(command: str) -> set[str]:
    return {f"--{name}" for name in list_options(OptionClasses()[command])} | OF_OTHERS


def texts_of(path: Path) -> list[str]:
    """List the texts of a file, with `{}` for what is filled in."""
    found = []
    for node in list_nodes(path):
        if isinstance(node, ast.JoinedStr):
            parts = [part.value if isinstance(part, ast.Constant) else "{}" for part in node.values]
            found.append("".join(map(str, parts)))
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            found.append(node.value)
    return found


def test_texts_name_files_of_the_repository_and_options_that_there_are():
    """In all sentences of the program: errors, lines, notes and pages of doctor."""
    known = {f"--{name}" for kind in OptionClasses().values() for name in list_options(kind)}
    known |= OF_OTHERS
    for path in parse_package():
        for text in texts_of(path):
            for file in re.findall(
                r"(?<![\w/])(?:docs|examples|benchmarks|integrations)/[\w./-]+\.(?:md|py|ipynb|json)",
                text,
            ):
                assert (ROOT / file).is_file(), (path.name, file)
            if path.parts[-2] == "sfm" or " " not in text.strip():
                continue  # words for the processes of COLMAP and ffmpeg are no sentences
            for word in re.findall(r"(?<![\w<!-])--[a-z][\w.-]*[a-z]", text):
                assert word in known or word.startswith("--config."), (path.name, word)


def test_the_package_can_be_run_by_its_name():
    done = subprocess.run(
        [sys.executable, "-m", "gscompleter", "--version"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert (done.returncode, done.stdout.strip()) == (0, __version__)
