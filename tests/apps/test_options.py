"""Options of all commands: one name has one meaning, and an old one is refused with the new one."""

import re
import sys
from collections import defaultdict
from dataclasses import dataclass
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest

from command import run
from gscompleter.apps.command_line.old_spellings import OLD_SPELLINGS
from gscompleter.apps.command_line.words import list_options
from gscompleter.apps.commands.shared_options import list_inputs
from gscompleter.cli import OptionClasses, parse_command
from gscompleter.config.settings import Settings
from gscompleter.data.formats import SCENE_FORMATS
from gscompleter.system.errors import InputError
from paths import TESTS

DOCS = TESTS.parent / "docs"


@pytest.fixture(scope="module")
def table() -> ModuleType:
    """Return the script that makes the tables of pages."""
    spec = spec_from_file_location("make_tables", DOCS / "make_tables.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    # Dataclasses look their module up by its name.
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_one_name_has_one_kind_of_value_and_one_sentence_in_every_command(table):
    by_name = defaultdict(list)
    for option in table.list_all_options():
        by_name[option.name].append(option)
    assert len(by_name["--out"]) > 10
    for name, same in by_name.items():
        assert {option.sentence for option in same} == {same[0].sentence}, name
        assert same[0].sentence, name
        # A command may offer fewer of the choices than the one that offers most.
        widest = max(same, key=lambda option: len(option.kinds)).kinds
        assert all(option.kinds <= widest for option in same), (name, same)


@pytest.mark.parametrize("page", ["options.md", "formats.md", "generators.md", "provenance.md"])
def test_pages_list_what_is_in_the_code(table, page):
    pages = table.make_pages()
    assert len(pages) == 4
    said = (DOCS / page).read_text(encoding="utf-8")
    assert said == pages[DOCS / page], "run `make pages`"


def test_every_table_that_is_made_stands_in_one_page(table):
    texts = [(DOCS / page).read_text(encoding="utf-8") for page in table.PAGES]
    named = [found["name"] for text in texts for found in table.REGION.finditer(text)]
    assert sorted(named) == sorted(table.TABLES)


def test_an_option_of_several_numbers_says_so(table):
    assert list(table.list_kinds(tuple[float, float, float] | None)) == ["3 numbers"]
    assert list(table.list_kinds(tuple[Path, ...])) == ["path"]


def test_the_help_of_a_format_names_all(table):
    (sentence,) = {one.sentence for one in table.list_all_options() if one.name == "--format"}
    assert set(re.findall(r"[\w-]+", sentence.partition(": ")[2])) == {*SCENE_FORMATS, "or"}


def test_another_meaning_under_the_same_name_is_found(table, monkeypatch):
    @dataclass(frozen=True, kw_only=True)
    class DemoOptions(Settings):
        """Options of a command that reads a word in another way."""

        out: int = 0
        """Number of results."""

    monkeypatch.setattr("gscompleter.apps.commands.demo.DemoOptions", DemoOptions)
    with pytest.raises(AssertionError, match="--out"):
        test_one_name_has_one_kind_of_value_and_one_sentence_in_every_command(table)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (
            ("repair", "splat.ply", "--camera", "camera.json", "--mask", "wrong.png"),
            "repair has no option --camera any more; the cameras of masks are named by --target",
        ),
        (
            ("complete", "room", "--scene", "splat.ply", "--from-photographs-only"),
            "any more; `gscompleter update` adds what photographs show and a splat lacks, and",
        ),
        (("repair", "splat.ply", "--camera=camera.json"), "are named by --target"),
        (
            ("bench", "--quick"),
            "There is no command bench any more; `python benchmarks/measure_completions.py` in a",
        ),
    ],
)
def test_an_old_spelling_is_refused_with_the_new_one(
    words, sentence, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "out"
    assert run(monkeypatch, *words, "--out", out) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.parametrize(("command", "name"), OLD_SPELLINGS)
def test_an_old_spelling_is_no_option_of_its_command(command, name):
    assert name not in list_options(OptionClasses()[command])
    with pytest.raises(InputError, match=f"{command} has no option --{name} any more; "):
        parse_command([command, f"--{name.replace('-', '_')}", "x"])


def test_the_number_of_a_photograph_is_no_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "8").mkdir()
    (tmp_path / "cameras.json").touch()
    words = ["complete", "scene", "--target", "8", "cameras.json", "--out", "8"]
    inputs = list_inputs(parse_command(words))
    assert Path("8") not in inputs
    assert Path("cameras.json") in inputs


def test_results_may_be_called_as_their_protocol(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "n-10").mkdir()
    (tmp_path / "index.json").touch()
    words = ["evaluate", "scenes", "--protocol", "n-10", "index.json", "--out", "n-10"]
    options = parse_command(words)
    inputs = list_inputs(options)
    assert Path("n-10") not in inputs
    assert Path("index.json") in inputs
    options.check_overlap()
