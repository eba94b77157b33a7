"""Settings of a completion (the defaults, the paper's, and its ablations) and of `clean`."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from annotated_types import Interval, Predicate

from gscompleter.config.settings import (
    COVERED,
    Count,
    Settings,
    Share,
    Weight,
    apply_changes,
)
from gscompleter.system.errors import InputError, quote_value, require_path
from gscompleter.system.plugins import is_in_file

PixelCount = Annotated[int, Interval(ge=0, le=4096)]
StepSize = Annotated[float, Interval(gt=0, le=10)]
SourceDepthName = Literal["context", "monocular", "moge-2-large"]
"""Names of depths of a photograph, which come before folders that are called so."""


@dataclass(frozen=True)
class SynthesisConfig(Settings):
    """Synthesis of the target image by generators with weights; others ignore it."""

    correct_color: bool = True
    """Match the colours of the synthesized image to those of the photographs (not in the paper)."""
    source_depth: SourceDepthName = "context"
    """Default of `complete --generator-depth`: rendered, or by a network; `moge-2-large` is
    that of PE-Field's authors (paper)."""


@dataclass(frozen=True)
class AnchorConfig(Settings):
    """Choice of the photograph that forms the stereo pair with the synthesized image."""

    max_rotation: Annotated[float, Interval(ge=0, le=180)] = 45.0
    """Largest rotation between anchor and target, in degrees, that still leaves overlap."""
    selection: Literal["widest", "nearest"] = "widest"
    """`widest` takes the view with the widest baseline (paper), `nearest` the nearest view."""
    min_baseline: Share = 0.01
    """Smallest baseline between anchor and target, relative to the widest one (paper: 0)."""
    min_overlap: Share = 0.25
    """Smallest share of the observed target image that an anchor should see too (paper: 0)."""


@dataclass(frozen=True)
class AlignmentConfig(Settings):
    """Affine alignment of the lifted depths with the depths of the scene (Eq. 8)."""

    align_at: Literal["anchor", "target", "none"] = "anchor"
    """View at which depths are compared. `target` and `none` are ablations of the paper."""
    min_agreement: Share = 0.3
    """Smallest share of observed target pixels that must agree with the fit at the anchor; below
    it, a fit at the target may replace it (paper: 0, it never does)."""


@dataclass(frozen=True)
class DepthAgreementConfig(Settings):
    """Guard `depth-agreement`: reject targets whose lifted depths disagree with the scene."""

    reject_below: Share = 0.15
    """Add nothing if no fit is found and fewer observed pixels than this share agree."""


@dataclass(frozen=True)
class RegistrationConfig(Settings):
    """Registration of the lifted Gaussians along their rays, as we do it (`stages/register.py`)."""

    iterations: Count = 6
    """Iterations of Adam; 0 keeps the affine alignment (ablation without RC)."""
    learning_rate: StepSize = 0.025
    """Learning rate of Adam, relative to the distance of each Gaussian; it decreases to zero."""
    degrees_of_freedom: Literal[1, 3] = 1
    """1 moves Gaussians along their rays, 3 moves them freely (ablation of the paper)."""
    depth_weight: Weight = 1.0
    """λ_d of Eq. 11."""
    stereo_weight: Weight = 1.0
    """λ_s of Eq. 11."""
    hole_depth: Literal["lifted", "scene"] = "lifted"
    """Depth in holes: of the lifted Gaussians, or continued smoothly from the scene around."""
    extrapolate_into_holes: bool = True
    """Move pixels in a hole like those around it."""


SPLAT_REGISTRATION = RegistrationConfig(hole_depth="scene")
"""Registration to a splat, with further photographs or without any."""


@dataclass(frozen=True)
class PaperRegistrationConfig(Settings):
    """Registration of the lifted Gaussians as in the paper (`stages/register_paper.py`)."""

    iterations: Count = 50
    """Iterations of Adam; 0 keeps the affine alignment (ablation without RC)."""
    learning_rate: StepSize = 0.01
    """Learning rate of Adam, in scene units."""
    degrees_of_freedom: Literal[1, 3] = 1
    """1 moves Gaussians along their rays, 3 moves them freely (ablation)."""
    depth_weight: Weight = 1.0
    """λ_d of Eq. 11."""
    stereo_weight: Weight = 1.0
    """λ_s of Eq. 11."""
    rgb_weight: Weight = 0.1
    """λ_c of Eq. 11."""


@dataclass(frozen=True)
class FreeSpaceConfig(Settings):
    """Guard `free-space`: keep new Gaussians out of space that photographs show to be empty."""

    num_steps: Annotated[int, Interval(ge=1, le=1000)] = 48
    """Steps by which a Gaussian slides back before it is dropped."""


@dataclass(frozen=True)
class HoleConfig(Settings):
    """Definition of the hole mask (Eq. 12)."""

    max_alpha: Annotated[float, Interval(gt=0, le=1)] = COVERED
    """τ of Eq. 12: pixels with less accumulated opacity are holes. Depth comparisons always use
    0.5."""
    min_covered: Share = 0.02
    """Smallest share of the target image that must show the scene; others are skipped."""
    dilation: PixelCount = 3
    """Pixels by which the hole mask is dilated to hide seams; 0 disables it (paper)."""
    kind: Literal["all", "enclosed"] = "all"
    """What is a hole: all empty pixels, or in an object on nothing only those that it encloses."""
    padding: Literal["all", "beside"] = "all"
    """Holes in the padding of the target image that count: all, or those beside a hole that reaches
    the border of the image."""
    forces_removed: bool = False
    """Pixels that showed something removed are holes, whatever stands behind it."""
    keeps_confirmed: bool = False
    """Unless photographs confirm what stands behind it: then it shows the place as it is."""
    candidate_radius: PixelCount | None = 16
    """Distance to a hole, in pixels, within which Gaussians are registered (paper: None, all)."""


@dataclass(frozen=True)
class DynamicMasksConfig(Settings):
    """Guard `dynamic-masks`: copy nothing from regions that moved between photographs."""

    min_color_difference: Annotated[float, Interval(gt=0, le=1)] = 0.12
    """Colour difference, in [0, 1], above which a surface has moved between photographs."""


@dataclass(frozen=True)
class TrustConfig(Settings):
    """Photometric trust in the Gaussians of an input splat."""

    color_sigma: Annotated[float, Interval(gt=0, le=1)] = 0.08
    """Colour difference from a photograph, in [0, 1], at which trust drops to 1/e. It grows with
    the mean error of the scene."""
    angle_sigma: Annotated[float, Interval(gt=0, le=180)] = 20.0
    """Angle between the rays of a photograph and of the camera, in degrees, at which the weight of
    that photograph drops to 1/e."""


@dataclass(frozen=True)
class RefineConfig(Settings):
    """Refinement of colours and opacities of added Gaussians (Eq. 13)."""

    color_rounds: Count = 3
    """Rounds of the colour fit to the synthesized image; 0 keeps the lifted colours (paper)."""
    iterations: Count = 10
    """Most iterations of Adam; 0 keeps the lifted opacities (ablation without MV)."""
    rel_tol: Share | None = 3e-4
    """Stop if the relative decrease of the loss falls to this value. None runs all iterations."""
    learning_rate: StepSize = 0.24
    """Learning rate of Adam, in the unit of `parametrization`."""
    parametrization: Literal["logit", "linear"] = "logit"
    """Optimized variable: the logit, as 3DGS stores it, or the opacity clamped to [0, 1]."""
    target_weight: Weight = 0.1
    """λ of Eq. 13, the weight of the synthesized image."""
    num_views: Count = 2
    """Number of nearest context views in the loss."""


@dataclass(frozen=True)
class RecolorConfig(Settings):
    """Recolouring of Gaussians that cover the target but are not trusted there."""

    hold_weight: Weight = 50.0
    """Weight of a photograph, in whose direction colours are held, against the target's."""
    ridge: Weight = 0.02
    """Weight of small coefficients, relative to the weight of all observations of a Gaussian."""
    iterations: Count = 8
    """Rounds on the residual image."""
    min_change: Share = 6 / 255
    """Largest change of a colour at the target that is not worth a change of the file."""


@dataclass(frozen=True)
class PsnrGuardConfig(Settings):
    """Guard `psnr`: the error budget of the photographs, within which additions must stay.

    A target uses at most half of what the targets before it left of the loss over all targets, so
    that none finds it spent. That loss is at least twice what one target may cause.
    """

    max_drop: Annotated[float, Interval(ge=0, le=100)] = 0.018
    """Largest loss of PSNR of any photograph by one target, in dB over the whole image."""
    max_total_drop: Annotated[float, Interval(ge=0, le=100)] = 0.05
    """Largest loss of PSNR of any photograph by all targets together, in dB."""
    max_ssim_drop: Share = 0.0009
    """Largest loss of SSIM of any photograph by one target."""
    max_total_ssim_drop: Share = 0.0025
    """Largest loss of SSIM of any photograph by all targets together."""
    invisible_psnr: Annotated[float, Interval(ge=0, le=200)] = 45.0
    """PSNR in dB from which on an error is invisible, so that any loss down to it is allowed."""
    max_opacity_loss: Share = 0.75
    """Drop a connected part of the hole if its Gaussians lose more than this share of opacity."""


@dataclass(frozen=True)
class GapConfig(Settings):
    """Closing of thin gaps, which open where the camera moves from a target."""

    displacement: Annotated[float, Interval(ge=0, le=2)] = 0.6
    """Move of the first camera that looks for gaps, away from the photograph nearest to the target,
    relative to their baseline; others stand 0.75 and 1.25 times as far to both sides. 0 closes none
    (paper)."""
    max_alpha: Annotated[float, Interval(gt=0, le=1)] = 0.85
    """Accumulated opacity below which a thin structure is a gap."""


@dataclass(frozen=True)
class NextBestViewConfig(Settings):
    """Search for target cameras if the user names none."""

    bases: Annotated[int, Interval(ge=1, le=1000)] = 16
    """Photographs, spread over the scene, around which candidates are placed."""
    max_step: Annotated[float, Interval(gt=0, le=1)] = 0.2
    """Largest move of a candidate, relative to the depth of the image."""
    yaw_fraction: Annotated[float, Interval(gt=0, le=0.5)] = 0.25
    """Rotation of a candidate, relative to the field of view."""
    image_size: Annotated[int, Interval(ge=16, le=4096)] = 96
    """Longer side, in pixels, of the images in which candidates are scored."""
    border_radius: Share = 0.25
    """Largest distance of a counted hole pixel to observed pixels, relative to that side."""
    clearance: Share = 0.5
    """Depth below which a surface is too close, relative to the nearest 5 % of a photograph, and
    height above the ground below which a candidate is too low, relative to that of a photograph."""
    max_close: Share = 0.1
    """Largest share of the image that surfaces that are too close may fill."""
    min_gain: Share = 0.01
    """Smallest gain, as a share of the image, for which another target is added."""
    enough: Annotated[float, Interval(gt=0, le=1)] = 0.7
    """Share of the best gain that is enough for a nearer camera to be preferred."""


@dataclass(frozen=True)
class FloaterConfig(Settings):
    """Settings of the cleaning without photographs.

    A size is the largest standard deviation of a Gaussian. A spacing is the median distance of
    neighbours, around a Gaussian or in the whole scene, whichever is larger. The radius of the
    scene is half the diagonal of the smallest box around it, without its outliers.
    """

    neighbors: Annotated[int, Interval(ge=2, le=1000)] = 16
    """Number of nearest neighbours that a Gaussian is compared with, by medians."""
    max_gap: Weight = 3.5
    """Isolated: it is farther from its neighbours than this many times the sum of both sizes."""
    max_thickness: Weight = 2.5
    """Huge: its smallest standard deviation exceeds this many spacings; or ..."""
    max_size: Weight = 5.0
    """... its size exceeds this many times that of its neighbours, ..."""
    max_remoteness: Weight = 8.0
    """... and it is farther from them than this many spacings."""
    max_elongation: Annotated[float, Interval(ge=1, le=1e6)] = 30.0
    """Needle: its size exceeds this many times its second largest standard deviation, and both its
    size and its distance from its neighbours exceed `max_size` times their size."""
    min_opacity: Share = 0.01
    """Transparent: its opacity is below this one, or up to ten times this one if it is larger than
    its neighbours: the limit is multiplied by half the ratio of the sizes."""
    min_length: Weight = 0.02
    """Streak: its size exceeds this share of the radius of the scene, ..."""
    min_slenderness: Weight = 4.0
    """... and this many times its second largest standard deviation, ..."""
    max_free: Share = 0.5
    """... and more than this share of it passes through no other Gaussian; or ..."""
    max_uncovered: Share = 0.25
    """... more than this share of what it covers in twelve renders from outside is where nothing
    else is, and more than a third of `max_free` of it passes through no other Gaussian."""

    def strengthen(self, strength: float) -> FloaterConfig:
        """Divide limits of streaks by `strength`, and others by its root; below 1 fewer go.

        Divided by 2, the limits of neighbours take a twentieth of a good splat (decision 085).
        """
        root = math.sqrt(strength)
        return replace(
            self,
            max_gap=self.max_gap / root,
            max_thickness=self.max_thickness / root,
            max_size=self.max_size / root,
            max_remoteness=self.max_remoteness / root,
            max_elongation=max(self.max_elongation / root, 1.0),
            min_opacity=min(self.min_opacity * root, 1.0),
            min_length=self.min_length / strength,
            min_slenderness=self.min_slenderness / strength,
            max_free=min(self.max_free / strength, 1.0),
            max_uncovered=min(self.max_uncovered / strength, 1.0),
        )


@dataclass(frozen=True)
class CleaningConfig(Settings):
    """Settings of the cleaning."""

    min_ratio: Annotated[float, Interval(ge=1, le=1e6)] = 4.0
    """Remove a Gaussian if photographs gain this many times what others lose without it."""
    idle: Weight = 1.0
    """Also remove a Gaussian if the photographs lose at most this many times an equal share of
    their error, spread over all visible Gaussians."""
    tolerance: Annotated[float, Interval(ge=0, le=10)] = 0.01
    """Largest loss of PSNR of a photograph by the whole cleaning, in dB."""
    probes: Annotated[int, Interval(ge=1, le=1000)] = 8
    """Number of random images for the estimate of a Gaussian's influence."""
    floaters: FloaterConfig = FloaterConfig()

    def strengthen(self, strength: float) -> CleaningConfig:
        """Multiply by `strength` what photographs may lose; of `floaters` likewise."""
        return replace(
            self,
            min_ratio=max(self.min_ratio / strength, 1.0),
            idle=self.idle * strength,
            tolerance=self.tolerance * strength,
            floaters=self.floaters.strengthen(strength),
        )


LIFTED_MARGIN = 0.25
"""`margin` for a scene that was lifted from pixels, beside which everything is empty."""

GUARDS = {
    "dynamic-masks": "gscompleter.guards.dynamic_masks:DynamicMasks",
    "image-agreement": "gscompleter.guards.agreement:ImageAgreement",
    "depth-agreement": "gscompleter.guards.agreement:DepthAgreement",
    "free-space": "gscompleter.guards.free_space:FreeSpace",
    "psnr": "gscompleter.guards.psnr:PsnrGuard",
    "completed-targets": "gscompleter.guards.completed_targets:CompletedTargets",
    "contribution": "gscompleter.guards.contribution:Contribution",
    "removal": "gscompleter.editing.removal_guard:Removal",
    "hull": "gscompleter.guards.hull:Hull",
}
"""Module and class of each guard, imported when a preset names it."""
USUAL_GUARDS = tuple(name for name in GUARDS if name not in ("removal", "hull"))
REMOVAL_ALPHA = 0.85
"""`holes.max_alpha` after a removal."""
REMOVAL_RADIUS = 0.05
"""`next_best_view.border_radius` after a removal."""
REMOVAL_GAIN = 0.002
"""`next_best_view.min_gain` after a removal, whose hole is all that is to be filled."""

# A type checker cannot read a Literal that is computed from a table; pydantic and tyro can.
if TYPE_CHECKING:
    GuardName = str
else:
    GuardName = Literal[tuple(GUARDS)]


FileName = Annotated[str, Predicate(is_in_file)]
"""A guard in a file, as in `my_guard.py:KeepOpaque`."""


@dataclass(frozen=True)
class CompleterConfig(Settings):
    """Settings of a completion; `paper()`, the defaults, `splat()` and `bare()` are values of it.

    The defaults are ours where measurements favour them over the paper's (`docs/method.md`).
    """

    trust: Literal["full", "photometric"] = "full"
    """Trust in the scene: `full` takes it as it is (paper), `photometric` counts a Gaussian as far
    as photographs confirm it."""
    guards: tuple[GuardName | FileName, ...] = USUAL_GUARDS
    """Safeguards beyond the paper, in the order in which they are asked (paper: none); one of yours
    as file.py:Class."""
    add_observed: bool = True
    """Add what the photographs of a given scene show and the scene lacks, before Φ invents
    anything (paper: False)."""
    margin: Annotated[float, Interval(ge=0, le=4)] | None = None
    """Padding of the target image on every side, relative to its size, if a hole reaches its
    border, so that nearby cameras see no new hole there (paper: 0). None: 0.25 for a scene that was
    lifted from pixels, 0 for a trained splat."""
    ego_mask: bool = True
    """Ignore image regions that stay the same while the camera moves, such as the bonnet of the
    car that carries it (paper: use all pixels)."""
    synthesis: SynthesisConfig = SynthesisConfig()
    anchor: AnchorConfig = AnchorConfig()
    alignment: AlignmentConfig = AlignmentConfig()
    registration_method: Literal["ours", "paper"] = "ours"
    """Registration: `ours` reads `registration`, `paper` reads `paper_registration`."""
    registration: RegistrationConfig = RegistrationConfig()
    paper_registration: PaperRegistrationConfig = PaperRegistrationConfig()
    holes: HoleConfig = HoleConfig()
    refine: RefineConfig = RefineConfig()
    recolor: RecolorConfig = RecolorConfig()
    trust_settings: TrustConfig = TrustConfig()
    dynamic_masks: DynamicMasksConfig = DynamicMasksConfig()
    depth_agreement: DepthAgreementConfig = DepthAgreementConfig()
    free_space: FreeSpaceConfig = FreeSpaceConfig()
    psnr_guard: PsnrGuardConfig = PsnrGuardConfig()
    gaps: GapConfig = GapConfig()
    next_best_view: NextBestViewConfig = NextBestViewConfig()

    def __post_init__(self) -> None:
        """Raise InputError for another value in place of a group of settings.

        So are settings of the registration that is not used.
        """
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(field.default, Settings) and not isinstance(value, type(field.default)):
                raise InputError(
                    f"The {field.name} of a config has to be of {type(field.default).__name__}, "
                    f"and is {quote_value(value)}."
                )
        # Such settings would change nothing, and a comparison of their values would mislead.
        if self.registration_method == "ours":
            others = "paper_registration"
            is_untouched = self.paper_registration == PaperRegistrationConfig()
        else:
            others = "registration"
            # A preset for splats keeps its own settings if only the method is changed.
            is_untouched = self.registration in (RegistrationConfig(), SPLAT_REGISTRATION)
        if not is_untouched:
            raise InputError(
                f"The settings {others} are changed, and the registration_method "
                f"{self.registration_method} does not read them; choose the other method, or "
                "change its own settings."
            )

    @property
    def footprint(self) -> Literal["constant", "fixed"]:
        """Size of a Gaussian that moves along its ray: that of its image, or its own (paper)."""
        return "constant" if self.registration_method == "ours" else "fixed"

    @property
    def completes_removals_only(self) -> bool:
        """True if only what a removal opened is a hole."""
        return "removal" in self.guards

    @staticmethod
    def splat() -> CompleterConfig:
        """Return the settings for a splat that comes with further photographs."""
        # A trained splat is right where photographs confirm it (decision 019), and none of these
        # may get worse.
        return CompleterConfig(
            trust="photometric",
            guards=("image-agreement", "free-space", "psnr", "completed-targets", "contribution"),
            registration=SPLAT_REGISTRATION,
            holes=HoleConfig(padding="beside"),
        )

    @staticmethod
    def bare() -> CompleterConfig:
        """Return the settings for a splat without photographs, of which renders take their place.

        Renders confirm all that the splat shows, so it has full trust, and they show nothing that
        it lacks. Nothing moves in them. The error budgets are not relative to their error, which is
        zero: what is invisible is allowed (`psnr_guard.invisible_psnr`). No photograph tests what
        is added, so no more is added than the hole asks for.
        """
        return CompleterConfig(
            guards=("image-agreement", "free-space", "psnr", "completed-targets", "contribution"),
            add_observed=False,
            registration=SPLAT_REGISTRATION,
            holes=HoleConfig(padding="beside"),
        )

    @staticmethod
    def paper() -> CompleterConfig:
        """Return the settings of the paper; `docs/paper.md` lists the remaining differences."""
        return CompleterConfig(
            guards=(),
            add_observed=False,
            margin=0.0,
            ego_mask=False,
            synthesis=SynthesisConfig(correct_color=False, source_depth="moge-2-large"),
            anchor=AnchorConfig(min_baseline=0.0, min_overlap=0.0),
            alignment=AlignmentConfig(min_agreement=0.0),
            registration_method="paper",
            refine=RefineConfig(color_rounds=0, iterations=30, rel_tol=None, learning_rate=0.08),
            holes=HoleConfig(dilation=0, candidate_radius=None),
            gaps=GapConfig(displacement=0.0),
        )

    def for_removal(self) -> CompleterConfig:
        """Return the same settings for a splat that something is removed from.

        Nothing but the hole is completed. Gaussians at its border are often half transparent, and
        targets are best that show much of that border.
        """
        # First in the list: the others judge what it leaves in the hole.
        others = tuple(name for name in self.guards if name != "removal")
        return replace(
            self,
            trust="full",
            guards=("removal", *others),
            # Its photographs still show what was removed.
            add_observed=False,
            holes=replace(self.holes, max_alpha=REMOVAL_ALPHA),
            next_best_view=replace(
                self.next_best_view, border_radius=REMOVAL_RADIUS, min_gain=REMOVAL_GAIN
            ),
        )

    def for_marks(self) -> CompleterConfig:
        """Return the same settings for a splat of which the user marked what is wrong.

        That is removed, and its place is a hole whatever stands behind it, unless photographs
        confirm that.
        """
        removal = self.for_removal()
        return replace(removal, holes=replace(removal.holes, forces_removed=True))

    def for_photographs(self) -> CompleterConfig:
        """Return the same settings for a splat with photographs, instead of renders of itself.

        They tell whether what stands behind something that is marked is right.
        """
        return replace(self, holes=replace(self.holes, keeps_confirmed=True))

    def for_object(self) -> CompleterConfig:
        """Return the same settings for an object that stands on nothing.

        Only holes that it encloses are completed, and nothing is added outside of its hull.
        """
        # Last in the list: `free-space` moves candidates.
        others = tuple(name for name in self.guards if name != "hull")
        holes = replace(self.holes, kind="enclosed")
        return replace(self, guards=(*others, "hull"), holes=holes)

    def for_holes(self, kind: Literal["all", "enclosed"]) -> CompleterConfig:
        """Return the same settings for holes of a kind: all, or those that an object encloses."""
        if kind == "enclosed":
            return self.for_object()
        return replace(self, holes=replace(self.holes, kind=kind))

    def choose_margin(self, is_lifted: bool) -> CompleterConfig:
        """Return the same settings with a padding for what the scene is, unless it is given.

        A trained splat is opaque beyond what was photographed, and needs no padding.
        """
        if self.margin is not None:
            return self
        return replace(self, margin=LIFTED_MARGIN if is_lifted else 0.0)

    def without_guard(self, name: GuardName) -> CompleterConfig:
        """Return the same settings without one guard."""
        return replace(self, guards=tuple(guard for guard in self.guards if guard != name))


_NO_DA: dict[str, Any] = {"align_at": "none"}
_NO_RC: dict[str, Any] = {"iterations": 0}
_NO_SA: dict[str, Any] = {"selection": "nearest"}

ABLATIONS: dict[str, dict[str, Any]] = {
    "no-sa": {"anchor": _NO_SA},  # the nearest view instead of the best stereo anchor
    "no-da": {"alignment": _NO_DA},  # no affine
    "no-rc": {"registration": _NO_RC},  # no optimisation of distances
    "no-da-rc": {"alignment": _NO_DA, "registration": _NO_RC},
    "none": {"anchor": _NO_SA, "alignment": _NO_DA, "registration": _NO_RC},
    "no-mv": {"refine": {"iterations": 0}},  # opacities as lifted; without the guard `psnr`, too
    "3-dof": {"registration": {"degrees_of_freedom": 3}},
    "target-aligned": {"alignment": {"align_at": "target"}},
    "no-dilation": {"holes": {"dilation": 0}},
    "dilation": {"holes": {"dilation": 3}},
    "theta-30": {"anchor": {"max_rotation": 30.0}},
    "theta-45": {"anchor": {"max_rotation": 45.0}},
    "theta-90": {"anchor": {"max_rotation": 90.0}},
}
"""Changes to a config for each ablation of the paper. `registration` stands for the settings of the
registration that the config names."""


def get_named_config(
    name: str, is_splat: bool = False, has_photographs: bool = True
) -> CompleterConfig:
    """Return `default`, `splat`, `bare` or `paper`, or one with an ablation: `paper/no-sa`.

    `default` follows the input: it is `splat` for a splat that comes with further photographs, and
    `bare` for one without any.
    """
    for_splats = CompleterConfig.splat() if has_photographs else CompleterConfig.bare()
    bases = {
        "default": for_splats if is_splat else CompleterConfig(),
        "splat": CompleterConfig.splat(),
        "bare": CompleterConfig.bare(),
        "paper": CompleterConfig.paper(),
    }
    if name in bases:
        return bases[name]

    # `no-sa` alone is an ablation of the default, `paper/no-sa` one of the paper's settings.
    base, _, ablation = name.rpartition("/")
    if (base or "default") not in bases or ablation not in ABLATIONS:
        raise InputError(
            f"There is no config '{quote_value(name)}'; choose default, splat, bare, paper or one "
            f"of {', '.join(ABLATIONS)} (paper/no-sa for an ablation of the paper's settings), or "
            "give a YAML file."
        )

    # An ablation changes the registration that its base names; the other one is not read.
    base_config = bases[base or "default"]
    changes = dict(ABLATIONS[ablation])
    if "registration" in changes and base_config.registration_method == "paper":
        changes["paper_registration"] = changes.pop("registration")
    config = apply_changes(base_config, changes)

    # The guard would fade what the missing refinement leaves too opaque, and hide its effect.
    return config.without_guard("psnr") if ablation == "no-mv" else config


def load_config(
    source: Path | str,
    is_splat: bool = False,
    has_photographs: bool = True,
    adapt: Callable[[CompleterConfig], CompleterConfig] = lambda config: config,
) -> CompleterConfig:
    """Return a config by name, or read the changes to its `base` from a YAML file.

    `adapt` changes the named config, as `CompleterConfig.for_removal` does; a file's changes win.
    """
    changes = read_file_changes(source)
    if changes is None:
        return adapt(get_named_config(os.fspath(source), is_splat, has_photographs))
    base_name = str(changes.pop("base", "default"))
    base = adapt(get_named_config(base_name, is_splat, has_photographs))
    return apply_changes(base, changes, f"{quote_value(source)}: ")


def read_file_changes(source: Path | str) -> dict[str, Any] | None:
    """Read the changes of a YAML file, and the name of its `base`; None for a named config.

    Their names and values are not checked yet.
    """
    # A name is no path, and may be longer than one.
    is_given = isinstance(source, (str, os.PathLike)) and bool(os.fspath(source))
    if is_given and Path(source).suffix not in {".yaml", ".yml"}:
        return None
    path = require_path(source)
    # Imported here, so that only a file waits for PyYAML.
    from gscompleter.config.yaml_file import read_yaml

    return read_yaml(path)
