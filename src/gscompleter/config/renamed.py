"""Settings of the last release that have a new name, and the sentences that refuse them."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from gscompleter.errors import InputError, quote_value

RENAMED = {
    "registration.affine.bridge": "alignment.align_at",
    "registration.affine.min_agreement": "alignment.min_agreement",
    "registration.affine.min_merged": "depth_agreement.reject_below",
    "registration.affine": "alignment",
    "registration.schedule": "registration.lr_schedule",
    "registration.step": "registration.lr_unit",
    "registration.depth_of": "registration.rendered_depth",
    "registration.carry_into_holes": "registration.extrapolate_into_holes",
    "holes.neighbourhood": "holes.candidate_radius",
    "contradiction.min_difference": "dynamic_masks.min_color_difference",
    "contradiction": "dynamic_masks",
    "support.doubts": "trust",
    "support.max_difference": "trust_settings.color_sigma",
    "support.max_turn": "trust_settings.angle_sigma",
    "support": "trust_settings",
    "refine.min_fall": "refine.rel_tol",
    "harm.tolerance": "psnr_guard.max_drop",
    "harm.ssim_tolerance": "psnr_guard.max_ssim_drop",
    "harm.max_loss": "psnr_guard.max_opacity_loss",
    "harm": "psnr_guard",
    "exploration.turn": "next_best_view.yaw_fraction",
    "exploration.side": "next_best_view.image_size",
    "exploration.reach": "next_best_view.border_radius",
    "exploration": "next_best_view",
}
"""Old names of settings and groups of settings with today's."""


def refuse_old_keys(paths: Iterable[str], where: str = "") -> None:
    """Raise InputError for a setting under an old name; the sentence begins with `where`."""
    for path in paths:
        new = translate_key(path)
        if new is not None:
            raise InputError(
                f"{where}The setting {quote_value(path)} is now called {new}; use the new name."
            )


def translate_key(path: str) -> str | None:
    """Return today's name of a setting, or None if the name is not an old one."""
    group, _, name = path.rpartition(".")
    if path in RENAMED or not group:
        return RENAMED.get(path)
    new = translate_key(group)
    return None if new is None else f"{new}.{name}"


def list_paths(changes: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """List the settings in nested mappings, as `group.name`; an empty group is one."""
    for name, value in changes.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping) and value and path.count(".") < 2:
            yield from list_paths(value, f"{path}.")
        else:
            yield path
