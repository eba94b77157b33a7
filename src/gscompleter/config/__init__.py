"""Settings of a completion: ours, the paper's, and the paper's ablations, as values."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from annotated_types import Interval

from gscompleter.config.settings import Count, Settings, Share, Weight, updated
from gscompleter.coverage import COVERED
from gscompleter.errors import InputError, quoted

Pixels = Annotated[int, Interval(ge=0, le=4096)]
Step = Annotated[float, Interval(gt=0, le=10)]
Memory = Annotated[float, Interval(ge=0, lt=1)]


@dataclass(frozen=True)
class SynthesisConfig(Settings):
    """Settings of a Φ with weights; others ignore them."""

    correct_color: bool = True
    """Adapt the colours of the synthesized image to those of the photographs. The paper takes the
    image as it is."""
    source_depth: Literal["context", "monocular"] = "context"
    """Depth of the photograph for PE-Field, where its own settings name none: that of the scene,
    or, as in the paper, of a monocular network."""


@dataclass(frozen=True)
class AnchorConfig(Settings):
    max_rotation: Annotated[float, Interval(ge=0, le=180)] = 45.0
    """Largest turn away from the target, in degrees, that still leaves overlap."""
    selection: Literal["widest", "nearest"] = "widest"
    """`widest` baseline is the paper's rule; `nearest` view is its ablation without it."""
    min_baseline: Share = 0.01
    """Smallest baseline of an anchor to the target, as a share of the widest. The paper excludes no
    view."""
    min_overlap: Share = 0.25
    """Smallest share of what the target observes of the scene that an anchor must see too, where
    any view does. The paper asks for none."""


@dataclass(frozen=True)
class AffineConfig(Settings):
    bridge: Literal["anchor", "target", "none"] = "anchor"
    """View through which depths are compared. `target` and `none` are ablations of the paper."""
    min_agreement: Share | None = 0.3
    """Smallest share of what the target sees of the scene that must agree with an affine fitted
    through the anchor, before one that is fitted at the target may take its place. None trusts the
    anchor always, as the paper does."""
    min_merged: Share | None = 0.15
    """Smallest share of it that must agree, where no affine fits there either, for anything to be
    added. None adds whatever there is, as the paper does."""


@dataclass(frozen=True)
class RegistrationConfig(Settings):
    affine: AffineConfig = AffineConfig()
    """Settings of the coarse fit."""
    iterations: Count = 8
    """Steps of Adam; 0 leaves the coarse fit as it is (the paper's ablation without RC)."""
    learning_rate: Step = 0.019
    """Step of Adam, in the unit that `step` names."""
    schedule: Literal["falling", "constant"] = "falling"
    """Whether the step falls linearly to nothing, so that few iterations reach far and still end
    close."""
    beta1: Memory = 0.0
    """Adam's memory of gradients. Its usual 0.9 remembers all of so short a run and overshoots."""
    beta2: Memory = 0.8
    """Adam's memory of their squares; usually 0.999."""
    step: Literal["relative", "literal"] = "relative"
    """`relative`: of each primitive's own distance, so that the unit of the scene does not
    matter; depth losses are then relative to the median context depth. `literal`: in scene units,
    as in the paper."""
    degrees_of_freedom: Literal[1, 3] = 1
    """1 slides along the camera ray; 3 moves freely (ablation of the paper)."""
    depth_weight: Weight = 1.0
    """λ_d of Eq. 11."""
    stereo_weight: Weight = 1.0
    """λ_s of Eq. 11."""
    rgb_weight: Weight = 0.0
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
    mask_sky: bool = True
    """Leave the sky out of the depth losses. The paper's losses have every pixel."""
    min_ratio: Annotated[float, Interval(gt=0, le=1)] | None = 0.1
    """Smallest factor by which the affine, or the optimisation, may shorten a distance, so that
    nothing is pushed through the camera. None bounds nothing, as in the paper."""
    carry_into_holes: bool = True
    """Let pixels in a hole, where the scene has no depth to agree with, move like the observed
    ones around them, so that no step remains at the border. The paper leaves them to the affine."""


@dataclass(frozen=True)
class FreeSpaceConfig(Settings):
    num_steps: Annotated[int, Interval(ge=0, le=1000)] = 48
    """How often a candidate slides back before it is given up; 0 checks nothing, as in the
    paper."""


@dataclass(frozen=True)
class HoleConfig(Settings):
    max_alpha: Annotated[float, Interval(gt=0, le=1)] = COVERED
    """τ of Eq. 12: a pixel of the target that the scene covers by less is a hole. It is painted by
    Φ, what is lifted there joins the scene, and its depth continues that of its surroundings. Where
    the scene's depth is compared, a pixel stays covered from one half on."""
    min_covered: Share = 0.02
    """Smallest share of the target's image that surfaces of the scene must cover. A target that
    sees less of them is refused, for there is nothing to continue."""
    dilation: Pixels = 3
    """Pixels by which the mask grows on every side, which hides seams; 0 leaves it as it is."""
    neighbourhood: Pixels | None = 16
    """Pixels around a hole within which candidates are registered. Those farther away neither
    join the scene nor inform those that do. None registers all of them, as the paper does."""


@dataclass(frozen=True)
class ContradictionConfig(Settings):
    """Where photographs contradict each other, because something moved. What is completed takes
    nothing from there. A scene that was brought is not asked."""

    min_difference: Annotated[float, Interval(gt=0, le=1)] | None = 0.12
    """Difference of colour, in [0, 1], from which two photographs of the same surface show
    different things; None asks nothing, as in the paper."""


@dataclass(frozen=True)
class SupportConfig(Settings):
    """What is doubted of a scene that was brought. Of one that Ψ made of the photographs nothing
    is."""

    doubts: bool = True
    """Whether what the scene shows counts only as far as its photographs support it. Without, it is
    taken as it is, as in the paper."""
    max_difference: Annotated[float, Interval(gt=0, le=1)] = 0.08
    """Difference of colour, in [0, 1], from a photograph at which the scene's agreement with it has
    fallen to 1/e. Where the whole scene is less exact, it grows in proportion."""
    max_turn: Annotated[float, Interval(gt=0, le=180)] = 20.0
    """Degrees between the rays of a photograph and of a camera at which what the photograph says
    has fallen to 1/e. What it saw of a surface says less of how it looks from the side."""
    keep_unsupported: bool = False
    """Leave Gaussians that nothing supports where they are, and only add to them."""


@dataclass(frozen=True)
class RefineConfig(Settings):
    iterations: Count = 10
    """Steps of Adam at most; 0 leaves the opacities as they were lifted (the paper's ablation w/o
    MV)."""
    min_fall: Share | None = 3e-4
    """Share of the loss of which a step has to take more away for another to follow: where nothing
    that was added stands before a photograph, hardly anything goes. None takes all steps."""
    learning_rate: Step = 0.24
    """Step of Adam, on what `parametrization` names."""
    parametrization: Literal["logit", "linear"] = "logit"
    """What Adam moves: the logit, as 3DGS stores it, or the opacity itself, clamped to [0, 1]."""
    target_weight: Weight = 0.1
    """λ of Eq. 13, on the synthesized image."""
    num_views: Count = 2
    """How many of the nearest context views take part."""


@dataclass(frozen=True)
class ReconcileConfig(Settings):
    """How what is added to a scene that is doubted is fitted to all photographs at once. It takes
    the place of `RefineConfig` there."""

    iterations: Count = 60
    """Steps of Adam; 0 leaves colours and opacities as they were lifted."""
    views_per_step: Annotated[int, Interval(ge=1, le=1000)] = 4
    """How many photographs take part in a step, besides the synthesized image."""
    photograph_weight: Weight = 20.0
    """Weight of what a photograph's error is above the allowed, as a share of it, against the error
    in the holes, as a share of what it was."""
    opacity_step: Step = 0.25
    """Step of Adam on the logit of opacities."""
    colour_step: Step = 0.04
    """Step of Adam on spherical harmonics."""
    beta1: Memory = 0.7
    """Adam's memory of slopes; usually 0.9. Each step asks other photographs."""
    beta2: Memory = 0.95
    """Adam's memory of their squares; usually 0.999."""
    sh_degree: Annotated[int, Interval(ge=0, le=3)] = 2
    """Degree of spherical harmonics up to which an added Gaussian may look different from
    different sides, as those of a trained scene do; never above the scene's."""

    def at_most(self, sh_degree: int) -> ReconcileConfig:
        """The same for a scene of this degree."""
        return replace(self, sh_degree=min(self.sh_degree, sh_degree))


@dataclass(frozen=True)
class HarmConfig(Settings):
    tolerance: Annotated[float, Interval(ge=0, le=100)] | None = 0.018
    """Largest loss of PSNR, in dB, that any context view may suffer, over the whole image; None
    checks nothing, as in the paper. Photographs of a scene that is doubted lose nothing, whatever
    it is."""
    ssim_tolerance: Share = 0.0009
    """Largest loss of SSIM that any photograph may suffer."""
    max_loss: Share | None = 0.75
    """Largest share of its opacity that what is added may lose by that. If it is more, or if the
    photographs show something else than the synthesized image, nothing is added; None adds whatever
    there is, as in the paper."""


@dataclass(frozen=True)
class ExplorationConfig(Settings):
    """Where a scene is completed, where nobody names a target."""

    bases: Annotated[int, Interval(ge=1, le=1000)] = 16
    """Photographs, spread over all, around whose cameras targets are looked for."""
    max_step: Annotated[float, Interval(gt=0, le=1)] = 0.2
    """Longest move, as a share of the depth of what the camera sees. Where these photographs stand
    closer together, it is as long as that."""
    turn: Annotated[float, Interval(gt=0, le=0.5)] = 0.25
    """Angle of a turn, as a share of the opening angle."""
    side: Annotated[int, Interval(ge=16, le=4096)] = 96
    """Pixels of the longer side of the images that candidates are judged by."""
    reach: Share = 0.25
    """How far from what was observed a pixel of a hole still counts, as a share of that side."""
    clearance: Share = 0.5
    """Share of the depth of the nearest twentieth of what a photograph sees, before which a surface
    is close."""
    max_close: Share = 0.1
    """Largest share of the image that close surfaces may fill."""
    min_gain: Share = 0.01
    """Gain, as a share of the image, below which little is left to gain."""
    enough: Annotated[float, Interval(gt=0, le=1)] = 0.7
    """Share of the largest gain from which on a nearer camera comes first."""


@dataclass(frozen=True)
class CompleterConfig(Settings):
    """Settings of the four stages. The defaults are ours, wherever measurement shows better than
    the paper's; `docs/design.md` has the table."""

    margin: Annotated[float, Interval(ge=0, le=4)] = 0.25
    """Share of its size by which the target image is extended on every side while it is completed,
    where a hole reaches its border, so that a camera that moves on from the target does not meet
    the next hole there. The paper completes what the target itself sees."""
    ego_mask: bool = True
    """Ignore parts of photographs that stay the same while the camera moves, such as the bonnet of
    the vehicle that carries it. The paper takes photographs as they are."""
    synthesis: SynthesisConfig = SynthesisConfig()
    """How the target image is synthesized."""
    anchor: AnchorConfig = AnchorConfig()
    """Which photograph forms the stereo pair with the synthesized image."""
    registration: RegistrationConfig = RegistrationConfig()
    """How the lifted Gaussians are brought to the scene."""
    free_space: FreeSpaceConfig = FreeSpaceConfig()
    """How candidates keep out of space that photographs saw through."""
    holes: HoleConfig = HoleConfig()
    """What counts as a hole."""
    contradiction: ContradictionConfig = ContradictionConfig()
    """What counts as having moved between photographs."""
    support: SupportConfig = SupportConfig()
    """What counts as no hole only as far as photographs support it."""
    refine: RefineConfig = RefineConfig()
    """How the opacities of the added Gaussians are refined."""
    reconcile: ReconcileConfig = ReconcileConfig()
    """How what is added to a scene that is doubted is brought to agree with its photographs."""
    harm: HarmConfig = HarmConfig()
    """How much worse a photograph may be matched than before."""
    exploration: ExplorationConfig = ExplorationConfig()
    """Where targets are looked for, where nobody names any."""

    @staticmethod
    def paper() -> CompleterConfig:
        """The paper to the letter: the hard hole mask, steps in scene units, sizes that stay what
        they were when a Gaussian slides, every pixel in the losses, nothing checked afterwards.

        `docs/paper.md` lists what remains different, and how ambiguous sentences are read.
        """
        return CompleterConfig(
            margin=0.0,
            ego_mask=False,
            synthesis=SynthesisConfig(correct_color=False, source_depth="monocular"),
            anchor=AnchorConfig(min_baseline=0.0, min_overlap=0.0),
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
                mask_sky=False,
                min_ratio=None,
                carry_into_holes=False,
                affine=AffineConfig(min_agreement=None, min_merged=None),
            ),
            free_space=FreeSpaceConfig(num_steps=0),
            refine=RefineConfig(iterations=30, min_fall=None, learning_rate=0.08),
            holes=HoleConfig(dilation=0, neighbourhood=None),
            harm=HarmConfig(tolerance=None, max_loss=None),
            support=SupportConfig(doubts=False),
            contradiction=ContradictionConfig(min_difference=None),
        )


_NO_DA: dict[str, Any] = {"affine": {"bridge": "none"}}
_NO_RC: dict[str, Any] = {"iterations": 0}
_NO_SA: dict[str, Any] = {"selection": "nearest"}

ABLATIONS: dict[str, dict[str, Any]] = {
    "no-sa": {"anchor": _NO_SA},  # the nearest view instead of the best stereo anchor
    "no-da": {"registration": _NO_DA},  # no affine
    "no-rc": {"registration": _NO_RC},  # no optimisation of distances
    "no-da-rc": {"registration": _NO_DA | _NO_RC},
    "none": {"anchor": _NO_SA, "registration": _NO_DA | _NO_RC},
    "no-mv": {"refine": {"iterations": 0}, "harm": {"tolerance": None}},  # opacities as lifted
    "3-dof": {"registration": {"degrees_of_freedom": 3}},
    "target-aligned": {"registration": {"affine": {"bridge": "target"}}},
    "no-dilation": {"holes": {"dilation": 0}},
    "dilation": {"holes": {"dilation": 3}},
    "theta-30": {"anchor": {"max_rotation": 30.0}},
    "theta-45": {"anchor": {"max_rotation": 45.0}},
    "theta-90": {"anchor": {"max_rotation": 90.0}},
}
"""The paper's ablations: what of a config each changes, so that it lacks (or varies) one thing."""


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
            f"There is no config '{quoted(name)}'; choose default, paper or one of "
            f"{', '.join(ABLATIONS)} (paper/no-sa for an ablation of the paper's settings), or "
            "give a YAML file."
        )
    return updated(bases[base or "default"], ABLATIONS[ablation])


def load_config(source: str) -> CompleterConfig:
    """A config by name, or from a YAML file that names only what differs from its `base`.

    Raises:
        InputError: where the file is missing or not YAML, or names an unknown setting, or a value
            of the wrong type or out of its range.
    """
    path = Path(source)
    if path.suffix not in {".yaml", ".yml"}:
        return named_config(source)
    from gscompleter.config.yaml_file import read_yaml

    changes = read_yaml(path)
    base = named_config(str(changes.pop("base", "default")))
    return updated(base, changes, f"{quoted(source)}: ")
