"""Depths and reconstructors that a user names as `file.py:function`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.plugins import load_from_file
from gscompleter.system.tensor_checks import describe


def load_own_model(
    name: str, option: str, form: str, weights: Path | str | None, weights_option: str
) -> Any:
    """Load what `file.py:function` names, for the option of this name.

    `form` says what it has to be. Raise InputError for anything that cannot be called, or if
    weights are given, which such a model opens itself.
    """
    if weights is not None:
        raise InputError(
            f"A {option} of a file opens its own weights; leave the file of weights out.",
            weights_option,
        )
    model = load_from_file(name, option)
    if not callable(model):
        raise InputError(
            f"'{quote_value(name)}' has to be a function from {form}, and is {describe(model)}.",
            option,
        )
    return model
