"""Published weights of learned models in single files (no torch, so it imports fast).

Names, digits and licences are those of the authors' pages; no file was downloaded to verify them.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Literal

UNSTATED = "not stated"
UNLICENSED = "no licence is stated for the file"


@dataclass(frozen=True, kw_only=True)
class PublishedWeights:
    """A published weight file."""

    name: str
    """Our name: model, size, training data, and the image size unless it is 256x256."""
    model: str
    """Name that the authors gave their model."""
    network: str | None
    """Configuration that fits the tensors, or None if unknown."""
    repository: str | None
    """Repository on the Hugging Face hub, or None if the file is elsewhere."""
    revision: str | None = "main"
    """Commit of the repository; `main` if unknown, which is not pinned."""
    file: str
    sha256: str | None = None
    """SHA-256 of the file, or its published leading hex digits; None if unpublished."""
    megabytes: int | None = None
    """Size of the file in MB, if known."""
    parameters: int | None
    """Number of parameters, rounded to millions if taken from the authors."""
    views: tuple[int, int]
    """Smallest and largest number of views in training."""
    image_size: tuple[int, int] = (256, 256)
    """Height and width of the images in training, in pixels."""
    near_far: tuple[float, float] | None
    """Depth range of the authors' evaluation in scene units, if known."""
    code: str
    """URL of the authors' code."""
    code_licence: str = "MIT"
    """Licence of that code; ours is independent of it."""
    weights_licence: str = UNSTATED
    """Licence of the file, or `not stated`."""
    caution: str = UNLICENSED
    """Reason why commercial use is unclear; empty if the licence allows it."""
    source: str
    """URL of the authors' download page."""
    entry: str = "state_dict"
    """Entry of the file with the tensors, unless they are at the top level."""
    prefix: str = "encoder."
    """Prefix of the network's tensor names in the file."""
    gives: Literal["Gaussians", "scene depth", "monocular depth", "depth", "image"] = "Gaussians"
    """Output of the network; `scene depth` is converted to Gaussians, `monocular depth` supports
    stereo, `depth` is not supported, and an `image` is that of a generator."""

    @property
    def url(self) -> str:
        """URL of the file, or of the page that offers it."""
        if self.repository is None:
            return self.source
        return f"https://huggingface.co/{self.repository}/resolve/{self.revision}/{self.file}"

    @property
    def is_reconstructor(self) -> bool:
        """True if the network is known and yields Gaussians, directly or from depth."""
        return self.gives in ("Gaussians", "scene depth") and self.network is not None

    @property
    def integrity_check(self) -> str:
        """Description of the check that the file is the published one."""
        if self.sha256 is None:
            return "nothing"
        digits = len(self.sha256)
        return "SHA-256" if digits == 64 else f"first {digits} digits of SHA-256"

    @property
    def size(self) -> str:
        """Size of the file as text; if unknown, at least 4 bytes per parameter."""
        if self.megabytes is not None:
            return f"{self.megabytes} MB"
        return "?" if self.parameters is None else f">= {self.parameters * 4 // 10**6} MB"


FROM_DEPTH_ANYTHING = "training started from Depth Anything V2 {}, which is CC BY-NC 4.0"
FROM_BASE = FROM_DEPTH_ANYTHING.format("Base")
FROM_LARGE = FROM_DEPTH_ANYTHING.format("Large")
NON_COMMERCIAL = "the licence of the file, CC BY-NC 4.0, allows non-commercial use only"
ON_DL3DV = "trained on DL3DV-10K, whose terms allow non-commercial research only"
ON_DEPTH_DATA = f"{ON_DL3DV}, and on ScanNet, TartanAir and VKITTI2, which have their own terms"

MVSPLAT = PublishedWeights(
    name="mvsplat-re10k",
    model="MVSplat",
    network="mvsplat",
    repository=None,
    revision=None,
    file="re10k.ckpt",
    megabytes=48,
    parameters=11_955_734,
    views=(2, 2),
    near_far=(1.0, 100.0),
    code="https://github.com/donydchen/mvsplat",
    source="https://drive.google.com/drive/folders/14_E_5R6ojOWnLSrSVLVEMHnTiKsfddjU",
)

VOLSPLAT = PublishedWeights(
    name="volsplat-re10k",
    model="VolSplat",
    network="volsplat",
    repository="lhmd/VolSplat",
    file="volsplat-re10k-256x256.ckpt",
    parameters=137_998_741,
    views=(6, 6),
    near_far=(0.5, 100.0),
    code="https://github.com/ziplab/VolSplat",
    weights_licence="MIT",
    caution=FROM_BASE,
    source="https://huggingface.co/lhmd/VolSplat",
)

PARAMETERS = {
    "small-s1-u4-l4": 38_346_416,
    "small-s1-u8-l8": 38_404_880,
    "base-s2-u2-l4": 120_747_896,
    "base-s2-u4-l8": 120_877_016,
    "large-s2-u2-l4": 354_337_760,
    "depth-base-s2-u4-l8": 111_229_753,
}
"""Number of parameters by configuration: ViT size, number of scales, upsampling factor, and full
resolution over that of the coarsest features."""


def _create_depthsplat(
    file: str, configuration: str, caution: str = "", far: float = 100.0
) -> PublishedWeights:
    """Parse the name of a DepthSplat file: model, image size, view range, start of its SHA-256."""
    # An example is depthsplat-gs-base-dl3dv-256x448-randview2-6-02c7b19d.pth.
    parts = re.fullmatch(r"(.+-(\d+)x(\d+))-\w*view(\d+)(?:-(\d+))?-([0-9a-f]{8})\.pth", file)
    assert parts is not None, file
    stem, height, width, fewest, most, digits = parts.groups()
    return PublishedWeights(
        name=stem.replace("-gs-", "-").removesuffix("-256x256"),
        model="DepthSplat",
        network=f"depthsplat-{configuration}",
        repository="haofeixu/depthsplat",
        file=file,
        sha256=digits,
        parameters=PARAMETERS.get(configuration),
        views=(int(fewest), int(most or fewest)),
        image_size=(int(height), int(width)),
        near_far=(0.5, far),
        code="https://github.com/cvg/depthsplat",
        weights_licence="MIT",
        caution=caution,
        source="https://huggingface.co/haofeixu/depthsplat",
    )


def _create_depth_anything(
    name: str, repository: str, parameters: int, caution: str = NON_COMMERCIAL, **others: Any
) -> PublishedWeights:
    return PublishedWeights(
        name=name,
        model=repository,
        network=name,
        repository=f"depth-anything/{repository}",
        file="model.safetensors",
        parameters=parameters,
        image_size=(504, 504),
        near_far=None,
        code="https://github.com/ByteDance-Seed/Depth-Anything-3",
        code_licence="Apache-2.0",
        weights_licence="CC BY-NC 4.0" if caution else "Apache-2.0",
        caution=caution,
        source=f"https://huggingface.co/depth-anything/{repository}",
        prefix="model.",
        **{"views": (2, 18), **others},
    )


def _create_retrained(weights: PublishedWeights, **others: Any) -> PublishedWeights:
    """Create the entry of a baseline that VolSplat's authors retrained and published."""
    return replace(
        weights,
        repository=VOLSPLAT.repository,
        revision=VOLSPLAT.revision,
        sha256=None,
        megabytes=None,
        views=VOLSPLAT.views,
        near_far=None,
        weights_licence=VOLSPLAT.weights_licence,
        source=VOLSPLAT.source,
        **{"caution": "", **others},
    )


DEPTHSPLAT = _create_depthsplat(
    "depthsplat-gs-small-re10k-256x256-view2-cfeab6b1.pth", "small-s1-u4-l4"
)
DEPTH_ALONE: dict[str, Any] = {"near_far": None, "entry": "model", "prefix": "", "gives": "depth"}


def _create_onnx(repository: str, licence: str, **others: Any) -> PublishedWeights:
    """Create the entry of an ONNX file, whose licence allows commercial use."""
    return PublishedWeights(
        network=None,
        repository=repository,
        views=(1, 1),
        near_far=None,
        code_licence=licence,
        weights_licence=licence,
        caution="",
        source=f"https://huggingface.co/{repository}",
        **others,
    )


def _create_inpainting(
    model: str, repository: str, licence: str, **others: Any
) -> PublishedWeights:
    """Create the entry of a generator that fills holes."""
    name = model.lower().replace("-", "")
    entries = {"name": name, "model": model, "parameters": None, "gives": "image", **others}
    return _create_onnx(repository, licence, image_size=(512, 512), **entries)


def _create_moge(name: str, size: str, **others: Any) -> PublishedWeights:
    """Create the entry of a size of MoGe-2, as its authors exported it."""
    return _create_onnx(
        f"Ruicheng/moge-2-{size}-normal-onnx",
        "MIT",
        name=name,
        model=name.replace("moge", "MoGe"),
        file="model.onnx",
        image_size=(518, 518),
        code="https://github.com/microsoft/MoGe",
        gives="monocular depth",
        **others,
    )


MIGAN = _create_inpainting(
    "MI-GAN",
    "andraniksargsyan/migan",
    "MIT",
    revision="406830d0fa60666da0071c342ad2fbc8f30c5c64",
    file="migan_pipeline_v2.onnx",
    sha256="6f1f3530a1a2324b19752018ce756088b07973cda8d7d890034ace5c8a48c40b",
    megabytes=28,
    code="https://github.com/Picsart-AI-Research/MI-GAN",
)
LAMA = _create_inpainting(
    "LaMa",
    "Carve/LaMa-ONNX",
    "Apache-2.0",
    revision="c3c0c9e468934d62e79c329e35d82dd09ff8c444",
    file="lama_fp32.onnx",
    sha256="1faef5301d78db7dda502fe59966957ec4b79dd64e16f03ed96913c7a4eb68d6",
    megabytes=208,
    code="https://github.com/advimman/lama",
)

_FILES = (
    MVSPLAT,
    replace(MVSPLAT, name="mvsplat-acid", file="acid.ckpt"),
    # Its tensor names are not known.
    _create_retrained(
        MVSPLAT, name="mvsplat-re10k-6view", file="mvsplat-re10k-baseline-256x256.ckpt"
    ),
    DEPTHSPLAT,
    _create_depthsplat(
        "depthsplat-gs-base-re10k-256x256-view2-ca7b6795.pth", "base-s2-u2-l4", FROM_BASE
    ),
    _create_depthsplat(
        "depthsplat-gs-large-re10k-256x256-view2-e0f0f27a.pth", "large-s2-u2-l4", FROM_LARGE
    ),
    _create_depthsplat(
        "depthsplat-gs-base-re10k-256x448-view2-fea94f65.pth", "base-s2-u4-l8", FROM_BASE
    ),
    _create_depthsplat(
        "depthsplat-gs-base-dl3dv-256x448-randview2-6-02c7b19d.pth",
        "base-s2-u4-l8",
        f"{ON_DL3DV}; {FROM_BASE}",
        far=200.0,
    ),
    _create_depthsplat(
        "depthsplat-gs-small-re10kdl3dv-448x768-randview4-10-c08188db.pth",
        "small-s1-u8-l8",
        ON_DL3DV,
        far=200.0,
    ),
    _create_depthsplat(
        "depthsplat-gs-base-re10kdl3dv-448x768-randview2-6-f8ddd845.pth",
        "base-s2-u4-l8",
        f"{ON_DL3DV}; {FROM_BASE}",
        far=200.0,
    ),
    # Its size is not published.
    _create_retrained(
        DEPTHSPLAT,
        name="depthsplat-re10k-6view",
        network=None,
        file="depthsplat-re10k-baseline-256x256.ckpt",
        parameters=None,
        caution=f"if its size is Base, {FROM_BASE}",
    ),
    # Its upsampling is not published.
    replace(
        _create_depthsplat(
            "depthsplat-depth-small-352x640-randview2-8-e807bd82.pth", "", ON_DEPTH_DATA
        ),
        network=None,
        parameters=36_000_000,
        **DEPTH_ALONE,
    ),
    replace(
        _create_depthsplat(
            "depthsplat-depth-base-352x640-randview2-8-65a892c5.pth",
            "depth-base-s2-u4-l8",
            f"{ON_DEPTH_DATA}; {FROM_BASE}",
        ),
        **DEPTH_ALONE,
    ),
    VOLSPLAT,
    _create_depth_anything(
        "da3-small",
        "DA3-SMALL",
        34_299_463,
        "",
        revision="e08cab65ca0ec38e7826075418411ab90cab4da3",
        sha256="364492e38a3a06d221ac75da7f6621ada3f2361cd24fde11ba79091e9f40efcf",
        gives="scene depth",
    ),
    _create_depth_anything("da3-base", "DA3-BASE", 135_366_599, "", gives="scene depth"),
    _create_depth_anything("da3-large", "DA3-LARGE-1.1", 410_941_767, gives="scene depth"),
    _create_depth_anything("da3-giant", "DA3-GIANT-1.1", 1_355_674_125),
    _create_depth_anything(
        "da3-metric-large",
        "DA3METRIC-LARGE",
        334_171_394,
        "",
        views=(1, 1),
        gives="scene depth",
    ),
    _create_depth_anything(
        "da3-mono-large",
        "DA3MONO-LARGE",
        334_171_394,
        "",
        views=(1, 1),
        gives="monocular depth",
    ),
    _create_depth_anything("da3-nested-giant-large", "DA3NESTED-GIANT-LARGE-1.1", 1_689_845_519),
    MIGAN,
    LAMA,
    _create_moge(
        "moge-2",
        "vits",
        revision="e50ffda41565591092adea54c6ac83d6212e1e23",
        sha256="24eacb5dc7a2c54c7bc98f7de085ffbed79ad006ea5b664c2c2cdc02ff3a52f0",
        megabytes=141,
        parameters=35_000_000,
    ),
    _create_moge(
        "moge-2-base",
        "vitb",
        sha256="bbf14e07a30f11e69d36ab861590123f5598ababcbc8946a063eb4a966f35a21",
        megabytes=419,
        parameters=104_000_000,
    ),
    _create_moge(
        "moge-2-large",
        "vitl",
        sha256="afbc4ccc3450298f3afb35b90f015f4c4f552dea21dc6470d5f7b78b77e2d751",
        megabytes=1324,
        parameters=331_000_000,
    ),
)

PUBLISHED: dict[str, PublishedWeights] = {weights.name: weights for weights in _FILES}
