"""Loading of FLUX Kontext for PE-Field."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import torch

from gscompleter.models.diffusion.complete import check_complete, check_parts, load_language_models
from gscompleter.models.diffusion.kontext import Kontext, Prompt
from gscompleter.models.diffusion.placing import move_to_device, select_dtype
from gscompleter.models.diffusion.published import (
    KONTEXT,
    PE_FIELD,
    Source,
    announce,
    check_packages,
    convert_load_errors,
    parse_source,
)
from gscompleter.models.diffusion.rotary import HEADS, enable_per_head_positions
from gscompleter.system.errors import InputError, quote_value

PROMPT = "Ensure that the picture does not change in any way"
"""Fixed prompt of the training."""


@lru_cache(maxsize=1)
def load_kontext(path: str | None = None, device: str = "cpu", offload: bool = False) -> Kontext:
    """Load the PE-Field model; the last one is cached.

    Args:
        path: A folder or repository with a whole pipeline, or a folder with the transformer
            alone, to use with the published base. If None, both are the published ones.
        device: cpu (float32) or cuda (bfloat16).
        offload: Keep only the active part on the GPU; slower, and needs accelerate.

    Raises:
        InputError: Packages or weights are missing, or the weights do not fit.
    """
    check_packages("pe-field")
    base, transformer = find_sources(path)
    announce([base, transformer])
    # Each source converts its own errors, which name it. The prompt is encoded first: its text
    # encoders are freed before the transformer is in memory.
    dtype = select_dtype(device)
    with convert_load_errors(base):
        prompt = encode_prompt(base, device, dtype)
    with convert_load_errors(transformer):
        network = load_transformer(transformer, dtype)
    with convert_load_errors(base):
        pipeline = load_pipeline(base, network, dtype)

    heads = pipeline.transformer.config.num_attention_heads
    if heads != HEADS:
        raise InputError(
            f"The transformer of {transformer.location} has {heads} heads, and PE-Field needs "
            f"{HEADS}; give that of PE-Field."
        )
    enable_per_head_positions(pipeline.transformer)
    move_to_device(pipeline, device, offload)
    return Kontext(pipeline, prompt, device, dtype)


def find_sources(path: str | None) -> tuple[Source, Source]:
    """Determine the sources of base pipeline and transformer."""
    if path is None:
        return KONTEXT, PE_FIELD
    source = parse_source(path)
    # A hub repository holds a whole pipeline, of which the transformer is one folder.
    if not source.is_local or (Path(source.location) / "model_index.json").is_file():
        return source, replace(source, subfolder="transformer")
    if (Path(source.location) / "config.json").is_file():
        return KONTEXT, source
    raise InputError(
        f"{quote_value(Path(path))} holds neither a model_index.json (a pipeline) nor a "
        "config.json (a transformer); give a folder that diffusers saved."
    )


def encode_prompt(base: Source, device: str, dtype: torch.dtype) -> Prompt:
    """Encode the prompt by T5 and CLIP, which are freed afterwards."""
    from diffusers import FluxKontextPipeline

    readers = FluxKontextPipeline.from_pretrained(
        base.location,
        transformer=None,
        vae=None,
        dtype=dtype,
        **load_language_models(base, dtype),
        **base.load_arguments,
    ).to(device)
    with torch.inference_mode():
        tokens, pooled, _ = readers.encode_prompt(PROMPT, device=device)
    return Prompt(tokens.to(dtype), pooled.to(dtype))


def load_transformer(source: Source, dtype: torch.dtype) -> Any:
    """Load the denoising transformer."""
    from diffusers import FluxTransformer2DModel

    network = FluxTransformer2DModel.from_pretrained(
        source.location, dtype=dtype, **source.load_arguments
    )
    check_complete(network, "transformer")
    return network


def load_pipeline(base: Source, network: Any, dtype: torch.dtype) -> Any:
    """Load VAE and scheduler around `network`, without text encoders."""
    from diffusers import FluxKontextPipeline

    # Named as absent, or diffusers would download and load them.
    unused = dict.fromkeys(("text_encoder", "text_encoder_2", "tokenizer", "tokenizer_2"))
    pipeline = FluxKontextPipeline.from_pretrained(
        base.location, transformer=network, dtype=dtype, **unused, **base.load_arguments
    )
    check_parts(pipeline)
    return pipeline
