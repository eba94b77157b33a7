"""Photographs that a given scene does not reproduce, since it was not trained on them.

They show how the scene looks from where it is wrong: each is the wanted image at its own camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.config import CompleterConfig
from gscompleter.numerics.geometry import pad_camera, select_spread_cameras
from gscompleter.numerics.robust import fit_robust_affine
from gscompleter.parts import PartOrigin
from gscompleter.render.cache import Parts, SceneRenderer
from gscompleter.stages.recolor import recolor
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.stages.target_view import TargetView, render_target
from gscompleter.state import Completion
from gscompleter.system.progress import track
from gscompleter.types import View

MAX_DROP = 6.0
"""PSNR in dB below the best third of the photographs from which on a photograph is new."""
REPRODUCED_ERROR = 1e-4
"""Mean squared error up to which a photograph is reproduced, 40 dB."""
MAX_DISTRUST = 0.5
"""Distrust up to which a pixel is compared in exposure."""
MIN_KNOWN_SHARE = 0.05
"""Smallest fraction of such pixels."""
MAX_NEW_PHOTOS = 32
"""Most new photographs that are used; of more, those far apart."""


def find_new_photos(
    config: CompleterConfig, parts: Parts, views: Sequence[View], scenes: SceneRenderer
) -> list[int]:
    """Find photographs that the scene does not reproduce; none under full trust."""
    if config.trust == "full":
        return []
    frozen = scenes.freeze_at(parts, [view.camera for view in views])
    errors = torch.stack(
        [compute_error(scene.render.image, view) for scene, view in zip(frozen, views, strict=True)]
    )
    # The scene reproduces what it was trained on about equally well. Even if most photographs are
    # new, the best third is not: its median is the error of a photograph that was trained on.
    trained_error = errors.sort().values[len(errors) // 6].clamp_min(REPRODUCED_ERROR)
    return torch.nonzero(errors > trained_error * 10 ** (MAX_DROP / 10))[:, 0].tolist()


def compute_error(image: Float[Tensor, "h w 3"], view: View) -> Float[Tensor, ""]:
    """Compute the mean squared error of a render, fitted to the exposure of a photograph."""
    shown = image.clamp(0, 1)[view.valid_mask]
    photo = view.image[view.valid_mask]
    gain, offset = fit_robust_affine(shown, photo)
    return (gain * shown + offset - photo).square().mean()


def match_new_photo(photo: View, view: TargetView) -> Float[Tensor, "h w 3"]:
    """Match the exposure of a photograph to the scene where the scene is trusted.

    `view` is the scene at the camera of the photograph.
    """
    known = photo.valid_mask & ~view.holes & (view.distrust < MAX_DISTRUST)
    return match_exposure(photo.image, view.render.image, known)


def match_exposure(
    photograph: Float[Tensor, "h w 3"], image: Float[Tensor, "h w 3"], known: Bool[Tensor, "h w"]
) -> Float[Tensor, "h w 3"]:
    """Match the exposure of a photograph to a render of the scene, where that is `known` to agree.

    If hardly any pixel is, the photograph stays as it is.
    """
    if int(known.sum()) < MIN_KNOWN_SHARE * known.numel():
        return photograph
    gain, offset = fit_robust_affine(photograph[known], image.clamp(0, 1)[known])
    return (gain * photograph + offset).clamp(0, 1)


def recolor_to_photos(
    state: Completion, photos: Sequence[View], scenes: SceneRenderer
) -> Completion:
    """Recolour the scene to new photographs, held in the directions of all others."""
    chosen: list[int] = []
    if photos:
        chosen = select_spread_cameras([photo.camera for photo in photos], MAX_NEW_PHOTOS)
    for index in track(sorted(chosen), "Learning new photographs"):
        photo = photos[index]
        view = render_target(state, pad_camera(photo.camera, 0.0), scenes)
        # Where the photograph is ignored, the render itself is wanted: nothing changes.
        matched = replace(photo, image=match_new_photo(photo, view))
        wanted = matched.paint_ignored(view.render.image)
        reference = GeneratedView(wanted.image, photo.camera, is_photograph=True)
        state = recolor(reference, view, PartOrigin("photographs")).state
    return replace(state, num_new_photos=len(photos))
