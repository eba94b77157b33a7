"""The notebook of the examples: stored without output, and run as Colab would run it."""

from __future__ import annotations

import os
import re
import runpy
from pathlib import Path

import pytest

import gscompleter as gsc
from paths import ROOT

nbformat = pytest.importorskip("nbformat", reason="needs gscompleter[test]")
nbclient = pytest.importorskip("nbclient", reason="needs gscompleter[test]")
pytest.importorskip("ipykernel", reason="needs gscompleter[test]")

NOTEBOOK = ROOT / "examples" / "quickstart.ipynb"
SIDE = 64
"""Pixels of the longer side, instead of those that a reader gets."""


def read_notebook():
    return nbformat.read(NOTEBOOK, as_version=4)


def find_pictures(cell) -> list[str]:
    shown = [output.data.get("text/html", "") for output in cell.outputs if "data" in output]
    return re.findall(r"<figcaption>([^<]+)</figcaption>", "".join(shown))


def test_it_is_stored_without_output():
    notebook = read_notebook()
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert [cell for cell in code if cell.outputs or cell.execution_count] == []


def read_small_notebook():
    """Read the notebook, with small photographs."""
    notebook = read_notebook()
    (sized,) = [cell for cell in notebook.cells if "RESOLUTION = " in cell.source]
    sized.source = re.sub(r"(?<=RESOLUTION = )\d+", str(SIDE), sized.source)
    return notebook


# `test_snippets.py` runs the same calls.
@pytest.mark.slow
def test_a_scene_is_completed_and_saved(tmp_path, monkeypatch):
    """Run the cells before those with a splat of one's own, without a kernel of Jupyter."""
    monkeypatch.chdir(tmp_path)
    names = {}
    for cell in read_small_notebook().cells:
        if cell.source.startswith("## Your own splat"):
            break
        if cell.cell_type == "code" and "%pip" not in cell.source:
            exec(cell.source, names)
    assert names["completion"].targets[0].hole_fraction > 0.05
    assert find_names(tmp_path / "completed") >= {"completed.ply", "context.ply", "report.html"}
    assert (tmp_path / "report.html").is_file()


@pytest.fixture(scope="module")
def executed(tmp_path_factory):
    """Return the executed notebook, small, and the folder that it ran in."""
    folder = tmp_path_factory.mktemp("notebook")
    notebook = read_small_notebook()
    client = nbclient.NotebookClient(
        notebook, timeout=300, kernel_name="python3", resources={"metadata": {"path": str(folder)}}
    )
    # The kernel is a process of its own, which has to find this source tree.
    path = os.pathsep.join([str(ROOT / "src"), os.environ.get("PYTHONPATH", "")])
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", path)
        client.execute()
    return notebook, folder


# `test_a_scene_is_completed_and_saved` runs the first cells.
@pytest.mark.slow
def test_values_show_themselves(executed):
    notebook, _ = executed
    pictures = [
        names for cell in notebook.cells if (names := cell.get("outputs") and find_pictures(cell))
    ]
    before_after = ["target 1, before", "target 1, after"]
    assert pictures == [["frame 0"], before_after, before_after, before_after]
    longest = max(
        len(output.data.get("text/plain", ""))
        for cell in notebook.cells
        for output in cell.get("outputs", ())
        if "data" in output
    )
    assert longest < 300


@pytest.mark.slow
def test_it_writes_scenes_and_the_report(executed):
    _, folder = executed
    assert (folder / "report.html").is_file()
    completed = gsc.load_ply(folder / "completed" / "completed.ply")
    assert int((completed.generated > 0).sum()) > 0
    assert find_names(folder / "without_wheel") >= {"completed.ply", "removed.ply", "report.html"}


def find_names(folder: Path) -> set[str]:
    return {path.name for path in folder.iterdir()}


def test_the_site_has_a_badge_of_colab_once_the_repository_has_an_address():
    pytest.importorskip("mkdocs", reason="needs gscompleter[docs]")
    site = runpy.run_path(str(ROOT / "mkdocs_hooks.py"))
    plain = site["of_notebook"](None)
    assert plain.startswith("# gscompleter: quick start")
    assert plain.count("```python") == sum(c.cell_type == "code" for c in read_notebook().cells)
    assert "colab.research" not in plain
    page = site["of_notebook"]("https://github.com/some/place/")
    address = "/github/some/place/blob/main/examples/quickstart.ipynb)"
    assert address in page
    assert "colab-badge.svg" in page


@pytest.mark.slow
def test_its_progress_leaves_nothing_behind(executed):
    notebook, _ = executed
    (cell,) = [cell for cell in notebook.cells if "completer(views, target)" in cell.source]
    progress, result = (output for output in cell.outputs if "data" in output)
    assert progress.data["text/html"] == ""
    assert "Completion(1 target" in result.data["text/plain"]
