"""Watch copies of scenes, whose harmonics are most of the memory of a command."""

import pytest

from gscompleter.types import Gaussians


def watch_copies(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Return a list to which the number of Gaussians of each selection that is a copy is added."""
    copied: list[int] = []
    choose = Gaussians.__getitem__

    def watch(gaussians, index):
        chosen = choose(gaussians, index)
        if chosen.sh.untyped_storage().data_ptr() != gaussians.sh.untyped_storage().data_ptr():
            copied.append(len(chosen))
        return chosen

    monkeypatch.setattr(Gaussians, "__getitem__", watch)
    return copied
