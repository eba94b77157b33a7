"""Completion cases on posed photographs: complete, then score against what was held back.

A case names two or more context frames and a target frame whose photograph no stage sees, and
frames beside the target ("neighbours"), which a flat billboard in front of the target camera
cannot satisfy. A file of cases is JSON: `{"resolution": [h, w], "cases": [{"scene", "context",
"target", "near", "far", "neighbours"}, ...]}` with scene folders beside the file.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.completer import GSCompleter
from gscompleter.errors import InputError
from gscompleter.evaluation.geometry_metrics import abs_rel
from gscompleter.evaluation.metrics import masked_psnr, psnr, ssim
from gscompleter.io.scene import load_views
from gscompleter.render import Renderer
from gscompleter.types import Camera, Completion, Gaussians, Render, View


@dataclass(frozen=True)
class Case:
    """One completion task."""

    scene: Path
    """Folder of the scene."""
    context: tuple[int, ...]
    target: int
    neighbours: tuple[int, ...]
    """Frames beside the target, for scoring only."""
    resolution: tuple[int, int]
    """Height and width."""
    near: float | None = None
    far: float | None = None

    @property
    def name(self) -> str:
        return f"{self.scene.name} {'+'.join(map(str, self.context))}>{self.target}"

    def load(self, frames: tuple[int, ...]) -> list[View]:
        """Photographs of `frames`."""
        return load_views(self.scene, list(frames), self.resolution, near=self.near, far=self.far)


def read_cases(path: Path) -> list[Case]:
    """The cases of a file.

    Raises:
        InputError: where the file is missing or holds no cases.
    """
    try:
        content = json.loads(path.read_text())
        height, width = content["resolution"]
        return [
            Case(
                path.parent / row["scene"],
                tuple(row["context"]),
                row["target"],
                tuple(row.get("neighbours", ())),
                (height, width),
                row.get("near"),
                row.get("far"),
            )
            for row in content["cases"]
        ]
    except OSError as error:
        raise InputError(f"Cannot read the cases {path}: {error.strerror}.") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} is no file of cases ({type(error).__name__}: {error}); it needs resolution "
            "and cases, each with scene, context and target."
        ) from error


@dataclass(frozen=True)
class Change:
    """One score before and after completion."""

    before: float
    after: float

    @property
    def gain(self) -> float:
        return self.after - self.before


@dataclass(frozen=True)
class CaseScores:
    """How a completion fares against the photographs it did not see. None: no truth exists."""

    name: str
    hole_fraction: float
    target_psnr: Change
    target_ssim: Change
    neighbours_psnr: Change | None
    """Mean over the neighbours."""
    context_psnr: tuple[Change, ...]
    """Of each context view."""
    depth_observed: float | None
    """AbsRel at the target where the context covers it."""
    depth_hole: float | None
    """AbsRel at the target where the context has a hole and the completion fills it."""
    depth_rim: float | None
    """Median relative difference of depth between what was added, drawn alone, and the context,
    where both cover the target: the step at the border of the holes."""
    hole_psnr: float | None
    """PSNR at the target over the pixels of the hole only, after completion."""
    seconds: float


@dataclass(frozen=True)
class Outcome:
    """What a method, ours or another, made of a scene."""

    before: Gaussians
    """The context."""
    after: Gaussians
    added: Gaussians | None
    """What stands in `after` beside the context; None where the context itself was changed."""
    hole_mask: Bool[Tensor, "h w"]
    """True where the context has a hole, seen from the target."""
    seconds: float


@dataclass(frozen=True)
class Truth:
    """Photographs to score against. Their cameras have the depth range of the scene."""

    views: tuple[View, ...]
    """The context views."""
    target: View
    neighbours: tuple[View, ...] = ()


def run_case(case: Case, completer: GSCompleter) -> tuple[Completion, View, CaseScores]:
    """Complete a case and score it; the target's photograph is looked at afterwards only."""
    views = case.load(case.context)
    (target,) = case.load((case.target,))
    completion = completer(views, target.camera)
    (result,) = completion.targets
    outcome = Outcome(
        completion.context,
        completion.scene,
        result.added,
        result.hole_mask,
        completion.seconds["total"],
    )
    camera = result.target
    truth = ranged_truth(views, target, case.load(case.neighbours), camera.near, camera.far)
    return completion, target, score(case.name, outcome, truth, completer.renderer)


def ranged_truth(
    views: Sequence[View],
    target: View,
    neighbours: Sequence[View],
    near: float | None,
    far: float | None,
) -> Truth:
    """Photographs whose cameras have the depth range (scene units) that the method worked with."""

    def with_range(view: View) -> View:
        return replace(view, camera=replace(view.camera, near=near, far=far))

    return Truth(
        tuple(with_range(view) for view in views),
        with_range(target),
        tuple(with_range(view) for view in neighbours),
    )


@torch.no_grad()
def score(name: str, outcome: Outcome, truth: Truth, renderer: Renderer) -> CaseScores:
    """All scores of one completed case, called `name`."""
    target, hole = truth.target, outcome.hole_mask
    before = renderer.render(outcome.before, target.camera)
    after = renderer.render(outcome.after, target.camera)
    covered = after.alpha >= 0.5
    return CaseScores(
        name=name,
        hole_fraction=hole.float().mean().item(),
        target_psnr=Change(psnr(before.image, target.image), psnr(after.image, target.image)),
        target_ssim=Change(ssim(before.image, target.image), ssim(after.image, target.image)),
        neighbours_psnr=mean_change([change(outcome, v, renderer) for v in truth.neighbours]),
        context_psnr=tuple(change(outcome, view, renderer) for view in truth.views),
        depth_observed=absrel(after.depth, target.depth, ~hole & covered),
        depth_hole=absrel(after.depth, target.depth, hole & covered),
        depth_rim=rim_error(outcome.added, before, target.camera, renderer),
        hole_psnr=masked_psnr(after.image, target.image, hole),
        seconds=outcome.seconds,
    )


def rim_error(
    added: Gaussians | None,
    context: Render,
    target: Camera,
    renderer: Renderer,
    min_pixels: int = 50,
) -> float | None:
    """Median of |D_added - D_context| / D_context where both cover the target.

    None where fewer than `min_pixels` are covered by both, or nothing can be told from the context.
    """
    if added is None or len(added) == 0:
        return None
    alone = renderer.render(added, target)
    both = (alone.alpha >= 0.5) & (context.alpha >= 0.5)
    if both.sum() < min_pixels:
        return None
    return ((alone.depth - context.depth).abs() / context.depth)[both].median().item()


def change(outcome: Outcome, view: View, renderer: Renderer) -> Change:
    """PSNR of a photograph before and after."""

    def of(scene: Gaussians) -> float:
        return psnr(renderer.render(scene, view.camera).image, view.image)

    return Change(of(outcome.before), of(outcome.after))


def mean_change(changes: list[Change]) -> Change | None:
    """Mean before and mean after; None of nothing."""
    if not changes:
        return None
    n = len(changes)
    return Change(sum(c.before for c in changes) / n, sum(c.after for c in changes) / n)


def absrel(
    depth: Float[Tensor, "h w"], truth: Float[Tensor, "h w"] | None, where: Bool[Tensor, "h w"]
) -> float | None:
    """`abs_rel` over `where`; None where no truth is known."""
    return None if truth is None else abs_rel(depth, truth, where)
