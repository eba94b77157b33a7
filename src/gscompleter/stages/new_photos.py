"""Photographs that a given scene does not reproduce, since it was not trained on them.

They show how the scene looks from where it is wrong: each is the wanted image at its own camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.config import CompleterConfig
from gscompleter.generators.exposure import fit_robust_affine
from gscompleter.geometry import pad_camera, select_spread_cameras
from gscompleter.progress import track
from gscompleter.render.cache import Parts, SceneRenderer
from gscompleter.stages.recolor import recolor
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.stages.target_view import render_target
from gscompleter.state import NEW_PHOTO_ID, Completion
from gscompleter.types import View

MAX_DROP = 6.0
"""PSNR in dB below the best third of the photographs from which on a photograph is new."""
MAX_PHOTOS = 32
"""Most new photographs that are used; of more, those far apart."""


def find_new_photos(
    config: CompleterConfig, parts: Parts, views: Sequence[View], scenes: SceneRenderer
) -> list[int]:
    """Find photographs that the scene does not reproduce; none under full trust."""
    if config.trust == "full":
        return []
    frozen = scenes.freeze_at(parts, [view.camera for view in views])
    images = [scene.render.image.clamp(0, 1) for scene in frozen]
    errors = torch.stack(
        [
            (match_exposure(view, image).image - image)[view.valid_mask].square().mean()
            for view, image in zip(views, images, strict=True)
        ]
    )
    good = errors.sort().values[len(errors) // 6]  # the median of the best third
    return torch.nonzero(errors > good * 10 ** (MAX_DROP / 10))[:, 0].tolist()


def match_exposure(view: View, image: Float[Tensor, "h w 3"]) -> View:
    """Match the exposure of a photograph to that of an image."""
    valid = view.valid_mask
    gain, offset = fit_robust_affine(view.image[valid], image[valid])
    return replace(view, image=(gain * view.image + offset).clamp(0, 1))


def recolor_to_photos(
    state: Completion, photos: Sequence[View], scenes: SceneRenderer
) -> Completion:
    """Recolour the scene to new photographs, held in the directions of all others."""
    chosen = select_spread_cameras([photo.camera for photo in photos], MAX_PHOTOS) if photos else []
    for index in track(sorted(chosen), "Learning new photographs"):
        view = render_target(state, pad_camera(photos[index].camera, 0.0), scenes)
        matched = match_exposure(photos[index], view.render.image.clamp(0, 1))
        wanted = torch.where(matched.valid_mask[..., None], matched.image, view.render.image)
        reference = GeneratedView(wanted, matched.camera, is_photograph=True)
        state = recolor(reference, view, NEW_PHOTO_ID).state
    return replace(state, num_new_photos=len(photos))
