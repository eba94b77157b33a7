"""Checks of what a value holds: types, dtypes, shapes and devices.

They run whenever a value is constructed, in every step of an optimisation too. So they read no
number, which would wait for a GPU, and they take microseconds. Numbers are checked by
`value_checks`, once, where a value enters.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from numbers import Integral, Real

import torch
from torch import Tensor
from torch.nn import Parameter

from gscompleter.system.errors import InputError, quote_value

FLOATS = (torch.float32, torch.float64)
"""Types of numbers that are stored; float64 is for files and comparisons. Errors ask for the first
type of a group. Forms take this object, by which tensors of one float type are known."""
BOOLS = (torch.bool,)
BYTE_DTYPES = (torch.uint8,)
INTEGERS = (torch.int32, torch.int64)

Form = tuple[tuple[torch.dtype, ...], tuple[int | str, ...]]
"""Allowed dtypes and the shape of a tensor. A letter stands for any length, which errors call so;
types compare the lengths of one letter themselves."""


def check_tensors(value: object, owner: str, forms: Mapping[str, Form]) -> None:
    """Raise InputError unless each tensor has its form, and all have one device and float type.

    `owner` names the value in sentences, such as "a camera". Tensors whose class gives them the
    default None may be absent.
    """
    kind = type(value)
    device = None
    float_dtype = None
    for name, (dtypes, shape) in forms.items():
        tensor = getattr(value, name)
        # The default of a field is an attribute of the class, which a field without one is not.
        if tensor is None and hasattr(kind, name) and getattr(kind, name) is None:
            continue
        if not isinstance(tensor, Tensor) or not _has_form(tensor, dtypes, shape):
            raise InputError(
                f"The {name} of {owner} has to be {describe_form(dtypes, shape)}, and is "
                f"{describe(tensor)}; convert it."
            )
        if device is None:
            device = tensor.device
        elif tensor.device != device:
            raise InputError(
                f"The tensors of {owner} have to be on one device, and its {name} is on "
                f"{tensor.device} while others are on {device}; move it."
            )
        if dtypes is not FLOATS:
            continue
        if float_dtype is None:
            float_dtype = tensor.dtype
        elif tensor.dtype is not float_dtype:
            raise InputError(
                f"The numbers of {owner} have to be of one type, and its {name} is "
                f"{name_dtype(tensor.dtype)} while others are {name_dtype(float_dtype)}; convert "
                "it."
            )


def _has_form(
    tensor: Tensor, dtypes: tuple[torch.dtype, ...], shape: tuple[int | str, ...]
) -> bool:
    if tensor.dtype not in dtypes or len(tensor.shape) != len(shape):
        return False
    if tensor.layout is not torch.strided or _lacks_values(tensor):
        return False
    lengths = zip(shape, tensor.shape, strict=True)
    return all(isinstance(wanted, str) or wanted == length for wanted, length in lengths)


def _lacks_values(tensor: Tensor) -> bool:
    """Return True for a tensor on the device "meta", a shape without values.

    Other subclasses may say that they are there and keep values of their own, as fake tensors do.
    """
    return type(tensor) in (Tensor, Parameter) and tensor.is_meta


def iterate_tensors(value: object, name: str) -> Iterator[tuple[str, Tensor]]:
    """Yield every tensor inside nested dataclasses and tuples, by paths as `name.field[0]`."""
    if isinstance(value, Tensor):
        yield name, value
    elif isinstance(value, tuple):
        for i, item in enumerate(value):
            yield from iterate_tensors(item, f"{name}[{i}]")
    # A dataclass itself, given in place of an object of it, has the fields, but no values in them.
    elif is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            yield from iterate_tensors(getattr(value, field.name), f"{name}.{field.name}")


def describe(value: object) -> str:
    """Describe a tensor by its dtype and shape, a string or number by itself, the rest by type."""
    if value is None:
        return "None"
    if isinstance(value, str):
        return f"'{quote_value(value)}'"
    if isinstance(value, (int, float)):
        return quote_value(value)
    if isinstance(value, type):
        return f"the class {value.__name__} instead of an object"
    if not isinstance(value, Tensor):
        return f"of type {type(value).__name__}"
    layout = "" if value.layout is torch.strided else "sparse "
    place = " without values" if _lacks_values(value) else ""
    shape = quote_value(list(value.shape))
    return f"a {layout}tensor of {name_dtype(value.dtype)} and shape {shape}{place}"


def describe_form(dtypes: tuple[torch.dtype, ...], shape: tuple[int | str, ...]) -> str:
    """Describe the dtype and shape that a tensor has to have."""
    lengths = ", ".join(map(str, shape))
    return f"a tensor of {name_dtype(dtypes[0])} and shape [{lengths}]"


def name_dtype(dtype: torch.dtype) -> str:
    """Name a dtype without `torch.`."""
    return str(dtype).removeprefix("torch.")


def is_whole_number(value: object) -> bool:
    """Return True for a whole number, NumPy's too; booleans are none."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def is_number(value: object) -> bool:
    """Return True for a real number, NumPy's too; booleans are none."""
    return isinstance(value, Real) and not isinstance(value, bool)
