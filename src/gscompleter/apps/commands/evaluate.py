"""The command `evaluate`: run and score methods, and write tables and figures of the paper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro
from annotated_types import Interval

from gscompleter.apps.commands.engines import decide_engine
from gscompleter.apps.commands.shared_decisions import check_generator
from gscompleter.apps.commands.shared_options import (
    EngineOptions,
    MaskOptions,
    SynthesisOptions,
    list_inputs,
    replace_by_scenes,
)
from gscompleter.apps.requests.evaluation import (
    CasesRequest,
    ComparisonRequest,
    EvaluationRequest,
    ReproductionRequest,
)
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.apps.requests.scene import Size
from gscompleter.config.generators import (
    PREFIX,
    GeneratorOptions,
    GeneratorSettings,
    get_settings_class,
)
from gscompleter.data.mask_reading import MaskReading
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.overlap import refuse_overlap
from gscompleter.system.jobs.engine_names import EngineName
from gscompleter.system.process import import_without_collection

if TYPE_CHECKING:
    from gscompleter.evaluation.paper import DataSet

# fmt: off
TableName = Literal[
    "models", "ablation", "refinement", "time", "dof", "alignment", "spans", "stress", "steps",
    "rotation", "paradigms", "sequence", "all",
]
FigureName = Literal[
    "qualitative", "densification", "registration", "seams", "sequence", "all"
]
# fmt: on
ComparedKind = Literal["depth", "generator"]
"""Kind of models that are compared in a table of their own."""

FIGURE_OPTIONS = ("figure_cases", "outlines", "crops")
"""Options of figures alone."""
AUTO = "auto"
"""Generator of the preset, or else the default one."""
DEPTH_WORDS = ("depth", "depth-weights")
"""Kind and option of `assign_weights` for a monocular depth."""
WEIGHTS_SETTING = "generator_weights"
"""Setting that several generators cannot share: a file of weights is of one network."""


@dataclass(frozen=True)
class PresetGeneratorOptions(GeneratorOptions):
    """Models that synthesize images, and their settings."""

    # The parent has one generator; a type checker allows no other type.
    generator: tuple[str, ...] = (AUTO,)  # type: ignore[assignment]
    """Model that synthesizes the image at a target. As in `complete`; `auto` is that of the preset,
    or else warp-inpaint; several are compared in one table, and a setting goes to those of them
    that have it."""

    def make_settings(self) -> GeneratorSettings:
        """Return the settings of the only generator; errors are as in `GeneratorOptions`."""
        (name,) = self.generator
        return GeneratorOptions(**{**vars(self), "generator": name}).make_settings()

    def share_settings(self) -> dict[str, PresetGeneratorOptions]:
        """Return, by generator, options with it alone and those of the given settings that it has.

        Raises:
            InputError: None of the generators has a given setting, or several would take the
                weights.
        """
        given = {
            setting: value
            for setting, value in vars(self).items()
            if setting.startswith(PREFIX) and value != getattr(PresetGeneratorOptions, setting)
        }
        taken: dict[str, dict[str, Any]] = {name: {} for name in self.generator}
        for setting, value in given.items():
            takers = [
                name
                for name in self.generator
                if hasattr(get_settings_class(name), setting.removeprefix(PREFIX))
            ]
            if not takers:
                raise InputError(
                    f"None of the generators {', '.join(taken)} has this setting; leave it out.",
                    setting,
                )
            if setting == WEIGHTS_SETTING and len(takers) > 1:
                raise InputError(
                    f"These weights would be taken by {' and '.join(takers)}; compare them without "
                    "weights of your own, or one after the other.",
                    setting,
                )
            for name in takers:
                taken[name][setting] = value
        return {
            name: PresetGeneratorOptions((name,), **settings) for name, settings in taken.items()
        }


@dataclass(frozen=True, kw_only=True)
class EvaluateOptions(SynthesisOptions, EngineOptions, MaskOptions):
    """Run methods on cases with known target photographs, and score them.

    Run the same command again to continue. `gscompleter tables OUT` writes the tables at any time.
    With a preset, a table, a figure or several reconstructors it writes tables and figures of the
    paper instead, with several depths or generators one table that compares them.

    Example: gscompleter evaluate cases.json --methods context full --out scores
    """

    paths: Annotated[tuple[Path, ...], tyro.conf.Positional, tyro.conf.arg(metavar="PATH")]
    """A cases.json; or, with --protocol, scenes: folders with a transforms.json, folders of such
    folders, a file of scenes, pixelSplat chunks, RealEstate10K camera files, or drives (Waymo,
    nuScenes, KITTI, DDAD, PandaSet; front camera)."""
    out: Path
    """Write results here. A folder; that of an earlier run is continued."""
    protocol: tuple[str, ...] = ()
    """Choice of context and target frames. One or several of: n-10 (frames n and n + 10 for n + 20,
    then n + 20 and n + 10 for n, for n = 0, 21, 42, …); stress (0 and 30 for 99) or stress-12-39
    (0 and 12 for 39); sequence-4 or sequence-4-steps-6 (start from frames 0 and 4, then complete 8,
    12, … one after the other); or an evaluation index, by its path or as dl3dv-n-10, re10k-n-30,
    acid-n-30 or dl3dv-stress, which are ours. A cases.json needs none."""
    methods: tuple[str, ...] = ("context", "full", "paper")
    """Methods to compare: context, full, paper, an ablation such as no-sa, densify-100,
    densify-800, distill, reggs; or a group: ablations, baselines, all. Tables and figures of the
    paper have their own."""
    preset: Literal["re10k", "acid", "dl3dv", "waymo"] | None = None
    """Data set of the paper, which sets protocol, resolution, near, far, reconstructors and
    generator where they are not given. At its own resolution photographs are cropped, and scenes
    left out, as by the code of the models' authors."""
    table: tuple[TableName, ...] = ()
    """Tables of the paper to write; `all` leaves out those that need another generator."""
    figure: tuple[FigureName, ...] = ()
    """Figures of the paper to draw."""
    figure_cases: tuple[str, ...] = ()
    """Cases of the figures, named as in the tables; by default the first eight."""
    outlines: bool = False
    """Outline the holes in figures."""
    crops: bool = False
    """Show the widest hole of each case in figures magnified."""
    reconstructor: tuple[str, ...] = ()
    """Model that turns photographs into Gaussians. It is plane-sweep (the default), or one or
    several of `gscompleter models`, or functions of yours as file.py:function."""
    # As for the generator: the parent has one depth.
    depth: tuple[str, ...] = ("none",)  # type: ignore[assignment]
    """Monocular depth that helps plane-sweep where stereo measures nothing. It is none, moge-2, or
    a function of yours as file.py:function; several are compared in one table."""
    depth_weights: tuple[Path, ...] = ()  # type: ignore[assignment]
    """Weights of that depth. A file for each, or NAME=FILE for some of them; others are
    downloaded."""
    weights: tuple[Path, ...] = ()
    """Weights of the reconstructor. A file for each, or NAME=FILE for some of them, as in
    mvsplat-re10k=re10k.ckpt; others are downloaded."""
    synthesis: Annotated[PresetGeneratorOptions, tyro.conf.OmitArgPrefixes] = (
        PresetGeneratorOptions()
    )
    near: float | None = None
    """Smallest depth in the scene, in the unit of its cameras. By default that of the data, or else
    of the model's authors."""
    far: float | None = None
    """Largest depth in the scene, in the unit of its cameras. By default as for near."""
    rerun: Literal["nothing", "failures", "scores"] = "nothing"
    """Repeat this part of an earlier run in OUT. Nothing, the cases that failed, or the scores of
    all saved predictions."""
    engine: EngineName | None = None
    """Engine that runs jobs or cases: processes of this machine, Ray, or SLURM. This process if not
    given."""
    resolution: Size | None = None
    """Size of images in pixels. The working size as in `complete`; by default that of the cases."""
    no_masks: bool = False
    """Use what masks and alpha channels of photographs hide instead of ignoring it. In the
    methods and in the scores."""
    ignore_moving: bool = False
    """Ignore boxes of moving objects in the same way (Waymo, nuScenes)."""
    one_per_scene: bool = False
    """Run only the first case of each scene and protocol, as the paper does."""
    no_ego_mask: bool = False
    """Use also what stays the same while the camera moves, such as the bonnet of its car, instead
    of ignoring it."""
    no_refine_poses: bool = False
    """Keep the given poses of photographs; else those that matches contradict are refined. Once for
    a scene, and not with a preset, a table or figure of the paper, or an evaluation index."""
    limit: Annotated[int, Interval(ge=1)] | None = None
    """Most cases to run, over all shards."""
    apart: bool = False
    """Use also the cases that their file keeps apart, for reports of what was decided without them.
    run.json and the tables say so, and apart_uses.md beside the file counts it."""

    def check_overlap(self) -> None:
        """Refuse an output that is, holds or lies in an input."""
        # Weights may be given as NAME=FILE, which is no path.
        files = [
            *assign_weights(choose_reconstructors(self), self.weights).values(),
            *assign_weights(self.depth, self.depth_weights, *DEPTH_WORDS).values(),
        ]
        others = list_inputs(replace(self, weights=(), depth_weights=()))
        inputs = [*others, *(file for file in files if file is not None)]
        refuse_overlap(self.out, replace_by_scenes(inputs, self.paths))


def choose_reconstructors(options: EvaluateOptions) -> tuple[str, ...]:
    """Return the reconstructors that are named, or else those of the preset, or the default one."""
    from gscompleter.evaluation.paper import get_data_set  # no help page waits for torch

    return options.reconstructor or get_data_set(options.preset).reconstructor


def decide_evaluation(
    options: EvaluateOptions,
) -> EvaluationRequest | ComparisonRequest | ReproductionRequest:
    """Decide which methods run with which models, or which tables and figures need them.

    The result runs one choice of models, compares several depths or generators in one table, or
    reproduces tables and figures of the paper.
    """
    from gscompleter.evaluation.paper import get_data_set  # no help page waits for torch

    # What is not given is as in the preset, or as without one.
    preset = get_data_set(options.preset)
    reconstructors = choose_reconstructors(options)
    is_reproduction = bool(
        options.preset or options.table or options.figure or len(reconstructors) > 1
    )
    generators = tuple(
        preset.generator if name == AUTO else name for name in options.synthesis.generator
    )
    refuse_repeated(reconstructors, options.depth, generators)
    refuse_unused(options, is_reproduction)
    for generator in generators:
        check_generator(generator)
    compared = find_compared(options.depth, generators, is_reproduction)
    if not options.paths:
        raise InputError("No data is given; name a cases.json, or scenes with --protocol.")

    weights = assign_weights(reconstructors, options.weights)
    depth_weights = assign_weights(options.depth, options.depth_weights, *DEPTH_WORDS)
    models = decide_models_by_generator(
        options, generators, reconstructors[0], weights[reconstructors[0]], depth_weights
    )
    run = EvaluationRequest(
        cases=decide_cases(options, preset, is_reproduction),
        methods=options.methods,
        models=models[generators[0]],
        out=options.out,
        rerun=options.rerun,
        engine=decide_engine(options),
        answer=options.answer,
    )
    if compared == "depth":
        with_depths = {
            depth: replace(run.models, depth=depth, depth_weights=own)
            for depth, own in depth_weights.items()
        }
        return ComparisonRequest(run=run, kind=compared, models=with_depths)
    if compared == "generator":
        return ComparisonRequest(run=run, kind=compared, models=models)
    if not is_reproduction:
        return run
    return ReproductionRequest(
        run=run,
        weights=weights,
        tables=options.table,
        figures=options.figure,
        figure_cases=options.figure_cases,
        has_outlines=options.outlines,
        has_crops=options.crops,
    )


def decide_cases(options: EvaluateOptions, preset: DataSet, is_reproduction: bool) -> CasesRequest:
    """Decide which cases are evaluated, and how their data are read."""
    return CasesRequest(
        paths=options.paths,
        protocol=options.protocol,
        preset=options.preset,
        resolution=preset.resolution if options.resolution is None else options.resolution,
        near=preset.near if options.near is None else options.near,
        far=preset.far if options.far is None else options.far,
        uses_masks=not options.no_masks,
        masks=MaskReading(options.invert_masks, options.large_masks),
        ignore_moving=options.ignore_moving,
        one_per_scene=options.one_per_scene,
        ego_mask=not options.no_ego_mask,
        # Numbers of others stand beside those of the paper, whose data are as they were given.
        refines_poses=not (options.no_refine_poses or is_reproduction),
        limit=options.limit,
        apart=options.apart,
    )


def decide_models_by_generator(
    options: EvaluateOptions,
    generators: tuple[str, ...],
    reconstructor: str,
    weights: Path | None,
    depth_weights: Mapping[str, Path | None],
) -> dict[str, ModelRequest]:
    """Decide on the models that run with each generator, by its name.

    The other arguments are those of `decide_run_models`.
    """
    synthesis = replace(options.synthesis, generator=generators)
    # A single generator refuses a setting that it does not have in a sentence of its own.
    shared = synthesis.share_settings() if len(generators) > 1 else {generators[0]: synthesis}
    return {
        generator: decide_run_models(options, reconstructor, weights, depth_weights, own)
        for generator, own in shared.items()
    }


def refuse_repeated(
    reconstructors: Sequence[str], depths: Sequence[str], generators: Sequence[str]
) -> None:
    """Refuse a model that is named twice, and options that name none."""
    if len(set(reconstructors)) < len(reconstructors):
        raise InputError("A reconstructor is named twice; name each once.", "reconstructor")
    if not depths or len(set(depths)) < len(depths):
        raise InputError("A depth is named twice, or none is; name each once.", "depth")
    if not generators or len(set(generators)) < len(generators):
        raise InputError("A generator is named twice, or none is; name each once.", "generator")


def refuse_unused(options: EvaluateOptions, is_reproduction: bool) -> None:
    """Refuse options that nothing would follow."""
    for name in FIGURE_OPTIONS:
        if getattr(options, name) and not options.figure:
            raise InputError("There is no figure to apply this to; name one with --figure.", name)
    if is_reproduction and options.methods != EvaluateOptions.methods:
        raise InputError(
            "Tables and figures of the paper have methods of their own; leave this out.", "methods"
        )


def find_compared(
    depths: Sequence[str], generators: Sequence[str], is_reproduction: bool
) -> ComparedKind | None:
    """Find the kind of which several models are named, or None.

    Raise InputError if several of both kinds are, or some beside a reproduction of the paper.
    """
    named: dict[ComparedKind, Sequence[str]] = {"depth": depths, "generator": generators}
    several = [kind for kind, names in named.items() if len(names) > 1]
    if not several:
        return None
    kind = several[0]
    if len(several) > 1:
        raise InputError(
            "Depths and generators are compared one after the other; name several depths with one "
            "generator, or several generators with one depth.",
            kind,
        )
    if is_reproduction:
        raise InputError(
            f"Several {kind}s are compared with one reconstructor, in a table of their own; leave "
            "--preset, --table and --figure out, and name one reconstructor.",
            kind,
        )
    return kind


def decide_run_models(
    options: EvaluateOptions,
    reconstructor: str,
    weights: Path | None,
    depth_weights: Mapping[str, Path | None],
    synthesis: PresetGeneratorOptions,
) -> ModelRequest:
    """Decide on the models of a run and their devices.

    Of several depths it takes the first. `weights` are those of the reconstructor, `depth_weights`
    those by depth; `synthesis` names one generator.
    """
    from gscompleter.render.device import choose_devices

    devices = choose_devices(options.device, options.renderer_device, options.network_device)
    return ModelRequest(
        reconstructor=reconstructor,
        weights=weights,
        depth=options.depth[0],
        depth_weights=depth_weights[options.depth[0]],
        generator=synthesis.generator[0],
        generator_settings=synthesis.make_settings(),
        device=devices.renderer,
        network_device=devices.networks,
        seed=options.seed,
    )


def assign_weights(
    models: Sequence[str],
    weights: Sequence[Path],
    kind: str = "reconstructor",
    option: str = "weights",
) -> dict[str, Path | None]:
    """Assign files of weights to models: one for each in their order, or by `NAME=FILE`.

    Models without a file get None, for the published one. `kind` and `option` name the models and
    the option in errors.

    Raises:
        InputError: A file has no model, or a model two files.
    """
    named: dict[str, Path] = {}
    plain: list[Path] = []
    for word in weights:
        # A path may contain `=`, too; only a known name before it makes it NAME=FILE.
        name, _, file = str(word).partition("=")
        if file and name in models:
            if name in named:
                raise InputError(
                    f"{quote_value(name)} is given two files of weights; give one.", option
                )
            named[name] = Path(file)
        else:
            plain.append(word)
    if plain and (named or len(plain) != len(models)):
        raise InputError(
            f"{quote_value(plain[0])} belongs to no {kind}; give --{option} one file for "
            f"each of {', '.join(models)} in this order, or {models[0]}=FILE for some of them."
        )
    # There are as many plain files as models, or none.
    files = dict(zip(models, plain, strict=True)) if plain else named
    return {model: files.get(model) for model in models}


def run_evaluate(options: EvaluateOptions) -> int:
    """Run and score the methods, or write tables and figures; return the exit code."""
    # No help page waits for torch.
    with import_without_collection():
        from gscompleter.apps.evaluating.reproduction import run_evaluation
    return run_evaluation(decide_evaluation(options))
