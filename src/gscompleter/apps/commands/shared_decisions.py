"""Decisions that several commands share: from options to the parts of a request.

Options that exclude each other are refused here and in the files of the commands, nowhere below.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Literal

from gscompleter.apps.command_line.named_splat import names_splat
from gscompleter.apps.commands.shared_options import (
    CompletingOptions,
    ReconstructorOptions,
    SceneOptions,
)
from gscompleter.apps.requests.completion import (
    CompletionRequest,
    ResultsRequest,
    TargetRequest,
    WorkRequest,
)
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.apps.requests.scene import (
    AloneRequest,
    Names,
    PhotographsRequest,
    PosesRequest,
    SceneRequest,
    decide_resolution,
)
from gscompleter.apps.requests.splat import SplatRequest
from gscompleter.config import CompleterConfig
from gscompleter.config.generators import GeneratorOptions
from gscompleter.data.mask_reading import MaskReading
from gscompleter.system.errors import InputError, quote_value

# Functions import what needs torch when they are called, so that no help page waits for it.

PHOTOGRAPH_OPTIONS = (
    *("format", "frames", "no_refine_poses", "no_masks", "ignore"),
    # It needs both: edits of a splat matter to photographs, which still show what was taken out.
    "forget_edits",
)
"""Options that only photographs can follow. A default that is typed all the same cannot be told
from one that is not."""
SPLAT_OPTIONS = ("drop_nonfinite", "ignore_properties", "forget_edits")
"""Switches that only a splat can follow."""

Adapt = Callable[[CompleterConfig], CompleterConfig]
"""Changes a config for what a command does."""


def decide_filling(
    options: CompletingOptions,
    targets: TargetRequest,
    results: ResultsRequest,
    *,
    context: Names | None,
    synthesis: GeneratorOptions,
    has_marks: bool,
    adapt: Adapt = lambda config: config,
) -> CompletionRequest:
    """Decide which holes of which scene are filled, and by what.

    Args:
        options: What the user gave. Those that exclude each other in one command alone were refused
            before.
        targets: Cameras at which holes are filled.
        results: What is written, and where.
        context: That of the options, or the one that the images were painted for.
        synthesis: The generator of the options, or that of painted images.
        has_marks: True if the command has masks of what goes. `--invert-masks` is then for them,
            and not for masks of photographs.
        adapt: Changes the config for what a command does.

    Raises:
        InputError: Options exclude each other, or a model, setting or device is not there.
    """
    check_source_options(options, has_marks)
    models = decide_models(options, synthesis)
    lacks_photographs = has_splat_alone(options)
    # A splat without photographs may be SCENE itself.
    path = options.folder if lacks_photographs and options.scene is None else options.scene
    splat = None if path is None else decide_splat(options, path)
    config = decide_config(options, adapt)

    masks = MaskReading(
        options.invert_masks and not has_marks,
        options.large_masks,
        is_turned_by_option=not has_marks,
        folder=options.ignore,
    )
    source: PhotographsRequest | AloneRequest
    if lacks_photographs:
        assert splat is not None
        scene = decide_scene(options, splat.path, masks, has_splat=True)
        kind = choose_hole_kind(options, config)
        source = AloneRequest(scene, context, options.cameras, options.up, kind)
    else:
        assert options.folder is not None
        scene = decide_scene(options, options.folder, masks, splat is not None)
        named = (*(context or ()), *targets.named)
        poses = PosesRequest(options.out, options.overwrite, options.frames, named)
        source = PhotographsRequest(scene, poses, context)
    work = WorkRequest(splat=splat, geometry=options.geometry, models=models, config=config)
    return CompletionRequest(source=source, work=work, targets=targets, results=results)


def decide_config(
    options: CompletingOptions, adapt: Adapt = lambda config: config
) -> CompleterConfig:
    """Decide on the settings of the method: those of `--config`, and what other options change."""
    lacks_photographs = has_splat_alone(options)
    is_splat = lacks_photographs or options.scene is not None
    config = options.config.decide(is_splat, not lacks_photographs, adapt)
    if options.no_recolor:
        config = stop_recoloring(config)
    # With photographs, a scene is what they show, unless the user says otherwise. Of a splat alone
    # the kind is decided when it was read.
    kind = choose_hole_kind(options, config)
    if not lacks_photographs and kind != "auto":
        config = config.for_holes(kind)
    return config


def choose_hole_kind(
    options: CompletingOptions, config: CompleterConfig
) -> Literal["auto", "all", "enclosed"]:
    """Choose which holes are filled: those of the option, or else of the setting if it was given.

    `config` is that of the options. Raises InputError if both are given and differ.
    """
    if not options.config.gives("holes", "kind"):
        return options.holes
    if options.holes not in ("auto", config.holes.kind):
        raise InputError(
            f"--holes is {options.holes}, and the setting holes.kind is {config.holes.kind}; give "
            "one of them.",
            "holes",
        )
    return config.holes.kind


def decide_results(options: SceneOptions) -> ResultsRequest:
    """Decide where results are written."""
    return ResultsRequest(out=options.out, overwrite=options.overwrite, answer=options.answer)


def decide_scene(
    options: SceneOptions, folder: Path, masks: MaskReading, has_splat: bool
) -> SceneRequest:
    """Decide how the photographs in a folder are read, or the splat in their place.

    With a splat (`has_splat`) the default resolution is that of its training, if that is smaller.
    """
    check_mask_options(options, masks)
    return SceneRequest(
        folder,
        options.format,
        decide_resolution(options.resolution),
        follows_training=has_splat and options.resolution is None,
        near=options.near,
        far=options.far,
        uses_given_depth=not options.no_given_depth,
        refines_poses=not options.no_refine_poses,
        uses_masks=not options.no_masks,
        masks=masks,
    )


def decide_photographs(options: SceneOptions, folder: Path) -> PhotographsRequest:
    """Decide how the photographs of a splat are read by a command that has no targets."""
    masks = MaskReading(options.invert_masks, options.large_masks, folder=options.ignore)
    poses = PosesRequest(options.out, options.overwrite, options.frames, options.context or ())
    return PhotographsRequest(
        decide_scene(options, folder, masks, has_splat=True), poses, options.context
    )


def decide_splat(options: SceneOptions, path: Path) -> SplatRequest:
    """Decide how a splat is read."""
    from gscompleter.splats.foreign import resolve_splat

    return SplatRequest(
        resolve_splat(path),
        drop_nonfinite=options.drop_nonfinite,
        ignore_properties=options.ignore_properties,
        forget_edits=options.forget_edits,
        beside=options.out,
    )


def decide_models(options: ReconstructorOptions, synthesis: GeneratorOptions) -> ModelRequest:
    """Decide on models and their devices.

    Raises:
        InputError: A reconstructor, generator, setting or device is not there. What is wrong with a
            monocular depth or with weights is found when they are loaded.
    """
    from gscompleter.reconstructors import check_reconstructor
    from gscompleter.render.device import choose_devices

    check_reconstructor(options.reconstructor)
    settings = synthesis.make_settings()
    devices = choose_devices(options.device, options.renderer_device, options.network_device)
    return ModelRequest(
        reconstructor=options.reconstructor,
        weights=options.weights,
        depth=options.depth,
        depth_weights=options.depth_weights,
        generator=synthesis.generator,
        generator_settings=settings,
        device=devices.renderer,
        network_device=devices.networks,
        seed=options.seed,
    )


def stop_recoloring(config: CompleterConfig) -> CompleterConfig:
    """Return a config that keeps all colours of the splat."""
    return replace(config, recolor=replace(config.recolor, iterations=0))


def has_splat_alone(options: CompletingOptions) -> bool:
    """Return True for a splat without photographs: SCENE is left out, or is the splat itself."""
    return options.folder is None or names_splat(options.folder)


def check_splat_named(options: CompletingOptions, what: str) -> None:
    """Refuse a command that takes something out of a splat where none is named.

    `what` happens to it, such as "removed".
    """
    if options.scene is not None or has_splat_alone(options):
        return
    # A splat that is not there is no folder of photographs.
    if options.folder is not None and not os.path.exists(options.folder):
        raise InputError(f"There is no {quote_value(options.folder)}; correct the path.")
    raise InputError(
        f"Without a splat there is nothing that could be {what}; name it with --scene.", "scene"
    )


def check_source_options(options: CompletingOptions, has_marks: bool) -> None:
    """Refuse options that photographs, or a splat, would have to be there for."""
    if has_splat_alone(options):
        check_options_alone(options, has_marks)
        return
    if options.cameras is not None:
        raise InputError(
            "The photographs of SCENE have cameras of their own; leave --cameras out, or name the "
            "splat alone.",
            "cameras",
        )
    if options.up is not None:
        raise InputError("The photographs of SCENE tell what is up; leave --up out.", "up")
    for name in SPLAT_OPTIONS:
        if options.scene is None and getattr(options, name):
            raise InputError("There is no splat to apply this to; name it with --scene.", name)


def check_options_alone(options: CompletingOptions, has_marks: bool) -> None:
    """Refuse two splats, none, and options of photographs where a splat is alone."""
    if options.folder is not None and options.scene is not None:
        raise make_two_splats_error(options.folder, options.scene)
    if options.folder is None and options.scene is None:
        raise InputError(
            "Nothing is named that is to be completed; name SCENE, the folder of photographs, or "
            "a splat."
        )
    for name in PHOTOGRAPH_OPTIONS:
        if getattr(options, name) != getattr(SceneOptions, name):
            raise InputError(
                "There are no photographs to apply this to; name their folder as SCENE.", name
            )
    if options.invert_masks and not has_marks:
        raise InputError(
            "There are no photographs whose masks could be read the other way round, and no --mask "
            "is given; leave it out.",
            "invert-masks",
        )
    if options.large_masks and not has_marks:
        raise InputError("There are no masks that could be too large; leave it out.", "large-masks")


def make_two_splats_error(folder: Path, scene: Path) -> InputError:
    """Make the error for a splat that is named as SCENE where `--scene` names something, too."""
    from gscompleter.splats.foreign import resolve_splat

    # The two are easily taken for each other.
    if os.path.exists(scene) and not names_splat(resolve_splat(scene)):
        return InputError(
            f"SCENE, {quote_value(folder, 80)}, is a splat, and {quote_value(scene, 80)} does not "
            "look like one; name the photographs as SCENE, and the splat with --scene."
        )
    return InputError(
        f"Two splats are named, {quote_value(folder, 80)} and {quote_value(scene, 80)}; name one, "
        "and as SCENE only its photographs.",
        "scene",
    )


def check_mask_options(options: SceneOptions, masks: MaskReading) -> None:
    """Refuse options on masks of photographs where none is used; `masks` is how they are read."""
    if not options.no_masks:
        return
    if masks.is_inverted:
        raise InputError(
            "--no-masks leaves out the masks that would be read the other way round; give one of "
            "both.",
            "invert-masks",
        )
    if masks.folder is not None:
        raise InputError(
            "--no-masks uses all pixels of the photographs, and --ignore names masks of some to "
            "leave out; give one of both.",
            "ignore",
        )


def check_context(context: Names | None) -> None:
    """Refuse an empty context, and photographs that it names twice by the same word."""
    if context is None:
        return
    if len(context) == 0 or len(set(context)) < len(context):
        raise InputError(
            "--context names no frame, or one twice; name different ones, as in --context 0 4, or "
            "leave it out.",
            "context",
        )


def check_generator(name: str) -> None:
    """Refuse the generator of painted images for a command that is given none."""
    if name == "painted":
        raise InputError(
            "The generator 'painted' needs painted images, which `complete --images` names; choose "
            "another one where there are none.",
            "generator",
        )
