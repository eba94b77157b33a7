"""Settings of a completion: ours, the paper's, and the paper's ablations, as values."""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, Literal, TypeVar

import yaml

from gscompleter.coverage import COVERED
from gscompleter.errors import InputError

C = TypeVar("C")


@dataclass(frozen=True)
class AnchorConfig:
    max_rotation: float = 45.0
    """Largest turn away from the target, in degrees, that still leaves overlap."""
    selection: Literal["widest", "nearest"] = "widest"
    """`widest` baseline is the paper's rule; `nearest` view is its ablation without it."""


@dataclass(frozen=True)
class AffineConfig:
    bridge: Literal["anchor", "target", "none"] = "anchor"
    """View through which depths are compared. `target` and `none` are ablations of the paper."""
    max_trials: int = 512
    """Two-point hypotheses, all scored at once."""
    max_pixels: int = 8192
    """Pixels the hypotheses are scored on, drawn at random where there are more."""
    residual_threshold: float = 0.05
    """Largest residual of an inlier, relative to the context depth."""
    min_inliers: float = 0.3
    """Smallest share of inliers that makes a fit trustworthy."""
    min_pixels: int = 64
    """Fewest comparable pixels; under it there is nothing to fit."""
    min_agreement: float | None = 0.3
    """Smallest share of what the target sees of the scene that must agree with an affine fitted
    through the anchor, before one that is fitted at the target may take its place. None trusts the
    anchor always, as the paper does."""
    min_depth_spread: float = 0.05
    """Smallest spread of the predicted depths ((p95 - p5) / median) that tells scale and shift
    apart; under it only a scale is fitted."""


@dataclass(frozen=True)
class RegistrationConfig:
    affine: AffineConfig = AffineConfig()
    """Settings of the coarse fit."""
    iterations: int = 20
    """Steps of Adam; 0 leaves the coarse fit as it is (the paper's ablation without RC)."""
    learning_rate: float = 0.008
    """Step of Adam, in the unit that `step` names."""
    schedule: Literal["falling", "constant"] = "falling"
    """Whether the step falls linearly to nothing, so that few iterations reach far and still end
    close."""
    beta1: float = 0.5
    """Adam's memory of gradients. Its usual 0.9 remembers half of so short a run and overshoots."""
    beta2: float = 0.9
    """Adam's memory of their squares; usually 0.999."""
    step: Literal["relative", "literal"] = "relative"
    """`relative`: of each primitive's own distance, so that the unit of the scene does not
    matter; depth losses are then relative to the median context depth. `literal`: in scene units,
    as in the paper."""
    degrees_of_freedom: Literal[1, 3] = 1
    """1 slides along the camera ray; 3 moves freely (ablation of the paper)."""
    depth_weight: float = 1.0
    """λ_d of Eq. 11."""
    stereo_weight: float = 1.0
    """λ_s of Eq. 11."""
    rgb_weight: float = 0.0
    """λ_c of Eq. 11; 0.1 in the paper. With a constant footprint a primitive looks the same at the
    target wherever it stands on its ray, and the term tells it nothing."""
    depth_of: Literal["candidates", "composite"] = "candidates"
    """What L_depth renders: the candidates alone, each of which then feels its own error; or, as
    in the paper, the scene with them, where those behind the context are hidden and stay wrong."""
    footprint: Literal["constant", "fixed"] = "constant"
    """`constant`: sizes scale with distance, so that the image at the target stays as it is.
    `fixed`: sizes stay what they were, as in the paper."""
    mask_occluded: bool = True
    """Leave out of the stereo loss what the anchor cannot see: a new surface that lies behind the
    context there. The paper's literal loss pulls it forward onto the context."""
    occlusion_tolerance: float = 0.05
    """How far behind the context, relative to depth, still counts as the same surface."""
    carry_tolerance: float = 0.02
    """Largest error of depth, relative to the scene's, of an observed pixel that is taken for an
    example by the holes."""
    carry_into_holes: bool = True
    """Let pixels in a hole, where the scene has no depth to agree with, move like the observed
    ones around them, so that no step remains at the border. The paper leaves them to the affine."""


@dataclass(frozen=True)
class FreeSpaceConfig:
    num_steps: int = 48
    """How often a candidate slides back before it is given up; 0 checks nothing, as in the
    paper."""
    step: float = 0.04
    """By how much it slides each time, relative to its distance."""
    clearance: float = 0.01
    """How far behind the scene's surface, relative to depth, a camera that sees this surface must
    find the candidate. What lies a little behind is hidden there, and still closes the hole."""
    border: int = 3
    """Pixels beyond the border of an image at which a Gaussian still shows within it."""


@dataclass(frozen=True)
class HoleConfig:
    max_alpha: float = COVERED
    """τ of Eq. 12: a pixel of the target that the scene covers by less is a hole. It is painted by
    Φ, what is lifted there joins the scene, and its depth continues that of its surroundings. Where
    the scene's depth is compared, a pixel stays covered from one half on."""
    dilation: int = 3
    """Pixels by which the mask grows on every side, which hides seams; 0 leaves it as it is."""
    neighbourhood: int | None = 16
    """Pixels around a hole within which candidates are registered. Those farther away neither
    join the scene nor inform those that do. None registers all of them, as the paper does."""


@dataclass(frozen=True)
class RefineConfig:
    iterations: int = 10
    """Steps of Adam; 0 leaves the opacities as they were lifted (the paper's ablation w/o MV)."""
    learning_rate: float = 0.24
    """Step of Adam, on what `parametrization` names."""
    parametrization: Literal["logit", "linear"] = "logit"
    """What Adam moves: the logit, as 3DGS stores it, or the opacity itself, clamped to [0, 1]."""
    target_weight: float = 0.1
    """λ of Eq. 13, on the synthesized image."""
    num_views: int = 2
    """How many of the nearest context views take part."""


@dataclass(frozen=True)
class HarmConfig:
    tolerance: float | None = 0.045
    """Largest loss of PSNR, in dB, that any context view may suffer; None checks nothing, as in
    the paper."""
    max_trials: int = 16
    """How often harmful Gaussians lose half of their opacity before a view that still does not
    hold loses all it sees of them."""


@dataclass(frozen=True)
class CompleterConfig:
    """Settings of the four stages. The defaults are ours, wherever measurement shows better than
    the paper's; `docs/design.md` has the table."""

    margin: float = 0.25
    """Share of its size by which the target image is extended on every side while it is completed,
    so that a camera that moves on from the target does not meet the next hole at its border. The
    paper completes what the target itself sees."""
    anchor: AnchorConfig = AnchorConfig()
    """Which photograph forms the stereo pair with the synthesized image."""
    registration: RegistrationConfig = RegistrationConfig()
    """How the lifted Gaussians are brought to the scene."""
    free_space: FreeSpaceConfig = FreeSpaceConfig()
    """How candidates keep out of space that photographs saw through."""
    holes: HoleConfig = HoleConfig()
    """What counts as a hole."""
    refine: RefineConfig = RefineConfig()
    """How the opacities of the added Gaussians are refined."""
    harm: HarmConfig = HarmConfig()
    """How much worse a photograph may be matched than before."""

    @staticmethod
    def paper() -> CompleterConfig:
        """The paper to the letter: steps in scene units, sizes that stay what they were when a
        Gaussian slides, no occlusion mask in the stereo loss, nothing checked afterwards."""
        return CompleterConfig(
            margin=0.0,
            registration=RegistrationConfig(
                iterations=50,
                learning_rate=0.01,
                schedule="constant",
                beta1=0.9,
                beta2=0.999,
                step="literal",
                rgb_weight=0.1,
                depth_of="composite",
                footprint="fixed",
                mask_occluded=False,
                carry_into_holes=False,
                affine=AffineConfig(min_agreement=None),
            ),
            free_space=FreeSpaceConfig(num_steps=0),
            refine=RefineConfig(iterations=30, learning_rate=0.08),
            holes=HoleConfig(neighbourhood=None),
            harm=HarmConfig(tolerance=None),
        )


def _bridge(config: CompleterConfig, bridge: Any) -> CompleterConfig:
    affine = replace(config.registration.affine, bridge=bridge)
    return replace(config, registration=replace(config.registration, affine=affine))


def without_anchor_selection(config: CompleterConfig) -> CompleterConfig:
    """w/o SA: the nearest view instead of the best stereo anchor."""
    return replace(config, anchor=replace(config.anchor, selection="nearest"))


def without_depth_alignment(config: CompleterConfig) -> CompleterConfig:
    """w/o DA: no affine."""
    return _bridge(config, "none")


def without_ray_constraint(config: CompleterConfig) -> CompleterConfig:
    """w/o RC: no optimisation of distances."""
    return replace(config, registration=replace(config.registration, iterations=0))


def without_any(config: CompleterConfig) -> CompleterConfig:
    """w/o ALL: no SA, no DA, no RC."""
    return without_anchor_selection(without_depth_alignment(without_ray_constraint(config)))


def without_refinement(config: CompleterConfig) -> CompleterConfig:
    """w/o MV: opacities as they were lifted, and nothing checked afterwards."""
    return replace(
        config,
        refine=replace(config.refine, iterations=0),
        harm=replace(config.harm, tolerance=None),
    )


def _degrees_of_freedom_3(config: CompleterConfig) -> CompleterConfig:
    return replace(config, registration=replace(config.registration, degrees_of_freedom=3))


def _dilation(radius: int) -> Callable[[CompleterConfig], CompleterConfig]:
    return lambda config: replace(config, holes=replace(config.holes, dilation=radius))


def _max_rotation(degrees: float) -> Callable[[CompleterConfig], CompleterConfig]:
    return lambda config: replace(config, anchor=replace(config.anchor, max_rotation=degrees))


ABLATIONS: dict[str, Callable[[CompleterConfig], CompleterConfig]] = {
    "no-sa": without_anchor_selection,
    "no-da": without_depth_alignment,
    "no-rc": without_ray_constraint,
    "no-da-rc": lambda config: without_depth_alignment(without_ray_constraint(config)),
    "none": without_any,
    "no-mv": without_refinement,
    "3-dof": _degrees_of_freedom_3,
    "target-aligned": lambda config: _bridge(config, "target"),
    "no-dilation": _dilation(0),
    "dilation": _dilation(3),
    "theta-30": _max_rotation(30.0),
    "theta-45": _max_rotation(45.0),
    "theta-90": _max_rotation(90.0),
}
"""The paper's ablations: each turns a config into the one that lacks (or varies) one thing."""


def named_config(name: str) -> CompleterConfig:
    """`default`, `paper`, or one of them with an ablation: `no-sa`, `paper/no-sa`.

    Raises:
        InputError: where there is none of that name.
    """
    bases = {"default": CompleterConfig(), "paper": CompleterConfig.paper()}
    if name in bases:
        return bases[name]
    base, _, ablation = name.rpartition("/")
    if (base or "default") not in bases or ablation not in ABLATIONS:
        raise InputError(
            f"There is no config {name!r}; choose default, paper or one of {', '.join(ABLATIONS)} "
            "(paper/no-sa for an ablation of the paper's settings), or give a YAML file."
        )
    return ABLATIONS[ablation](bases[base or "default"])


def load_config(source: str) -> CompleterConfig:
    """A config by name, or from a YAML file that names only what differs from its `base`.

    Raises:
        InputError: where the file is missing or not YAML, or names an unknown setting or a value
            of the wrong type.
    """
    path = Path(source)
    if path.suffix not in {".yaml", ".yml"}:
        return named_config(source)
    try:
        content = yaml.safe_load(path.read_text())
    except OSError as error:
        raise InputError(f"Cannot read the config {path}: {error.strerror}.") from error
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise InputError(
            f"The config {path} is not YAML: {' '.join(str(error).split())}."
        ) from error
    content = {} if content is None else content
    if not isinstance(content, Mapping):
        raise InputError(f"The config {path} must map settings to values, as in `holes: ...`.")
    changes = dict(content)
    base = named_config(str(changes.pop("base", "default")))
    return updated(base, changes, str(path))


def updated(config: C, changes: Mapping[str, Any], where: str) -> C:
    """`config` with `changes`, a mapping of its fields in which dataclasses are mappings too."""
    hints = typing.get_type_hints(type(config))
    values = {}
    for name, value in changes.items():
        if name not in hints:
            known = ", ".join(field.name for field in fields(config))  # type: ignore[arg-type]
            raise InputError(f"{where}: there is no setting {name!r}; choose one of {known}.")
        current = getattr(config, name)
        if is_dataclass(current):
            if not isinstance(value, Mapping):
                raise InputError(f"{where}: {name} holds settings of its own, got {value!r}.")
            values[name] = updated(current, value, f"{where}: {name}")
        else:
            values[name] = _checked(value, hints[name], f"{where}: {name}")
    return replace(config, **values)  # type: ignore[type-var]


def _checked(value: Any, hint: Any, where: str) -> Any:
    """`value` if it is what the annotation `hint` allows; a whole number passes as a float."""
    if typing.get_origin(hint) is typing.Literal:
        allowed = typing.get_args(hint)
        if value in allowed and not isinstance(value, bool):
            return value
        raise InputError(f"{where} must be one of {', '.join(map(str, allowed))}, got {value!r}.")
    options = typing.get_args(hint) if isinstance(hint, types.UnionType) else (hint,)
    if float in options and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if isinstance(value, options) and (bool in options or not isinstance(value, bool)):
        return value
    names = " or ".join("null" if o is type(None) else o.__name__ for o in options)
    raise InputError(f"{where} must be {names}, got {value!r}.")
