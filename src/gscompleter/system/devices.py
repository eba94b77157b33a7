"""Choice of an implementation by the name of a device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TypeVar

from gscompleter.system.errors import InputError, quote_value

Implementation = TypeVar("Implementation")


def make_for_device(
    makers: Mapping[str, Callable[[str], Implementation]], name: str, part: str
) -> Implementation:
    """Make what implements a part of the program on a device such as `cuda` or `cuda:1`.

    `makers` are by the type of the device, and get its name.

    Raises:
        InputError: None is for this type; the sentence names the part.
    """
    kind = name.partition(":")[0]
    if kind not in makers:
        raise InputError(
            f"There is no device '{quote_value(name)}' for {part}; choose one of "
            f"{', '.join(makers)}.",
            "device",
        )
    return makers[kind](name)
