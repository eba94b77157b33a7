"""What a script may have switched in torch for its own work, and ours must not depend on.

Completion optimises by gradients in float32. A script often runs in `torch.inference_mode` or
`no_grad`, with another default type or default device, or under `autocast`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import fields, is_dataclass, replace
from typing import Any, ParamSpec, TypeVar

import torch
from torch import Tensor

from gscompleter.system.tensor_checks import iterate_tensors

FunctionParameters = ParamSpec("FunctionParameters")
Result = TypeVar("Result")

CPU = torch.device("cpu")


def run_in_plain_torch(
    function: Callable[FunctionParameters, Result],
) -> Callable[FunctionParameters, Result]:
    """Run a function with torch as it starts, whatever the script has switched.

    Tensors of inference mode among its arguments are copied, because no gradient can be computed
    with them.
    """

    @functools.wraps(function)
    def run(*args: FunctionParameters.args, **kwargs: FunctionParameters.kwargs) -> Result:
        with use_plain_torch():
            plain_args = [copy_inference_tensors(value) for value in args]
            plain_kwargs = {key: copy_inference_tensors(value) for key, value in kwargs.items()}
            return function(*plain_args, **plain_kwargs)

    return run


@contextmanager
def use_plain_torch() -> Iterator[None]:
    """Switch to gradients, float32, the CPU and no autocast, and back at the end.

    The default type is one for all threads of a process.
    """
    dtype = torch.get_default_dtype()
    with ExitStack() as stack:
        if torch.is_inference_mode_enabled():
            stack.enter_context(torch.inference_mode(False))
        if not torch.is_grad_enabled():
            stack.enter_context(torch.enable_grad())
        if torch.get_default_device() != CPU:
            stack.enter_context(CPU)
        for device in ("cpu", "cuda"):
            if torch.is_autocast_enabled(device):
                stack.enter_context(torch.autocast(device, enabled=False))
        if dtype is not torch.float32:
            torch.set_default_dtype(torch.float32)
            stack.callback(torch.set_default_dtype, dtype)
        yield


def copy_inference_tensors(value: Any) -> Any:
    """Return a value whose tensors are all normal ones; the value itself if they are."""
    if isinstance(value, Tensor):
        return value.clone() if value.is_inference() else value
    if isinstance(value, (list, tuple)):
        copies = [copy_inference_tensors(item) for item in value]
        is_same = all(copy is item for copy, item in zip(copies, value, strict=True))
        return value if is_same or type(value) not in (list, tuple) else type(value)(copies)
    # A class in place of its value has the fields, but no values in them.
    if not is_dataclass(value) or isinstance(value, type):
        return value
    if not any(tensor.is_inference() for _, tensor in iterate_tensors(value, "")):
        return value
    changes = {
        field.name: copy_inference_tensors(getattr(value, field.name))
        for field in fields(value)
        if field.init
    }
    return replace(value, **changes)
