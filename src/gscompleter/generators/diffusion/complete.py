"""Models that lack no tensor: what is missing, transformers would fill with random numbers."""

from __future__ import annotations

import re
from typing import Any

import torch

from gscompleter.generators.diffusion.published import IncompleteWeightsError, Source


def language_models(source: Source, dtype: torch.dtype) -> dict[str, Any]:
    """The parts of a pipeline that are models of transformers, by name, each as by `loaded`."""
    import transformers
    from diffusers import DiffusionPipeline, pipelines

    parts = DiffusionPipeline.load_config(source.place, **source.arguments)
    models = {}
    for name, kind in parts.items():
        if not isinstance(kind, (list, tuple)) or kind[0] is None:
            continue
        # Names that neither library knows any more are for diffusers to translate.
        library = transformers if kind[0] == "transformers" else getattr(pipelines, kind[0], None)
        model = getattr(library, kind[1], None)
        if isinstance(model, type) and issubclass(model, transformers.PreTrainedModel):
            models[name] = loaded(model, source, name, dtype=dtype, subfolder=name)
    return models


def loaded(kind: Any, source: Source, part: str, unused: str = "^$", **arguments: Any) -> Any:
    """A model of transformers of the class `kind`.

    Args:
        kind: The class.
        source: Where its files are.
        part: What to call it in a sentence.
        unused: Pattern of tensors that it has but never uses, and that may be missing.
        arguments: For its `from_pretrained`.

    Raises:
        IncompleteWeightsError: where it lacks a tensor.
    """
    model, told = kind.from_pretrained(
        source.place, output_loading_info=True, **{**source.arguments, **arguments}
    )
    missing = sorted(name for name in told["missing_keys"] if not re.search(unused, name))
    if missing:
        raise IncompleteWeightsError(part, missing)
    return model


def check_complete(model: torch.nn.Module, part: str) -> None:
    """Raise an IncompleteWeightsError where a model of diffusers lacks a tensor."""
    # diffusers gives no memory to what it did not find
    missing = sorted(name for name, value in model.named_parameters() if value.is_meta)
    if missing:
        raise IncompleteWeightsError(part, missing)


def check_parts(pipeline: Any) -> None:
    """`check_complete` for each model among the parts of a pipeline."""
    for part, model in pipeline.components.items():
        if isinstance(model, torch.nn.Module):
            check_complete(model, part)
