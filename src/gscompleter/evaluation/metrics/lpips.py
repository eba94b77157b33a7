"""LPIPS, the learned perceptual distance of Zhang et al. (CVPR 2018), version 0.1.

    LPIPS = sum_l mean_{y,x} sum_c w_lc (f_lc(y, x) - g_lc(y, x))²

f and g are unit-length ImageNet features of the two images at five layers l, w the learned weights.
The modules are ours; parameters are named as in the files of torchvision (backbone) and of
github.com/richzhang/PerceptualSimilarity (w). Only files with the published SHA-256 are read.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float
from torch import Tensor, nn

from gscompleter.errors import InputError
from gscompleter.models.weights.fetching import WeightsNotAvailable
from gscompleter.models.weights.reading import check_kind, check_sha256, read_tensors

NetworkName = Literal["vgg", "alex"]

TORCHVISION = "https://download.pytorch.org/models/"
# The address names a commit, so its content cannot change.
LINEAR = (
    "https://raw.githubusercontent.com/richzhang/PerceptualSimilarity/"
    "082bb24f84c091ea94de2867d34c4544f68e0963/lpips/weights/v0.1/"
)


@dataclass(frozen=True)
class WeightsFile:
    """A published file of weights."""

    name: str
    site: str
    """Address without the name."""
    sha256: str

    @property
    def url(self) -> str:
        """Address of the file."""
        return self.site + self.name


@dataclass(frozen=True)
class Network:
    """A backbone and its files."""

    convolutions: tuple[tuple[int, int, int, int], ...]
    """Channels, kernel, stride and padding of each; a ReLU follows."""
    pooled: tuple[int, ...]
    """Convolutions before which the image is halved by max-pooling."""
    pool: int
    """Side of the pooling windows, in pixels."""
    taps: tuple[int, ...]
    """The five convolutions whose features are compared."""
    min_side: int
    """Smallest image side for which the last tap has a pixel."""
    backbone: WeightsFile
    linear: WeightsFile


# The names of the backbones contain the first digits of their SHA-256. Those of the linear weights
# are not published; several independent projects record the same values.
NETWORKS: dict[str, Network] = {
    "vgg": Network(
        tuple(
            (channels, 3, 1, 1)
            for channels, depth in ((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))
            for _ in range(depth)
        ),
        pooled=(2, 4, 7, 10),
        pool=2,
        taps=(1, 3, 6, 9, 12),
        min_side=16,
        backbone=WeightsFile(
            "vgg16-397923af.pth",
            TORCHVISION,
            "397923af8e79cdbb6a7127f12361acd7a2f83e06b05044ddf496e83de57a5bf0",
        ),
        linear=WeightsFile(
            "vgg.pth", LINEAR, "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868"
        ),
    ),
    "alex": Network(
        ((64, 11, 4, 2), (192, 5, 1, 2), (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)),
        pooled=(1, 2),
        pool=3,
        taps=(0, 1, 2, 3, 4),
        min_side=31,
        backbone=WeightsFile(
            "alexnet-owt-7be5be79.pth",
            TORCHVISION,
            "7be5be791159472b1fbf3c69796f7cb30dca7ad8466c2df70058c37116cdee02",
        ),
        linear=WeightsFile(
            "alex.pth", LINEAR, "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0"
        ),
    ),
}


class Lpips(nn.Module):
    """The metric as a module; `load_lpips` loads the published weights."""

    shift: Float[Tensor, "3 1 1"]
    scale: Float[Tensor, "3 1 1"]

    def __init__(self, network: Network) -> None:
        super().__init__()
        self.network = network
        self.taps: list[int] = []
        layers: list[nn.Module] = []  # numbered as in torchvision
        channels = 3
        for number, (out, kernel, stride, padding) in enumerate(network.convolutions):
            if number in network.pooled:
                layers.append(nn.MaxPool2d(network.pool, stride=2))
            layers += [nn.Conv2d(channels, out, kernel, stride, padding), nn.ReLU()]
            channels = out
            if number in network.taps:
                # w_l. The published names count a dropout layer, which is used in training only.
                model = nn.Sequential(nn.Identity(), nn.Conv2d(channels, 1, 1, bias=False))
                self.add_module(f"lin{len(self.taps)}", nn.ModuleDict({"model": model}))
                self.taps.append(len(layers) - 1)
        self.features = nn.Sequential(*layers)
        # ImageNet's mean and deviation, for colours in [-1, 1].
        statistics = {"shift": (-0.030, -0.088, -0.188), "scale": (0.458, 0.448, 0.450)}
        for name, values in statistics.items():
            self.register_buffer(name, torch.tensor(values)[:, None, None], persistent=False)

    def forward(
        self, image: Float[Tensor, "h w 3"], truth: Float[Tensor, "h w 3"]
    ) -> Float[Tensor, ""]:
        """Compute LPIPS of two images in [0, 1], with `image` clipped; 0 is best."""
        height, width = image.shape[:2]
        if min(height, width) < self.network.min_side:
            raise InputError(
                f"LPIPS needs images of at least {self.network.min_side} pixels per side, "
                f"got {height} x {width}."
            )
        both = (self.compute_unit_features(x) for x in (image.clamp(0, 1), truth))
        terms = [
            self.get_submodule(f"lin{i}.model")((a - b).square()).mean()
            for i, (a, b) in enumerate(zip(*both, strict=True))
        ]
        return torch.stack(terms).sum()

    def compute_unit_features(
        self, image: Float[Tensor, "h w 3"]
    ) -> list[Float[Tensor, "1 _ _ _"]]:
        """Compute features at the five taps, of unit length along the channels."""
        x = image.to(self.shift).permute(2, 0, 1) * 2 - 1
        x = ((x - self.shift) / self.scale)[None]
        found = []
        for number, layer in enumerate(self.features):
            x = layer(x)
            if number in self.taps:
                length = x.square().sum(dim=1, keepdim=True).sqrt()
                found.append(x / (length + 1e-10))
        return found


def load_lpips(
    network: NetworkName = "vgg", folder: Path | None = None, download: bool = True
) -> Lpips:
    """Load the metric with its published weights, without gradients.

    MVSplat and DepthSplat report VGG16; the authors recommend AlexNet for comparing images.

    Args:
        network: `vgg` or `alex`.
        folder: Folder of the two files, with their published names; None means torch.hub's cache.
        download: Download missing files to the cache (vgg: 530 MB, alex: 240 MB).

    Raises:
        WeightsNotAvailable: A file is missing and cannot be downloaded.
        InputError: A file is not the published one.
    """
    wanted = NETWORKS[network]
    weights: dict[str, Tensor] = {}
    for file in (wanted.backbone, wanted.linear):
        path = locate_weights(file, wanted, folder, download and folder is None)
        check_kind(path, file.name)
        check_sha256(path, file.sha256, file.name)
        weights |= read_tensors(path, file.name)
    metric = Lpips(wanted)
    # The file also holds the classifier, which the metric does not use.
    weights = {k: v for k, v in weights.items() if not k.startswith("classifier.")}
    try:
        metric.load_state_dict(weights, strict=True)
    except RuntimeError as error:
        raise InputError(
            f"The weights in {path.parent} do not fit the LPIPS network {network}: {error}"
        ) from error
    return metric.eval().requires_grad_(False)


def get_weights_path(file: WeightsFile, folder: Path | None) -> Path:
    """Return the expected path of a file, in `folder` or in the cache of torch.hub."""
    if folder is not None:
        return folder / file.name
    cache = "checkpoints" if file.site == TORCHVISION else "checkpoints/lpips_v0.1"
    return Path(torch.hub.get_dir()) / cache / file.name


def locate_weights(
    file: WeightsFile, network: Network, folder: Path | None, download: bool
) -> Path:
    """Return the path of a weights file, downloaded if needed and allowed."""
    path = get_weights_path(file, folder)
    if path.is_file():
        return path
    failure = ""
    if download:
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            # The hash is checked before the file gets its name.
            torch.hub.download_url_to_file(file.url, str(path), file.sha256, progress=False)
            return path
        except (OSError, RuntimeError) as error:
            failure = f" (the download failed: {error})"
    files = (network.backbone, network.linear)
    places = " and ".join(dict.fromkeys(str(get_weights_path(f, folder).parent) for f in files))
    needed = " and ".join(f.url for f in files)
    raise WeightsNotAvailable(f"LPIPS lacks {path.name}{failure}; put {needed} into {places}.")


load_cached_lpips = lru_cache(maxsize=2)(load_lpips)
"""`load_lpips` with a cache of two networks."""


@torch.no_grad()
def compute_lpips(
    image: Float[Tensor, "h w 3"],
    truth: Float[Tensor, "h w 3"],
    network: NetworkName = "vgg",
    folder: Path | None = None,
) -> float | None:
    """Compute LPIPS, or return None if the weights are not on this machine."""
    try:
        metric = load_cached_lpips(network, folder, download=False)
    except WeightsNotAvailable:
        return None
    return float(metric(image, truth).item())
