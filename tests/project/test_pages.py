"""Pages: which command for which need, what assistants read, and how long pages may be."""

import re
import runpy
import unicodedata
from functools import cache
from pathlib import Path

import pytest

from gscompleter.cli import COMMANDS, parse_command
from gscompleter.config.settings import validate
from paths import ROOT

NEEDS = (ROOT / "docs" / "index.md").read_text("utf-8")
LLMS = (ROOT / "llms.txt").read_text("utf-8")
LINK = re.compile(r"\]\(([^)\s]+)\)")


def test_the_first_page_has_every_command():
    named = set(re.findall(r"`gscompleter (\w+)", NEEDS))
    assert named == set(COMMANDS)


def test_the_commands_of_the_first_page_are_understood():
    commands = [words for words in re.findall(r"`gscompleter ([^`]+)`", NEEDS) if "--" in words]
    assert len(commands) > 12
    for words in commands:
        validate(parse_command(words.split()))


def test_the_first_page_is_the_first_page_of_the_site():
    nav = (ROOT / "mkdocs.yml").read_text("utf-8").split("nav:\n")[1]
    assert nav.startswith("  - Which command: index.md\n")


def test_assistants_are_told_of_every_command():
    words = set(re.findall(r"\w+", LLMS.split("Commands: ")[1].split("\n\n")[0]))
    assert set(COMMANDS) <= words


def test_assistants_are_led_to_every_page_of_the_guide():
    linked = LINK.findall(LLMS)
    assert [link for link in linked if not (ROOT / link).is_file()] == []
    guide = {f"docs/guide/{path.name}" for path in (ROOT / "docs" / "guide").glob("*.md")}
    assert guide <= set(linked)
    assert LLMS.startswith("# gscompleter\n\n> ")


def test_its_links_lead_to_pages_of_the_site():
    pytest.importorskip("mkdocs", reason="needs gscompleter[docs]")
    site = runpy.run_path(str(ROOT / "mkdocs_hooks.py"))
    linked = LINK.findall(site["link_pages"](LLMS))
    assert linked[:2] == ["./", "quickstart/"]
    assert all(link.endswith("/") for link in linked)


# ------------------------------------------------------------------- lengths, pictures and links

DOCS = ROOT / "docs"
TASKS = sorted((DOCS / "guide").glob("*.md"))
"""One page for each task, of about 600 words; rules and tables of options are in `reference`."""
MOST_WORDS = 700
MOST_BYTES = 150_000
"""Size of a picture that make_guide_pictures.py makes; the demo and its viewer have more."""
WITHOUT_PICTURE = {"convert", "evaluate", "supersplat", "lichtfeld", "blender", "comfyui"}
"""Of the last four a picture would be of another program's window."""
DECISIONS = sorted((DOCS / "decisions").glob("[0-9]*.md"))
LINKED = [ROOT / "README.md", ROOT / "CHANGELOG.md", ROOT / "CONTRIBUTING.md", ROOT / "llms.txt"]
LINKED += [ROOT / "benchmarks" / "history.md", *sorted(DOCS.rglob("*.md"))]


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def count_words(path: Path) -> int:
    return len(path.read_text("utf-8").split())


def read_prose(path: Path) -> str:
    """Read a page without its blocks of code, in which brackets and number signs mean else."""
    return re.sub(r"^```.*?^```$", "", path.read_text("utf-8"), flags=re.M | re.S)


@cache
def list_anchors(page: Path) -> set[str]:
    """List the anchors of a page, as mkdocs makes them from its headings."""
    anchors: set[str] = set()
    for heading in re.findall(r"^#+ (.+)$", read_prose(page), re.M):
        words = re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", heading)
        plain = unicodedata.normalize("NFKD", words).encode("ascii", "ignore").decode()
        anchor = re.sub(r"[-\s]+", "-", re.sub(r"[^\w\s-]", "", plain).strip().lower())
        number = sum(known.rpartition("_")[0] == anchor for known in anchors)
        anchors.add(f"{anchor}_{number + 1}" if anchor in anchors else anchor)
    return anchors


@pytest.mark.parametrize("page", TASKS, ids=name_of)
def test_a_page_of_the_guide_is_one_task(page):
    text = page.read_text("utf-8")
    assert count_words(page) <= MOST_WORDS, "move tables and rules to docs/reference"
    first = text.split("\n\n")[1]
    assert re.search(r"\byour?\b", first, re.I), "begin with what the reader has and wants"
    assert re.search(r"^```", text, re.M), "a task has a command"
    assert "## What can go wrong" in text
    pictures = re.findall(r"!\[[^\]]+\]\(([^)]+)\)", text)
    assert len(pictures) == (0 if page.stem in WITHOUT_PICTURE else 1)


@pytest.mark.parametrize("page", DECISIONS, ids=name_of)
def test_a_decision_is_short(page):
    assert count_words(page) <= 150, "move variants and tables to benchmarks/history.md"


def test_the_first_page_of_the_repository_is_short_and_begins_with_the_loop():
    text = (ROOT / "README.md").read_text("utf-8")
    assert len(text.split()) <= 1000
    first_block = text.split("```")[1]
    commands = re.findall(r"^gscompleter (\w+)", first_block, re.M)
    assert commands == ["inspect", "complete", "update", "inspect"]
    assert "0 % invented" in text.split("## Install")[0]
    assert len(re.findall(r"!\[[^\]]+\]\(docs/", text)) == 1


def test_pictures_are_small_and_used():
    pictures = [*(DOCS / "pictures").glob("*"), DOCS / "loop.webp"]
    assert [name_of(path) for path in pictures if path.stat().st_size > MOST_BYTES] == []
    pages = "".join(page.read_text("utf-8") for page in LINKED)
    assert [name_of(path) for path in pictures if f"/{path.name})" not in pages] == []


@pytest.mark.parametrize("page", LINKED, ids=name_of)
def test_links_lead_to_files_and_headings(page):
    lost = []
    for link in LINK.findall(read_prose(page)):
        target, _, anchor = link.partition("#")
        if re.match(r"[a-z]+:", link):
            continue
        path = (page.parent / target).resolve() if target else page
        found = path.exists() and (
            path.suffix != ".md" or not anchor or anchor in list_anchors(path)
        )
        lost += [] if found else [link]
    assert lost == []


def test_pages_that_the_program_names_are_there():
    """Help texts, sentences and docstrings name pages by their place in the repository."""
    named = {
        (name_of(path), page)
        for path in [*(ROOT / "src").rglob("*.py"), *(ROOT / "integrations").rglob("*.md")]
        for page in re.findall(r"docs/[\w/-]+\.md", path.read_text("utf-8"))
    }
    assert len(named) > 10
    assert [pair for pair in named if not (ROOT / pair[1]).is_file()] == []


def test_links_of_written_and_made_reference_pages():
    """Both are in the folder `reference` of the site; only those made of code have its links."""
    pytest.importorskip("mkdocs", reason="needs gscompleter[docs]")
    site_link = runpy.run_path(str(ROOT / "mkdocs_hooks.py"))["site_link"]
    link, place = "../../benchmarks/history.md#decision-038", "docs/reference/splats.md"
    assert site_link(link, place, "reference/splats.md") == "../history.md#decision-038"
    assert site_link(link, place, "reference/commands.md") == link
