"""Values print one line, and a notebook shows pictures of them."""

from __future__ import annotations

import base64
import io
import re
import sys
from dataclasses import replace
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image

from gscompleter.system import progress
from gscompleter.system.files.display import MAX_NOTEBOOK_SIDE, embed_picture
from gscompleter.system.progress import NotebookDisplay, show_in_notebook, stage, track
from gscompleter.types import DepthMap, Render, View
from scenes import Room, camera_at, random_gaussians, view_of


@pytest.fixture
def view() -> View:
    return view_of(Room(), camera_at(size=48), frame=3)


def test_values_print_a_line_without_tensors(view):
    render = Render(view.image, view.depth, torch.ones_like(view.depth))
    for value in (view, view.camera, random_gaussians(50), render, render.depth_map()):
        line = repr(value)
        assert line.startswith(type(value).__name__ + "(")
        assert "tensor" not in line
        assert len(line) < 200


def test_a_line_names_what_matters(view):
    assert repr(view) == "View(frame 3, 48 x 48 pixels, with depth)"
    camera = repr(view.camera)
    assert "48 x 48 pixels" in camera
    assert "depths 0.5 to 20" in camera
    assert "50 Gaussians" in repr(random_gaussians(50))
    assert repr(random_gaussians(50)[:0]).startswith("Gaussians(0 Gaussians")
    none = DepthMap(torch.zeros(4, 5), torch.zeros(4, 5, dtype=torch.bool))
    assert repr(none) == "DepthMap(5 x 4 pixels, 0.0% valid)"
    assert "nan" not in none._repr_html_()


def test_a_notebook_shows_the_image_itself(view):
    # Smooth colours, of which JPEG loses little.
    ramp = torch.linspace(0, 1, 48)
    smooth = torch.stack(
        [*torch.meshgrid(ramp, ramp, indexing="ij"), torch.full((48, 48), 0.3)], -1
    )
    html = replace(view, image=smooth)._repr_html_()
    (content,) = re.findall(r"base64,([^\"]+)", html)
    shown = np.array(Image.open(io.BytesIO(base64.b64decode(content))))
    assert np.abs(shown / 255 - smooth.numpy()).max() < 0.05
    assert "frame 3" in html


def test_pictures_are_bounded_and_escaped():
    html = embed_picture(torch.zeros(30, 3 * MAX_NOTEBOOK_SIDE), "<script>")
    assert f'width="{MAX_NOTEBOOK_SIDE}"' in html
    assert "<script>" not in html
    assert "http" not in html


class Place:
    """A place below a cell, as IPython's `display` returns it."""

    def __init__(self) -> None:
        self.shown: list[str] = []

    def update(self, data, raw):
        assert raw
        self.shown.append(data["text/html"])


@pytest.fixture
def notebook(monkeypatch) -> Place:
    """Let this process be the kernel of a notebook."""
    place = Place()

    def display(data, raw, display_id):
        assert raw
        assert display_id
        place.update(data, raw)
        return place

    package = ModuleType("IPython.display")
    package.display = display
    monkeypatch.setitem(sys.modules, "IPython", SimpleNamespace(display=package))
    monkeypatch.setitem(sys.modules, "IPython.display", package)
    monkeypatch.setattr(progress, "is_notebook", lambda: True)
    return place


def test_a_notebook_shows_stages_in_one_place_and_empties_it(notebook):
    with show_in_notebook():
        for _ in track(range(2), "target"):
            with stage("register"):
                pass
    assert "target 1 of 2" in notebook.shown[0]
    assert any("register" in html for html in notebook.shown)
    assert any("target 2 of 2" in html for html in notebook.shown)
    assert notebook.shown[-1] == ""


def test_the_outermost_call_shows_the_progress(notebook):
    with show_in_notebook(), stage("outer"):
        outer = progress._display.get()
        with show_in_notebook():
            assert progress._display.get() is outer
    assert isinstance(outer, NotebookDisplay)


def test_a_failure_empties_the_place(notebook):
    with pytest.raises(ValueError, match="broken"), show_in_notebook(), stage("context"):
        raise ValueError("broken")
    assert notebook.shown[-1] == ""


def test_elsewhere_nothing_is_shown(capsys):
    with show_in_notebook(), stage("context"):
        assert progress._display.get() is None
    assert capsys.readouterr() == ("", "")
