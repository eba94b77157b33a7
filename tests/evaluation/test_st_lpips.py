"""ST-LPIPS is that of its authors' package, and absent without its weights."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from gscompleter.evaluation.metrics import st_lpips
from gscompleter.evaluation.metrics.st_lpips import (
    LAYERS,
    MIN_NETWORK_SIDE,
    ST_LPIPS_PACKAGE,
    ST_LPIPS_WEIGHTS,
    compute_st_lpips,
    halve_smoothly,
    load_weights,
)
from gscompleter.evaluation.tables import ABSENT_NOTES

CHANNELS = (64, 192, 384, 256, 256)
SIZES = ((MIN_NETWORK_SIDE, MIN_NETWORK_SIDE), (64, 80), (255, 130))
AUTHORS = """
import json, sys
from types import ModuleType

# The package imports these for its other networks; ST-LPIPS over its AlexNet calls none of them.
for name in ("torchvision", "torchvision.models", "IPython", "torchsummary"):
    sys.modules[name] = ModuleType(name)
sys.modules["torchvision"].models = sys.modules["torchvision.models"]
sys.modules["IPython"].embed = sys.modules["torchsummary"].summary = None

import torch
from stlpips_pytorch.stlpips import LPIPS

metric = LPIPS(net="alex", variant="shift_tolerant", verbose=False)
found = []
for pair in torch.load(sys.argv[1], weights_only=True):
    with torch.no_grad():
        image, truth = (side.movedim(-1, 0)[None] for side in pair)
        found.append(metric(image, truth, normalize=True).item())
print(json.dumps(found))
"""
"""Program that runs the authors' code on pairs of images."""


@pytest.fixture(autouse=True)
def no_cached_weights():
    load_weights.cache_clear()
    yield
    load_weights.cache_clear()


def make_pair(height: int, width: int) -> torch.Tensor:
    """Make an image and a noisy one."""
    random = torch.Generator().manual_seed(height)
    image = torch.rand(height, width, 3, generator=random)
    noise = torch.rand(height, width, 3, generator=random)
    return torch.stack([image, (image + 0.3 * noise).clamp(0, 1)])


def test_the_score_is_that_of_the_authors_code(tmp_path):
    if find_spec(ST_LPIPS_PACKAGE) is None:
        pytest.skip("needs gscompleter[evaluation]")
    pairs = [make_pair(*size) for size in SIZES]
    torch.save(pairs, tmp_path / "pairs.pt")
    words = [sys.executable, "-c", AUTHORS, str(tmp_path / "pairs.pt")]
    done = subprocess.run(words, capture_output=True, text=True, check=True)
    theirs = json.loads(done.stdout.splitlines()[-1])
    assert [compute_st_lpips(*pair) for pair in pairs] == pytest.approx(theirs, rel=1e-4)


def install_random_weights(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a package with random weights in the place of the true one."""
    random = torch.Generator().manual_seed(0)
    sides = (11, 5, 3, 3, 3)
    weights = {"scaling_layer.shift": torch.zeros(1, 3, 1, 1)}
    weights["scaling_layer.scale"] = torch.ones(1, 3, 1, 1)
    before = 3
    for number, ((name, _, _), channels, side) in enumerate(
        zip(LAYERS, CHANNELS, sides, strict=True)
    ):
        kernel = torch.randn(channels, before, side, side, generator=random)
        weights[f"net.{name}.weight"] = kernel / kernel[0].numel() ** 0.5
        weights[f"net.{name}.bias"] = torch.zeros(channels)
        weights[f"lin{number}.model.1.weight"] = torch.full((1, channels, 1, 1), 1 / channels)
        before = channels
    path = folder / ST_LPIPS_PACKAGE / ST_LPIPS_WEIGHTS
    path.parent.mkdir(parents=True)
    torch.save(weights, path)
    # Importing it would end the test: only its file is read.
    (folder / ST_LPIPS_PACKAGE / "__init__.py").write_text("raise AssertionError('imported')")
    monkeypatch.syspath_prepend(folder)


def test_equal_images_have_no_distance_and_colours_are_clipped(tmp_path, monkeypatch):
    install_random_weights(tmp_path, monkeypatch)
    image, other = make_pair(32, 40)
    assert compute_st_lpips(image, image) == 0
    score = compute_st_lpips(image, other)
    assert score is not None
    assert score > 0
    assert compute_st_lpips(other, image) == pytest.approx(score, rel=1e-4)
    assert compute_st_lpips(image + 5 * (image == 1), other) == score
    assert compute_st_lpips(image[: MIN_NETWORK_SIDE - 1], other[: MIN_NETWORK_SIDE - 1]) is None
    assert compute_st_lpips(image[:MIN_NETWORK_SIDE], other[:MIN_NETWORK_SIDE]) is not None
    assert f"{MIN_NETWORK_SIDE} pixels or more" in ABSENT_NOTES["st_lpips"]
    assert ST_LPIPS_PACKAGE not in sys.modules


def test_halving_keeps_a_constant_and_averages_nine_pixels():
    flat = torch.full((1, 2, 6, 9), 0.5)
    assert torch.allclose(halve_smoothly(flat), flat[:, :, :4, :6])
    point = torch.zeros(1, 1, 7, 7)
    point[..., 3, 3] = 16
    # Pixel i of the half is centred on pixel 2 i - 1.
    assert halve_smoothly(point)[0, 0, 2, 2] == 4


def test_without_the_package_there_is_no_score(monkeypatch):
    monkeypatch.setattr(st_lpips, "find_spec", lambda name: None)
    assert compute_st_lpips(*make_pair(32, 32)) is None
