"""Detection of missing tensors, which transformers would initialize randomly."""

from __future__ import annotations

import re
from typing import Any

import torch

from gscompleter.models.diffusion.published import IncompleteWeightsError, Source


def load_language_models(source: Source, dtype: torch.dtype) -> dict[str, Any]:
    """Load the parts of a pipeline that are models of transformers, by name."""
    import transformers
    from diffusers import DiffusionPipeline, pipelines

    parts = DiffusionPipeline.load_config(source.location, **source.load_arguments)
    models = {}
    for name, kind in parts.items():
        if not isinstance(kind, (list, tuple)) or kind[0] is None:
            continue
        # Names unknown to both libraries are translated by diffusers.
        library = transformers if kind[0] == "transformers" else getattr(pipelines, kind[0], None)
        model = getattr(library, kind[1], None)
        if isinstance(model, type) and issubclass(model, transformers.PreTrainedModel):
            models[name] = load_transformers_model(model, source, name, dtype=dtype, subfolder=name)
    return models


def load_transformers_model(
    kind: Any, source: Source, part: str, unused: str = "^$", **arguments: Any
) -> Any:
    """Load a model of transformers of class `kind`, named `part` in errors.

    Tensors that match `unused` may be missing.

    Raises:
        IncompleteWeightsError: A tensor is missing.
    """
    model, info = kind.from_pretrained(
        source.location, output_loading_info=True, **{**source.load_arguments, **arguments}
    )
    missing = sorted(name for name in info["missing_keys"] if not re.search(unused, name))
    if missing:
        raise IncompleteWeightsError(part, missing)
    return model


def check_complete(model: torch.nn.Module, part: str) -> None:
    """Raise IncompleteWeightsError if a model of diffusers lacks a tensor."""
    # diffusers leaves missing parameters on the meta device
    missing = sorted(name for name, value in model.named_parameters() if value.is_meta)
    if missing:
        raise IncompleteWeightsError(part, missing)


def check_parts(pipeline: Any) -> None:
    """Apply `check_complete` to each model of a pipeline."""
    for part, model in pipeline.components.items():
        if isinstance(model, torch.nn.Module):
            check_complete(model, part)
