"""Packages of authors that run a model by themselves, and the weights that they load."""

from __future__ import annotations

import os
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

from gscompleter.system.errors import InputError, quote_value


def import_authors_module(name: str, title: str, install: str, option: str) -> Any:
    """Import a module of an authors' package.

    `title` is what needs it, such as "The depth 'moge-3-large'", `install` the command that
    installs it, and `option` the one that the user chose it with.

    Raises:
        InputError: The package, or one that it needs in turn, is missing or broken.
    """
    try:
        return import_module(name)
    except MemoryError:  # the command tells of it in a sentence of its own
        raise
    except Exception as error:  # one that does not fit the installed torch raises anything
        raise InputError(
            f"{title} needs its package: {install} ({quote_value(str(error))}).", option
        ) from error


def choose_weights(
    weights: Path | None, published: str, option: str, kind: Literal["file", "folder"]
) -> str:
    """Return the weights that a package loads: those of the user, or else the `published` ones.

    Packages take whatever is not the `kind` that they read for the name of a repository on the
    Hugging Face hub, such as `models/mine.pt`, and would load what somebody put there.

    Raises:
        InputError: `weights`, which `option` named, do not exist or are of the other kind.
    """
    if weights is None:
        return published
    if not os.path.exists(weights):
        raise InputError(
            f"There are no weights at {quote_value(weights)}; correct the path.", option
        )
    if os.path.isdir(weights) != (kind == "folder"):
        raise InputError(f"{quote_value(weights)} is no {kind}; name the {kind}.", option)
    return str(weights)
