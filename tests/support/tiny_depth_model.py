"""Depth Anything with few, random weights."""

from pathlib import Path

import pytest
import torch


def tiny_model(folder: Path) -> Path:
    """Depth Anything with random weights."""
    transformers = pytest.importorskip("transformers", reason="needs gscompleter[diffusion]")
    pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    torch.manual_seed(0)
    backbone = transformers.Dinov2Config(
        hidden_size=32,
        num_hidden_layers=4,
        num_attention_heads=2,
        intermediate_size=32,
        image_size=56,
        patch_size=14,
        out_features=["stage1", "stage2", "stage3", "stage4"],
        reshape_hidden_states=False,
    )
    config = transformers.DepthAnythingConfig(
        backbone_config=backbone,
        reassemble_hidden_size=32,
        neck_hidden_sizes=[8, 8, 8, 8],
        fusion_hidden_size=8,
        head_hidden_size=8,
    )
    transformers.DepthAnythingForDepthEstimation(config).save_pretrained(folder)
    size = {"height": 56, "width": 56}
    processor = transformers.DPTImageProcessorPil(size=size, ensure_multiple_of=14, do_pad=False)
    processor.save_pretrained(folder)
    return folder
