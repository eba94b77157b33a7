"""Safeguards beyond the paper, a file each; a preset names those that are asked, in order.

A new guard is a class that overrides one of three hooks and explains its losses, and an entry in
`config.GUARDS`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from importlib import import_module
from typing import ClassVar

from gscompleter.config import GUARDS, CompleterConfig
from gscompleter.render.cache import SceneRenderer
from gscompleter.stages.additions import Additions, Refined, accept
from gscompleter.stages.refine import RefineAtTarget
from gscompleter.stages.synthesize import GeneratedView
from gscompleter.stages.target_view import TargetView
from gscompleter.state import Completion
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.plugins import is_in_file, load_from_file
from gscompleter.system.tensor_checks import describe
from gscompleter.system.timing import timed_stage
from gscompleter.target_result import Rejection
from gscompleter.types import DepthAffine, Gaussians


@dataclass(frozen=True)
class Attempt:
    """An addition, and everything that guards may judge it by."""

    view: TargetView
    reference: GeneratedView
    affine: DepthAffine
    refined: Refined


class Guard:
    """A safeguard beyond the paper. Every hook returns its first argument unless overridden."""

    name: ClassVar[str]
    loss: ClassVar[str] = ""
    """Why it leaves a part of a hole empty: a clause after "of the hole stays empty, because"."""

    def begin(self, state: Completion, scenes: SceneRenderer) -> Completion:
        """Inspect the scene before its first target."""
        return state

    def place(self, candidates: Gaussians, view: TargetView) -> Gaussians:
        """Move or drop registered Gaussians, before they are refined."""
        return candidates

    def verify(self, added: Gaussians, attempt: Attempt) -> Gaussians:
        """Fade or drop refined Gaussians; returning none of them rejects the target."""
        return added

    def explain_rejection(self, attempt: Attempt) -> str:
        """Return the sentence for the report if this guard rejects the target, or an empty one."""
        return ""


def prepare_guards(state: Completion, scenes: SceneRenderer) -> Completion:
    """Let the guards of a completion inspect the scene before its first target."""
    for guard in load_guards(state.config):
        state = guard.begin(state, scenes)
    return state


@timed_stage("integrate")
def place(candidates: Additions, view: TargetView, guards: Sequence[Guard]) -> Additions:
    """Let guards move or drop candidates, before they are refined."""
    for guard in guards:
        candidates = candidates.then(
            guard.name, guard.place(candidates.gaussians, view), guard.loss
        )
    return candidates


@timed_stage("integrate")
def verify(added: Additions, attempt: Attempt, guards: Sequence[Guard]) -> Additions:
    """Let guards fade or drop what was refined; after a rejection no further guard is asked."""
    for guard in guards:
        before = added.gaussians
        added = added.then(guard.name, guard.verify(before, attempt), guard.loss)
        if len(before) > 0 and len(added.gaussians) == 0:
            return replace(added, rejection=Rejection(guard.name, guard.explain_rejection(attempt)))
    return added


def accept_at(
    view: TargetView,
    candidates: Additions,
    image: GeneratedView,
    affine: DepthAffine,
    refine: RefineAtTarget,
) -> Additions:
    """Accept candidates at a target, where guards place and verify them."""
    guards = load_guards(view.state.config)

    def place_at_view(candidates: Additions) -> Additions:
        return place(candidates, view, guards)

    def refine_at_view(placed: Gaussians) -> Refined:
        return refine(placed, image, view)

    def verify_at_view(added: Additions, refined: Refined) -> Additions:
        return verify(added, Attempt(view, image, affine, refined), guards)

    return accept(candidates, place_at_view, refine_at_view, verify_at_view)


def load_guards(config: CompleterConfig) -> list[Guard]:
    """Load the guards that a config names, in its order."""
    guards = []
    # Imported by name, since the modules of guards import this one.
    for name in config.guards:
        if is_in_file(name):
            guards.append(load_own_guard(name))
            continue
        module, _, class_name = GUARDS[name].partition(":")
        guards.append(getattr(import_module(module), class_name)())
    return guards


def load_own_guard(name: str) -> Guard:
    """Load a guard from `file.py:Class`; raise InputError for anything else there."""
    guard = load_from_file(name, "config.guards")
    if not isinstance(guard, Guard) or not isinstance(getattr(guard, "name", None), str):
        raise InputError(
            f"'{quote_value(name)}' has to be a subclass of gsc.Guard with a name, and is "
            f"{describe(guard)}.",
            "config.guards",
        )
    return guard
