"""Additions record their steps, and one function accepts all of them."""

from dataclasses import replace

import torch

from gscompleter.parts import PartOrigin
from gscompleter.stages.additions import Additions, Refined, accept
from gscompleter.target_result import Rejection
from gscompleter.types import Gaussians
from scenes import random_gaussians

TARGET = PartOrigin("target", 3)
CANDIDATES = Additions.begin(TARGET, "lift", random_gaussians(6))


def list_steps(additions: Additions) -> list[tuple[str, int]]:
    return [(step.name, len(step.gaussians)) for step in additions.steps]


def test_a_step_that_changes_nothing_is_none():
    same = CANDIDATES.then("free-space", CANDIDATES.gaussians)
    fewer = same.then("filter", same.gaussians[:4])
    assert list_steps(fewer) == [("lift", 6), ("filter", 4)]


def test_candidates_are_placed_then_refined_then_verified():
    def place(additions: Additions) -> Additions:
        return additions.then("filter", additions.gaussians[:5])

    def refine(placed: Gaussians) -> Refined:
        faded = replace(placed, opacities=0.5 * placed.opacities, encoded=None)
        return Refined(faded, (), (2.0, 1.0))

    def verify(additions: Additions, refined: Refined) -> Additions:
        assert additions.gaussians is refined.gaussians
        return additions.then("psnr", additions.gaussians[:3])

    accepted = accept(CANDIDATES, place, refine, verify)
    assert list_steps(accepted) == [("lift", 6), ("filter", 5), ("refine", 5), ("psnr", 3)]
    assert accepted.losses == (2.0, 1.0)
    assert accepted.rejection == Rejection()
    part = accepted.to_part()
    assert part.origin == TARGET
    assert (part.gaussians.generated == 3).all()
    first = CANDIDATES.gaussians[:3]
    assert torch.equal(part.gaussians.opacities, 0.5 * first.opacities)
