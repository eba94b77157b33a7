"""What the stages exchange.

Conventions, the same everywhere: OpenCV axes (x right, y down, z forward); `c2w` takes camera
coordinates to world coordinates; intrinsics are in pixels and the centre of the top-left pixel
is (0.5, 0.5); images are [h, w, 3] in [0, 1]; `depth` is z-depth in scene units and `distance`
the Euclidean length along a unit ray; quaternions are wxyz; scales are linear, opacities lie in
[0, 1] and spherical harmonics are [n, k, 3] in the basis of 3DGS.

Values are frozen: a stage returns new ones and writes to none it was given.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal, TypeVar

import torch
from jaxtyping import Bool, Float, Int, Int64, Shaped, UInt8
from torch import Tensor

from gscompleter.coverage import COVERED
from gscompleter.errors import InputError

SH_C0 = 0.28209479177387814
"""The constant spherical harmonic: colour = 0.5 + SH_C0 * sh[:, 0]."""

MAX_RIGID_ERROR = 1e-3
"""Largest entry of RᵀR - I that still counts as rounding of a rotation R."""

M = TypeVar("M", bound="Movable")


@dataclass(frozen=True)
class Movable:
    """What holds tensors, or other such values, that lie on one device together."""

    def to(self: M, device: torch.device | str) -> M:
        """The same on `device`."""
        parts = {n: part for n, part in vars(self).items() if isinstance(part, (Tensor, Movable))}
        return replace(self, **{name: part.to(device) for name, part in parts.items()})


@dataclass(frozen=True)
class Camera(Movable):
    """A pinhole camera with OpenCV axes: x right, y down, z forward."""

    c2w: Float[Tensor, "4 4"]
    """Camera-to-world transform. Its last column is the camera centre."""
    K: Float[Tensor, "3 3"]
    """Intrinsics in pixels. The centre of the top-left pixel is (0.5, 0.5)."""
    width: int
    height: int
    near: float | None = None
    """Smallest z-depth of the scene, in scene units; None where it is not known."""
    far: float | None = None
    """Largest z-depth of the scene, in scene units; None where it is not known."""

    def __post_init__(self) -> None:
        """Raise InputError if no camera is like that; values that lie on a GPU stay unread."""
        defect = _planes_defect(self.near, self.far) or (
            _pose_defect(self.c2w) or _intrinsics_defect(self.K, self.width, self.height)
        )
        if defect is not None:
            raise InputError(f"There is no such camera: {defect}.")

    @property
    def center(self) -> Float[Tensor, "3"]:
        """Camera centre in world coordinates."""
        return self.c2w[:3, 3]

    @property
    def forward(self) -> Float[Tensor, "3"]:
        """Unit viewing direction (the z axis) in world coordinates."""
        return self.c2w[:3, 2]

    @property
    def viewmat(self) -> Float[Tensor, "4 4"]:
        """World-to-camera transform, for the rasteriser's door only."""
        return torch.linalg.inv(self.c2w.double()).to(self.c2w.dtype)

    @property
    def near_plane(self) -> float:
        """z-depth in front of which no Gaussian is drawn: a hundredth of `near`, else 0.01.

        It follows the unit of the scene wherever `near` is known, so that a scene in
        millimetres and the same scene in kilometres give the same image.
        """
        return 0.01 * self.near if self.near is not None else 0.01

    def rays(self) -> Float[Tensor, "h w 3"]:
        """Unit directions through the pixel centres, in world axes."""
        return torch.nn.functional.normalize(self.z_rays(), dim=-1)

    def z_rays(self) -> Float[Tensor, "h w 3"]:
        """Directions through the pixel centres, in world axes, of unit z in the camera.

        A point at z-depth `depth` is `center + depth * z_ray`.
        """
        x = torch.arange(self.width, device=self.K.device, dtype=self.K.dtype) + 0.5
        y = torch.arange(self.height, device=self.K.device, dtype=self.K.dtype) + 0.5
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        pixels = torch.nn.functional.pad(pixels, (0, 1), value=1.0)
        return pixels @ torch.linalg.inv(self.K).T @ self.c2w[:3, :3].T


def _planes_defect(near: float | None, far: float | None) -> str | None:
    """Find what makes depth planes impossible; None if nothing does."""
    for name, plane in (("near", near), ("far", far)):
        if plane is not None and not 0 < plane < math.inf:
            return f"its {name} plane is at {plane:g}, and a positive z-depth is needed"
    if near is not None and far is not None and near >= far:
        return f"its near plane at {near:g} is not before its far plane at {far:g}"
    return None


def _pose_defect(c2w: Float[Tensor, "4 4"]) -> str | None:
    """Find what makes a pose impossible; None if nothing does. Plain floats are the fastest way."""
    if not isinstance(c2w, Tensor) or c2w.shape != (4, 4) or not c2w.is_floating_point():
        return "its pose is no tensor of 4 × 4 floats"
    if c2w.device.type != "cpu":
        return None
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = c2w.tolist()
    if not math.isfinite(a + b + c + d + e + f + g + h + i + x + y + z):
        return "its pose holds NaN or infinity"
    lengths = (a * a + d * d + g * g, b * b + e * e + h * h, c * c + f * f + i * i)
    angles = (a * b + d * e + g * h, a * c + d * f + g * i, b * c + e * f + h * i)
    errors = (*(length - 1 for length in lengths), *angles, *last[:3], last[3] - 1)
    if not max(map(abs, errors)) <= MAX_RIGID_ERROR:
        return "its pose is no rotation and translation but scaled, sheared or projective"
    if a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) < 0:
        return "its pose is left-handed; mirror one of its axes"
    return None


def _intrinsics_defect(K: Float[Tensor, "3 3"], width: int, height: int) -> str | None:
    """Find what makes intrinsics impossible; None if nothing does."""
    if not isinstance(K, Tensor) or K.shape != (3, 3) or not K.is_floating_point():
        return "its K is no tensor of 3 × 3 floats"
    if width < 1 or height < 1:
        return f"its image has {width} × {height} pixels"
    if K.device.type != "cpu":
        return None
    (fx, skew, cx), (_, fy, cy), _ = K.tolist()
    if not (fx > 0 and fy > 0 and math.isfinite(fx + fy + cx + cy + skew)):
        return f"its focal lengths are {fx:g} and {fy:g}, its centre is ({cx:g}, {cy:g})"
    return None


@dataclass(frozen=True)
class Window:
    """A target camera, and the wider one that it is completed with."""

    target: Camera
    wide: Camera
    """The same camera with more pixels on every side; its rays through the old ones stay."""
    left: int
    """Pixels that were added on the left, and on the right."""
    top: int
    """Pixels that were added at the top, and at the bottom."""

    def crop(self, image: Shaped[Tensor, "wide_h wide_w *c"]) -> Shaped[Tensor, "h w *c"]:
        """The part of an image of `wide` that `target` sees."""
        rows = slice(self.top, self.top + self.target.height)
        return image[rows, self.left : self.left + self.target.width]


@dataclass(frozen=True)
class View(Movable):
    """A photograph (or a synthesized image) and the camera that took it."""

    image: Float[Tensor, "h w 3"]
    camera: Camera
    frame: int | None = None
    """Number of the frame in its scene; None for a view that is not one of its frames."""
    depth: Float[Tensor, "h w"] | None = None
    """Measured z-depth in scene units, 0 where unknown. For scoring: no stage reads it."""
    ignored: Bool[Tensor, "h w"] | None = None
    """True where the photograph is to be ignored, such as where something moves: nothing is made of
    it there, and nothing compared with it. None where all of it counts."""
    contradicted: Bool[Tensor, "h w"] | None = None
    """True where other photographs show something else in its place, so that something moved: what
    is completed takes nothing from there. None where that was not asked."""

    def __post_init__(self) -> None:
        """Raise InputError if the image, or a map of it, has another size than the camera."""
        size = self.camera.height, self.camera.width
        image = self.image
        if (
            not isinstance(image, Tensor)
            or image.shape[2:] != (3,)
            or not image.is_floating_point()
        ):
            raise InputError(
                "The image of a view is no tensor of floats of shape [h, w, 3]; convert it."
            )
        for name in ("image", "depth", "ignored", "contradicted"):
            pixels = getattr(self, name)
            if pixels is not None and tuple(pixels.shape[:2]) != size:
                raise InputError(
                    f"The {name} of a view has the shape {list(pixels.shape)}, and its camera has "
                    f"{size[0]} × {size[1]} pixels (height × width); resize one of them."
                )

    @property
    def counted(self) -> Bool[Tensor, "h w"]:
        """True where the photograph is not to be ignored."""
        everywhere = torch.ones_like(self.image[..., 0], dtype=torch.bool)
        return everywhere if self.ignored is None else ~self.ignored

    @property
    def trusted(self) -> Bool[Tensor, "h w"]:
        """True where what is completed may follow the photograph."""
        return self.counted if self.contradicted is None else self.counted & ~self.contradicted

    def compared(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """`image` as it is held against the photograph: the same as this where it is ignored."""
        if self.ignored is None:
            return image
        return torch.where(self.ignored[..., None], self.image, image)

    def evened(self, gain: Float[Tensor, "3"]) -> View:
        """The same in an exposure that this one is brighter than by `gain`, channel by channel."""
        return replace(self, image=(self.image / gain).clamp(0, 1))


@dataclass(frozen=True)
class Gaussians(Movable):
    """A set of n 3D Gaussians in the world frame, with their provenance."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """Rotations as wxyz quaternions, of any length but zero."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the rotated axes, in scene units (linear)."""
    opacities: Float[Tensor, "n"]
    sh: Float[Tensor, "n k 3"]
    """Spherical harmonics; k is 1, 4, 9 or 16 for degree 0 to 3."""
    generated: UInt8[Tensor, "n"]
    """0 where observed, else the 1-based number of the target that created the Gaussian."""
    encoded: Float[Tensor, "n 4"] | None = None
    """Log-scales and logit opacity as the file held them, where these came from a file.

    Exponential and logarithm are not exact inverses in float32. Writing uses these values
    wherever they still stand for `scales` and `opacities`, which makes round trips exact.
    """
    is_antialiased: bool = False
    """True for Gaussians that were made for antialiased rendering (Mip-Splatting): a renderer then
    multiplies each opacity by `sqrt(det S / det(S + 0.3 I))`, S the covariance in the image in px².
    """

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        """The Gaussians at `index`: a boolean mask [n], integers [m] or a slice."""
        tensors: dict[str, Any] = {n: p for n, p in vars(self).items() if isinstance(p, Tensor)}
        if isinstance(index, Tensor) and index.dtype == torch.int64:
            index = index.to(self.means.device)  # in the way that is twice as fast as indexing
            return replace(self, **{n: part.index_select(0, index) for n, part in tensors.items()})
        return replace(self, **{n: part[index] for n, part in tensors.items()})

    @property
    def sh_degree(self) -> int:
        return {1: 0, 4: 1, 9: 2, 16: 3}[self.sh.shape[1]]


def observed(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    sh: Float[Tensor, "n k 3"],
) -> Gaussians:
    """Gaussians whose provenance is a photograph."""
    generated = torch.zeros(len(means), dtype=torch.uint8, device=means.device)
    return Gaussians(means, quats, scales, opacities, sh, generated)


def merge(parts: Sequence[Gaussians]) -> Gaussians:
    """All Gaussians of `parts`, in order, each with its provenance.

    Spherical harmonics of a lower degree are padded with zeros, which changes no colour.

    Raises:
        ValueError: no parts, or antialiased ones among others: no renderer draws both alike.
    """
    if not parts:
        raise ValueError("merge needs at least one set of Gaussians, got none")
    if len({part.is_antialiased for part in parts}) > 1:
        raise ValueError("antialiased Gaussians cannot be merged with others")
    k = max(part.sh.shape[1] for part in parts)
    sh = [torch.nn.functional.pad(part.sh, (0, 0, 0, k - part.sh.shape[1])) for part in parts]
    unknown = float("nan")  # equal to nothing: the writer encodes these anew
    encoded = [
        part.means.new_full((len(part), 4), unknown) if part.encoded is None else part.encoded
        for part in parts
    ]
    return Gaussians(
        torch.cat([part.means for part in parts]),
        torch.cat([part.quats for part in parts]),
        torch.cat([part.scales for part in parts]),
        torch.cat([part.opacities for part in parts]),
        torch.cat(sh),
        torch.cat([part.generated for part in parts]),
        torch.cat(encoded) if any(part.encoded is not None for part in parts) else None,
        parts[0].is_antialiased,
    )


def sh_from_rgb(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Degree-0 spherical harmonics that show `rgb` from everywhere."""
    return ((rgb - 0.5) / SH_C0)[:, None]


@dataclass(frozen=True)
class Render:
    """What a camera sees of a set of Gaussians, over black."""

    image: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]
    """z-depth, sum(w z) / sum(w) over the compositing weights w; 0 where nothing is seen."""
    alpha: Float[Tensor, "h w"]
    """Accumulated opacity, sum(w)."""

    def cropped(self, window: Window) -> Render:
        """What the target of `window` sees of a render of its wide camera."""
        return Render(window.crop(self.image), window.crop(self.depth), window.crop(self.alpha))

    def depth_map(self, min_alpha: float = COVERED) -> DepthMap:
        """The depth, valid where the Gaussians cover at least `min_alpha` of the pixel."""
        return DepthMap(self.depth, self.alpha >= min_alpha)


@dataclass(frozen=True)
class DepthMap:
    """z-depth per pixel and where it can be trusted."""

    depth: Float[Tensor, "h w"]
    valid: Bool[Tensor, "h w"]
    confidence: Float[Tensor, "h w"] | None = None
    """How sure the model is of it, in [0, 1]; None where the model does not tell."""


@dataclass(frozen=True)
class Reconstruction:
    """What a reconstructor Ψ makes of its views: Gaussians and a depth map per view.

    All of its tensors lie on the device of the views' images, the indices too.
    """

    gaussians: Gaussians
    depths: tuple[DepthMap, ...]
    """One per view, in the order of the views."""
    view_index: Int[Tensor, "n"] | None = None
    """For pixel-aligned models, the view each Gaussian came from; None for others."""
    pixel_index: Int[Tensor, "n"] | None = None
    """For pixel-aligned models, the row-major pixel of that view; None for others."""
    gains: Float[Tensor, "v 3"] | None = None
    """By how much each view is brighter than the Gaussians, which have one exposure, by channel;
    None where exposures were not evened out."""


@dataclass(frozen=True)
class InitialContext:
    """The context scene of stage 1 with the photographs that it was reconstructed from."""

    gaussians: Gaussians
    views: tuple[View, ...]
    """The photographs with the depth range of the scene, in the exposure of `gaussians`."""
    gains: Float[Tensor, "v 3"] | None = None
    """Exposure of each original photograph relative to `gaussians`, by channel; None where Ψ did
    not normalize exposures."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Wall time by stage."""


@dataclass(frozen=True)
class SceneContext:
    """What is known of the scene when a generator Φ is asked for an unseen image."""

    views: tuple[View, ...]
    """The photographs."""
    at_views: tuple[Render, ...]
    """The context scene rendered at the cameras of `views`, in their order."""
    at_target: Render
    """The context scene rendered at the target camera."""
    max_alpha: float = COVERED
    """A pixel of the target that the scene covers by less is a hole."""
    correct_color: bool = True
    """True if a Φ with weights adapts its colours to those of the photographs."""
    source_depth: Literal["context", "monocular"] = "context"
    """Source of the photograph's depth for PE-Field, unless its own settings name one."""
    believed: Float[Tensor, "h w"] | None = None
    """The alpha of the scene at the target as far as photographs support it; None where it is not
    doubted."""

    @property
    def holes(self) -> Bool[Tensor, "h w"]:
        """Where the scene has a hole at the target, which is for Φ to fill."""
        alpha = self.at_target.alpha if self.believed is None else self.believed
        return alpha < self.max_alpha


@dataclass(frozen=True)
class Lift:
    """The synthesized image lifted to 3D by stereo with the anchor (paper, Sec. III-D)."""

    gaussians: Gaussians
    """Candidates: the Gaussians of the reference image only, in the world frame."""
    reference_depth: DepthMap
    anchor_depth: DepthMap
    pixel_index: Int[Tensor, "n"] | None
    """The row-major pixel of the reference each candidate came from, where known."""


@dataclass(frozen=True)
class DepthAffine:
    """`context depth = scale * predicted depth + shift`, on z-depth (paper, Eq. 8)."""

    scale: float = 1.0
    shift: float = 0.0
    inliers: float = 0.0
    """Share of the compared pixels that agree with the fit."""
    method: Literal["ransac", "median", "identity"] = "identity"
    """How the fit was found; the later ones are the fallbacks of the earlier."""
    agreement: float | None = None
    """Share of what the target sees of the scene that agrees with it; None where that was not
    asked, or too little was seen."""
    contradicted: bool = False
    """True where what the target sees of the scene took the place of what the anchor sees."""
    refuted: bool = False
    """True where what the target sees agrees neither with it nor with any other."""


@dataclass(frozen=True)
class DepthPairs:
    """Depths that an affine was fitted to, or as many of them as show how well it fits."""

    seen_from: Literal["anchor", "target"]
    """The camera at which they were compared."""
    predicted: Float[Tensor, "n"]
    """z-depth as it was lifted, in scene units."""
    context: Float[Tensor, "n"]
    """z-depth of the scene, in scene units."""
    agrees: Bool[Tensor, "n"]
    """Whether the affine brings the one to the other."""


@dataclass(frozen=True)
class TargetCompletion:
    """What happened at one target, kept for inspection."""

    target: Camera
    before: Render
    """The scene as it was, seen from the target."""
    after: Render
    hole_mask: Bool[Tensor, "h w"]
    """True where the scene had a hole, before dilation."""
    reference: View | None
    """The synthesized view; None where there was nothing to complete."""
    anchor: int
    """Index of the anchor among the context views."""
    anchor_fallback: bool
    """True where every view was turned too far and the least-turned one was taken."""
    affine: DepthAffine
    added: Gaussians
    losses: Mapping[str, Sequence[float]] = field(default_factory=dict)
    """Loss per iteration of the two optimisations, `register` and `refine`."""
    registered: Gaussians | None = None
    """All that was lifted, as it was registered, before the hole mask filters it; None where it was
    not kept (`GSCompleter.keep_registered`) or nothing was lifted."""
    notes: tuple[str, ...] = ()
    """Fallbacks that were taken, a sentence each."""
    support: Float[Tensor, "h w"] | None = None
    """How far photographs supported what the target saw of a scene that was brought, in [0, 1];
    None where it was not doubted."""
    pairs: DepthPairs | None = None
    """Of what the affine was fitted to; None where nothing was compared."""
    refused: str | None = None
    """Why the target cannot be completed, a sentence; None where it can."""

    @property
    def hole_fraction(self) -> float:
        return self.hole_mask.float().mean().item()


@dataclass(frozen=True)
class Proxy:
    """A scene of n Gaussians drawn with m, each of which stands for a run of neighbours."""

    scene: Gaussians
    """The m Gaussians."""
    run: Int64[Tensor, "n"]
    """Which of them stands for each of the n."""


@dataclass(frozen=True)
class Evidence:
    """What k photographs show of each of the m Gaussians that a scene that was brought is drawn
    with."""

    means: Float[Tensor, "m 3"]
    """Where the Gaussians lie, in world coordinates."""
    centers: Float[Tensor, "k 3"]
    """Where the photographs were taken, in world coordinates."""
    areas: Float[Tensor, "k m"]
    """How much of each Gaussian each photograph shows, in squared scene units."""
    agreement: Float[Tensor, "k m"]
    """How far the scene looks there as the photograph does, in [0, 1]; 0 where it shows nothing."""


@dataclass(frozen=True)
class ErrorBudget:
    """Largest error that the render of a photograph may have, whatever is added."""

    view: View
    """The photograph; what it ignores does not count."""
    metric: Literal["mse", "dssim"]
    """Mean squared error, or 1 - SSIM."""
    limit: float
    """Largest error."""


@dataclass(frozen=True)
class Completion:
    """A scene on its way to completion: what `GSCompleter` begins with and what a step leads to.

    A step gives a new value and leaves this one as it is, so that undo is to go on from the former.
    """

    drawn: Gaussians
    """The scene as the stages see it: what the context is drawn with, without what was set aside,
    followed by everything that was added."""
    context: Gaussians
    """The scene before its first target."""
    views: tuple[View, ...]
    """The photographs, with the depth range that the completion works in, in the exposure of the
    context where Ψ evened theirs out."""
    budgets: tuple[tuple[ErrorBudget, ...], ...]
    """Error budgets of each of `views`, then of `witnesses`. The first of each leaves out the holes
    of the context, so that closing them makes up for nothing."""
    targets: tuple[TargetCompletion, ...]
    """What happened so far, in the order of the targets."""
    seconds: Mapping[str, float]
    """Wall time of context, generate, lift, register, integrate and total."""
    witnesses: tuple[View, ...] = ()
    """Other photographs of the scene: none of them may get worse either."""
    bystanders: tuple[Camera, ...] = ()
    """Cameras of other photographs, which are not looked at: what they see of the scene stays in
    sight."""
    gains: Float[Tensor, "v 3"] | None = None
    """By how much each photograph, as it was taken, is brighter than in `views`, by channel; None
    where exposures were not evened out."""
    begun: tuple[Render, ...] = ()
    """What each of `views` saw of the context, as it is drawn, before any target."""
    proxy: Proxy | None = None
    """What a large context is drawn with; None where it is drawn itself."""
    evidence: Evidence | None = None
    """What `views` and `witnesses` show of the context; None where a context is not doubted."""
    set_aside: Bool[Tensor, "m"] | None = None
    """Which Gaussians that the context is drawn with nothing supports and nothing needs, so that
    the scene is without them; None for none."""

    @property
    def photographs(self) -> tuple[View, ...]:
        """All that the scene is compared with: `views`, then `witnesses`."""
        return (*self.views, *self.witnesses)

    @property
    def drawn_context(self) -> Gaussians:
        """The m Gaussians that the context is drawn with."""
        return self.context if self.proxy is None else self.proxy.scene

    @property
    def num_kept(self) -> int:
        """How many Gaussians of the context `drawn` begins with."""
        aside = 0 if self.set_aside is None else int(self.set_aside.sum())
        return len(self.drawn_context) - aside

    @property
    def added(self) -> Gaussians:
        """The generated Gaussians of all targets."""
        return self.drawn[self.num_kept :]

    @property
    def removed(self) -> Bool[Tensor, "n"] | None:
        """Which Gaussians of the context were set aside; None for none."""
        aside = self.set_aside
        return aside if aside is None or self.proxy is None else aside[self.proxy.run]

    @property
    def observed(self) -> Gaussians:
        """The context, bit for bit as it was, without what was set aside."""
        removed = self.removed
        return self.context if removed is None else self.context[~removed]

    @cached_property
    def scene(self) -> Gaussians:
        """The context, bit for bit as it was, without what was set aside, followed by everything
        that was added."""
        if self.proxy is None:
            return self.drawn
        return merge([self.observed, self.added]) if len(self.added) else self.observed

    @property
    def next_number(self) -> int:
        """Provenance of what the next target adds: it goes on from what the context holds."""
        given = int(self.context.generated.max()) if len(self.context) else 0
        return given + len(self.targets) + 1

    def ranged(self, camera: Camera) -> Camera:
        """`camera` with the depth range that the completion works in."""
        known = self.views[0].camera
        return replace(camera, near=known.near, far=known.far)
