"""Models that lack no tensor: what is missing, transformers would fill with random numbers."""

from __future__ import annotations

from typing import Any

import torch

from gscompleter.generators.diffusion.published import Source


class IncompleteWeightsError(ValueError):
    """Tensors are missing from the files of a model."""

    def __init__(self, part: str, names: list[str]) -> None:
        more = f" and {len(names) - 1} more" if len(names) > 1 else ""
        super().__init__(f"its {part} lacks the tensor {names[0]}{more}")


def text_encoders(source: Source, dtype: torch.dtype) -> dict[str, Any]:
    """The parts of a pipeline that are models of transformers, by name.

    Raises:
        IncompleteWeightsError: where one lacks a tensor.
    """
    import transformers
    from diffusers import DiffusionPipeline

    parts = DiffusionPipeline.load_config(source.place, **source.arguments)
    models = {}
    for name, kind in parts.items():
        if not isinstance(kind, (list, tuple)) or kind[0] != "transformers":
            continue
        model = getattr(transformers, kind[1])
        if issubclass(model, transformers.PreTrainedModel):
            models[name] = loaded(model, source, name, dtype=dtype, subfolder=name)
    return models


def loaded(kind: Any, source: Source, part: str, **arguments: Any) -> Any:
    """A model of transformers of the class `kind`.

    Raises:
        IncompleteWeightsError: where it lacks a tensor.
    """
    model, told = kind.from_pretrained(
        source.place, output_loading_info=True, **{**source.arguments, **arguments}
    )
    if told["missing_keys"]:
        raise IncompleteWeightsError(part, sorted(told["missing_keys"]))
    return model


def check_complete(pipeline: Any) -> None:
    """See that the parts of `pipeline` that are models of diffusers lack no tensor.

    Raises:
        IncompleteWeightsError: where one does.
    """
    for part, model in pipeline.components.items():
        if isinstance(model, torch.nn.Module):
            # diffusers gives no memory to what it did not find
            missing = sorted(name for name, value in model.named_parameters() if value.is_meta)
            if missing:
                raise IncompleteWeightsError(part, missing)
