"""A completion that meets all kernels, and the kernels that have run in a process."""

from importlib import import_module
from pkgutil import iter_modules

from numba.core.registry import CPUDispatcher

from gscompleter import GSCompleter
from gscompleter.numerics import kernels
from scenes import Room, camera_at, view_of


def complete(is_short: bool) -> None:
    """Complete a room beside two and three photographs, reconstructed and given.

    In short, beside two.
    """
    target = camera_at(0.7, yaw=12, size=64)
    for places in ((-0.3, 0.1), (-0.3, 0.1, 0.3)):
        views = [view_of(Room(), camera_at(x, size=64)) for x in places]
        completion = GSCompleter()(views, target)
        if is_short:
            return
    GSCompleter()(views, target, completion.scene)


def signatures() -> set[tuple[str, str]]:
    """Return the names and argument types of all kernels that ran in this process."""
    return {
        (f"{module.name}.{name}", str(types))
        for module in iter_modules(kernels.__path__)
        for name, value in vars(import_module(f"{kernels.__name__}.{module.name}")).items()
        if isinstance(value, CPUDispatcher)
        for types in value.signatures
    }
