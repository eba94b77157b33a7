"""A CUDA device that is none: tensors say that they are on `cuda:0` and compute on the CPU.

Inside of `fake_cuda()` torch sees one GPU. Where tensors of two devices meet it raises, as CUDA
does, and it counts what takes time there: launches of kernels, and waits of the host. A wait is a
value that the host reads, or a copy between host and device that it has to see finished; both are
`cudaStreamSynchronize` in a profile of a real GPU.

The device is one of Python alone: to torch's C++ code every tensor is on the CPU, so that the
autograd engine needs no CUDA and runs in the thread that calls it. Hence a mode of functions
handles what C++ would decide by the device.
"""

from __future__ import annotations

import sys
import threading
import weakref
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest.mock import patch

import torch
from torch import Tensor
from torch.autograd import _engine_run_backward
from torch.overrides import TorchFunctionMode
from torch.utils._python_dispatch import TorchDispatchMode

from gscompleter.system import timing

CUDA = torch.device("cuda", 0)
CPU = torch.device("cpu")
_run_thread = threading.Thread.run
BETWEEN_STAGES = "between stages"

READING = {
    "aten::_local_scalar_dense": "item",
    "aten::nonzero": "nonzero",
    "aten::masked_select": "masked_select",
    "aten::_unique2": "unique",
    "aten::unique_dim": "unique",
    "aten::unique_consecutive": "unique",
    "aten::equal": "equal",
    "aten::bincount": "bincount",
    "aten::is_nonzero": "item",
    "aten::_linalg_check_errors": "check of a decomposition",
    "aten::_linalg_eigh": "check of a decomposition",
    "aten::_linalg_svd": "check of a decomposition",
    "aten::linalg_lstsq": "check of a decomposition",
}
"""Operations whose result, or its size, the host reads from the device."""
TAKING_NUMBERS = ("aten::fill_", "aten::masked_fill_", "aten::masked_fill")
"""Operations that take a single number of the CPU, beside those that work element by element."""
ANY_DEVICE = ("aten::copy_", "aten::index", "aten::index_put", "aten::index_put_")
"""Operations that take tensors of the CPU beside those of the device."""
NO_KERNEL = ("aten::empty", "aten::new_empty", "aten::detach", "aten::lift_fresh", "aten::alias")
"""Beginnings of the names of operations that launch nothing, beside those that return views."""


@dataclass
class Counts:
    """What the device had to do, by stage of the completion."""

    launches: Counter[str] = field(default_factory=Counter)
    """Kernels by stage."""
    waits: Counter[tuple[str, str, str]] = field(default_factory=Counter)
    """Waits of the host by stage, by what it waits for and by the line that waits."""
    stages: list[str] = field(default_factory=lambda: [BETWEEN_STAGES])
    """The stages that run, the innermost last."""

    def launch(self, count: int = 1) -> None:
        """Count kernels."""
        self.launches[self.stages[-1]] += count

    def wait(self, reason: str) -> None:
        """Count a wait of the host."""
        self.waits[self.stages[-1], reason, find_caller()] += 1

    def count_waits(self, stage: str) -> int:
        """Return the number of waits in a stage."""
        return sum(count for (where, _, _), count in self.waits.items() if where == stage)

    def list_waits(self, stage: str) -> str:
        """List the lines that wait in a stage, the most frequent ones first."""
        lines = [
            f"{count} {reason} {line}"
            for (where, reason, line), count in self.waits.most_common()
            if where == stage
        ]
        return "\n".join(lines)

    @contextmanager
    def inside(self, name: str) -> Iterator[None]:
        """Count for a stage, by the name that a profile of torch shows."""
        self.stages.append(name.removeprefix(timing.STAGE_PREFIX))
        try:
            yield
        finally:
            self.stages.pop()


@dataclass
class Memory:
    """Bytes of the device that tensors hold, each storage counted once."""

    counts: Counts
    alive: int = 0
    peaks: Counter[str] = field(default_factory=Counter)
    """Most bytes at once, by stage."""
    largest: dict[str, Counter[str]] = field(default_factory=dict)
    """Bytes at the peak of each stage, by the line that made them."""
    _held: dict[int, tuple[int, str]] = field(default_factory=dict)
    """Bytes of a storage, and the line that made it, by its address."""
    _users: Counter[int] = field(default_factory=Counter)
    """Tensors that hold a storage."""
    _is_at_peak: bool = False
    """Whether nothing was released since the last peak of the stage."""
    _lock: threading.RLock = field(default_factory=threading.RLock)

    def hold(self, tensor: FakeCudaTensor) -> None:
        """Count the storage of a tensor until the last tensor on it is gone."""
        storage = tensor.values.untyped_storage()
        place = storage.data_ptr()
        with self._lock:
            if self._users[place] == 0:
                self._held[place] = storage.nbytes(), find_caller()
                self.alive += storage.nbytes()
                stage = self.counts.stages[-1]
                if self.alive > self.peaks[stage]:
                    self.peaks[stage] = self.alive
                    self._is_at_peak = True
            self._users[place] += 1
        weakref.finalize(tensor, self._release, place, self.counts.stages[-1]).atexit = False

    def _release(self, place: int, stage: str) -> None:
        """Forget a tensor, and its storage with the last one."""
        with self._lock:
            self._users[place] -= 1
            if self._users[place]:
                return
            if self._is_at_peak:
                # The sums of all lines are made once for a peak, when it ends.
                self._is_at_peak = False
                lines: Counter[str] = Counter()
                for size, line in self._held.values():
                    lines[line] += size
                self.largest[self.counts.stages[-1]] = lines
            del self._users[place]
            size, _ = self._held.pop(place)
            self.alive -= size


def find_caller() -> str:
    """Find the innermost line of the package, else of gsplat, that is being run."""
    frame = sys._getframe(1)
    while frame is not None:
        path = Path(frame.f_code.co_filename)
        for package in ("gscompleter", "gsplat"):
            if package in path.parts[:-1]:
                folders = path.parts[:-1]
                start = len(folders) - 1 - folders[::-1].index(package)
                return f"{'/'.join(path.parts[start:])}:{frame.f_lineno}"
        frame = frame.f_back  # type: ignore[assignment]
    return "?"


class FakeCudaTensor(Tensor):
    """A tensor on `cuda:0`, whose values lie in `values` on the CPU."""

    values: Tensor

    @staticmethod
    def __new__(cls, values: Tensor) -> FakeCudaTensor:
        assert not isinstance(values, FakeCudaTensor)
        if values.dtype is torch.float64 and not get_device().has_doubles:
            raise TypeError("Cannot convert a MPS Tensor to float64 dtype; use float32 instead.")
        # Never a tensor of the inference mode: it could be no view of one from outside of it.
        with torch.inference_mode(False):
            wrapper = Tensor._make_wrapper_subclass(
                cls,
                values.size(),
                strides=values.stride(),
                storage_offset=values.storage_offset(),
                dtype=values.dtype,
            )
        wrapper.values = values
        get_device().memory.hold(wrapper)
        return wrapper

    __torch_function__ = torch._C._disabled_torch_function_impl

    @classmethod
    def __torch_dispatch__(cls, func, types, args=(), kwargs=None):
        return get_device().run(func, args, kwargs or {})

    device = property(lambda self: CUDA)
    is_cuda = property(lambda self: True)
    is_cpu = property(lambda self: False)

    def get_device(self) -> int:
        return CUDA.index

    def to(self, *args: Any, **kwargs: Any) -> Tensor:
        return move(self, *args, **kwargs)

    def cpu(self) -> Tensor:
        return move(self, CPU)

    def cuda(self, *_: Any, **__: Any) -> Tensor:
        return self

    def tolist(self) -> Any:
        get_device().counts.wait("tolist")
        return self.values.tolist()

    def numpy(self, *, force: bool = False) -> Any:
        if force:
            return self.detach().cpu().numpy()
        raise TypeError(
            "can't convert cuda:0 device type tensor to numpy. Use Tensor.cpu() to copy the tensor "
            "to host memory first."
        )

    def __array__(self, *_: Any) -> Any:
        return self.numpy()

    def __repr__(self) -> str:  # type: ignore[override]
        return f"FakeCudaTensor({self.values!r})"

    def __format__(self, form: str) -> str:
        return format(self.item(), form) if self.dim() == 0 else super().__format__(form)

    def __deepcopy__(self, memo: dict[int, Any]) -> Tensor:
        copied = self.detach().clone().requires_grad_(self.requires_grad)
        memo[id(self)] = copied
        return copied


def move(tensor: Tensor, *args: Any, **kwargs: Any) -> Tensor:
    """Move a tensor as `Tensor.to` does; differentiable."""
    copied = kwargs.pop("copy", False)
    if args and isinstance(args[0], Tensor):
        device, dtype, wants_no_wait = args[0].device, args[0].dtype, kwargs.get("non_blocking")
        memory_format = None
    else:
        device, dtype, wants_no_wait, memory_format = torch._C._nn._parse_to(*args, **kwargs)
    is_there = device is None or device.type == tensor.device.type
    if "meta" in (tensor.device.type, device and device.type):
        return Tensor.to(tensor, *args, **kwargs)
    if not is_there:
        # Values are converted on the device: before they leave it, or after they reach it.
        if tensor.is_cuda:
            tensor = tensor if dtype is None else convert(tensor, dtype)
            return Download.apply(tensor)
        tensor = Upload.apply(tensor, bool(wants_no_wait))
    if dtype is not None and dtype != tensor.dtype:
        tensor = convert(tensor, dtype)
        copied = False
    if memory_format is not None:
        tensor = tensor.contiguous(memory_format=memory_format)
    return tensor.clone() if copied and is_there else tensor


def convert(tensor: Tensor, dtype: torch.dtype) -> Tensor:
    """Convert to a type of numbers, on the device of the tensor."""
    return Tensor.to(tensor, dtype)


class Upload(torch.autograd.Function):
    """Copies a tensor from the host to the device."""

    @staticmethod
    def forward(ctx, tensor, wants_no_wait):
        counts = get_device().counts
        if not wants_no_wait:
            counts.wait("upload")
        return FakeCudaTensor(tensor.detach().clone())

    @staticmethod
    def backward(ctx, gradient):
        return Download.apply(gradient), None


class Download(torch.autograd.Function):
    """Copies a tensor from the device to the host."""

    @staticmethod
    def forward(ctx, tensor):
        get_device().counts.wait("download")
        return tensor.values.detach().clone()

    @staticmethod
    def backward(ctx, gradient):
        return Upload.apply(gradient, False)


class Thread(threading.local):
    """What the device knows of a thread."""

    is_in_call = False
    """Whether a function of torch that was given tensors of the device is being run."""


class FakeDevice:
    """The device: runs operations of torch, raises where devices mix, and counts."""

    def __init__(self, has_doubles: bool) -> None:
        self.has_doubles = has_doubles
        self.counts = Counts()
        self.memory = Memory(self.counts)
        self.thread = Thread()

    def run(self, func: Any, args: tuple[Any, ...], kwargs: dict[str, Any]) -> Any:
        """Run one operation of torch's C++ level, on tensors of either device."""
        name = func._schema.name
        given = list(find_tensors((args, kwargs)))
        device = kwargs.get("device")
        names_cuda = device is not None and torch.device(device).type == "cuda"
        if not any(isinstance(x, FakeCudaTensor) for x in given):
            if name == "aten::_to_copy" and names_cuda:
                return Upload.apply(func(*args, **kwargs | {"device": CPU}), False)
            # What a function of torch allocates for itself lies where its arguments are.
            is_allocated = not given and self.thread.is_in_call
            if not names_cuda and not is_allocated:
                return func(*args, **kwargs)
        generator = kwargs.get("generator")
        if generator is not None and generator.device.type == "cpu":
            raise RuntimeError("Expected a 'cuda' device type for generator but found 'cpu'")
        self.refuse_mixed(func, args, given)
        self.count(func, name, args, kwargs)
        host_args, host_kwargs = map_leaves(to_host, (args, kwargs))
        if device is not None:
            host_kwargs["device"] = CPU
        result = func(*host_args, **host_kwargs)
        if is_in_place(func):
            if torch.Tag.inplace_view in func.tags:
                with torch.utils._mode_utils.no_dispatch():
                    func(*args, **kwargs)
            return kwargs["out"] if "out" in kwargs else args[0]
        return map_leaves(to_device, result)

    def refuse_mixed(self, func: Any, args: tuple[Any, ...], given: list[Tensor]) -> None:
        """Raise RuntimeError where tensors of both devices meet; single numbers may."""
        name = func._schema.name
        on_host = [x for x in given if not isinstance(x, FakeCudaTensor)]
        if name in ANY_DEVICE[1:]:
            # Indices may lie on the host, but neither what is indexed nor what is put there.
            on_host = [args[0], *args[2:3]] if name != "aten::index" else [args[0]]
            on_host = [
                x for x in on_host if isinstance(x, Tensor) and not isinstance(x, FakeCudaTensor)
            ]
        elif name in ANY_DEVICE:
            on_host = []
        # Kernels that work element by element take a single number from the host.
        if torch.Tag.pointwise in func.tags or name in (*ANY_DEVICE, *TAKING_NUMBERS):
            on_host = [x for x in on_host if x.dim() > 0]
        if on_host:
            raise RuntimeError(
                "Expected all tensors to be on the same device, but found at least two devices, "
                f"cuda:0 and cpu! ({name} of {[tuple(x.shape) for x in on_host]})"
            )

    def count(self, func: Any, name: str, args: tuple[Any, ...], kwargs: dict[str, Any]) -> None:
        """Count the launch and the waits of an operation."""
        if name in READING:
            self.counts.wait(READING[name])
        if name == "aten::repeat_interleave" and kwargs.get("output_size") is None:
            self.counts.wait("repeat_interleave")
        if name == "aten::copy_" and not kwargs.get("non_blocking", args[2:] == (True,)):
            if not isinstance(args[1], FakeCudaTensor) and args[1].dim() > 0:
                self.counts.wait("upload")
            if not isinstance(args[0], FakeCudaTensor):
                self.counts.wait("download")
        if name in ANY_DEVICE[1:]:
            indices = [index for index in args[1] if index is not None]
            # A single number that is put where a mask is true needs no positions.
            is_filled = name != "aten::index" and not isinstance(args[2], FakeCudaTensor)
            for index in indices:
                if not isinstance(index, FakeCudaTensor) and index.dim() > 0:
                    self.counts.wait("upload")
                if index.dtype in (torch.bool, torch.uint8) and not is_filled:
                    self.counts.wait("indices of a mask")
        if not func.is_view and not name.startswith(NO_KERNEL):
            self.counts.launch()


def is_in_place(func: Any) -> bool:
    """Return True if an operation writes into an argument and returns it."""
    returned = func._schema.returns
    return bool(returned) and returned[0].alias_info is not None and returned[0].alias_info.is_write


def find_tensors(value: Any) -> Iterator[Tensor]:
    """Find the tensors in nested lists, tuples and dictionaries."""
    if isinstance(value, Tensor):
        yield value
    elif isinstance(value, (list, tuple)):
        for part in value:
            yield from find_tensors(part)
    elif isinstance(value, dict):
        yield from find_tensors(list(value.values()))


def map_leaves(change: Callable[[Any], Any], value: Any) -> Any:
    """Change everything in nested lists, tuples and dictionaries."""
    if isinstance(value, (list, tuple)):
        parts = [map_leaves(change, part) for part in value]
        # Several results of an operation are a named tuple.
        return type(value)(parts) if type(value) in (list, tuple) else type(value)(*parts)
    if isinstance(value, dict):
        return {name: map_leaves(change, part) for name, part in value.items()}
    return change(value)


def to_host(value: Any) -> Any:
    """Return the values of a tensor of the device; anything else as it is."""
    return value.values if isinstance(value, FakeCudaTensor) else value


def to_device(value: Any) -> Any:
    """Return a tensor of the device for its values; anything else as it is."""
    if isinstance(value, Tensor) and not isinstance(value, FakeCudaTensor):
        return FakeCudaTensor(value)
    return value


class Operations(TorchDispatchMode):
    """Sends operations without a tensor of the device there: those that create one."""

    @classmethod
    def _should_skip_dynamo(cls) -> bool:
        return False  # otherwise torch loads its compiler, which takes seconds

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return get_device().run(func, args, kwargs or {})


class Functions(TorchFunctionMode):
    """Handles calls of torch whose result depends on the device of an argument."""

    def __torch_function__(self, func, types, args=(), kwargs=None):
        kwargs = kwargs or {}
        if func.__name__ == "__get__":  # attributes, such as the shape
            return func(*args)
        device = get_device()
        if func is Tensor.to:
            return move(*args, **kwargs)
        if func is Tensor.cuda:
            return move(args[0], CUDA)
        if func is Tensor.type_as:
            return move(*args)
        wanted = kwargs.get("device")
        if func in (torch.tensor, torch.as_tensor, Tensor.new_tensor):
            if func is Tensor.new_tensor:
                wanted = wanted or args[0].device
                kwargs.setdefault("dtype", args[0].dtype)
                func, args = torch.tensor, args[1:]
            if wanted is not None and torch.device(wanted).type == "cuda":
                kwargs = {name: value for name, value in kwargs.items() if name != "device"}
                needs_gradient = kwargs.pop("requires_grad", False)
                return move(func(*args, **kwargs), CUDA).requires_grad_(needs_gradient)
        before = device.thread.is_in_call
        device.thread.is_in_call = wanted is None and any(
            isinstance(x, FakeCudaTensor) for x in find_tensors((args, kwargs))
        )
        try:
            return func(*args, **kwargs)
        finally:
            device.thread.is_in_call = before


_device: FakeDevice | None = None


def get_device() -> FakeDevice:
    """Return the device of the surrounding `fake_cuda`."""
    assert _device is not None, "a tensor of the fake device is used outside of fake_cuda()"
    return _device


def run_backward(*args: Any, **kwargs: Any) -> Any:
    """Run autograd's engine, with the mode of functions that its caller has left."""
    with Functions():  # for functions of autograd that are written in Python
        return _engine_run_backward(*args, **kwargs)


def run_thread(thread: threading.Thread) -> None:
    """Run a thread, with modes of its own."""
    with Functions(), Operations():
        _run_thread(thread)


SEEN_BY_TORCH: dict[str, Any] = {
    "is_available": lambda: True,
    "is_initialized": lambda: True,
    "_lazy_init": lambda: None,
    "synchronize": lambda *_: None,
    "device_count": lambda: 1,
    "current_device": lambda: 0,
    "get_device_name": lambda *_: "fake device",
    "get_device_capability": lambda *_: (9, 0),
    "mem_get_info": lambda *_: (64 << 30, 80 << 30),
    "memory_allocated": lambda *_: 0,
    "max_memory_allocated": lambda *_: 0,
    "reset_peak_memory_stats": lambda *_: None,
    "empty_cache": lambda: None,
    "is_bf16_supported": lambda *_, **__: True,
}
"""What torch.cuda answers."""


@contextmanager
def fake_cuda(has_doubles: bool = True) -> Iterator[Counts]:
    """Let torch see a GPU inside the block, and count what it has to do.

    Without doubles it refuses numbers of 64 bits after the point, as the GPU of a Mac does.
    """
    global _device
    assert _device is None
    _device = FakeDevice(has_doubles)
    overwriting = torch.__future__.get_overwrite_module_params_on_conversion()
    # Parameters of a network change their class with their device.
    torch.__future__.set_overwrite_module_params_on_conversion(True)
    try:
        with (
            patch.multiple(torch.cuda, **SEEN_BY_TORCH),
            patch.object(threading.Thread, "run", run_thread),
            patch.object(torch.autograd, "_engine_run_backward", run_backward),
            patch.object(timing, "record_function", _device.counts.inside),
            Functions(),
            Operations(),
        ):
            yield _device.counts
    finally:
        torch.__future__.set_overwrite_module_params_on_conversion(overwriting)
        _device = None
