"""Old public names work for one release, and warn."""

import pytest
import torch

import gscompleter.generators
import gscompleter.types
from gscompleter import GSCompleter, View
from gscompleter.deprecation import accept_old_keywords
from scenes import camera_at

SENTENCE = r"{} is deprecated and stops working in the next release; use {}\."


def warns(old: str, new: str):
    return pytest.warns(DeprecationWarning, match=SENTENCE.format(old, new))


def test_a_function_takes_the_old_keyword():
    @accept_old_keywords(witnesses="check_views")
    def complete(check_views: int) -> int:
        return check_views

    with warns("witnesses=", "check_views="):
        assert complete(witnesses=3) == 3


@pytest.mark.parametrize("method", [GSCompleter.__call__, GSCompleter.begin])
def test_the_completer_does(method):
    with warns("witnesses=", "check_views="), pytest.raises(TypeError, match="argument"):
        method(witnesses=())


def test_a_view_has_its_old_members():
    mask = torch.zeros(8, 8, dtype=torch.bool)
    with warns("ignored=", "ignore_mask="):
        view = View(torch.zeros(8, 8, 3), camera_at(size=8), ignored=mask)
    with warns("View.ignored", "ignore_mask"):
        assert view.ignored is mask
    with pytest.raises(AttributeError, match="'View' object has no attribute 'nothing'"):
        view.nothing  # noqa: B018


@pytest.mark.parametrize(
    ("module", "old", "new"),
    [
        (gscompleter.types, "SceneContext", "GeneratorInput"),
        (gscompleter.generators, "Synthesis", "GeneratorOutput"),
    ],
)
def test_a_module_has_its_old_names(module, old, new):
    with warns(f"{module.__name__}.{old}", new):
        assert getattr(module, old) is getattr(module, new)
