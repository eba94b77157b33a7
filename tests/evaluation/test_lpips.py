"""LPIPS, on random weights in the format of the published files."""

import hashlib
from dataclasses import replace
from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from gscompleter.errors import InputError
from gscompleter.evaluation.metrics import lpips as module
from gscompleter.evaluation.metrics.lpips import (
    NETWORKS,
    WeightsNotAvailable,
    compute_lpips,
    load_lpips,
)

# Written out by hand from the papers: (number in the file, in, out, kernel) of each convolution.
VGG = [(0, 3, 64), (2, 64, 64), (5, 64, 128), (7, 128, 128), (10, 128, 256), (12, 256, 256)]
VGG += [(14, 256, 256), (17, 256, 512), (19, 512, 512), (21, 512, 512), (24, 512, 512)]
VGG += [(26, 512, 512), (28, 512, 512)]
ALEX = [(0, 3, 64, 11), (3, 64, 192, 5), (6, 192, 384, 3), (8, 384, 256, 3), (10, 256, 256, 3)]
CHANNELS = {"vgg": (64, 128, 256, 512, 512), "alex": (64, 192, 384, 256, 256)}


def random_weights(network: str) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Make random backbone and linear weights, named as published, with a classifier."""
    generator = torch.Generator().manual_seed(3)
    shapes = [(*row, 3) for row in VGG] if network == "vgg" else ALEX
    backbone = {"classifier.6.bias": torch.zeros(1000)}
    for number, channels, out, kernel in shapes:
        size = (out, channels, kernel, kernel)
        deviation = (2 / (channels * kernel**2)) ** 0.5
        backbone[f"features.{number}.weight"] = torch.randn(size, generator=generator) * deviation
        backbone[f"features.{number}.bias"] = torch.randn(out, generator=generator) * 0.1
    linear = {
        f"lin{i}.model.1.weight": torch.rand(1, channels, 1, 1, generator=generator)
        for i, channels in enumerate(CHANNELS[network])
    }
    return backbone, linear


def publish(
    folder: Path, network: str, monkeypatch: pytest.MonkeyPatch, backbone: object, linear: object
) -> None:
    """Save the files under their published names and make their hashes the expected ones."""
    entry = NETWORKS[network]
    for field, content in (("backbone", backbone), ("linear", linear)):
        file = getattr(entry, field)
        path = folder / file.name
        torch.save(content, path)
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        entry = replace(entry, **{field: replace(file, sha256=digest)})
    monkeypatch.setitem(NETWORKS, network, entry)


@pytest.fixture(params=["vgg", "alex"])
def weights(
    request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[str, Path]:
    publish(tmp_path, request.param, monkeypatch, *random_weights(request.param))
    return request.param, tmp_path


def images(size: int = 40) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(0)
    return tuple(torch.rand(size, size + 7, 3, generator=generator) for _ in range(2))  # type: ignore[return-value]


def vgg_features(x: Tensor, w: dict[str, Tensor]) -> list[Tensor]:
    found = []
    for number, *_ in VGG:
        if number in (5, 10, 17, 24):
            x = F.max_pool2d(x, 2)
        x = F.conv2d(x, w[f"features.{number}.weight"], w[f"features.{number}.bias"], padding=1)
        x = x.clamp_min(0)
        if number in (2, 7, 14, 21, 28):
            found.append(x)
    return found


def alex_features(x: Tensor, w: dict[str, Tensor]) -> list[Tensor]:
    found = []
    for number, stride, padding in ((0, 4, 2), (3, 1, 2), (6, 1, 1), (8, 1, 1), (10, 1, 1)):
        if number in (3, 6):
            x = F.max_pool2d(x, 3, 2)
        x = F.conv2d(
            x, w[f"features.{number}.weight"], w[f"features.{number}.bias"], stride, padding
        ).clamp_min(0)
        found.append(x)
    return found


def recomputed(image: Tensor, truth: Tensor, network: str) -> float:
    """Compute LPIPS by its formula, in float64."""
    backbone, linear = (
        {k: v.double() for k, v in part.items()} for part in random_weights(network)
    )
    features = vgg_features if network == "vgg" else alex_features
    mean = torch.tensor([0.485, 0.456, 0.406]).double()
    deviation = torch.tensor([0.229, 0.224, 0.225]).double()
    sides = [
        features(((x.double() - mean) / deviation).permute(2, 0, 1)[None], backbone)
        for x in (image, truth)
    ]
    total = 0.0
    for i, (a, b) in enumerate(zip(*sides, strict=True)):
        a = a / torch.linalg.vector_norm(a, dim=1, keepdim=True)
        b = b / torch.linalg.vector_norm(b, dim=1, keepdim=True)
        w = linear[f"lin{i}.model.1.weight"].reshape(1, -1, 1, 1)
        total += (w * (a - b) ** 2).sum(dim=1).mean().item()
    return total


def test_lpips_is_its_formula(weights: tuple[str, Path]):
    network, folder = weights
    image, truth = images()
    value = load_lpips(network, folder)(image, truth).item()
    assert value > 0.1
    assert value == pytest.approx(recomputed(image, truth, network), rel=1e-4)


def test_equal_images_are_at_distance_zero_and_the_order_does_not_matter(
    weights: tuple[str, Path],
):
    metric = load_lpips(*weights)
    image, truth = images()
    assert metric(truth, truth).item() == 0.0
    assert metric(image, truth).item() == pytest.approx(metric(truth, image).item(), rel=1e-6)


def test_a_more_disturbed_image_is_farther_away(weights: tuple[str, Path]):
    metric = load_lpips(*weights)
    other, truth = images()
    values = [metric(truth.lerp(other, share), truth).item() for share in (0.0, 0.1, 0.3, 0.9)]
    assert values == sorted(values)


def test_the_image_is_clipped_as_it_is_shown(weights: tuple[str, Path]):
    metric = load_lpips(*weights)
    image, truth = images()
    bright = image * 1.5
    assert metric(bright, truth).item() == metric(bright.clamp(0, 1), truth).item()


@pytest.mark.parametrize("network", ["vgg", "alex"])
def test_the_smallest_image_is_as_small_as_stated(
    network: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    publish(tmp_path, network, monkeypatch, *random_weights(network))
    metric, side = load_lpips(network, tmp_path), NETWORKS[network].min_side
    small = torch.rand(side, side, 3, generator=torch.Generator().manual_seed(0))
    assert metric(small, 1 - small).isfinite()
    with pytest.raises(InputError, match=f"at least {side} pixels"):
        metric(small[1:], small[1:])


def test_missing_weights_are_named_with_their_place(tmp_path: Path):
    with pytest.raises(WeightsNotAvailable) as caught:
        load_lpips("vgg", tmp_path)
    sentence = caught.value.args[0]  # uncut, for the folder of a test may be long
    assert isinstance(caught.value, InputError)
    for part in ("vgg16-397923af.pth", "vgg.pth", str(tmp_path), "https://download.pytorch.org"):
        assert part in sentence


def test_a_failed_download_tells_where_the_files_belong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    def offline(*args: object, **kwargs: object) -> None:
        raise OSError("no connection")

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path))
    monkeypatch.setattr(torch.hub, "download_url_to_file", offline)
    with pytest.raises(WeightsNotAvailable, match="no connection.*alexnet-owt-7be5be79.pth"):
        load_lpips("alex")


def test_a_download_goes_to_the_cache_and_names_the_hash(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    source = tmp_path / "published"
    source.mkdir()
    publish(source, "alex", monkeypatch, *random_weights("alex"))
    fetched = []

    def fetch(url: str, path: str, sha256: str, progress: bool) -> None:
        fetched.append((url.rsplit("/", 1)[1], sha256))
        Path(path).write_bytes((source / url.rsplit("/", 1)[1]).read_bytes())

    monkeypatch.setattr(torch.hub, "get_dir", lambda: str(tmp_path / "hub"))
    monkeypatch.setattr(torch.hub, "download_url_to_file", fetch)
    load_lpips("alex")
    files = (NETWORKS["alex"].backbone, NETWORKS["alex"].linear)
    assert fetched == [(file.name, file.sha256) for file in files]
    load_lpips("alex", download=False)
    assert (tmp_path / "hub/checkpoints/lpips_v0.1/alex.pth").is_file()


def test_tables_get_a_reason_instead_of_a_number(tmp_path: Path):
    image, truth = images()
    assert compute_lpips(image, truth, "vgg", tmp_path) is None


def test_tables_get_the_number_where_there_are_weights(weights: tuple[str, Path]):
    image, truth = images()
    score = compute_lpips(image, truth, *weights)
    assert score == load_lpips(*weights)(image, truth).item()
    module.load_cached_lpips.cache_clear()


def test_another_file_under_the_name_is_refused(tmp_path: Path):
    for file in (NETWORKS["alex"].backbone, NETWORKS["alex"].linear):
        torch.save({}, tmp_path / file.name)
    with pytest.raises(InputError, match="not the published file") as caught:
        load_lpips("alex", tmp_path)
    assert not isinstance(caught.value, WeightsNotAvailable)


class Trap:
    """An object that plain unpickling would execute."""

    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (pytest.fail, ("code of the file was run",))


def test_pickled_objects_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    backbone, _ = random_weights("alex")
    publish(tmp_path, "alex", monkeypatch, backbone, {"lin0.model.1.weight": Trap()})
    with pytest.raises(InputError, match="holds Python objects"):
        load_lpips("alex", tmp_path)


def test_weights_of_another_network_do_not_fit(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    backbone, linear = random_weights("alex")
    del backbone["features.6.bias"]
    publish(tmp_path, "alex", monkeypatch, backbone, linear)
    with pytest.raises(InputError, match="do not fit"):
        load_lpips("alex", tmp_path)


def test_the_published_backbones_carry_their_hash_in_their_names():
    for network in NETWORKS.values():
        assert network.backbone.name.endswith(f"-{network.backbone.sha256[:8]}.pth")
        assert network.backbone.url.endswith(network.backbone.name)
        assert network.linear.url.endswith(network.linear.name)
