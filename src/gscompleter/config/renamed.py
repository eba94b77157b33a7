"""Settings of the last release that have a new name, and the sentences that refuse them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
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

REMOVED = ("reconcile", "support.keep_unsupported", "trust_settings.prune")
"""Settings and groups that have no successor: untrusted Gaussians are recoloured instead."""

NEW_VALUES = {
    "registration.lr_schedule": "linear or constant",
    "registration.lr_unit": "distance or scene",
    "trust": "full or photometric",
}
"""Values of the settings whose meaning changed with their name."""


def refuse_old_keys(changes: Mapping[str, Any], where: str = "") -> None:
    """Refuse settings under an old name.

    Raises:
        InputError: There is one; the sentence begins with `where` and has the new name.
    """
    for path in _iterate_paths(changes):
        refuse_removed(path, f"{where}{quote_value(path)}")
        new = translate_key(path)
        if new is not None:
            raise InputError(
                f"{where}{describe_renamed(quote_value(path), new, _describe_values(new))}"
            )


def refuse_old_options(words: Sequence[str], prefix: str = "--config.") -> None:
    """Refuse options such as `--config.harm.tolerance` under an old name.

    Raises:
        InputError: There is one; the sentence has the new name.
    """
    for word in words:
        option = word.partition("=")[0].replace("-", "_")
        stem = prefix.replace("-", "_")
        if not option.startswith(stem):
            continue
        refuse_removed(option.removeprefix(stem), quote_value(word.partition("=")[0]))
        new = translate_key(option.removeprefix(stem))
        if new is not None:
            name = f"{prefix}{new.replace('_', '-')}"
            raise InputError(
                describe_renamed(quote_value(word.partition("=")[0]), name, _describe_values(new))
            )


def refuse_removed(path: str, named: str) -> None:
    """Raise InputError if a setting has no successor."""
    if any(path == gone or path.startswith(f"{gone}.") for gone in REMOVED):
        raise InputError(
            f"The setting {named} is gone, as untrusted Gaussians of a splat are recoloured and "
            "none is removed; leave it out."
        )


def translate_key(path: str) -> str | None:
    """Return today's name of a setting, or None if the name is not an old one."""
    group, _, name = path.rpartition(".")
    if path in RENAMED or not group:
        return RENAMED.get(path)
    new = translate_key(group)
    return None if new is None else f"{new}.{name}"


def describe_renamed(old: str, new: str, values: str = "") -> str:
    """Write the sentence that names the new name of a setting."""
    return f"The setting {old} is now called {new}{values}; use the new name."


def _describe_values(new: str) -> str:
    return f" ({NEW_VALUES[new]})" if new in NEW_VALUES else ""


def _iterate_paths(changes: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Iterate over the settings in nested mappings, as `group.name`; an empty group is one."""
    for name, value in changes.items():
        path = f"{prefix}{name}"
        if isinstance(value, Mapping) and value and path.count(".") < 2:
            yield from _iterate_paths(value, f"{path}.")
        else:
            yield path
