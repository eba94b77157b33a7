"""Everything that is opened and loaded before a completion.

In this order: what can be refused at once, the photographs, the splat, the kernels, the models, and
the depth range. A splat without photographs takes a way of its own up to the models, with renders
in their place (`read_splat_alone`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, is_dataclass, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from jaxtyping import Float
from rich.console import Console

from gscompleter.apps.completing.prepared import Prepared
from gscompleter.apps.inputs.captures import RenderRequest
from gscompleter.apps.inputs.depth_range import (
    apply_scene_range,
    apply_splat_range,
)
from gscompleter.apps.inputs.describing import (
    list_missing_photographs,
    list_named,
    print_lines,
)
from gscompleter.apps.inputs.earlier_work import mark_earlier_work
from gscompleter.apps.inputs.memory import check_gpu, check_scene
from gscompleter.apps.inputs.named_photographs import check_target_files
from gscompleter.apps.inputs.opening import choose_working_size, open_scene
from gscompleter.apps.inputs.own_scene import find_own_photographs
from gscompleter.apps.inputs.paintings import read_paintings
from gscompleter.apps.inputs.reading import add_fit_views, read_task
from gscompleter.apps.inputs.refined_poses import read_at_refined_poses, take_over_poses
from gscompleter.apps.inputs.renders import open_renders
from gscompleter.apps.inputs.selection import collect_usable_cameras
from gscompleter.apps.inputs.splat import add_check_views, move_to_splat, read_splat, sort_splat
from gscompleter.apps.inputs.taken_out import take_over_edits
from gscompleter.apps.inputs.task import CompletionTask, Opened
from gscompleter.apps.requests.completion import (
    CompletionRequest,
    TargetRequest,
    UpdateRequest,
    WorkRequest,
)
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.apps.requests.scene import AloneRequest, PhotographsRequest
from gscompleter.apps.requests.splat import Selection, SplatRequest
from gscompleter.apps.warmup import SPLAT_PART, compile_beside, compile_kernels, list_uncompiled
from gscompleter.completer import GSCompleter
from gscompleter.config import CompleterConfig
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.mask_reading import MaskReading
from gscompleter.generators import load_generator
from gscompleter.generators.painted import Painting
from gscompleter.numerics.given_geometry import GivenGeometry
from gscompleter.planning.planner import ViewPlanner
from gscompleter.reconstructors import DepthAware, FittingReconstructor, load_reconstructor
from gscompleter.reconstructors.depth_predictors import StoredDepth
from gscompleter.render.loading import load_renderer
from gscompleter.splats.alignment.similarity import transform_camera
from gscompleter.splats.edits import read_edits
from gscompleter.splats.formats import find_origin
from gscompleter.splats.geometry_files import load_geometry
from gscompleter.stages.context import prepare_single
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.progress import show_preparation
from gscompleter.system.timing import record_seconds, timed_stage
from gscompleter.trust.lifted import is_lifted
from gscompleter.types import Camera, View


@dataclass(frozen=True)
class Loaded:
    """A scene that was read, with its models."""

    opened: Opened
    task: CompletionTask
    completer: GSCompleter
    """With the models and the settings of the request."""
    cameras: Mapping[int, Camera]
    """Cameras of all usable photographs by frame, in the frame of the result."""
    seconds: Mapping[str, float]
    """Seconds that count as those of the context stage."""


@dataclass(frozen=True)
class Marks:
    """What is marked as wrong: by masks at the targets, or by a selection of Gaussians."""

    masks: tuple[Path, ...] = ()
    """An image for each target, in their order; none with a selection."""
    reading: MaskReading = MaskReading()
    """How these masks are read."""
    selection: Selection | None = None
    """Gaussians that are marked; None without a selection."""


def prepare_completion(
    request: CompletionRequest,
    console: Console,
    marks: Marks = Marks(),
    place: Selection | None = None,
    remakes_own: bool = False,
) -> Prepared:
    """Open the scene and load the models.

    `marks` or `place` say what will go, and matter only without photographs: cameras are then found
    around the place, and what is marked counts as the hole. `remakes_own` is that of `read_inputs`.

    Raises:
        InputError: Something that is given is missing, damaged, or does not fit the rest.
    """
    source = request.source
    work = request.work
    targets = request.targets
    geometry = read_geometry(work)
    if isinstance(source, AloneRequest):
        opened, task, config = read_splat_alone(work, source, targets, marks, place)
        print_lines(console, *opened.photographs.notes)
    else:
        check_models(work)
        config = work.config if work.splat is None else work.config.for_photographs()
        opened = open_for_completion(work, source, targets, console)
        opened, task = read_opened(work, source, targets, opened, console, remakes_own=remakes_own)
    loaded = load_models(work, config, targets, opened, task, geometry, console)
    return make_prepared(request, targets, loaded)


def make_prepared(
    request: CompletionRequest | UpdateRequest,
    targets: TargetRequest | None,
    loaded: Loaded,
    settings: Mapping[str, Any] = MappingProxyType({}),
) -> Prepared:
    """Make what a request begins with, from the scene that was loaded for it.

    `targets` and `settings` are those of `Prepared`.
    """
    source = request.source
    return Prepared(
        command=request.command,
        source=source,
        work=request.work,
        targets=targets,
        results=request.results,
        opened=loaded.opened,
        task=loaded.task,
        explorer=ViewPlanner(loaded.completer),
        cameras=loaded.cameras,
        seconds=loaded.seconds,
        inverts_masks=source.scene.masks.is_inverted,
        settings=settings,
    )


def check_models(work: WorkRequest) -> None:
    """Refuse what is wrong with a model before kernels are compiled, which takes minutes."""
    # With compiled kernels, `load_models` tells it within seconds.
    if list_uncompiled(list_parts(work)):
        load_completer(work.models, work.config, ())


def list_parts(work: WorkRequest) -> list[str]:
    """List the parts whose kernels a completion needs; names without kernels do no harm."""
    models = work.models
    parts = [models.device, models.reconstructor, models.generator]
    return [*parts, SPLAT_PART] if work.splat is not None and models.device == "cpu" else parts


def open_for_completion(
    work: WorkRequest,
    photographs: PhotographsRequest,
    targets: TargetRequest,
    console: Console,
) -> Opened:
    """Open the photographs, after reading what can be wrong without their cameras."""
    check = partial(check_completion_inputs, work, photographs, targets)
    opened = open_input(photographs, work.splat, console, check)
    if not work.config.ego_mask:
        opened = replace(opened, photographs=opened.photographs.keep_ego_vehicle())
    return opened


def read_opened(
    work: WorkRequest,
    photographs: PhotographsRequest,
    targets: TargetRequest,
    opened: Opened,
    console: Console,
    num_known: int | None = None,
    remakes_own: bool = False,
    asks_splat: bool = True,
) -> tuple[Opened, CompletionTask]:
    """Read the inputs, at refined poses unless these are to be taken as they are.

    `num_known` and `asks_splat` are those of `refine_opened`, and `remakes_own` that of
    `read_inputs`.
    """
    read = partial(read_inputs, work, photographs, targets, remakes_own=remakes_own)
    # The paper takes poses as they are.
    if follows_paper(work) or not photographs.scene.refines_poses:
        return opened, read(opened)
    return read_at_refined_poses(opened, read, console, num_known, asks_splat)


def follows_paper(work: WorkRequest) -> bool:
    """Return True if scenes are made as in the paper."""
    return work.config.registration_method == "paper"


def read_inputs(
    work: WorkRequest,
    photographs: PhotographsRequest,
    targets: TargetRequest,
    opened: Opened,
    remakes_own: bool,
) -> CompletionTask:
    """Read the context and the targets, and add the input splat; compile the kernels.

    A context that is not named is fitted to further photographs. `remakes_own` is True if a splat
    that an earlier command reconstructed is to be made anew, also from its photographs.
    With a splat everything is in its frame from here on, and else in that of the photographs.
    """
    device = work.models.device
    splat = work.splat
    given = None
    splat_file = None
    with compile_beside(list_parts(work)):
        with show_preparation("reading photographs"):
            has_splat = splat is not None
            is_free = splat is None and not follows_paper(work)
            own: tuple[int, ...] = ()
            if remakes_own and splat is not None and work.config.add_observed:
                own = find_own_photographs(work, read_edits(splat.path), opened.files)
            # Plane-sweep fits a scene to any number of photographs (decision 140); networks were
            # trained with few.
            is_fitted = is_free and work.models.reconstructor == "plane-sweep"
            task = read_task(
                opened, photographs.context, targets.named, device, has_splat, is_fitted, own
            )
            task = add_paintings(task, targets, opened)
            if is_free and photographs.context is None:
                task = add_fit_views(task, opened)
        if splat is not None:
            with show_preparation("reading the scene"):
                task = add_check_views(task, opened)
                given, splat_file = sort_splat(read_splat(splat), splat, device)
                # Harmonics that lie in a file take no memory.
                if device == "cpu":
                    check_scene(task, given)
    if given is None or splat_file is None:  # both without a splat
        return task
    with show_preparation("aligning the scene"):
        task = move_to_splat(task, given, splat_file, opened)
    if device == "cuda":
        margin = work.config.choose_margin(is_lifted(given)).margin
        check_gpu(task, work.models, margin or 0.0)
    return task


def add_paintings(task: CompletionTask, targets: TargetRequest, opened: Opened) -> CompletionTask:
    """Add the painted images to the targets of a task, if there are any."""
    if targets.images is None:
        return task
    resolution = opened.request.resolution
    painted = read_paintings(task.targets, opened.photographs, resolution, targets.images)
    return replace(task, targets=painted)


def load_models(
    work: WorkRequest,
    config: CompleterConfig,
    targets: TargetRequest,
    opened: Opened,
    task: CompletionTask,
    geometry: GivenGeometry | None,
    console: Console,
) -> Loaded:
    """Load the models, and set the depth range of the photographs.

    `config` is that of the request, with what was found of a splat alone; `geometry` is what
    `read_geometry` read.
    """
    models = work.models
    # Only here, because the oracle is given the photographs of the targets.
    with show_preparation("loading models"):
        known = [t.view if targets.images is None else t.placed_painting for t in task.targets]
        completer = load_completer(models, config, [image for image in known if image is not None])
    completer, task = use_predicted_depth(models, completer, task)
    if geometry is not None:
        task = add_geometry(task, geometry)
    reconstructor = completer.reconstructor
    if work.splat is None and not isinstance(reconstructor, FittingReconstructor):
        task = replace(task, check_views=None)

    # A single photograph has no stereo, so a network predicts its depth; a splat needs neither.
    if work.splat is None:
        try:
            task = replace(task, views=prepare_single(reconstructor, task.views))
        except InputError as error:
            # Of a copy that is not whole, that is the cause.
            missing = list_missing_photographs(opened.photographs)
            if not missing:
                raise
            raise InputError(
                f"{len(missing)} of {len(list_named(opened.photographs))} photographs are missing, "
                f"such as {quote_value(missing[0])}, and too few are left: {error}"
            ) from error

    # The depth range is counted as a part of the context stage, whose seconds it is added to.
    with show_preparation("depth range"), record_seconds() as seconds, timed_stage("context"):
        notes: tuple[str, ...] = ()
        if task.scene is None or task.is_remade:
            task, notes = apply_scene_range(task, reconstructor)
        else:
            task = apply_splat_range(task, task.scene, completer.renderer)
        # Renders of the splat itself show nothing that it lacks.
        if work.splat is not None and opened.renders_from is None:
            task, told = mark_earlier_work(task)
            task, edited = take_over_edits(task, work.splat.forget_edits, completer.renderer)
            notes = (*notes, *told, *edited)
    print_lines(console, *notes)
    return Loaded(opened, task, completer, collect_cameras(opened, task), seconds)


def read_geometry(work: WorkRequest) -> GivenGeometry | None:
    """Read geometry from elsewhere, before photographs: it takes seconds, and they may minutes."""
    if work.geometry is None:
        return None
    with show_preparation("reading the geometry"):
        return load_geometry(work.geometry)


def add_geometry(task: CompletionTask, geometry: GivenGeometry) -> CompletionTask:
    """Add geometry that was given in the frame of the splat's file, or else of the photographs."""
    # The task is relative to an origin in that frame.
    origin = task.origin if task.splat_file is None else task.splat_file.origin
    return replace(task, geometry=geometry.move(-origin))


def use_predicted_depth(
    models: ModelRequest, completer: GSCompleter, task: CompletionTask
) -> tuple[GSCompleter, CompletionTask]:
    """Let predicted depth that lies beside the photographs support stereo, or say why it does not.

    A depth that the user named takes its place.
    """
    reconstructor = completer.reconstructor
    if not task.predicted_depths:
        return completer, task
    is_aware = isinstance(reconstructor, DepthAware) and is_dataclass(reconstructor)
    if models.depth == "none" and is_aware:
        stored = StoredDepth(task.predicted_depths)
        supported = replace(reconstructor, predict_depth=stored)  # type: ignore[type-var]
        return replace(completer, reconstructor=supported), task
    reason = f"the reconstructor {models.reconstructor} takes none"
    if is_aware:
        reason = f"--depth {models.depth} takes its place"
    note = f"Inverse depth that only supports stereo is not used: {reason}."
    return completer, replace(task, depth_notes=(*task.depth_notes, note))


def open_input(
    photographs: PhotographsRequest,
    splat: SplatRequest | None,
    console: Console,
    check: Callable[[], object],
) -> Opened:
    """Open the photographs; with a splat, at its poses and origin and in the size of its training.

    The size is only chosen if the user gave none. `check` is that of `open_scene`.
    """
    opened = open_scene(photographs.scene, photographs.poses, console, check)
    if splat is None:
        return opened
    if photographs.scene.refines_poses:
        opened = take_over_poses(opened, splat.path, console)
    # Photographs in the map of a splat are relative to its origin from here on.
    origin = find_origin(splat.path)
    if origin is not None:
        opened = replace(opened, photographs=opened.photographs.at_origin(np.array(origin)))
    if photographs.scene.follows_training:
        opened = choose_working_size(opened, splat.path, console)
    return opened


def check_completion_inputs(
    work: WorkRequest, photographs: PhotographsRequest, targets: TargetRequest
) -> None:
    """Read what can be read without the cameras of the photographs, and refuse it if it is wrong.

    It takes seconds, and the search for cameras after it minutes.
    """
    load_completer(work.models, work.config, ())
    check_target_files(targets.named, photographs.scene.resolution)
    if work.splat is not None:
        read_splat(work.splat)


def read_splat_alone(
    work: WorkRequest,
    source: AloneRequest,
    targets: TargetRequest,
    marks: Marks,
    place: Selection | None,
) -> tuple[Opened, CompletionTask, CompleterConfig]:
    """Read a splat without photographs, and render it in their place; compile the kernels.

    Also returns the config with what a hole of this splat is, and with its padding.
    """
    splat = work.splat
    assert splat is not None  # that of an `AloneRequest`
    device = work.models.device
    # What is wrong with the models is told before anything that takes time. They are loaded again
    # when the cameras are known, of which the oracle needs the photographs.
    load_completer(work.models, work.config, ())
    with show_preparation("reading the scene"):
        gaussians, splat_file = sort_splat(read_splat(splat), splat, device)
    compile_kernels(list_parts(work))

    request = RenderRequest(
        reading=source.scene,
        cameras=source.cameras,
        targets=targets.named,
        context=source.context,
        up=source.up,
        place=place,
        masks=marks.masks,
        mask_reading=marks.reading,
        marked=marks.selection,
        kind=source.holes,
        limits=work.config.holes,
    )
    with show_preparation("choosing cameras"):
        renderer = load_renderer(device)
        alone = open_renders(request, splat_file, gaussians, renderer, device)
        config = work.config.choose_margin(alone.kind.is_lifted).for_holes(alone.kind.holes)
        if device == "cpu":
            check_scene(alone.task, gaussians)
        else:
            check_gpu(alone.task, work.models, config.margin or 0.0)
    return alone.opened, add_paintings(alone.task, targets, alone.opened), config


def load_completer(
    models: ModelRequest, config: CompleterConfig, images: Sequence[View | Painting]
) -> GSCompleter:
    """Load the models of a request.

    Only the oracle reads the photographs of the targets, and only `painted` what was painted.
    """
    return GSCompleter(
        load_reconstructor(
            models.reconstructor,
            models.weights,
            models.network_device,
            models.depth,
            models.depth_weights,
        ),
        load_generator(
            models.generator,
            models.seed,
            images,
            models.network_device,
            models.generator_settings,
        ),
        load_renderer(models.device),
        config,
        models.seed,
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


def describe_settings(ready: Prepared) -> dict[str, Any]:
    """Describe the settings of targets and models for `summary.json`."""
    models = ready.work.models
    targets = TargetRequest(max_found=0) if ready.targets is None else ready.targets
    return {
        "target": list(targets.named),
        "auto": None if targets.named else targets.max_found,
        "reconstructor": models.reconstructor,
        "weights": None if models.weights is None else str(models.weights),
        "depth": models.depth,
        "depth_weights": None if models.depth_weights is None else str(models.depth_weights),
        "network_device": models.network_device,
        **models.describe_generator(),
        "geometry": None if ready.work.geometry is None else str(ready.work.geometry),
        "images": None if targets.images is None else str(targets.images),
        "uses_target_photographs": models.generator == "oracle",
        **ready.settings,
    }
