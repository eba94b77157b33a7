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
    """Compute |μ - μ'|² + tr(Σ + Σ' - 2 (Σ Σ')^½) of Inception features; 0 is best.

    This is `FrechetInceptionDistance` of torchmetrics with 2,048 features, its own weights and its
    own resizing. The estimate is biased: compare sets of equal size only, with thousands of images
    if possible. Tested with a stand-in for torchmetrics only.

    Raises:
        InputError: torchmetrics or its weights are missing, or a side has fewer than two images.
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


# No return type: the class comes from an optional package.
def load_metric():  # type: ignore[no-untyped-def]
    """Load the torchmetrics metric for images in [0, 1]; errors as `fid`."""
    try:
        # Imported here because the package imports torchvision.
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
