"""Each guard of the table has its tests, explains its losses, and stands in the reference page."""

import re
from dataclasses import replace
from importlib import import_module

import pytest

from gscompleter.config import GUARDS, CompleterConfig
from gscompleter.guards import Guard, accept_at
from gscompleter.parts import PartOrigin
from gscompleter.stages.additions import Additions
from gscompleter.stages.refine import keep_as_it_is
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.types import DepthAffine
from paths import ROOT
from scenes import Room, camera_at, gaussians_of, random_gaussians, view_of
from target_views import observe

METHOD = (ROOT / "docs" / "method.md").read_text("utf-8")


def load(name: str) -> type[Guard]:
    module, _, class_name = GUARDS[name].partition(":")
    return getattr(import_module(module), class_name)


@pytest.mark.parametrize("name", GUARDS)
def test_a_guard_has_the_name_of_its_row(name):
    assert load(name).name == name


@pytest.mark.parametrize("name", GUARDS)
def test_a_guard_that_can_drop_something_explains_its_losses(name):
    guard = load(name)
    can_drop = guard.place is not Guard.place or guard.verify is not Guard.verify
    assert bool(guard.loss) == can_drop
    # It goes on a sentence: "12 % of the hole stays empty, because ...".
    assert guard.loss == "" or (guard.loss[0].islower() and guard.loss[-1].isalpha())


@pytest.mark.parametrize("name", GUARDS)
def test_a_guard_has_a_file_of_tests(name):
    """That of its module: `guards/hull.py` has `tests/guards/test_hull.py`."""
    *_, package, module = GUARDS[name].partition(":")[0].split(".")
    assert (ROOT / "tests" / package / f"test_{module}.py").is_file()


@pytest.mark.parametrize("name", GUARDS)
def test_a_guard_has_a_line_in_the_reference_page(name):
    table = METHOD.split("\n## Guards\n")[1].split("\n## ")[0]
    hooks = ["begin", "place", "verify"]
    own = [hook for hook in hooks if getattr(load(name), hook) is not getattr(Guard, hook)]
    assert re.search(rf"^\| `{name}` \| {', '.join(own)} \|", table, re.M)


REMEMBERING = """
import gscompleter as gsc


class Remembering(gsc.Guard):
    name = "remembering"
    loss = "it was dropped"

    def place(self, candidates, view):
        self.count = len(candidates)
        return candidates

    def verify(self, added, attempt):
        return added[: self.count - 1]
"""


def test_the_guard_that_places_verifies(tmp_path):
    """Both hooks are asked of one object, so that the second knows what the first one saw."""
    file = tmp_path / "remembering.py"
    file.write_text(REMEMBERING)
    config = replace(CompleterConfig(), guards=(f"{file}:Remembering",))
    camera = camera_at(size=16)
    seen = view_of(Room(), camera)
    view = observe(gaussians_of(seen), [seen], camera, config)
    candidates = Additions.begin(PartOrigin("target", 1), "lift", random_gaussians(4))
    image = GeneratedView(seen.image, camera)
    accepted = accept_at(view, candidates, image, DepthAffine(), keep_as_it_is)
    assert len(accepted.gaussians) == 3
