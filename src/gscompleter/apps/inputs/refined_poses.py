"""Refinement of given poses that matches contradict, for the commands.

Beside a splat its frame stays, and the photographs come to it: refined poses are not taken if the
splat, seen from them, agrees less with the photographs than seen from the given ones. A splat that
covers too little of every photograph says nothing, and matches decide alone.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.inputs.own_scene import find_source_frames
from gscompleter.apps.inputs.taken_out import merge_taken_out
from gscompleter.apps.inputs.task import CompletionTask, Opened
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.refined_file import take_refined, write_refined
from gscompleter.data.sfm.refining import (
    MIN_REFINED,
    PoseRefinement,
    has_pycolmap,
    refine_poses,
)
from gscompleter.numerics.two_views import ERROR_SIDE
from gscompleter.reconstructors.features.epipolar import measure_pose_fit
from gscompleter.render.loading import load_renderer
from gscompleter.splats.alignment.estimate import sample_views
from gscompleter.splats.alignment.similarity import transform_view
from gscompleter.splats.alignment.witness import compare_poses
from gscompleter.system.errors import quote_value
from gscompleter.system.files.result_names import REFINED_POSES_FILE
from gscompleter.system.progress import show_preparation


def take_over_poses(opened: Opened, splat: Path, console: Console) -> Opened:
    """Take the refined poses that a splat was made with, which lie beside its file."""
    path = splat.parent / REFINED_POSES_FILE
    if not path.is_file():
        return opened
    taken = take_refined(opened.photographs, path)
    if taken is None:
        print_lines(console, f"{quote_value(path)} is of other photographs, and is not used.")
        return opened
    photographs, refinement = taken
    print_lines(console, f"Refined poses of {quote_value(path)} are used.")
    return replace(opened, photographs=photographs, given=opened.photographs, refinement=refinement)


def read_at_refined_poses(
    opened: Opened,
    read: Callable[[Opened], CompletionTask],
    console: Console,
    num_known: int | None = None,
    asks_splat: bool = True,
) -> tuple[Opened, CompletionTask]:
    """Read a task, and once more if poses that matches contradict could be refined.

    `num_known` and `asks_splat` are those of `refine_opened`.
    """
    task = read(opened)
    asks_splat = asks_splat and not task.is_remade
    refined = refine_opened(opened, task, console, num_known, asks_splat)
    return (opened, task) if refined is opened else (refined, read(refined))


def refine_opened(
    opened: Opened,
    task: CompletionTask,
    console: Console,
    num_known: int | None,
    asks_splat: bool,
) -> Opened:
    """Refine the poses of all photographs together if matches of the context contradict them.

    `task` was read at the given poses. Those that an earlier command refined stay, and so does
    `opened` where nothing is taken. `num_known` is the number of photographs of the scene, if new
    ones were placed after them. `asks_splat` is False for a splat that is made anew: it fits the
    poses that it was made at, whatever they are.
    """
    if opened.given is not None or len(opened.photographs.posed) < MIN_REFINED:
        return opened
    with show_preparation("checking poses"):
        fit = measure_pose_fit(task.views)
    if fit is None or not fit.is_contradicted:
        return opened
    if not has_pycolmap():
        print_lines(
            console,
            f"Matches contradict the given poses by {fit.given:.2f} px (of {ERROR_SIDE}); "
            "pip install 'gscompleter[poses]' refines them.",
        )
        return opened
    photographs, refinement = refine_poses(opened.photographs)
    if refinement is None:
        print_lines(
            console,
            f"Given poses are kept, though matches contradict them by {fit.given:.2f} px (of "
            f"{ERROR_SIDE}): too few photographs could be refined together, or compared.",
        )
        return opened
    if task.scene is not None and asks_splat and refinement.is_accepted:
        with show_preparation("comparing poses with the splat"):
            refinement = ask_splat(opened, photographs, task, refinement)
    print_lines(console, refinement.describe())
    if not refinement.is_accepted:
        return opened
    given = replace(opened.photographs, frames=opened.photographs.frames[:num_known])
    return replace(opened, photographs=photographs, given=given, refinement=refinement)


def write_refined_poses(folder: Path, opened: Opened) -> None:
    """Write the poses that differ from the given ones beside a result, if there are any."""
    if opened.given is not None:
        path = folder / REFINED_POSES_FILE
        write_refined(path, opened.given, opened.photographs, opened.refinement)


def ask_splat(
    opened: Opened, refined: Photographs, task: CompletionTask, refinement: PoseRefinement
) -> PoseRefinement:
    """Add how well the splat of a task agrees with photographs at given and at refined poses.

    `opened` has them at the given ones.
    """
    assert task.scene is not None
    assert task.splat_file is not None
    # Photographs still show what earlier edits took out.
    whole = merge_taken_out(task.scene, task.splat_file)
    # Photographs are read relative to their origin, and the frame of a task begins at their own.
    given = opened.photographs
    transform = task.frame @ compute_frame_from_photographs(-given.origin)
    sources = find_source_frames(task.splat_file.edits, opened.files)
    given_views, refined_views = (
        [
            transform_view(view.to(task.device), transform)
            for view in sample_views(photographs, task.context_frames, sources)
        ]
        for photographs in (given, refined)
    )
    compared = compare_poses(whole, given_views, refined_views, load_renderer(task.device.type))
    if compared is None:
        return refinement
    return replace(refinement, splat_given=compared.given, splat_refined=compared.refined)
