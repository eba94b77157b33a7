"""The same numbers as the authors' code, to the rounding of different CPUs."""

from torch import Tensor

PARITY = 2e-4
"""Largest difference that is rounding, of the array's largest value. The settings of one CPU differ
by up to 3.5e-5 (quaternions of MVSplat); the tanh form of GELU is 2.5e-3 off."""


def relative_error(found: Tensor, expected: Tensor) -> float:
    """Compute the largest difference over the largest expected value; NaN if anything is NaN."""
    assert found.shape == expected.shape, (found.shape, expected.shape)
    difference = (found.double() - expected.double()).abs().max()
    return (difference / expected.abs().max()).item()


def assert_within(errors: dict[str, float], bound: float = PARITY) -> None:
    """Check that each error, by the name of its array, lies below the bound. NaN does not."""
    assert errors
    wrong = [f"{name} is off by {error:.2g}" for name, error in errors.items() if not error < bound]
    assert not wrong, f"{'; '.join(wrong)} of the largest value, and {bound:g} is allowed"


def assert_close(found: Tensor, expected: Tensor, name: str, bound: float = PARITY) -> None:
    """Check that the array called `name` is as expected, but for rounding."""
    assert_within({name: relative_error(found, expected)}, bound)
