"""The extent of a splat, by quantiles along turned axes."""

import pytest
import torch

from gscompleter.render.outside import EXTENT_QUANTILES, compute_quantiles


@pytest.mark.parametrize("count", [1, 2, 51, 2000])
def test_quantiles_are_those_of_torch_to_the_bit(count):
    values = torch.randn(4, 3, count, generator=torch.Generator().manual_seed(count))
    wanted = values.quantile(torch.tensor(EXTENT_QUANTILES), dim=2)
    for ours, theirs in zip(compute_quantiles(values, EXTENT_QUANTILES), wanted, strict=True):
        assert torch.equal(ours, theirs)
