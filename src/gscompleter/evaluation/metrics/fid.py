"""Fréchet inception distance, through torchmetrics (`pip install gscompleter[fid]`)."""

from __future__ import annotations

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError


def fid(
    images: Sequence[Float[Tensor, "h w 3"]],
    truths: Sequence[Float[Tensor, "h w 3"]],
) -> float:
    """Compute |μ - μ'|² + tr(Σ + Σ' - 2 (Σ Σ')^½) of Inception features; 0 is best.

    This is `FrechetInceptionDistance` of torchmetrics with 2,048 features, its own weights and its
    own resizing. The estimate is biased: compare sets of equal size only, with thousands of images
    if possible. Tested with a stand-in for torchmetrics only.

    Raises:
        InputError: torchmetrics or its weights are missing, or a side has fewer than two images.
    """
    try:
        # Imported here because the package imports torchvision.
        from torchmetrics.image.fid import FrechetInceptionDistance

        metric = FrechetInceptionDistance(feature=2048, normalize=True)
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
    for side, found in (("photographs", truths), ("rendered images", images)):
        if len(found) < 2:
            raise InputError(f"FID needs at least two {side}, got {len(found)}.")
        for image in found:
            batch = image.clamp(0, 1).permute(2, 0, 1)[None].float()
            metric.update(batch, real=found is truths)
    return float(metric.compute())
