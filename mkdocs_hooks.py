"""What the site shows besides `docs/`: pages made of README, scripts, options and names.

Links hold in the repository; here they are turned to where the same file lies on the site.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import io
import os
import re
from html import escape
from pathlib import Path
from typing import Any
from unittest.mock import patch

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent
TEXTS = {
    "README.md": "index.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
}
"""Files of the repository that are pages of the site."""
STAGES = ("selection", "context", "anchor", "alignment", "registration", "integration")
"""Modules of `stages/` in the paper's order, with what chooses the photographs before them."""
LINK = re.compile(r"(?<=\]\()[^)\s]+(?=\))")


def tutorials() -> dict[str, Path]:
    """The numbered scripts by their pages."""
    return {f"tutorials/{path.stem}.md": path for path in sorted((ROOT / "examples").glob("0*.py"))}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """The scripts get a section, and pages that `nav` does not name another."""
    named = set(re.findall(r"[\w/]+\.md", str(config.nav)))
    others = sorted({path.name for path in (ROOT / "docs").glob("*.md")} - named)
    config.nav.insert(2, {"Tutorials": list(tutorials())})
    if others:
        config.nav.append({"More": others})
    return config


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """The pages that are made."""
    made = {page: (ROOT / name).read_text() for name, page in TEXTS.items()}
    made |= {page: of_script(path) for page, path in tutorials().items()}
    made |= {
        "reference/commands.md": of_commands(),
        "reference/python.md": of_names(),
        "reference/stages.md": of_stages(),
    }
    for page, text in made.items():
        files.append(File.generated(config, page, content=text))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Links to files of the repository become links to pages."""
    by_page = {made: name for name, made in TEXTS.items()}
    place = by_page.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    return LINK.sub(lambda link: site_link(link[0], place, page.file.src_uri), markdown)


def site_link(link: str, place: str, page: str) -> str:
    """Where a link in the file at `place` leads from its page."""
    target, mark, anchor = link.partition("#")
    if ":" in target or not target or page.startswith("reference/"):
        return link
    path = os.path.normpath(os.path.join(os.path.dirname(place), target))
    scripts = {f"examples/{script.name}": made for made, script in tutorials().items()}
    uri = (TEXTS | scripts).get(path, path.removeprefix("docs/"))
    return os.path.relpath(uri, os.path.dirname(page) or ".") + mark + anchor


def of_script(path: Path) -> str:
    """A script: what its docstring says, then the script."""
    text = path.read_text()
    title, _, said = (ast.get_docstring(ast.parse(text)) or path.stem).partition("\n")
    return f"# {title.rstrip('.')}\n\n{said}\n\n```python\n{text}```\n"


def of_commands() -> str:
    """What `--help-all` says of each command."""
    from gscompleter.cli import COMMANDS

    sections = [f"## {name}\n\n{as_definitions(help_of(name))}" for name in COMMANDS]
    return "# Command line\n\nWhat `gscompleter COMMAND --help-all` says.\n\n" + "\n".join(sections)


def as_definitions(said: str) -> str:
    """Help as Markdown: options are terms, and what is said of each is one paragraph."""
    parts = []
    for line in said.splitlines():
        text, indent = line.strip(), len(line) - len(line.lstrip())
        term, _, rest = text.partition("  ")
        if not text.strip("-"):
            parts.append("\n")
        elif text.startswith("usage: "):
            parts.append(f"```text\n{text.removeprefix('usage: ')}\n```\n")
        elif indent == 1 and text.endswith(("options", "arguments")):
            parts.append(f"\n**{text}**\n")
        elif indent == 2 and (term.startswith("-") or term.isupper()):
            parts.append(f"\n\n`{term}`\n:   {escape(rest.strip(), quote=False)}")
        else:
            parts.append(f" {escape(text, quote=False)}" if indent > 1 else f"{text}\n")
    return "".join(parts) + "\n"


def help_of(command: str) -> str:
    """The help of a command, 100 characters wide and without colours."""
    from gscompleter.cli import parsed

    said = io.StringIO()
    plain = {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    with (
        patch.dict(os.environ, plain),
        contextlib.redirect_stdout(said),
        contextlib.suppress(SystemExit),
    ):
        parsed([command, "--help-all"])
    return re.sub(r"\x1b\[[0-9;]*m", "", said.getvalue()).strip()


def of_names() -> str:
    """The public names."""
    package = importlib.import_module("gscompleter")
    entries = [f"::: gscompleter.{package._HOMES[name]}.{name}\n" for name in package.__all__]
    return "# Python\n\nThe names of `import gscompleter as gsc`.\n\n" + "\n".join(entries)


def of_stages() -> str:
    """The stages, in the paper's order."""
    entries = [f"::: gscompleter.stages.{name}\n" for name in STAGES]
    return "# Stages\n\nA stage is a function of values to a value.\n\n" + "\n".join(entries)
