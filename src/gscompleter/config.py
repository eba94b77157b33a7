"""Settings of a completion: ours, the paper's, and the paper's ablations, as values."""

from __future__ import annotations

import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

import yaml

from gscompleter.errors import InputError
from gscompleter.stages.alignment import AffineConfig
from gscompleter.stages.anchor import AnchorConfig
from gscompleter.stages.free_space import FreeSpaceConfig
from gscompleter.stages.integration import HarmConfig, HoleConfig, RefineConfig
from gscompleter.stages.registration import RegistrationConfig

C = TypeVar("C")


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
