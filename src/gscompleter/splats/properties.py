"""Properties of a .ply beyond those of plain 3DGS: harmless, unknown, or of another kind of splat.

A splat of another kind may have all properties of plain 3DGS, too. Where its further ones decide
what is seen, as in a moving splat, the picture would be wrong without a word.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from gscompleter.system.errors import InputError, join_names, quote_value

OPTION = "ignore_properties"
"""Argument and option that goes on with a file whose properties change what is seen."""
MAX_NAMED_PROPERTIES = 4
"""Most properties that a sentence names."""

_PLAIN = re.compile(
    r"[xyz]|n[xyz]|f_dc_[012]|f_rest_\d+|opacity|scale_[012]|rot_[0123]|generated|filter_3D"
)
"""Properties that are read."""
_HARMLESS = re.compile(
    # Colours for programs that show points, and what programs for point clouds keep.
    r"(?:diffuse_)?(?:red|green|blue|alpha)|[rgba]|intensity|confidence|curvature|quality|error"
    r"|scalar_\w+|classification|return_number|gps_time"
    # Numbers of parts and objects, and features to find them by.
    r"|(?:(?:class|instance|object|obj|segment|seg|semantic|group|cluster|part|material)_?)?ids?"
    r"|(?:class|instance|object|segment|semantic|group|cluster|part|material|label|index)(?:es|s)?"
    r"|(?:obj_dc|ins_feat|seg_feat|semantic|language_feature|feature|feat|embedding)_\d+"
    # What training and editors record.
    r"|uncertainty|importance|weight|visibility|max_radii\w*|source|state|selected|locked"
)
"""Properties that other programs add and that change nothing of what is seen."""


@dataclass(frozen=True)
class SplatKind:
    """A kind of splat that has the properties of plain 3DGS, and further ones that it needs."""

    description: str
    """What it is, after "is"."""
    consequence: str
    """What the picture would show."""
    remedy: str
    names: re.Pattern[str]
    """Names of properties by which it is known."""


MOVING = SplatKind(
    "a moving splat",
    "all of its moments would be shown at once",
    "export one moment of it as a plain .ply",
    # Spacetime Gaussians, and Gaussians of four dimensions.
    re.compile(
        r"trbf_(?:center|scale)|motion_\w+|omega_\w+|(?:velocity|vel)_\w+|t|time|t_scale|t_center"
        r"|scale_t|scaling_t|scale_3|rot_r_\d|rotation_r_\d|mu_t|cov_t"
    ),
)
OTHER_KERNEL = SplatKind(
    "a splat of another kernel than a Gaussian",
    "its edges would be drawn as those of Gaussians",
    "export Gaussians with its trainer",
    # Deformable Beta Splatting, generalised exponential splatting, Student's t.
    re.compile(r"beta|betas?_\d+|sb_params_\d+|shape|shape_\d|nu|nu_degree|kernel_\w+"),
)
TEXTURED = SplatKind(
    "a textured splat",
    "its textures would be missing",
    "export plain Gaussians with its trainer",
    re.compile(r"texture_\w+|tex_\w+"),
)
WRONG_KINDS = (MOVING, OTHER_KERNEL, TEXTURED)
"""Kinds whose picture is surely wrong without their own properties."""


@dataclass(frozen=True)
class FurtherProperties:
    """Properties of a file that are not used, and that may change what is seen."""

    names: tuple[str, ...]
    kind: SplatKind | None = None
    """Kind of splat that is known by some of them."""


def find_further_properties(names: Sequence[str]) -> FurtherProperties:
    """Find the properties of a .ply that are neither used nor harmless."""
    further = tuple(
        name for name in names if not (_PLAIN.fullmatch(name) or _HARMLESS.fullmatch(name))
    )
    # Names by which a kind is known come first, since sentences name the first few.
    for kind in WRONG_KINDS:
        telling = tuple(name for name in further if kind.names.fullmatch(name))
        if telling:
            rest = tuple(name for name in further if name not in telling)
            return FurtherProperties(telling + rest, kind)
    return FurtherProperties(further)


def refuse_other_kinds(names: Sequence[str], path: Path) -> None:
    """Raise InputError for a file whose picture is surely wrong without its own properties."""
    further = find_further_properties(names)
    if further.kind is not None:
        kind = further.kind
        raise InputError(
            f"{quote_value(path)} is {kind.description} "
            f"({join_names(further.names, MAX_NAMED_PROPERTIES)}): "
            f"{kind.consequence}; {kind.remedy}, or go on without these properties.",
            OPTION,
        )


def describe_further_properties(names: Sequence[str]) -> str | None:
    """Describe in a sentence the properties that are not used; None if all others are harmless."""
    further = find_further_properties(names)
    if not further.names:
        return None
    shown = join_names(further.names, MAX_NAMED_PROPERTIES)
    if further.kind is None:
        return f"Properties that plain 3DGS does not have are not used: {shown}."
    kind = further.kind
    return f"This looks like {kind.description} ({shown}); {kind.consequence}."
