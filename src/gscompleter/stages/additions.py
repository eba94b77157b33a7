"""Additions on their way into a scene, and the one way in: placed, refined, verified."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from gscompleter.parts import Part, PartOrigin, make_part
from gscompleter.render.protocols import OpacityRender
from gscompleter.target_result import Rejection
from gscompleter.types import Gaussians


@dataclass(frozen=True)
class Step:
    """The new Gaussians after a step of a target."""

    name: str
    """`lift`, `register`, `filter`, `refine`, or the name of a guard."""
    gaussians: Gaussians
    loss: str = ""
    """Why it leaves a part of a hole empty, as a clause for people; empty for those of the paper,
    which `find_unfilled` explains."""


@dataclass(frozen=True)
class Refined:
    """Added Gaussians with refined colours and opacities."""

    gaussians: Gaussians
    plans: tuple[OpacityRender, ...]
    """Differentiable render at each photograph of the scene."""
    losses: tuple[float, ...]
    """Value of Eq. 13 at each iteration."""


@dataclass(frozen=True)
class Additions:
    """New Gaussians of one origin, with all that was done to them."""

    origin: PartOrigin
    steps: tuple[Step, ...]
    """In their order. The report tells from them which one left a hole empty."""
    losses: tuple[float, ...] = ()
    """Value of Eq. 13 at each iteration of their refinement."""
    rejection: Rejection = Rejection()
    """Who rejected all of them, if anybody did."""

    @staticmethod
    def begin(origin: PartOrigin, step: str, gaussians: Gaussians) -> Additions:
        """Begin with candidates."""
        return Additions(origin, (Step(step, gaussians),))

    @property
    def gaussians(self) -> Gaussians:
        """What is left of them now."""
        return self.steps[-1].gaussians

    def then(self, step: str, gaussians: Gaussians, loss: str = "") -> Additions:
        """Return them after one more step; one that returns its argument itself is none.

        `loss` is that of `Step`.
        """
        if gaussians is self.gaussians:
            return self
        return replace(self, steps=(*self.steps, Step(step, gaussians, loss)))

    def to_part(self) -> Part:
        """Make the part of a completion, with the label of the origin."""
        return make_part(self.origin, self.gaussians)


Placement = Callable[[Additions], Additions]
"""Moves or drops candidates."""
Refinement = Callable[[Gaussians], Refined]
"""Fits colours and opacities."""
Verify = Callable[[Additions, Refined], Additions]
"""Fades or drops what was refined."""


def accept(
    candidates: Additions, place: Placement, refine: Refinement, verify: Verify
) -> Additions:
    """Accept candidates into a scene as far as they can be placed, refined and verified there.

    Everything that is added goes through here: what is generated for a target, what closes the
    gaps beside it, and what photographs show.
    """
    # Guards would look at the whole scene for nothing.
    if len(candidates.gaussians) == 0:
        return candidates
    placed = place(candidates)
    refined = refine(placed.gaussians)
    added = replace(placed.then("refine", refined.gaussians), losses=refined.losses)
    return verify(added, refined)
