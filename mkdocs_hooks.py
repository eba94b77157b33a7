"""Pages of the site that are generated: from README, scripts, notebook, options and public names.

The demo is completed for the page that embeds the viewer. Links are written for the repository, and
converted to the same file on the site.
"""

from __future__ import annotations

import ast
import contextlib
import importlib
import io
import json
import os
import re
import shutil
import tempfile
from html import escape
from pathlib import Path
from typing import Any
from unittest.mock import patch

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

ROOT = Path(__file__).resolve().parent
TEXTS = {
    "README.md": "overview.md",
    "CONTRIBUTING.md": "contributing.md",
    "CHANGELOG.md": "changelog.md",
    "benchmarks/history.md": "history.md",
    "benchmarks/apart_uses.md": "apart_uses.md",
}
"""Files of the repository that are pages of the site."""
FILES = ("LICENSE", "CITATION.cff")
"""Files of the repository that pages link to and that are copied as they are."""
LLMS = "llms.txt"
"""Start page for assistants; its links are converted to pages of the site."""
STAGES = (
    "context",
    "target_view",
    "synthesize",
    "select_anchor",
    "lift",
    "align_depth",
    "register",
    "register_paper",
    "extrapolate_registration",
    "filter_holes",
    "refine",
    "recolor",
    "new_photos",
)
"""Modules of `stages/` in the paper's order; those that do not exist are left out."""
NOTEBOOK = ROOT / "examples" / "quickstart.ipynb"
NOTEBOOK_PAGE = "tutorials/notebook.md"
DEMO_PAGE = "demo.md"
DEMO = "demo-viewer.html"
"""File of the site with the viewer and the completed demo in it."""
DEMO_RESOLUTION = 192
"""Longer side of the demo's photographs, in pixels: a file of some megabytes."""
COLAB = "https://colab.research.google.com"
FROM_CODE = ("reference/commands.md", "reference/python.md", "reference/stages.md")
"""Pages that are made of help texts and docstrings, whose links are those of the site already."""
LINK = re.compile(r"(?<=\]\()[^)\s]+(?=\))")


def tutorials() -> dict[str, Path]:
    """Return the numbered scripts by their pages."""
    return {f"tutorials/{path.stem}.md": path for path in sorted((ROOT / "examples").glob("0*.py"))}


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Add the scripts, the decisions, and the pages that `nav` does not name."""
    named = set(re.findall(r"[\w/-]+\.md", str(config.nav)))
    pages = sorted(path.relative_to(ROOT / "docs").as_posix() for path in find_pages())
    others = [page for page in pages if page not in named]
    decisions = [page for page in others if page.startswith("decisions/")]
    config.nav.insert(1, {"Demo": DEMO_PAGE})
    config.nav.insert(4, {"Tutorials": [{"Notebook": NOTEBOOK_PAGE}, *tutorials()]})
    add_pages(config.nav, "decisions/index.md", decisions)
    if more := [page for page in others if page not in decisions]:
        config.nav.append({"More": more})
    return config


def find_pages() -> list[Path]:
    """Return all Markdown files of `docs/`."""
    return list((ROOT / "docs").rglob("*.md"))


def add_pages(nav: list[Any], after: str, pages: list[str]) -> None:
    """Append `pages` to the section of `nav` that holds `after`, at any depth."""
    for entry in list(nav):
        if entry == after:
            nav.extend(pages)
        elif isinstance(entry, dict):
            for section in entry.values():
                if isinstance(section, list):
                    add_pages(section, after, pages)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the generated pages."""
    made = {page: (ROOT / name).read_text() for name, page in TEXTS.items()}
    made |= {page: of_script(path) for page, path in tutorials().items()}
    made |= {
        NOTEBOOK_PAGE: of_notebook(config.repo_url),
        DEMO_PAGE: of_demo(),
        **dict(zip(FROM_CODE, (of_commands(), of_names(), of_stages()), strict=True)),
    }
    made |= {name: (ROOT / name).read_text() for name in FILES}
    made[LLMS] = link_pages((ROOT / LLMS).read_text())
    for page, text in made.items():
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, NOTEBOOK.name, content=NOTEBOOK.read_text()))
    return files


def on_post_build(config: MkDocsConfig) -> None:
    """Write the viewer with the completed demo beside the pages."""
    write_demo(Path(config.site_dir) / DEMO)


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Convert links to files of the repository to links to pages."""
    by_page = {made: name for name, made in TEXTS.items()}
    place = by_page.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    return LINK.sub(lambda link: site_link(link[0], place, page.file.src_uri), markdown)


def link_pages(text: str) -> str:
    """Convert links to files of `docs/` to the folders of their pages, as mkdocs makes them."""
    folders = {
        path: f"{path.removeprefix('docs/').removesuffix('.md')}/" for path in LINK.findall(text)
    }
    folders["docs/index.md"] = "./"
    return LINK.sub(lambda link: folders[link[0]], text)


def site_link(link: str, place: str, page: str) -> str:
    """Convert a link in the repository file `place` to a link from its page."""
    target, mark, anchor = link.partition("#")
    if ":" in target or not target or page in FROM_CODE:
        return link
    path = os.path.normpath(os.path.join(os.path.dirname(place), target))
    scripts = {f"examples/{script.name}": made for made, script in tutorials().items()}
    scripts[f"examples/{NOTEBOOK.name}"] = NOTEBOOK_PAGE
    uri = (TEXTS | scripts).get(path, path.removeprefix("docs/"))
    return os.path.relpath(uri, os.path.dirname(page) or ".") + mark + anchor


def of_script(path: Path) -> str:
    """Make the page of a script: its docstring, then its code."""
    text = path.read_text()
    title, _, text_below = (ast.get_docstring(ast.parse(text)) or path.stem).partition("\n")
    return f"# {title.rstrip('.')}\n\n{text_below}\n\n```python\n{text}```\n"


def of_notebook(repository: str | None) -> str:
    """Make the page of the notebook: its text and code, as it is stored without output.

    With the address of the repository on GitHub (`repo_url` of mkdocs.yml), Colab opens it by a
    badge.
    """
    parts = []
    for cell in json.loads(NOTEBOOK.read_text())["cells"]:
        text = "".join(cell["source"])
        parts.append(text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```")
    links = [f"[Download the notebook](../{NOTEBOOK.name})"]
    if repository and "github.com/" in repository:
        place = repository.rstrip("/").partition("github.com/")[2]
        address = f"{COLAB}/github/{place}/blob/main/examples/{NOTEBOOK.name}"
        links.insert(0, f"[![Open in Colab]({COLAB}/assets/colab-badge.svg)]({address})")
    title, *others = parts
    return "\n\n".join([title, " · ".join(links), *others]) + "\n"


def of_demo() -> str:
    """Make the page that embeds the viewer."""
    return f"""# Demo

Two photographs of a motorcycle (Middlebury 2014, part of scikit-image), completed for a camera on
either side, as `gscompleter demo` does it. Drag to look around; `1` to `4` show before, after or
both, `P` plays the cameras, `?` lists the keys. The viewer needs WebGL 2, and loads nothing from
elsewhere; `gscompleter view OUT --save page.html` writes such a file.

<iframe src="../{DEMO}" title="The demo before and after" width="100%" height="560"
style="border:0" loading="lazy"></iframe>
"""


def write_demo(path: Path) -> None:
    """Complete the demo at a small size, and write its viewer into one file."""
    import gscompleter as gsc
    from gscompleter.apps.commands.view import ViewOptions, run_view

    with tempfile.TemporaryDirectory() as place:
        folder = gsc.write_demo_scene(Path(place) / "motorcycle")
        views = gsc.load_views(folder, resolution=DEMO_RESOLUTION)
        targets = gsc.load_cameras(folder / "targets.json", resolution=DEMO_RESOLUTION)
        out = gsc.GSCompleter()(views, targets).save(Path(place) / "demo")
        page = Path(place) / DEMO
        run_view(ViewOptions(scene=out, save=page, quiet=True))
        shutil.move(page, path)


def of_commands() -> str:
    """Make the page of all commands from their `--help-all`."""
    from gscompleter.cli import COMMANDS

    sections = [f"## {name}\n\n{as_definitions(help_of(name))}" for name in COMMANDS]
    return "# Command line\n\nThe output of `gscompleter COMMAND --help-all`.\n\n" + "\n".join(
        sections
    )


def as_definitions(help_text: str) -> str:
    """Convert help to Markdown: options are terms, each with one paragraph."""
    parts = []
    for line in help_text.splitlines():
        text, indent = line.strip(), len(line) - len(line.lstrip())
        term, _, rest = text.partition("  ")
        if not text.strip("-"):
            parts.append("\n")
        elif text.startswith("usage: "):
            parts.append(f"```text\n{text.removeprefix('usage: ')}\n```\n")
        elif text.startswith("Example: "):
            parts.append(f"Example: `{text.removeprefix('Example: ')}`\n")
        elif indent == 1 and text.endswith(("options", "arguments")):
            parts.append(f"\n**{text}**\n")
        elif indent == 2 and (term.startswith("-") or term.isupper()):
            parts.append(f"\n\n`{term}`\n:   {escape(rest.strip(), quote=False)}")
        else:
            parts.append(f" {escape(text, quote=False)}" if indent > 1 else f"{text}\n")
    return "".join(parts) + "\n"


def help_of(command: str) -> str:
    """Return the help of a command, 100 characters wide and without colours."""
    from gscompleter.cli import parse_command

    output = io.StringIO()
    plain = {"COLUMNS": "100", "NO_COLOR": "1", "TERM": "dumb"}
    with (
        patch.dict(os.environ, plain),
        contextlib.redirect_stdout(output),
        contextlib.suppress(SystemExit),
    ):
        parse_command([command, "--help-all"])
    return re.sub(r"\x1b\[[0-9;]*m", "", output.getvalue()).strip()


def of_names() -> str:
    """Make the page of the public names."""
    package = importlib.import_module("gscompleter")
    entries = [f"::: gscompleter.{package._HOMES[name]}.{name}\n" for name in package.__all__]
    return "# Python\n\nThe names of `import gscompleter as gsc`.\n\n" + "\n".join(entries)


def of_stages() -> str:
    """Make the page of the stages, in the paper's order."""
    folder = ROOT / "src" / "gscompleter" / "stages"
    names = [name for name in STAGES if (folder / f"{name}.py").is_file()]
    entries = [f"::: gscompleter.stages.{name}\n" for name in names]
    return "# Stages\n\nA stage is a function of values to a value.\n\n" + "\n".join(entries)
