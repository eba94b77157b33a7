"""Strict loading of tensors into a network."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from torch import Tensor, nn

from gscompleter.system.errors import InputError, quote_value

Shapes = Mapping[str, tuple[int, ...]]
"""Shapes of the tensors of a network by name."""


def load_strictly(
    model: nn.Module,
    state_dict: Mapping[str, Tensor],
    origin: Path | str,
    variants: Callable[[], Mapping[str, Shapes]] | None = None,
) -> None:
    """Load tensors into a network if names and shapes match exactly; else it is unchanged.

    Args:
        model: The network.
        state_dict: Parameters and buffers by their names in the network.
        origin: Origin of the tensors, for error messages.
        variants: Function that returns the shapes of all networks, to name the one that fits.

    Raises:
        InputError: A tensor is missing, unknown, of another shape, or not finite.
    """
    needed = get_shapes(model.state_dict())
    given = get_shapes(state_dict)
    if needed != given:
        # The file of another variant is the usual mistake, and can be named.
        known = {} if variants is None else variants()
        fitting = [name for name, shapes in known.items() if dict(shapes) == given]
        advice = "give another file"
        if fitting:
            advice = f"its tensors are those of {' or '.join(fitting)}"
        raise InputError(
            f"{quote_value(origin)} does not fit the network {type(model).__name__}: "
            f"{describe_differences(needed, given)}; {advice}."
        )
    # Checked before anything is loaded, so that a failure leaves the network as it was.
    check_finite(state_dict, origin)
    model.load_state_dict(state_dict, strict=True)


def check_finite(state_dict: Mapping[str, Tensor], origin: Path | str) -> None:
    """Raise InputError if a tensor contains NaN or infinity."""
    bad = [name for name, tensor in state_dict.items() if not torch.isfinite(tensor).all()]
    if bad:
        raise InputError(
            f"{quote_value(origin)} holds NaN or infinity in {len(bad)} of {len(state_dict)} "
            f"tensors (such as {quote_value(bad[0])}); fetch or train it again."
        )


def get_shapes(state_dict: Mapping[str, Tensor]) -> dict[str, tuple[int, ...]]:
    """Return the shape of each tensor."""
    return {name: tuple(tensor.shape) for name, tensor in state_dict.items()}


def describe_differences(needed: Shapes, given: Shapes) -> str:
    """Describe the differences of two sets of tensors, with an example of each kind."""
    missing = [name for name in needed if name not in given]
    extra = [name for name in given if name not in needed]
    other = [name for name in needed if name in given and needed[name] != given[name]]
    parts = []
    if missing:
        example = quote_value(missing[0])
        parts.append(f"it lacks {len(missing)} of {len(needed)} tensors (such as {example})")
    if extra:
        example = quote_value(extra[0])
        parts.append(f"it has {len(extra)} unknown to the network (such as {example})")
    if other:
        name = other[0]
        shapes = f"{quote_value(list(given[name]))} instead of {list(needed[name])}"
        parts.append(
            f"it has {len(other)} of another shape (such as {quote_value(name)}, {shapes})"
        )
    return ", ".join(parts)
