"""The cases of an evaluation."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import islice
from pathlib import Path

from rich.console import Console

from gscompleter.apps.requests.evaluation import CasesRequest
from gscompleter.apps.requests.scene import DEFAULT_LONG_SIDE, decide_resolution
from gscompleter.data.formats import open_photographs
from gscompleter.data.limits import check_planes
from gscompleter.data.mask_checks import read_masks_as_asked
from gscompleter.data.photographs import MAX_TRANSLATION, Photographs, Resolution
from gscompleter.evaluation import protocols
from gscompleter.evaluation.apart import (
    LEDGER,
    Apartable,
    describe_left_out,
    leave_out_apart,
)
from gscompleter.evaluation.authors_loader import AuthorsLoader
from gscompleter.evaluation.case_file import is_scene_file, locate_named, read_case_file
from gscompleter.evaluation.cases import (
    Case,
    ScenePlace,
    SkippedScene,
    filter_usable,
    list_places,
    list_scenes,
    open_clips,
    read_cases,
)
from gscompleter.evaluation.paper import get_data_set
from gscompleter.evaluation.protocols import EvaluationIndex
from gscompleter.system.errors import InputError, quote_value


def collect_tasks(
    request: CasesRequest, skipped: list[SkippedScene], notes: list[str]
) -> list[protocols.Task]:
    """Collect the tasks of a request, and append to `skipped` and `notes`."""
    left_out: list[Apartable] = []
    if request.protocol:
        listed = [place for path in request.paths for place in list_places(path)]
        places = list(leave_out_apart(listed, request.apart, left_out))
        notes += describe_apart(left_out, len(places), "scenes")
        # The iterator opens clips one by one, so those beyond the limit are not opened.
        return list(islice(iterate_tasks(request, places, skipped, notes), request.limit))

    listed_cases = [case for path in request.paths for case in read_cases(find_cases_file(path))]
    cases = list(leave_out_apart(listed_cases, request.apart, left_out))
    notes += describe_apart(left_out, len(cases), "cases")
    if request.one_per_scene:
        # The first case of a scene is the last that overwrites its entry in reversed order.
        first = {case.scene: case for case in reversed(cases)}
        cases = [case for case in cases if case is first[case.scene]]
    cases = cases[: request.limit]

    # Each scene is opened once for its notes, wherever its cases stand in the files.
    numbers_by_scene: dict[Path, list[int]] = {}
    for number, case in enumerate(cases):
        numbers_by_scene.setdefault(case.scene, []).append(number)
    tasks: dict[int, protocols.Task] = {}
    for scene, numbers in numbers_by_scene.items():
        own = make_scene_tasks(scene, [cases[number] for number in numbers], request, notes)
        tasks.update(zip(numbers, own, strict=True))
    return [tasks[number] for number in range(len(cases))]


def make_scene_tasks(
    scene: Path, cases: Sequence[Case], request: CasesRequest, notes: list[str]
) -> list[protocols.Task]:
    """Make the tasks of the cases of one scene, and append its notes."""
    tasks = [protocols.make_case_task(apply_request(case, request)) for case in cases]
    tasks = [replace(task, refines_poses=request.refines_poses) for task in tasks]
    clip = None
    # A scene that cannot be opened fails later, and its row in the table has the reason.
    with suppress(InputError):
        clip = open_photographs(scene)
    if clip is None:
        return tasks
    notes += clip.notes
    if request.ignore_moving:
        require_boxes(clip, request.uses_masks)
    clip = clip if request.uses_masks else clip.leave_out_masks()
    return mark_masked(read_masks_as_asked(clip, request.masks), tasks, notes)


def describe_apart(left_out: Sequence[Apartable], kept: int, kind: str) -> list[str]:
    """Describe what is left out, and how to use it; raise as `describe_left_out`.

    `kept` is the number of those of the `kind` that are used.
    """
    lines = describe_left_out(left_out, kept, kind)
    return [f"{line} Add --apart to use them, which is noted in {LEDGER}." for line in lines]


def require_boxes(clip: Photographs, reads_masks: bool) -> None:
    """Raise InputError if a scene has no boxes of moving objects that could be ignored."""
    if clip.has_boxes:
        return
    masks = " (masks are read without it)" if reads_masks else ""
    raise InputError(
        f"{clip.name} has no boxes of moving objects; leave --ignore-moving out{masks}."
    )


def mark_masked(
    clip: Photographs, tasks: Sequence[protocols.Task], notes: list[str]
) -> list[protocols.Task]:
    """Mark the tasks of a clip if their photographs have masks, and append a note about these."""
    frames = {frame for task in tasks for frame in (*task.context, *task.targets, *task.neighbours)}
    # Frames that the clip does not have are refused when their case is run.
    masks = clip.describe_masks(sorted(frame for frame in frames if frame < len(clip)))
    if masks is None:
        return list(tasks)
    notes.append(f"{clip.name}: {masks} are read; what they hide is ignored.")
    return [replace(task, has_masks=True) for task in tasks]


def apply_request(case: Case, request: CasesRequest) -> Case:
    """Return a case with resolution, depth range and what is ignored as the request asks.

    What is ignored are masks, the vehicle that carries the camera, and boxes of moving objects.
    """
    size = request.resolution
    return replace(
        case,
        near=case.near if request.near is None else request.near,
        far=case.far if request.far is None else request.far,
        resolution=case.resolution if size is None else decide_resolution(size),
        uses_masks=request.uses_masks,
        has_inverted_masks=request.masks.is_inverted,
        ignore_moving=request.ignore_moving,
        ego_mask=request.ego_mask,
    )


def iterate_tasks(
    request: CasesRequest,
    places: Sequence[ScenePlace],
    skipped: list[SkippedScene],
    notes: list[str],
) -> Iterator[protocols.Task]:
    """Iterate over the tasks of the protocols in the scenes at some places, clip by clip."""
    rules = [protocols.parse_protocol(text) for text in request.protocol]

    # With a preset, images are cropped and scenes left out as by its authors' code (decision 047).
    loader = find_authors_loader(request)
    resolution = DEFAULT_LONG_SIDE if request.resolution is None else request.resolution
    size: Resolution
    if loader is not None and isinstance(resolution, tuple):
        height, width = resolution
        size = loader.make_crop(height, width)
    else:
        size = decide_resolution(resolution)
    # Their code also keeps clips whose coordinates are large.
    max_translation = MAX_TRANSLATION if loader is None else None
    for place in places:
        for clip in filter_usable(open_clips(place.path), skipped, max_translation):
            notes += clip.notes
            # The authors' code scores every pixel of their data sets: masks and the vehicle are
            # not looked for. Boxes are ignored all the same where --ignore-moving asks for it.
            scores_all = loader is not None
            if request.ignore_moving:
                require_boxes(clip, request.uses_masks and not scores_all)
            if scores_all or not request.ego_mask:
                clip = clip.keep_ego_vehicle()
            if scores_all or not request.uses_masks:
                clip = clip.leave_out_masks()
            clip = read_masks_as_asked(clip, request.masks)
            if request.ignore_moving:
                clip = clip.ignore_moving()

            near = clip.near if request.near is None else request.near
            far = clip.far if request.far is None else request.far
            check_planes(near, far)
            clip = replace(clip, near=near, far=far)

            for rule in rules:
                if not rule.select_splits(clip):
                    skipped.append(SkippedScene(clip.name, explain_no_split(rule, clip)))
                kept = rule if loader is None else loader.choose_splits(rule, clip, skipped)
                # The loader of the authors has sorted the frames already if theirs does so, and
                # else the order is that of the index. Ours sorts the context.
                keeps_order = loader is not None
                tasks = protocols.make_tasks(kept, clip, size, keeps_order)
                tasks = [replace(task, apart_by=place.apart_by) for task in tasks]
                # An index fixes the frames of a benchmark, so that numbers of others compare.
                is_free = request.refines_poses and not isinstance(rule, EvaluationIndex)
                tasks = [replace(task, refines_poses=is_free) for task in tasks]
                tasks = mark_masked(clip, tasks, notes)
                yield from tasks[:1] if request.one_per_scene else tasks


def explain_no_split(rule: protocols.EvaluationProtocol, clip: Photographs) -> str:
    """Explain why a protocol has no task in a clip."""
    if isinstance(rule, EvaluationIndex):
        how = "leaves it out" if clip.name in rule.scenes else "does not name it"
        return f"the index {rule.name} {how}"
    return f"{rule.name} chooses none of its {len(clip)} frames"


def find_authors_loader(request: CasesRequest) -> AuthorsLoader | None:
    """Find the loader to follow; none without a preset, or at another size than the preset's."""
    preset = get_data_set(request.preset)
    return preset.loader if request.resolution == preset.resolution else None


def find_cases_file(path: Path) -> Path:
    """Find the cases.json that `path` is or contains."""
    file = path / "cases.json" if os.path.isdir(path) else path
    # A transforms.json is a scene, and so needs a protocol.
    if file.suffix != ".json" or not os.path.isfile(file) or file.name == "transforms.json":
        raise InputError(
            f"{quote_value(path)} is no cases.json; name one, or add --protocol for scenes, as in "
            "--protocol n-10."
        )
    return file


def list_data(path: Path) -> list[Path]:
    """List the scenes that a path stands for, and the file that names them if it is one."""
    named = [place.path for place in list_places(path)]
    # Whatever is no file of cases names none.
    with suppress(InputError):
        file = find_cases_file(path)
        named += [file, *(locate_named(file, row.scene) for row in read_case_file(file).rows)]
    scenes = [scene for place in named for scene in list_scenes(place)]
    return list(dict.fromkeys([*scenes, *([path] if is_scene_file(path) else [])]))


def print_skipped(skipped: Sequence[SkippedScene], console: Console) -> None:
    """Print the skipped clips with the reasons."""
    for clip in skipped:
        console.print(f"Skipped {clip.name}: {clip.reason}.", soft_wrap=True)
