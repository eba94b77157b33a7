"""Code that is found by its name: in tables of packages, files of users, and higher floors."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from functools import cache
from importlib import import_module
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from gscompleter.system.errors import InputError, quote_value

FILE_PATTERN = r"^(.+\.py):([A-Za-z_]\w*)$"
"""A file of Python and a name in it, as in `my_models.py:predict_depth`."""


@cache
def load_plugins(group: str) -> dict[str, Any]:
    """Merge the tables that the entry points of a group name: from a model's name to its loader."""
    # Help pages import this file and need none of it, which takes a tenth of their time.
    from importlib.metadata import entry_points

    table: dict[str, Any] = {}
    for point in entry_points(group=group):
        table |= point.load()
    return table


def load_function(module: str, name: str) -> Callable[..., Any]:
    """Import a function by its name.

    Values know by it what is done with them on a higher floor, which they must not import.
    """
    function: Callable[..., Any] = getattr(import_module(module), name)
    return function


def is_in_file(word: object) -> bool:
    """Check whether a word names something in a file of Python, as in `file.py:function`."""
    return isinstance(word, str) and re.match(FILE_PATTERN, word) is not None


def load_from_file(word: str, option: str) -> Any:
    """Return what `file.py:name` names; of a class, an instance that takes no arguments.

    The file is run once in a process, whatever options name it, with its folder on `sys.path` for
    what it imports. Raise InputError, with the name of the option, if it cannot be run or has no
    such name, or if no instance can be made.
    """
    found = re.match(FILE_PATTERN, word)
    assert found is not None
    file, name = found.groups()
    path = Path(file).absolute()
    if not path.is_file():
        raise InputError(f"There is no file {quote_value(path)}; name a file of Python.", option)
    try:
        module = _run_file(path)
    except (Exception, SystemExit) as error:  # code of users raises any kind
        raise InputError(
            f"{quote_value(path)} cannot be run ({_describe_error(error, path)}); correct it.",
            option,
        ) from error
    if not hasattr(module, name):
        own = [key for key, value in vars(module).items() if _is_own(value, module)]
        known = ", ".join(own) or "nothing that can be called"
        raise InputError(f"{quote_value(Path(file))} has no '{name}'; it has {known}.", option)
    value = getattr(module, name)
    if not isinstance(value, type):
        return value
    try:
        return value()
    except (Exception, SystemExit) as error:
        # Arguments that lack are an error of the call itself, before any line of the file.
        if isinstance(error, TypeError) and _find_line(error, path) is None:
            raise InputError(
                f"The class {name} of {quote_value(Path(file))} cannot be made without arguments "
                f"({quote_value(str(error))}); name a function, an object, or a class with "
                "defaults.",
                option,
            ) from error
        raise InputError(
            f"The class {name} of {quote_value(Path(file))} cannot be made "
            f"({_describe_error(error, path)}); correct it.",
            option,
        ) from error


@cache
def _run_file(path: Path) -> ModuleType:
    """Run a file as a module of its own; what it raises is raised."""
    # A name that no other file has; dataclasses look their module up by it.
    name = f"gscompleter_user_{path.stem}_{abs(hash(path)):x}"
    spec = spec_from_file_location(name, path)
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    sys.modules[name] = module
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))
    try:
        spec.loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _is_own(value: object, module: ModuleType) -> bool:
    """Check whether a value can be called and was defined by a module itself."""
    return callable(value) and getattr(value, "__module__", None) == module.__name__


def _describe_error(error: BaseException, path: Path) -> str:
    """Describe an error by its kind, its line in a file if it has one, and its message."""
    line = _find_line(error, path)
    place = "" if line is None else f", line {line}"
    return f"{type(error).__name__}{place}: {quote_value(str(error))}"


def _find_line(error: BaseException, path: Path) -> int | None:
    """Find the last line of a file that an error passed through, or that is no Python."""
    if isinstance(error, SyntaxError) and error.filename == str(path):
        return error.lineno
    line = None
    trace = error.__traceback__
    while trace is not None:
        if trace.tb_frame.f_code.co_filename == str(path):
            line = trace.tb_lineno
        trace = trace.tb_next
    return line
