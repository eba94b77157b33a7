"""Everything that is opened and loaded before a completion."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import partial
from typing import Any, Literal

import numpy as np
from jaxtyping import Float
from rich.console import Console

from gscompleter.apps.commands.complete import CompleteOptions
from gscompleter.apps.commands.shared_options import SceneOptions, parse_resolution
from gscompleter.apps.completing.paintings import add_paintings, choose_paintings
from gscompleter.apps.inputs.captures import RenderRequest
from gscompleter.apps.inputs.depth_range import (
    apply_scene_range,
    apply_splat_range,
)
from gscompleter.apps.inputs.describing import list_missing as list_missing_photographs
from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.inputs.memory import check_scene
from gscompleter.apps.inputs.named_photographs import check_context, check_target_files
from gscompleter.apps.inputs.opening import choose_working_size, open_scene
from gscompleter.apps.inputs.reading import read_task
from gscompleter.apps.inputs.removal import Selection
from gscompleter.apps.inputs.renders import open_renders
from gscompleter.apps.inputs.selection import collect_usable_cameras
from gscompleter.apps.inputs.splat import add_check_views, locate_splat, move_to_splat
from gscompleter.apps.inputs.taken_out import take_over_edits
from gscompleter.apps.inputs.task import CompletionTask, InputSplatFile, Opened, Target
from gscompleter.apps.warmup import SPLAT_PART, compile_beside, compile_kernels, list_missing
from gscompleter.completer import GSCompleter
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.photograph_names import describe_offset
from gscompleter.generators import load_generator
from gscompleter.planning.planner import Choice, ViewPlanner
from gscompleter.reconstructors import DepthAware, check_reconstructor, load_reconstructor
from gscompleter.reconstructors.depth_predictors import StoredDepth
from gscompleter.render.device import choose_devices
from gscompleter.render.loading import load_renderer
from gscompleter.render.lod import MIN_PROXY_GAUSSIANS
from gscompleter.splats.alignment.similarity import transform_camera
from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.formats import find_origin, load_splat
from gscompleter.splats.morton import sort_nearby
from gscompleter.stages.context import prepare_single
from gscompleter.state import Completion
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.progress import show_preparation
from gscompleter.system.timing import record_seconds, timed_stage
from gscompleter.types import Camera, Gaussians

PHOTOGRAPH_OPTIONS = {
    "format": None,
    "frames": 40,
    "no_masks": False,
    "ignore": None,
    "forget_edits": False,
}
"""Options that only photographs can follow, with their defaults."""


@dataclass(frozen=True)
class Prepared:
    """Everything that is loaded before the first completion."""

    options: CompleteOptions
    opened: Opened
    task: CompletionTask
    explorer: ViewPlanner
    cameras: Mapping[int, Camera]
    """Cameras of all usable photographs by frame, in the frame of the result."""
    seconds: Mapping[str, float]

    @property
    def completer(self) -> GSCompleter:
        """The completer with its models."""
        return self.explorer.completer

    def begin(self) -> Completion:
        """Initialize the context."""
        task = self.task
        begun = self.completer.begin(task.views, task.scene, task.check_views, task.target_cameras)
        guarding = tuple(begun.with_depth_range(camera) for camera in task.witnesses.guarding)
        return replace(begun, free_space_cameras=guarding)

    @property
    def command(self) -> str:
        """The command, for the record of edits."""
        return "update" if self.options.from_photographs_only else "complete"

    # `PreparedRemoval` adds the selection to them.
    def describe_settings(self) -> dict[str, Any]:
        """Describe the settings of targets and models for `summary.json`."""
        return describe_settings(self.options)

    def with_choices(self, choices: Iterable[Choice]) -> Prepared:
        """Return a copy with chosen candidates as targets."""
        # A candidate counts its photograph among the usable ones, where a target names its frame.
        frames = list(self.cameras)
        targets = []
        for choice in choices:
            frame = frames[choice.candidate.base]
            offset = describe_offset(choice.camera, self.cameras[frame])
            targets.append(
                Target(choice.camera, derived_from=frame, offset=offset, reason=choice.describe())
            )
        return replace(self, task=replace(self.task, targets=targets))


def prepare_completion(
    options: CompleteOptions, console: Console, place: Selection | None = None
) -> Prepared:
    """Open the scene and load the models.

    `place` is what will be removed, around which cameras are found if there are no photographs.
    """
    options = check_options(options)
    if options.folder is None:
        options, opened, task = read_splat_alone(options, place)
        task = add_paintings(task, options, opened)
        print_lines(console, *opened.photographs.notes)
    else:
        # With photographs, a scene is what they show, unless the user says otherwise.
        options = options if options.holes == "auto" else with_holes(options, options.holes)
        opened = open_for_completion(options, console)
        task = read_inputs(options, opened)
    return load_models(options, opened, task, console)


def check_options(options: CompleteOptions) -> CompleteOptions:
    """Refuse what is wrong whatever the scene is; return the options with the chosen devices."""
    check_context(options.context)
    options = check_photographs(options)
    check_targets(options)
    options = choose_paintings(options)
    check_reconstructor(options.reconstructor)
    options.synthesis.make_settings()
    devices = choose_devices(options.device, options.renderer_device, options.network_device)
    options = replace(
        options,
        device=devices.renderer,
        renderer_device=devices.renderer,
        network_device=devices.networks,
    )
    if options.scene is not None:
        options = replace(options, scene=resolve_splat(options.scene))
    # What is wrong with a model is told before kernels are compiled, which takes a minute or two.
    # Where there are kernels, it is told soon enough when the photographs are read.
    if list_missing(list_parts(options)):
        load_completer(options, ())
    return options


def list_parts(options: CompleteOptions) -> list[str]:
    """List the parts whose kernels a completion needs."""
    parts = [options.device, options.reconstructor, options.synthesis.generator]
    return [*parts, SPLAT_PART] if options.scene is not None and "cpu" in parts else parts


def open_for_completion(options: CompleteOptions, console: Console) -> Opened:
    """Open the photographs, after reading what can be wrong without their cameras."""
    opened = open_input(options, console, partial(check_completion_inputs, options))
    if not options.config.ego_mask:
        opened = replace(opened, photographs=opened.photographs.keep_ego_vehicle())
    return opened


def read_inputs(options: CompleteOptions, opened: Opened) -> CompletionTask:
    """Read the context and the targets, and add the input splat; compile the kernels."""
    device = options.device
    has_splat = options.scene is not None
    with compile_beside(list_parts(options)):
        with show_preparation("reading photographs"):
            task = read_task(opened, options.context, options.target, device, has_splat)
            task = add_paintings(task, options, opened)
        given = read_splat(task, options, opened) if has_splat else None
    if given is None:
        return task
    return add_splat(*given, options, opened)


def load_models(
    options: CompleteOptions, opened: Opened, task: CompletionTask, console: Console
) -> Prepared:
    """Load the models, and set the depth range of the photographs."""
    # Only here, because the oracle is given the photographs of the targets.
    with show_preparation("loading models"):
        completer = load_completer(options, task.targets)
    completer, task = use_predicted_depth(options, completer, task)
    reconstructor = completer.reconstructor

    # A single photograph has no stereo, so a network predicts its depth; a splat needs neither.
    if options.scene is None:
        try:
            task = replace(task, views=prepare_single(reconstructor, task.views))
        except InputError as error:
            # Of a copy that is not whole, that is the cause.
            missing = list_missing_photographs(opened.photographs)
            if not missing:
                raise
            raise InputError(
                f"{len(missing)} of {len(opened.photographs)} photographs are missing, such as "
                f"{quote_value(missing[0])}, and too few are left: {error}"
            ) from error

    # The depth range is counted as a part of the context stage, whose seconds it is added to.
    with show_preparation("depth range"), record_seconds() as seconds, timed_stage("context"):
        notes: tuple[str, ...] = ()
        if task.scene is None:
            task, notes = apply_scene_range(task, reconstructor)
        else:
            task = apply_splat_range(task, task.scene, completer.renderer)
            # Renders of the splat itself show nothing that it lacks.
            if opened.renders_from is None:
                task, notes = take_over_edits(task, options.forget_edits, completer.renderer)
    print_lines(console, *notes)

    cameras = collect_cameras(opened, task)
    return Prepared(options, opened, task, ViewPlanner(completer), cameras, seconds)


def use_predicted_depth(
    options: CompleteOptions, completer: GSCompleter, task: CompletionTask
) -> tuple[GSCompleter, CompletionTask]:
    """Let predicted depth that lies beside the photographs support stereo, or say why it does not.

    A depth that the user named takes its place.
    """
    reconstructor = completer.reconstructor
    if not task.predicted_depths:
        return completer, task
    is_aware = isinstance(reconstructor, DepthAware) and is_dataclass(reconstructor)
    if options.depth == "none" and is_aware:
        stored = StoredDepth(task.predicted_depths)
        supported = replace(reconstructor, predict_depth=stored)  # type: ignore[type-var]
        return replace(completer, reconstructor=supported), task
    reason = f"the reconstructor {options.reconstructor} takes none"
    if is_aware:
        reason = f"--depth {options.depth} takes its place"
    note = f"Inverse depth that only supports stereo is not used: {reason}."
    return completer, replace(task, depth_notes=(*task.depth_notes, note))


def open_input(options: SceneOptions, console: Console, check: Callable[[], object]) -> Opened:
    """Open the photographs, and choose their working size unless it is given.

    `check` is that of `open_scene`.
    """
    opened = open_scene(options.make_scene_request(), options.make_poses_request(), console, check)
    # Photographs in the map of a splat are relative to its origin from here on.
    origin = None if options.scene is None else find_origin(options.scene)
    if origin is not None:
        opened = replace(opened, photographs=opened.photographs.at_origin(np.array(origin)))
    if options.scene is not None and options.resolution is None:
        opened = choose_working_size(opened, options.scene, console)
    return opened


def check_photographs(options: CompleteOptions) -> CompleteOptions:
    """Refuse what does not fit the photographs or their absence.

    A splat that is named as SCENE is returned as `scene`.
    """
    if not options.lacks_photographs:
        if options.cameras is not None:
            raise InputError(
                "The photographs of SCENE have cameras of their own; leave --cameras out, or name "
                "the splat alone.",
                "cameras",
            )
        if options.up is not None:
            raise InputError(
                "The photographs of SCENE tell what is up; leave --up out.",
                "up",
            )
        return options
    if options.folder is not None and options.scene is not None:
        raise InputError(
            f"Two splats are named, {quote_value(options.folder, 80)} and "
            f"{quote_value(options.scene, 80)}; name one, and as SCENE only its photographs.",
            "scene",
        )
    if options.folder is None and options.scene is None:
        raise InputError(
            "Nothing is named that is to be completed; name SCENE, the folder of photographs, or "
            "a splat."
        )
    for name, default in PHOTOGRAPH_OPTIONS.items():
        if getattr(options, name) != default:
            raise InputError(
                "There are no photographs to apply this to; name their folder as SCENE.", name
            )
    if options.invert_masks and not options.has_marks:
        raise InputError(
            "There are no photographs whose masks could be read the other way round, and no --mask "
            "is given; leave it out.",
            "invert-masks",
        )
    if options.large_masks and not options.has_marks:
        raise InputError("There are no masks that could be too large; leave it out.", "large-masks")
    return replace(options, folder=None, scene=options.scene or options.folder)


def check_targets(options: CompleteOptions) -> None:
    """Refuse options for targets that exclude each other."""
    if options.target and options.auto is not None:
        raise InputError(
            "--target and --auto are both given; use one of them, and complete the result again "
            "with the other.",
            "auto",
        )
    if options.from_photographs_only and not options.config.add_observed:
        raise InputError(
            "With config.add_observed off nothing is added from photographs, as in the config "
            "paper; choose another config.",
            "config",
        )


def check_completion_inputs(options: CompleteOptions) -> None:
    """Read what can be read without the cameras of the photographs, and refuse it if it is wrong.

    It takes seconds, and the search for cameras after it minutes.
    """
    load_completer(options, ())
    check_target_files(options.target, parse_resolution(options.resolution))
    if options.scene is not None:
        load_splat(options.scene, options.drop_nonfinite, options.ignore_properties)


def read_splat(
    task: CompletionTask, options: CompleteOptions, opened: Opened
) -> tuple[CompletionTask, Gaussians]:
    """Read the input splat, and add check views to the task."""
    assert options.scene is not None
    with show_preparation("reading the scene"):
        task = add_check_views(task, opened)
        gaussians = load_splat(options.scene, options.drop_nonfinite, options.ignore_properties)
        if options.device == "cpu":
            check_scene(task, gaussians)
    return task, gaussians


def add_splat(
    task: CompletionTask, gaussians: Gaussians, options: CompleteOptions, opened: Opened
) -> CompletionTask:
    """Add the input splat to the task."""
    assert options.scene is not None
    with show_preparation("aligning the scene"):
        splat_file = locate_splat(options.scene, options.drop_nonfinite)
        gaussians, splat_file = sort_splat(gaussians, splat_file)
        return move_to_splat(task, gaussians, splat_file, opened)


def sort_splat(
    gaussians: Gaussians, splat_file: InputSplatFile
) -> tuple[Gaussians, InputSplatFile]:
    """Sort a large splat along a Morton curve, in place, and keep the order of its file."""
    # Gaussians of a file lie in random order, and each tile of an image would read memory all over
    # (decision 025). Files are written in the order of the given file, which `file_order` leads
    # back to.
    if len(gaussians) < MIN_PROXY_GAUSSIANS:
        return gaussians, splat_file
    return gaussians, replace(splat_file, file_order=sort_nearby(gaussians))


def read_splat_alone(
    options: CompleteOptions, place: Selection | None
) -> tuple[CompleteOptions, Opened, CompletionTask]:
    """Read a splat without photographs, and render it in their place; compile the kernels.

    Returns the options with what a hole of this splat is, and with its padding.
    """
    assert options.scene is not None
    device = options.device
    # What can be wrong is read before anything that takes time.
    load_completer(options, ())
    with show_preparation("reading the scene"):
        gaussians = load_splat(options.scene, options.drop_nonfinite, options.ignore_properties)
        splat_file = locate_splat(options.scene, options.drop_nonfinite)
        gaussians, splat_file = sort_splat(gaussians, splat_file)
    compile_kernels(list_parts(options))

    reading = replace(options, folder=options.scene).make_scene_request()
    request = RenderRequest(
        reading,
        options.cameras,
        options.target,
        options.context,
        options.marks,
        options.mark_reading,
        options.config.holes,
        options.holes,
        options.up,
        place,
    )
    with show_preparation("choosing cameras"):
        renderer = load_renderer(device)
        opened, task, kind = open_renders(request, splat_file, gaussians, renderer, device)
        if device == "cpu":
            check_scene(task, gaussians)
    options = replace(options, config=options.config.choose_margin(kind.is_lifted))
    return with_holes(options, kind.holes), opened, task


def with_holes(options: CompleteOptions, kind: Literal["all", "enclosed"]) -> CompleteOptions:
    """Return the options with the kind of holes."""
    config = options.config
    if kind == "enclosed":
        return replace(options, config=config.for_object())
    return replace(options, config=replace(config, holes=replace(config.holes, kind=kind)))


def load_completer(options: CompleteOptions, targets: Sequence[Target]) -> GSCompleter:
    """Load the models of the options."""
    # Only the oracle reads the photographs of the targets, and only `painted` what was painted.
    images = [t.view if options.images is None else t.placed_painting for t in targets]
    photographs = [image for image in images if image is not None]
    synthesis = options.synthesis
    # `check_options` has chosen both devices.
    networks = options.network_device or options.device
    config = options.config
    if options.no_recolor:
        config = replace(config, recolor=replace(config.recolor, iterations=0))
    return GSCompleter(
        load_reconstructor(
            options.reconstructor, options.weights, networks, options.depth, options.depth_weights
        ),
        load_generator(
            synthesis.generator, options.seed, photographs, networks, synthesis.make_settings()
        ),
        load_renderer(options.device),
        config,
        options.seed,
    )


def compute_view_transform(opened: Opened, task: CompletionTask) -> Float[np.ndarray, "4 4"]:
    """Compute the similarity from photographs as they are read to the frame of the result."""
    # Photographs are read relative to their local origin. `task.frame` begins at their own frame,
    # so the shift is undone before it.
    return task.frame @ compute_frame_from_photographs(-opened.photographs.origin)


def collect_cameras(opened: Opened, task: CompletionTask) -> dict[int, Camera]:
    """Return the cameras of all usable photographs by frame, in the frame of the result."""
    photographs = opened.photographs
    numbers = range(len(photographs))
    cameras = collect_usable_cameras(photographs, numbers, opened.request.resolution)
    transform = compute_view_transform(opened, task)

    # One depth range for all: that of the context, which was measured in the frame of the result.
    context_camera = task.views[0].camera
    near = context_camera.near
    far = context_camera.far
    return {
        frame: replace(transform_camera(camera, transform).to(task.device), near=near, far=far)
        for frame, camera in cameras.items()
    }


def describe_settings(options: CompleteOptions) -> dict[str, Any]:
    """Describe the settings of targets and models for `summary.json`."""
    return {
        "target": list(options.target),
        "auto": None if options.target else options.max_targets,
        "reconstructor": options.reconstructor,
        "weights": None if options.weights is None else str(options.weights),
        "depth": options.depth,
        "network_device": options.network_device,
        **options.synthesis.describe(),
        "images": None if options.images is None else str(options.images),
        "uses_target_photographs": options.synthesis.generator == "oracle",
    }
