"""What a script has switched in torch is switched back for our work, and stays for its own."""

from dataclasses import dataclass

import pytest
import torch
from torch import Tensor

from gscompleter.system.torch_modes import copy_inference_tensors, run_in_plain_torch


@dataclass(frozen=True)
class Pair:
    """Two tensors."""

    a: Tensor
    b: tuple[Tensor, ...] = ()


@run_in_plain_torch
def square(value: Tensor) -> Tensor:
    """Compute the gradient of a sum of squares, which needs gradients."""
    variable = (value * torch.ones(1)).requires_grad_()
    (gradient,) = torch.autograd.grad(variable.square().sum(), variable)
    return gradient


@pytest.fixture
def float64():
    """Switch the default type, as scripts do."""
    torch.set_default_dtype(torch.float64)
    yield
    torch.set_default_dtype(torch.float32)


@pytest.mark.parametrize("mode", [torch.inference_mode, torch.no_grad])
def test_gradients_are_computed_in_any_mode_and_the_mode_stays(mode):
    with mode():
        value = torch.full((2,), 3.0)
        assert square(value).tolist() == [6, 6]
        assert not torch.is_grad_enabled()
        assert torch.is_inference_mode_enabled() == (mode is torch.inference_mode)
    assert square(value).tolist() == [6, 6]  # a tensor of inference mode, outside of it


def test_the_default_type_is_float32_inside_and_stays_outside(float64):
    assert square(torch.ones(1, dtype=torch.float32)).dtype is torch.float32
    assert torch.get_default_dtype() is torch.float64


def test_the_default_type_comes_back_after_an_error(float64):
    @run_in_plain_torch
    def fail() -> None:
        raise ValueError

    with pytest.raises(ValueError, match=r"^$"):
        fail()
    assert torch.get_default_dtype() is torch.float64


def test_autocast_and_a_default_device_are_left_out():
    @run_in_plain_torch
    def multiply() -> Tensor:
        return torch.ones(2, 2) @ torch.ones(2, 2)

    with torch.autocast("cpu", dtype=torch.bfloat16), torch.device("meta"):
        product = multiply()
    assert (product.dtype, product.device.type) == (torch.float32, "cpu")


def test_only_values_of_inference_mode_are_copied():
    plain = Pair(torch.ones(1), (torch.ones(2),))
    assert copy_inference_tensors([plain])[0] is plain
    with torch.inference_mode():
        made = Pair(torch.ones(1), (torch.ones(2),))
    copied = copy_inference_tensors(made)
    assert not copied.a.is_inference()
    assert not copied.b[0].is_inference()
    assert copied.b[0].tolist() == [1, 1]
