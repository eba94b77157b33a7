"""Pages that list what there is: which command for which need, and what assistants read."""

import re
import runpy

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
