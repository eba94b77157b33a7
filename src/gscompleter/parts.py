"""Parts of a completed scene: Gaussians with their origin, which decides their label.

Labels, counts and sentences about the additions of a completion follow from their origins. A label
tells less than the origin: in a file, `generated` is one number per Gaussian, which every version
of gscompleter and every format can hold. The kinds of all rows are in `edits.json`.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.system.errors import InputError
from gscompleter.types import Gaussians

OBSERVED = 0
"""Label of the context: what was given, or reconstructed from its photographs; bit for bit as it
was."""
NOT_INVENTED = 255
"""Label of what was added later or changed, and what nobody invented: photographs show it, or it
is a piece of a Gaussian that was given and cut."""
MAX_TARGET_ID = NOT_INVENTED - 1
"""Largest number of a target: `generated` is one byte per Gaussian."""

PartKind = Literal["photographs", "target", "gap", "piece"]
"""Origin of additions: what photographs show and a scene lacked; what was invented for a target;
what closes thin gaps beside a target; a piece of a Gaussian that a removal cut."""
INVENTED_KINDS: tuple[PartKind, ...] = ("target", "gap")
"""Kinds that no photograph and no given scene shows."""


@dataclass(frozen=True)
class EarlierWork:
    """Masks of the Gaussians of a given scene that earlier commands made; None for none.

    A label does not tell them from Gaussians of a user, so that nothing of a scene counts as one by
    default.
    """

    invented: Bool[Tensor, "n"] | None = None
    """Those that Φ invented. They give way where photographs show something else."""
    lifted: Bool[Tensor, "n"] | None = None
    """Those that Ψ lifted from further photographs, which give way likewise."""
    remade: Bool[Tensor, "n"] | None = None
    """Those that Ψ made of photographs of the context. It makes them anew, of all of these."""


@dataclass(frozen=True)
class PartOrigin:
    """Where Gaussians come from that a completion added, or gave new colours."""

    kind: PartKind
    target_id: int = 0
    """Number of the target that they were invented for, from 1; 0 if nobody invented them."""

    def __post_init__(self) -> None:
        """Refuse a target without a number, whose Gaussians would count as given."""
        if (self.target_id > 0) is not self.is_invented:
            raise ValueError(f"the kind {self.kind} has no target with the number {self.target_id}")

    @property
    def is_invented(self) -> bool:
        """True if no photograph and no given scene shows them."""
        return self.kind in INVENTED_KINDS

    @property
    def label(self) -> int:
        """Value of `generated`."""
        return self.target_id if self.is_invented else NOT_INVENTED


@dataclass(frozen=True)
class Part:
    """Additions of one origin."""

    origin: PartOrigin
    gaussians: Gaussians

    def __len__(self) -> int:
        return len(self.gaussians)


def make_part(origin: PartOrigin, gaussians: Gaussians) -> Part:
    """Make a part, whose Gaussians get the label of their origin."""
    return Part(origin, label_gaussians(gaussians, origin))


def label_gaussians(gaussians: Gaussians, origin: PartOrigin) -> Gaussians:
    """Return Gaussians with the label of an origin."""
    return replace(gaussians, generated=torch.full_like(gaussians.generated, origin.label))


def split_into_parts(gaussians: Gaussians, parts: Sequence[Part]) -> Iterator[Part]:
    """Yield parts with changed Gaussians, which are in the order of the parts and as many."""
    counts = [len(part) for part in parts]
    assert len(gaussians) == sum(counts)
    start = 0
    for part, count in zip(parts, counts, strict=True):
        yield replace(part, gaussians=gaussians[start : start + count])
        start += count


def find_last_target_id(scene: Gaussians) -> int:
    """Find the largest target id in a scene; 0 if nothing was generated for a target."""
    ids = scene.generated.where(scene.generated != NOT_INVENTED, OBSERVED)
    return int(ids.max()) if len(ids) else 0


def check_target_ids(last: int, num_targets: int) -> None:
    """Raise InputError if `generated` cannot hold the ids of targets after the `last` one."""
    if last + num_targets > MAX_TARGET_ID:
        raise InputError(
            f"{num_targets} targets were given after {last} in the scene, and a .ply can "
            f"tell {MAX_TARGET_ID} apart; complete the scene in several runs."
        )
