"""The default Φ, without weights: warped photographs, and holes filled with patches.

Tone and lines continue the border of a hole. Where no line leads, structure near the border comes
from patches of the photographs, coarse to fine, after Wexler et al. (2007), Barnes et al.
(PatchMatch, 2009) and Darabi et al. (Image Melding, 2012).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from numpy import ndarray
from torch import Tensor
from torch.nn.functional import avg_pool2d, pad

from gscompleter.config.generators import GeneratorSettings
from gscompleter.generators.patch_devices import PatchDevice, get_patch_device
from gscompleter.generators.patch_rounds import FINEST_SPACING, PatchRounds
from gscompleter.generators.warp import (
    BORDER_WIDTH,
    WarpedImage,
    continue_image,
    warp_and_fill,
)
from gscompleter.numerics.image_ops import dilate, smooth_masked
from gscompleter.numerics.kernels import patchmatch
from gscompleter.numerics.kernels.patchmatch import PATCHMATCH_RADIUS, PATCHMATCH_SIDE
from gscompleter.numerics.smooth import average_trusted, compute_distance_to_known
from gscompleter.types import Camera, GeneratorInput, View

STRUCTURE_REACH = 0.15
"""Depth of structure in a hole, relative to the longer image side; its second half fades."""
TONE_RADIUS = 4
"""Radius in pixels over which patches keep the tone of the smooth continuation."""
CRACK_WIDTH = 4
"""Width in pixels up to which gaps are filled smoothly, without patches."""
MAX_BIAS = 0.1
"""Largest colour shift of a patch per channel."""
BIAS_PENALTY = 0.3
"""Cost of a squared shift relative to a squared colour difference."""
DEPTH_PENALTY = 0.02
"""Cost per squared log-depth of a source in front of the expected depth."""
DISTANCE_PENALTY = 0.002
"""Cost of a source at the other end of the image."""
MIN_VOTE_ROUNDS = 2
"""Iterations on the finest level."""
MAX_VOTE_ROUNDS = 8
"""Iterations on the coarsest level, where sharp votes need more to agree."""
WEIGHT_DECAY = 0.85
"""Weight factor of an unknown pixel per pixel from the border of the hole."""
MIN_SIZE = 80
"""Shorter side of the coarsest level, in pixels; coarser ones cost 0.3 dB."""
FINE_REACH = 8
"""Radius in pixels of the random search around a match of the coarser level."""


@dataclass(frozen=True)
class WarpInpaint:
    """Φ by depth-aware warping of all photographs and exemplar-based filling."""

    name: ClassVar[str] = "warp-inpaint"

    seed: int = 0
    device: str = "cpu"
    """Device of the search for patches, whatever device the photographs are on: a GPU searches
    large levels, `cpu` and `mps` none."""

    def __post_init__(self) -> None:
        """Raise InputError for a device that the search for patches does not know."""
        get_patch_device(self.device)

    def __call__(
        self, nearest: View, target: Camera, context: GeneratorInput
    ) -> Float[Tensor, "h w 3"]:
        """Synthesize the complete image of `target`, in [0, 1].

        Where a scene covers the target without being fully trusted it gets smooth colours, which
        cannot be wrong in structure. Empty pixels are filled as those of any other scene.
        """
        render = context.target_render
        trusted_alpha = context.trusted_alpha
        # Under full trust it is the alpha of the render itself. Where only some of the holes are
        # filled it never is: what is covered is smooth there, too (0.03 dB or less in a room).
        if trusted_alpha is None or trusted_alpha is render.alpha:
            return self.fill_holes(nearest, target, context)
        smooth = average_trusted(render, trusted_alpha / render.alpha.clamp_min(1e-6))
        empty = render.alpha < context.max_alpha
        if not empty.any():
            return smooth
        structured = self.fill_holes(nearest, target, replace(context, trusted_alpha=None))
        # Additions reach over the border of a hole, and show the same image there.
        return structured.where(dilate(empty, BORDER_WIDTH)[..., None], smooth)

    def fill_holes(
        self, nearest: View, target: Camera, context: GeneratorInput
    ) -> Float[Tensor, "h w 3"]:
        """Synthesize the image of `target` from warped photographs and patches."""
        warped = warp_and_fill(nearest, target, context)
        if not warped.known.any():
            return warped.image
        tone, lines, weight = continue_image(warped, target, context)
        structured = self.add_structure(tone, warped.to("cpu"), context)
        # Patches yield to lines by their weight (decision 042).
        image = torch.lerp(structured, lines, weight)
        return image.clamp(0, 1).to(nearest.image.device)

    def add_structure(
        self, tone: Float[Tensor, "h w 3"], warped: WarpedImage, context: GeneratorInput
    ) -> Float[Tensor, "h w 3"]:
        """Add structure to the smooth image `tone` along the borders of its holes.

        `tone`, `warped` and the result lie on the CPU, as the patches do.
        """
        reach = STRUCTURE_REACH * max(warped.known.shape)
        distance = compute_distance_to_known(warped.known)
        undecided = remove_cracks(~warped.known, CRACK_WIDTH) & (distance <= reach)
        if not undecided.any():
            return tone

        # Patches come from photographs of equal exposure, and from the known target pixels. These
        # are the last source: `init_matches` relies on it.
        images = [
            (gain * view.image.cpu()).clamp(0, 1)
            for view, gain in zip(context.views, warped.gains, strict=True)
        ]
        valid = [view.static_mask.cpu() for view in context.views]
        depths = [render.depth.cpu() for render in context.view_renders]
        sources = Sources.stack_images(
            [*images, warped.image], [*valid, warped.known], [*depths, warped.depth]
        )

        # Patches add what is finer than the tone, and keep the tone itself (decision 033). Deep in
        # a hole they fade, and beyond `reach` and in cracks the tone counts as known to them.
        expected = warped.depth.log()
        patched = fill_by_patches(tone, ~undecided, expected, sources, self.seed, self.device)
        detail = patched - tone
        detail = detail - smooth_masked(detail, undecided, TONE_RADIUS)
        fading = (2 * (1 - distance / reach)).clamp(0, 1)
        return torch.where(undecided[..., None], tone + fading[..., None] * detail, tone)


def load_warp_inpaint(
    settings: GeneratorSettings, seed: int, photographs: Sequence[View], device: str
) -> WarpInpaint:
    """Load the generator; patches of large levels are searched on the device of the networks."""
    return WarpInpaint(seed, device)


def remove_cracks(hole: Bool[Tensor, "h w"], width: int) -> Bool[Tensor, "h w"]:
    """Keep the parts of `hole` wider than `width` pixels; the image border is no limit."""
    # An opening removes what the square does not fit into. Beyond the image holes go on.
    kernel = np.ones((width + 1, width + 1), np.uint8)
    padded = np.pad(hole.numpy().astype(np.uint8), width + 1, mode="edge")
    opened = cv2.morphologyEx(padded, cv2.MORPH_OPEN, kernel)
    inner = slice(width + 1, -width - 1)
    return torch.from_numpy(opened[inner, inner] > 0)


@dataclass(frozen=True)
class Sources:
    """Images to copy patches from, padded to one size."""

    images: Float[Tensor, "s h w 3"]
    valid: Bool[Tensor, "s h w"]
    """True for pixels that may be copied; padding is not."""
    log_depth: Float[Tensor, "s h w"]
    """Logarithm of the z-depth in scene units, in the camera of each source."""

    @staticmethod
    def stack_images(
        images: list[Float[Tensor, "_ _ 3"]],
        valid: list[Bool[Tensor, "_ _"]],
        depths: list[Float[Tensor, "_ _"]],
    ) -> Sources:
        """Stack images of any size; depth is in scene units, 0 if unknown."""
        height = max(image.shape[0] for image in images)
        width = max(image.shape[1] for image in images)

        def stack(layers: list[Tensor]) -> Tensor:
            padded = []
            for layer in layers:
                channels = (0, 0) * (layer.dim() - 2)  # `pad` begins with the last dimension
                right = width - layer.shape[1]
                below = height - layer.shape[0]
                padded.append(pad(layer, (*channels, 0, right, 0, below)))
            return torch.stack(padded)

        # Unknown depth counts as far away, which costs nothing.
        farthest = max(depth.max().item() for depth in depths)
        logs = [torch.where(depth > 0, depth, farthest).clamp_min(1e-30).log() for depth in depths]
        return Sources(stack(images), stack(valid), stack(logs))


@dataclass(frozen=True)
class InpaintLevel:
    """One level of the pyramid of a target; level 0 is the finest."""

    image: Float[Tensor, "h w 3"]
    """Unknown pixels hold a first guess of the tone."""
    known: Bool[Tensor, "h w"]
    expected: Float[Tensor, "h w"]
    """Expected log-depth, as that of the sources."""
    sources: Sources
    """At the size of this level, too."""


Field = Int64[ndarray, "_ _ 3"]
"""Source, row and column of the matching patch per pixel near the hole; -1 elsewhere."""


def fill_by_patches(
    image: Float[Tensor, "h w 3"],
    known: Bool[Tensor, "h w"],
    expected: Float[Tensor, "h w"],
    sources: Sources,
    seed: int,
    device: str = "cpu",
) -> Float[Tensor, "h w 3"]:
    """Fill the unknown pixels of `image` with patches of `sources`.

    Unknown pixels of `image` hold a first guess of the tone. `expected` is the expected log-depth;
    nearer sources cost more. Tensors lie on the CPU, whatever device large levels are filled on.
    """
    patch_device = get_patch_device(device)
    # Coarse to fine (Wexler et al. 2007): the coarsest level decides what goes where, and each
    # finer one starts from its matches.
    levels = [InpaintLevel(image, known, expected, sources)]
    while min(levels[-1].known.shape) // 2 >= MIN_SIZE:
        levels.append(downsample_level(levels[-1]))

    filled = image
    field = None
    for number, level in reversed(list(enumerate(levels))):
        # From 0 on the finest level to 1 on the coarsest; a single level counts as the finest.
        coarseness = number / max(len(levels) - 1, 1)
        rounds = MIN_VOTE_ROUNDS + round((MAX_VOTE_ROUNDS - MIN_VOTE_ROUNDS) * coarseness)
        # All patches that overlap the hole. The finest level, which has the most, takes every
        # second one on each diagonal, as scores do not change (decision 045).
        spacing = FINEST_SPACING if number == 0 else 1
        rows, columns = np.indices(level.known.shape)
        centres = dilate(~level.known, PATCHMATCH_RADIUS).numpy() & (
            (rows + columns) % spacing == 0
        )
        # Each level and round draws other random numbers; the steps between seeds are primes.
        filled, field = search_and_vote(
            level, field, centres, rounds, seed + 7919 * number, patch_device
        )
    return filled


def search_and_vote(
    level: InpaintLevel,
    coarse_field: Field | None,
    centres: Bool[ndarray, "h w"],
    rounds: int,
    seed: int,
    device: PatchDevice,
) -> tuple[Float[Tensor, "h w 3"], Field | None]:
    """Alternate between searching the best patches around `centres` and voting for the image.

    Returns the image and the field of the matches, from which the next finer level starts; None if
    there is nothing to copy or to fill.
    """
    h, w = level.known.shape
    known = level.known.numpy()
    usable = find_usable_centres(level.sources.valid)
    if not usable.any() or known.all():
        return level.image, None

    # A query is the patch of the target around a centre, q in number; `query_at` finds it by pixel.
    queries = np.argwhere(centres)
    query_at = np.full((h, w), -1, np.int64)
    query_at[centres] = np.arange(len(queries))
    # What is deep in the hole was guessed, and should not decide what matches.
    distance = compute_distance_to_known(level.known).numpy()
    weight_in_hole = np.maximum(WEIGHT_DECAY**distance, 0.05)
    weight = np.where(known, 1.0, weight_in_hole).astype(np.float32)
    matches = init_matches(queries, coarse_field, usable, seed)
    channel_weight = patchmatch.pad_border(np.repeat(weight[..., None], 3, axis=-1))
    # Beyond the image a patch has no weight.
    total_weight = cv2.boxFilter(
        weight,
        -1,
        (PATCHMATCH_SIDE, PATCHMATCH_SIDE),
        normalize=False,
        borderType=cv2.BORDER_CONSTANT,
    )
    problem = patchmatch.PatchProblem(
        image=patchmatch.pad_border(level.image.numpy()),
        weight=channel_weight,
        total=total_weight[centres],
        queries=queries,
        query_at=query_at,
        expected_log_depth=level.expected.numpy()[centres],
        sources=patchmatch.pad_column(level.sources.images.numpy()),
        usable_mask=usable,
        log_depth=np.ascontiguousarray(level.sources.log_depth.numpy()),
    )
    costs = patchmatch.Costs(
        max_bias=np.float32(MAX_BIAS),
        bias_penalty=np.float32(BIAS_PENALTY),
        depth_penalty=np.float32(DEPTH_PENALTY),
        distance_penalty=np.float32(DISTANCE_PENALTY),
        diagonal=np.float32(math.hypot(*usable.shape[1:])),
    )
    # The matches of a coarser level are nearly right, so that they are searched around alone. The
    # coarsest level begins with the tone, and searches everywhere.
    is_refined = coarse_field is not None
    run_rounds = device.choose_rounds(len(queries))
    image, matches = run_rounds(
        PatchRounds(
            problem=problem,
            costs=costs,
            known=known,
            center_weight=weight[centres],
            matches=matches,
            is_refined=is_refined,
            reach=FINE_REACH if is_refined else max(usable.shape),
            num_rounds=rounds,
            seed=seed,
        )
    )
    field = np.full((h, w, 3), -1, np.int64)
    field[centres] = matches
    return torch.from_numpy(image), field


def find_usable_centres(valid: Bool[Tensor, "s h w"]) -> Bool[ndarray, "s h w"]:
    """Mark the pixels whose whole patch is valid and inside the image."""
    is_missing = pad(~valid, (PATCHMATCH_RADIUS,) * 4, value=True)
    inner = slice(PATCHMATCH_RADIUS, -PATCHMATCH_RADIUS)
    return np.stack([~dilate(mask, PATCHMATCH_RADIUS)[inner, inner].numpy() for mask in is_missing])


def init_matches(
    queries: Int64[ndarray, "q 2"],
    coarse_field: Field | None,
    usable: Bool[ndarray, "s source_h source_w"],
    seed: int,
) -> Int64[ndarray, "q 3"]:
    """Initialize matches from the coarse level, the nearest known patch, or at random.

    A match is a source with the row and column of a patch centre in it. The target image itself is
    the last source.
    """
    own = len(usable) - 1
    if usable[own].any():
        places = find_nearest(usable[own])[queries[:, 0], queries[:, 1]]
        matches = np.column_stack([np.full(len(queries), own), places])
    else:
        centres = np.argwhere(usable)
        matches = centres[np.random.default_rng(seed).integers(len(centres), size=len(queries))]
    if coarse_field is not None:
        # A pixel inherits the match of the coarse pixel over it, at twice the coordinates and with
        # its own place in the 2 x 2 block.
        h, w = coarse_field.shape[:2]
        rows = np.minimum(queries[:, 0] // 2, h - 1)
        columns = np.minimum(queries[:, 1] // 2, w - 1)
        coarse = coarse_field[rows, columns]
        guess = coarse.copy()
        guess[:, 1:] = coarse[:, 1:] * 2 + queries % 2
        # Only matches that exist, lie in their source, and have a whole patch there are inherited.
        is_valid = (coarse[:, 0] >= 0) & (guess[:, 1:] < usable.shape[1:]).all(axis=1)
        guess[~is_valid] = 0
        is_valid &= usable[guess[:, 0], guess[:, 1], guess[:, 2]]
        matches[is_valid] = guess[is_valid]
    return np.ascontiguousarray(matches)


def find_nearest(mask: Bool[ndarray, "h w"]) -> Int64[ndarray, "h w 2"]:
    """Find row and column of the nearest pixel of `mask`, for every pixel."""
    # OpenCV gives every pixel of the mask a label, and each other pixel the label of the nearest
    # one. So the labels in the mask tell which place each label stands for.
    _, labels = cv2.distanceTransformWithLabels(
        (~mask).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    places = np.zeros((labels.max() + 1, 2), np.int64)
    rows, columns = np.nonzero(mask)
    places[labels[rows, columns]] = np.column_stack([rows, columns])
    return places[labels]


def downsample_level(level: InpaintLevel) -> InpaintLevel:
    """Halve a level and its sources; averages leave out unknown and invalid pixels."""
    # Means of the known and of the guessed pixels of a block, each divided by its share.
    known = level.known.float()[..., None]
    known_share = pool_pixels(known)
    guess = pool_pixels(level.image * (1 - known)) / (1 - known_share).clamp_min(1e-6)
    seen = pool_pixels(level.image * known) / known_share.clamp_min(1e-6)
    image = torch.where(known_share > 0.5, seen, guess)
    expected = pool_pixels(level.expected[..., None])[..., 0]

    # One source at a time, since all of them and their copies take most memory of a synthesis.
    images = []
    valid = []
    log_depths = []
    sources = zip(level.sources.images, level.sources.valid, level.sources.log_depth, strict=True)
    for source_image, source_valid, source_log_depth in sources:
        usable = source_valid.float()[..., None]
        usable_share = pool_pixels(usable)
        layers = torch.cat([source_image, source_log_depth[..., None]], dim=-1)
        means = pool_pixels(layers * usable) / usable_share.clamp_min(1e-6)
        images.append(means[..., :3])
        valid.append(usable_share[..., 0] > 0.75)
        log_depths.append(means[..., 3])
    halved = Sources(torch.stack(images), torch.stack(valid), torch.stack(log_depths))
    return InpaintLevel(image, known_share[..., 0] > 0.5, expected, halved)


def pool_pixels(values: Float[Tensor, "*s h w c"]) -> Float[Tensor, "*s h2 w2 c"]:
    """Average 2 x 2 pixels."""
    channels_first = values.movedim(-1, -3).contiguous()
    means = avg_pool2d(channels_first, 2, ceil_mode=True, count_include_pad=False)
    return means.movedim(-3, -1).contiguous()
