"""Tiny diffusion models of the real classes with random weights, saved as diffusers saves them.

Their images are noise, for smoke tests of frames, sizes and stages.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch

LETTERS = "abcdefghijklmnopqrstuvwxyz"


def clip_tokenizer() -> Any:
    from transformers import CLIPTokenizer

    words = [*LETTERS, *(f"{letter}</w>" for letter in LETTERS)]
    words += ["<|startoftext|>", "<|endoftext|>"]
    vocabulary = {word: number for number, word in enumerate(words)}
    return CLIPTokenizer(vocab=vocabulary, merges=[], model_max_length=77)


def clip_text_encoder(width: int) -> Any:
    from transformers import CLIPTextConfig, CLIPTextModel

    config = CLIPTextConfig(
        vocab_size=54,
        hidden_size=width,
        intermediate_size=width,
        num_hidden_layers=1,
        num_attention_heads=2,
        eos_token_id=53,
        bos_token_id=52,
        pad_token_id=53,
    )
    return CLIPTextModel(config)


def t5(width: int) -> tuple[Any, Any]:
    from transformers import T5Config, T5EncoderModel, T5TokenizerFast

    pieces = [("<pad>", 0.0), ("</s>", 0.0), ("<unk>", 0.0), ("▁", -1.0)]
    pieces += [(letter, -2.0) for letter in LETTERS]
    tokenizer = T5TokenizerFast(vocab=pieces, extra_ids=0)
    config = T5Config(
        vocab_size=len(pieces), d_model=width, d_kv=8, d_ff=width, num_layers=1, num_heads=2
    )
    return tokenizer, T5EncoderModel(config)


def vae(levels: int, **settings: Any) -> Any:
    """Create an autoencoder that halves the image on all levels but the last."""
    from diffusers import AutoencoderKL

    return AutoencoderKL(
        block_out_channels=(4,) * levels,
        down_block_types=("DownEncoderBlock2D",) * levels,
        up_block_types=("UpDecoderBlock2D",) * levels,
        layers_per_block=1,
        latent_channels=4,
        norm_num_groups=2,
        **settings,
    )


def kontext_pipeline(heads: int = 24) -> Any:
    """Create FLUX Kontext with tokens of 64 pixels, so that a million pixels are 256 tokens."""
    from diffusers import (
        FlowMatchEulerDiscreteScheduler,
        FluxKontextPipeline,
        FluxTransformer2DModel,
    )

    torch.manual_seed(0)
    transformer = FluxTransformer2DModel(
        in_channels=16,
        num_layers=1,
        num_single_layers=1,
        attention_head_dim=16,
        num_attention_heads=heads,
        joint_attention_dim=32,
        pooled_projection_dim=24,
        guidance_embeds=True,
        axes_dims_rope=(4, 6, 6),
    )
    tokenizer, encoder = t5(32)
    return FluxKontextPipeline(
        scheduler=FlowMatchEulerDiscreteScheduler(use_dynamic_shifting=True, shift=3.0),
        vae=vae(
            6,
            shift_factor=0.1159,
            scaling_factor=0.3611,
            use_quant_conv=False,
            use_post_quant_conv=False,
        ),
        text_encoder=clip_text_encoder(24),
        tokenizer=clip_tokenizer(),
        text_encoder_2=encoder,
        tokenizer_2=tokenizer,
        transformer=transformer,
    )


def unet(**settings: Any) -> Any:
    """Create a UNet of two levels at 64 pixels; SDXL's has no cross attention on its first."""
    from diffusers import UNet2DConditionModel

    return UNet2DConditionModel(
        sample_size=32,
        out_channels=4,
        block_out_channels=(8, 16),
        layers_per_block=1,
        down_block_types=("DownBlock2D", "CrossAttnDownBlock2D"),
        up_block_types=("CrossAttnUpBlock2D", "UpBlock2D"),
        attention_head_dim=4,
        norm_num_groups=4,
        **settings,
    )


def stable_diffusion(inpainting: bool = True) -> Any:
    """Create Stable Diffusion at 64 pixels, for inpainting or for text only."""
    import diffusers

    torch.manual_seed(0)
    kind = "StableDiffusionInpaintPipeline" if inpainting else "StableDiffusionPipeline"
    return getattr(diffusers, kind)(
        vae=vae(2),
        text_encoder=clip_text_encoder(16),
        tokenizer=clip_tokenizer(),
        unet=unet(in_channels=9 if inpainting else 4, cross_attention_dim=16),
        scheduler=diffusers.DDIMScheduler(steps_offset=1, clip_sample=False),
        safety_checker=None,
        feature_extractor=None,
        requires_safety_checker=False,
    )


def checked_stable_diffusion() -> Any:
    """Create Stable Diffusion inpainting with its safety checker."""
    from diffusers.pipelines.stable_diffusion import StableDiffusionSafetyChecker
    from transformers import CLIPConfig, CLIPImageProcessorPil

    pipeline = stable_diffusion()
    layers = {"hidden_size": 16, "intermediate_size": 16, "num_hidden_layers": 1}
    config = CLIPConfig(
        vision_config={**layers, "num_attention_heads": 2, "image_size": 32, "patch_size": 16},
        text_config={**layers, "num_attention_heads": 2, "vocab_size": 54},
        projection_dim=16,
    )
    pipeline.register_modules(
        safety_checker=StableDiffusionSafetyChecker(config),
        feature_extractor=CLIPImageProcessorPil(size=32, crop_size=32),
    )
    return pipeline


def sdxl() -> Any:
    """Create SDXL inpainting at 64 pixels."""
    from diffusers import EulerDiscreteScheduler, StableDiffusionXLInpaintPipeline
    from transformers import CLIPTextModelWithProjection

    torch.manual_seed(0)
    second = CLIPTextModelWithProjection(clip_text_encoder(16).config)
    return StableDiffusionXLInpaintPipeline(
        vae=vae(2),
        text_encoder=clip_text_encoder(16),
        tokenizer=clip_tokenizer(),
        text_encoder_2=second,
        tokenizer_2=clip_tokenizer(),
        unet=unet(
            in_channels=9,
            cross_attention_dim=32,
            addition_embed_type="text_time",
            addition_time_embed_dim=8,
            projection_class_embeddings_input_dim=8 * 6 + second.config.projection_dim,
        ),
        scheduler=EulerDiscreteScheduler(),
    )


def flux_fill() -> Any:
    """Create Flux Fill with tokens of 64 pixels, like `kontext_pipeline`."""
    from diffusers import FluxFillPipeline, FluxTransformer2DModel

    parts = kontext_pipeline().components
    mask = 4 * 32**2
    transformer = FluxTransformer2DModel(
        in_channels=2 * 16 + mask,
        out_channels=16,
        num_layers=1,
        num_single_layers=1,
        attention_head_dim=16,
        num_attention_heads=2,
        joint_attention_dim=32,
        pooled_projection_dim=24,
        guidance_embeds=True,
        axes_dims_rope=(4, 6, 6),
    )
    kept = ("scheduler", "vae", "text_encoder", "tokenizer", "text_encoder_2", "tokenizer_2")
    return FluxFillPipeline(transformer=transformer, **{name: parts[name] for name in kept})


def qwen3(layers: int) -> dict[str, Any]:
    """Create a tokenizer of letters and a language model 16 wide."""
    from tokenizers import Tokenizer, models, pre_tokenizers
    from transformers import Qwen2TokenizerFast, Qwen3Config, Qwen3ForCausalLM

    words = {word: number for number, word in enumerate(["<pad>", "<unk>", *LETTERS])}
    letters = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    letters.pre_tokenizer = pre_tokenizers.Split("", "isolated")
    tokenizer = Qwen2TokenizerFast(
        tokenizer_object=letters,
        pad_token="<pad>",
        unk_token="<unk>",
        chat_template="{% for message in messages %}{{ message['content'] }}{% endfor %}",
    )
    config = Qwen3Config(
        vocab_size=len(tokenizer),
        hidden_size=16,
        intermediate_size=16,
        num_hidden_layers=layers,
        num_attention_heads=2,
        num_key_value_heads=2,
        head_dim=8,
        pad_token_id=0,
    )
    return {"tokenizer": tokenizer, "text_encoder": Qwen3ForCausalLM(config)}


def flux2_klein() -> Any:
    """Create FLUX.2 [klein] with tokens of 4 pixels, as the hub has it: not for inpainting."""
    import diffusers

    torch.manual_seed(0)
    return diffusers.Flux2KleinPipeline(
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(),
        vae=diffusers.AutoencoderKLFlux2(
            block_out_channels=(4, 4),
            down_block_types=("DownEncoderBlock2D",) * 2,
            up_block_types=("UpDecoderBlock2D",) * 2,
            layers_per_block=1,
            latent_channels=4,
            norm_num_groups=2,
        ),
        transformer=diffusers.Flux2Transformer2DModel(
            in_channels=16,
            num_layers=1,
            num_single_layers=1,
            attention_head_dim=16,
            num_attention_heads=2,
            joint_attention_dim=48,
            timestep_guidance_channels=16,
            axes_dims_rope=(4, 4, 4, 4),
            guidance_embeds=False,
        ),
        is_distilled=True,
        **qwen3(28),
    )


def z_image() -> Any:
    """Create Z-Image with tokens of 4 pixels, as the hub has it: not for inpainting."""
    import diffusers

    torch.manual_seed(0)
    return diffusers.ZImagePipeline(
        scheduler=diffusers.FlowMatchEulerDiscreteScheduler(),
        vae=vae(2, shift_factor=0.1, scaling_factor=0.4),
        transformer=diffusers.ZImageTransformer2DModel(
            in_channels=4,
            dim=32,
            n_layers=1,
            n_refiner_layers=1,
            n_heads=2,
            n_kv_heads=2,
            cap_feat_dim=16,
            axes_dims=[4, 6, 6],
            axes_lens=[1024, 512, 512],
        ),
        **qwen3(2),
    )


INPAINTERS = {
    "stable-diffusion": stable_diffusion,
    "stable-diffusion-of-text": lambda: stable_diffusion(inpainting=False),
    "sdxl": sdxl,
    "flux-fill": flux_fill,
    "flux2-klein": flux2_klein,
    "z-image": z_image,
}


def saved(pipeline: Any, folder: Path) -> Path:
    pipeline.save_pretrained(folder)
    return folder
