"""A device that no machine has: code that would fail on a GPU fails here, without one.

Within `Elsewhere()` the device `meta` holds tensors that compute values and gradients on the CPU.
As on a GPU, mixing one with a CPU tensor in an operation is an error, and `.numpy()` needs `.cpu()`
first, or `force=True`. It is stricter in one thing: a CPU index, which a GPU waits for, is refused
as well.
"""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves, tree_map

DEVICE = torch.device("meta")
COPY, PUT = torch.ops.aten.copy_.default, torch.ops.aten.index_put_.default


class MixedError(RuntimeError):
    """Tensors of two devices met in one operation."""


class There(Tensor):
    """A tensor on `DEVICE`; `inner` holds its values."""

    inner: Tensor

    @staticmethod
    def __new__(cls, inner: Tensor) -> There:
        made: There = Tensor._make_wrapper_subclass(
            cls,
            inner.shape,
            strides=inner.stride(),
            storage_offset=inner.storage_offset(),
            dtype=inner.dtype,
            device=DEVICE,
        )
        made.inner = inner
        return made

    def tolist(self) -> Any:
        """Wait for the device and copy, as on a GPU."""
        return self.inner.tolist()

    def numpy(self, *, force: bool = False) -> Any:
        """Copy to the CPU only if that is asked for, as on a GPU."""
        return self.inner.numpy(force=True) if force else super().numpy()

    @classmethod
    def __torch_dispatch__(cls, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


class Elsewhere(TorchDispatchMode):
    """A mode in which tensors on `DEVICE` hold values."""

    def __enter__(self) -> Elsewhere:
        self.constants = Constants()
        self.constants.__enter__()
        super().__enter__()
        return self

    def __exit__(self, *reason: Any) -> None:
        super().__exit__(*reason)
        self.constants.__exit__(*reason)

    def __torch_dispatch__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        return computed(func, args, kwargs or {})


class Constants(TorchFunctionMode):
    """A mode for `torch.tensor` and `new_tensor`, which bypass dispatch, in two steps."""

    def __torch_function__(self, func: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        kwargs = dict(kwargs or {})
        if func is torch.tensor and is_there(kwargs.get("device")):
            kwargs.pop("device")
            return torch.tensor(*args, **kwargs).to(DEVICE)
        if func is Tensor.new_tensor and isinstance(args[0], There):
            kwargs.setdefault("dtype", args[0].dtype)
            return torch.tensor(*args[1:], **kwargs).to(DEVICE)
        return func(*args, **kwargs)


def computed(func: Any, args: Any, kwargs: dict[str, Any]) -> Any:
    """Put the result of an operation on the device where a GPU would leave it."""
    leaves = tree_leaves((args, kwargs))
    there = [leaf for leaf in leaves if isinstance(leaf, There)]
    on_device = bool(there)
    if kwargs.get("device") is not None:
        on_device = is_there(kwargs["device"])
        kwargs = {**kwargs, "device": torch.device("cpu")}
        if on_device and kwargs.get("generator") is not None:
            raise MixedError(f"{func} draws on {DEVICE} with a generator of the CPU")
    elif there:
        refuse_company(func, args, leaves)
    outputs = func(*tree_map(inner_of, args), **tree_map(inner_of, kwargs))
    known = {id(one.inner): one for one in there}
    return tree_map(lambda value: placed(value, known), outputs) if on_device else outputs


def refuse_company(func: Any, args: Any, leaves: list[Any]) -> None:
    """Raise like a GPU: elementwise it accepts a CPU tensor that is a number, to copy any."""
    if func is COPY:
        return
    strangers = [x for x in leaves if isinstance(x, Tensor) and not isinstance(x, There)]
    numbers_do = torch.Tag.pointwise in func.tags or func is PUT
    for stranger in strangers:
        if not numbers_do or stranger.dim() > 0:
            raise MixedError(
                f"{func} was given a tensor {list(stranger.shape)} that lies on the CPU"
            )


def placed(value: Any, known: dict[int, There]) -> Any:
    """Put a result on the device; tensors changed in place stay themselves."""
    if not isinstance(value, Tensor) or isinstance(value, There):
        return value
    return known[id(value)] if id(value) in known else There(value)


def inner_of(value: Any) -> Any:
    return value.inner if isinstance(value, There) else value


def is_there(device: Any) -> bool:
    return device is not None and torch.device(device).type == DEVICE.type


def without_autocast(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let networks disable autocast on `DEVICE`, which autocast itself does not know."""
    known = torch.autocast

    def autocast(device: str, *arguments: Any, **settings: Any) -> torch.autocast:
        return known("cpu" if is_there(device) else device, *arguments, **settings)

    monkeypatch.setattr(torch, "autocast", autocast)
