"""Every command and every piece of Python in README and docs: run, or at least parsed.

A block of ``` is shell unless it says otherwise. Of its commands those of `gscompleter` are run on
a small room, `SCENE`, or the reason why not stands in `NOT_RUN`; all of them are parsed. `text` is
output, or a file.
"""

from __future__ import annotations

import ast
import re
import runpy
import shlex
import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path

import pytest
import torch

import gscompleter
from command import run
from gscompleter.apps.installation import PURPOSES
from gscompleter.apps.viewer.packages import Libraries
from gscompleter.cli import COMMANDS, parse_command
from gscompleter.config.settings import validate
from gscompleter.reconstructors.plane_sweep import PlaneSweep
from paths import ROOT
from phone_files import record3d, write_archive
from room_mesh import points_of, write_ply_points
from scenes import camera_at, photographed

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
FRAMES = 11
"""Number of photographs of the room that stands for SCENE, as many as the commands name."""
SIDE = 32
"""Pixels of its photographs."""

NOT_RUN = {
    "batch": "needs a manifest; test_batch.py has some",
    "live": "serves until it is closed; test_live.py presses its buttons",
    "repair": "needs a painted mask; test_repair.py paints some",
    "poses": "needs photographs that COLMAP can match; test_poses.py has them",
    "demo": "takes half a minute; test_demo.py runs it on small images",
    "warmup": "test_rehearsal.py compiles in advance",
    "evaluate": "needs sequences or takes hours; test_runs.py evaluates a room",
    "tables": "needs what evaluate wrote; test_runs.py has it",
    "index": "needs sequences; test_protocols.py writes one",
}
"""Commands that no test here runs, and why."""
NEEDED = {
    "--reconstructor": "names published weights, which no machine of ours has",
    "--generator": "names published weights, which no machine of ours has",
    "--depth": "names published weights, which no machine of ours has",
    "--images": "names what somebody painted; test_painters.py paints some",
    "--photos": "names photographs that COLMAP has to place; test_update.py has some",
    "walk.mp4": "is a video whose frames COLMAP has to place; test_video.py makes one",
    "PANORAMAS": "are panoramas that COLMAP has to place; test_panorama.py has some",
}
"""Words that name what the room lacks, and why commands with them are not run."""
FAST = ("doctor", "models", "report", "strip", "view", "convert", "inspect")
"""Commands that take a second or two."""
WRITES_OUT = ("complete", "clean", "update", "remove", "repair")
"""Commands after which OUT is theirs."""
PYTHON_FAST = {"README.md", "complete.md", "models.md"}
"""Pages whose Python takes a few seconds; that of the others is slow."""
PYTHON_NOT_RUN = {"docs/models.md": "needs published weights"}
"""Pages whose Python is only compiled, and why."""


@dataclass(frozen=True)
class Block:
    """A block between two lines of ```."""

    page: Path
    line: int
    language: str
    text: str

    @property
    def name(self) -> str:
        return f"{self.page.relative_to(ROOT)}:{self.line}"

    @property
    def commands(self) -> list[list[str]]:
        """The words of each command."""
        lines = self.text.replace("\\\n", " ").splitlines()
        return [words for line in lines if (words := shlex.split(line, comments=True))]


def blocks() -> Iterator[Block]:
    """Return the blocks of all pages."""
    for page in PAGES:
        text = page.read_text()
        for found in re.finditer(r"^```(\w*)\n(.*?)^```$", text, re.M | re.S):
            line = text[: found.start()].count("\n") + 1
            yield Block(page, line, found[1] or "sh", found[2])


def of(language: str) -> list[Block]:
    return [block for block in blocks() if block.language == language]


def test_every_block_says_what_it_is():
    unknown = [b.name for b in blocks() if b.language not in ("sh", "python", "text", "bibtex")]
    assert unknown == [], "mark them as sh (or nothing), python, or text"


def understand_ours(words: list[str]) -> None:
    if words != ["--version"]:
        assert words[0] in COMMANDS, f"there is no command {words[0]}"
        validate(parse_command(words))


def understand_make(words: list[str]) -> None:
    targets = set(re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.M))
    assert {word for word in words if "=" not in word} <= targets


def understand_pip(words: list[str]) -> None:
    for extras in re.findall(r"gscompleter\[([\w,]+)\]", " ".join(words)):
        assert set(extras.split(",")) <= set(PURPOSES)


def understand_python(words: list[str]) -> None:
    if words[0] == "-c":
        compile(words[1], "-c", "exec")
    else:
        assert (ROOT / words[0]).is_file()


def understand_docker(words: list[str]) -> None:
    if words[0] == "build":
        assert (ROOT / words[words.index("-f") + 1]).is_file()


UNDERSTOOD: dict[str, Callable[[list[str]], None]] = {
    "gscompleter": understand_ours,
    "make": understand_make,
    "pip": understand_pip,
    "python": understand_python,
    "docker": understand_docker,
    "apptainer": lambda words: None,
}
"""Checks of the words after each program."""


@pytest.mark.parametrize("block", of("sh"), ids=lambda block: block.name)
def test_commands_are_understood(block):
    for program, *words in block.commands:
        if program not in UNDERSTOOD:
            pytest.fail(
                f"{block.name}: say in UNDERSTOOD of tests/test_snippets.py how commands of "
                f"{program!r} are checked, or mark the block as text if it is none."
            )
        UNDERSTOOD[program](words)


@cache
def options_of(command: str) -> set[str]:
    """Return the names of the options of a command."""
    with pytest.MonkeyPatch.context() as patch:
        said: list[str] = []
        patch.setattr("sys.stdout.write", lambda text: said.append(text) or len(text))
        with pytest.raises(SystemExit):
            parse_command([command, "--help-all"])
    return set(re.findall(r"--[a-z][\w.-]*", "".join(said)))


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_within_sentences_name_what_there_is(page):
    prose = re.sub(r"^```.*?^```$", "", page.read_text(), flags=re.M | re.S)
    for code in re.findall(r"`gscompleter ([a-z][^`]*)`", prose):
        command, *words = code.split()
        assert command in COMMANDS
        named = {word for word in words if word.startswith("--")} - {"--help", "--help-all"}
        assert named <= options_of(command), code
    for code in re.findall(r"`((?:make|python|pip) [^`]+)`", prose):
        program, *words = shlex.split(code)
        UNDERSTOOD[program](words)


@pytest.mark.parametrize("command", ["complete", "view"])
def test_the_reference_has_a_term_for_each_option(command):
    pytest.importorskip("mkdocs", reason="needs gscompleter[docs]")
    site = runpy.run_path(str(ROOT / "mkdocs_hooks.py"))
    page = site["as_definitions"](site["help_of"](command))
    terms = set(re.findall(r"^`(?:-h, )?(--[\w.-]+)[^`]*`\n:   +\S", page, re.M))
    in_sentences = {"--config", "--target"}
    assert terms <= options_of(command) <= terms | in_sentences


def find_obstacle(words: list[str]) -> str | None:
    """Return why these words after `gscompleter` cannot be run here; None if they can."""
    if words[0] in NOT_RUN:
        return f"{words[0]} {NOT_RUN[words[0]]}"
    return next((f"{word} {NEEDED[word]}" for word in words if word in NEEDED), None)


def ours(block: Block) -> list[list[str]]:
    """Return the commands of `gscompleter` in a block, as words after it."""
    found = [words for program, *words in block.commands if program == "gscompleter"]
    return [words for words in found if words[0] in COMMANDS]


def runnable(block: Block) -> list[list[str]]:
    """Return the commands of a block that are run."""
    return [words for words in ours(block) if find_obstacle(words) is None]


def mark_blocks() -> list[object]:
    """Return the blocks with commands; those that complete something are slow.

    One of which nothing can be run says why when the slow tests run.
    """
    marked = []
    for block in of("sh"):
        tried = runnable(block)
        if not ours(block):
            continue
        marks = []
        if not tried:
            obstacle = find_obstacle(ours(block)[0])
            marks = [pytest.mark.slow, pytest.mark.skip(reason=obstacle or "")]
        elif not all(words[0] in FAST for words in tried):
            marks = [pytest.mark.slow]
        marked.append(pytest.param(block, id=block.name, marks=marks))
    return marked


def test_every_command_is_run_or_there_is_a_reason():
    tried = {words[0] for block in of("sh") for words in runnable(block)}
    untold = set(COMMANDS) - tried - set(NOT_RUN)
    assert untold == set(), (
        "show these commands in a block of README or docs that can be run on the room of "
        "tests/test_snippets.py, or say in NOT_RUN why they cannot"
    )


@pytest.fixture(scope="module")
def scene(tmp_path_factory) -> Path:
    """Return a room with as many small photographs as the commands name."""
    cameras = [camera_at(-0.3 + 0.1 * n, yaw=n, size=SIDE) for n in range(FRAMES)]
    return photographed(tmp_path_factory.mktemp("snippets") / "SCENE", cameras)


@pytest.fixture
def sandbox(scene, completed_room, tmp_path, monkeypatch) -> Path:
    """Return a folder with all that the commands name."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(
        "gscompleter.apps.viewer.packages.load_libraries", lambda: Libraries({}, {})
    )
    for name in ("SCENE", "scene"):
        shutil.copytree(scene, name)
    shutil.copytree(completed_room, "OUT")
    for name, file in (("before.ply", "context.ply"), ("after.ply", "completed.ply")):
        shutil.copy(completed_room / file, name)
    shutil.copy(completed_room / "context.ply", "splat.ply")
    shutil.copy(completed_room / "targets.json", "cameras.json")
    shutil.copy(scene / "transforms.json", "renders.json")
    write_ply_points(Path("scan.ply"), points_of())
    write_archive(Path("room.r3d"), record3d())
    return tmp_path


@pytest.mark.parametrize("block", mark_blocks())
def test_commands_run(block, sandbox, monkeypatch, capsys):
    """Save instead of serving, and replace existing output."""
    for number, words in enumerate(runnable(block)):
        serves = words[0] == "view" and "--save" not in words
        more = ["--save", f"page{number}.html"] if serves else []
        if words[0] in WRITES_OUT and "--overwrite" not in words:
            more += ["--overwrite"]
        assert run(monkeypatch, *words, *more) == 0, capsys.readouterr().err


def grey(nearest, target, context) -> torch.Tensor:
    """Return the least of generators."""
    return torch.full((target.height, target.width, 3), 0.5)


PYTHON_PAGES = sorted({block.page for block in of("python")})


@pytest.mark.parametrize("page", PYTHON_PAGES, ids=lambda page: page.name)
def test_python_names_what_there_is(page):
    """All imports of the blocks work, and `gsc.NAME` is a name of the package."""
    for block in of("python"):
        if block.page != page:
            continue
        for node in ast.walk(ast.parse(block.text)):
            if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("gscompleter"):
                module = import_module(node.module)
                assert all(hasattr(module, alias.name) for alias in node.names), block.name
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "gsc":
                assert hasattr(gscompleter, node.attr), f"{block.name}: gsc.{node.attr}"


@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, id=page.name, marks=[] if page.name in PYTHON_FAST else pytest.mark.slow)
        for page in PYTHON_PAGES
    ],
)
def test_python_runs(page, sandbox):
    """The blocks of a page, one after the other."""
    names = {"my_model": PlaneSweep(), "my_generator": grey}
    for block in of("python"):
        if block.page == page:
            code = compile(block.text, block.name, "exec")
            if str(page.relative_to(ROOT)) not in PYTHON_NOT_RUN:
                exec(code, names)


@pytest.mark.parametrize(
    ("script", "prints"),
    [
        ("01_complete_a_scene", "Gaussians joined"),
        pytest.param("04_stage_by_stage", "left", marks=pytest.mark.slow),
        pytest.param("02_bring_your_own_models", "joined", marks=pytest.mark.slow),
        pytest.param("03_bring_your_own_generator", "joined", marks=pytest.mark.slow),
    ],
)
def test_tutorials_run(script, prints, sandbox, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [script, "SCENE", "0", "4", "8"])
    runpy.run_path(str(ROOT / "examples" / f"{script}.py"), run_name="__main__")
    assert prints in capsys.readouterr().out
    assert (sandbox / "completed.ply").is_file()
