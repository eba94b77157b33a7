"""Fréchet inception distance, through torchmetrics (`pip install gscompleter[fid]`)."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError


def fid(
    images: Iterable[Float[Tensor, "h w 3"]],
    truths: Iterable[Float[Tensor, "h w 3"]],
    device: torch.device | str = "cpu",
) -> float:
    """|μ - μ'|² + tr(Σ + Σ' - 2 (Σ Σ')^½) of Inception features of two sets of images; 0 is best.

    The 2,048 features of the last pooling layer, by `FrechetInceptionDistance` of torchmetrics
    with its own weights (a download) and its own resizing to 299 x 299. Images are in [0, 1] and
    may differ in size. The estimate is biased for few images: compare only sets of equal size,
    thousands of images where possible.

    This function was checked against a stand-in for torchmetrics only. Neither the real library
    nor its weights were at hand where it was written.

    Args:
        images: What was rendered.
        truths: The photographs; at least two on each side.
        device: Where the features are computed.

    Raises:
        InputError: where torchmetrics is missing, its weights cannot be had, or there are fewer
            than two images on a side.
    """
    metric = load_metric().to(device)
    for images_of, real in ((truths, True), (images, False)):
        count = 0
        for image in images_of:
            batch = image.clamp(0, 1).permute(2, 0, 1)[None].float().to(device)
            metric.update(batch, real=real)
            count += 1
        if count < 2:
            side = "photographs" if real else "rendered images"
            raise InputError(f"FID needs at least two {side}, got {count}.")
    return float(metric.compute())


# The class is unknown without the optional package.
def load_metric():  # type: ignore[no-untyped-def]
    """The metric of torchmetrics, for images in [0, 1]; errors as those of `fid`."""
    try:
        # Here and not above: the package brings torchvision along.
        from torchmetrics.image.fid import FrechetInceptionDistance

        return FrechetInceptionDistance(feature=2048, normalize=True)
    except ImportError as error:
        raise InputError(
            f"FID needs torchmetrics and torch-fidelity ({error}); "
            "run `pip install gscompleter[fid]`."
        ) from error
    except OSError as error:
        raise InputError(
            f"FID could not get its Inception weights ({error}); run it once with a connection, "
            "or copy torch-fidelity's weights to the checkpoints folder of torch.hub."
        ) from error
