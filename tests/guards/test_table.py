"""Each guard of the table has its tests, explains its losses, and stands in the reference page."""

import re
from importlib import import_module

import pytest

from gscompleter.config import GUARDS
from gscompleter.guards import Guard
from paths import ROOT

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
