"""Files and scores of a completion that was made in Python, as the command `complete` writes them.

`Completion.save`, `report` and `score` find these functions by their names.
"""

from __future__ import annotations

import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from gscompleter.apps.inputs.splat import locate_splat
from gscompleter.apps.inputs.task import InputSplatFile, Target
from gscompleter.apps.report.completion import write_report
from gscompleter.apps.report.film import VIDEO_FILE
from gscompleter.apps.report.page import REPORT_FILE, write_completion_page
from gscompleter.apps.report.run_record import describe_python_run
from gscompleter.apps.report.scenes import GENERATED_FILE
from gscompleter.apps.report.schema import RECORD_FILE
from gscompleter.apps.report.score_rows import make_score_rows, measure_gaps
from gscompleter.data.local_origin import compute_frame_from_photographs
from gscompleter.data.scene import write_cameras
from gscompleter.editing.removal import restore_surroundings
from gscompleter.evaluation.metrics.coverage import (
    compute_coverage,
    render_pairs,
    sample_held_out_cameras,
)
from gscompleter.evaluation.verdict.held_out import HeldOut, render_before_after
from gscompleter.evaluation.verdict.judge import prepare_held_out
from gscompleter.numerics.geometry import is_same_camera
from gscompleter.render.cache import SceneRenderer
from gscompleter.render.loading import load_renderer
from gscompleter.render.protocols import Renderer
from gscompleter.splats.alignment.trainer_files import TRAINER_FILES
from gscompleter.splats.edits import EDITS, EditDraft
from gscompleter.splats.foreign import resolve_splat
from gscompleter.splats.formats import load_splat
from gscompleter.splats.layout import has_same_values
from gscompleter.state import Completion
from gscompleter.system.errors import InputError, quote_value, require_path
from gscompleter.system.files.output_file import reserve_file
from gscompleter.system.files.output_folder import open_output_folder
from gscompleter.system.files.result_names import (
    COMPLETED_FILES,
    CONTEXT_FILE,
    REMOVED_FILE,
    RENDERS_FILE,
    SUMMARY_FILE,
    TARGETS_FILE,
)
from gscompleter.system.files.writing import replace_file
from gscompleter.system.progress import show_in_notebook, stage
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import Camera, View

COMPLETE_COMMAND = "complete"
COMPLETION_RESULTS = (
    *COMPLETED_FILES,
    # The first one is a .ply, which holds its labels itself.
    *(f"{name}.generated.json" for name in COMPLETED_FILES[1:]),
    CONTEXT_FILE,
    GENERATED_FILE,
    REMOVED_FILE,
    TARGETS_FILE,
    RENDERS_FILE,
    REPORT_FILE,
    RECORD_FILE,
    SUMMARY_FILE,
    VIDEO_FILE,
    "images/target*.png",
    "images/photograph*.png",
    "images/context*.png",
    "images/removal*.png",
    *EDITS,
    *TRAINER_FILES,
)
"""Globs of the files that a completion may write."""
VALUES_FORMAT = "python"
"""Format of a scene whose photographs were given as values."""


@dataclass(frozen=True)
class Judged:
    """A completion, with its surroundings restored after a removal, and what scores it."""

    completion: Completion
    targets: Sequence[Target]
    held_out: Sequence[HeldOut]
    """Photographs that were not used, without those at targets."""
    renderer: Renderer

    @property
    def cameras(self) -> tuple[Camera, ...]:
        """Cameras of all photographs, those of targets included, in the order of their frames.

        It is that of the command, so that coverage is measured from the same places. Photographs
        without a frame come last.
        """
        photos = [photo.view for photo in self.completion.photos]
        # Targets at one camera have one photograph.
        at_targets = {id(target.photograph): target.view for target in self.targets}
        unused = [
            *(view for view in at_targets.values() if view is not None),
            *(photograph.view for photograph in self.held_out),
        ]
        # A photograph that checked the splat, in a smaller size, may be among the unused ones. Its
        # camera then has that size, too, so that only its frame tells. The unused one counts, as in
        # the command.
        known = {view.frame for view in unused} - {None}
        views = [*(view for view in photos if view.frame not in known), *unused]
        views.sort(key=lambda view: math.inf if view.frame is None else view.frame)
        return tuple(view.camera for view in views)


def prepare_judged(completion: Completion, unused_views: Sequence[View]) -> Judged:
    """Finish a removal that is not yet restored, and give targets their photographs.

    The first unused view at the camera of a target is that of the target, and scores nothing else;
    the others are held out. Raises InputError if an unused view is none, or is part of the context.
    """
    held_out = prepare_held_out(completion, unused_views)
    renderer = load_renderer(completion.context.means.device.type)
    # After a removal, photographs must look as before where they do not show what was removed. What
    # `gsc.remove` returns is restored already, and is written as it is.
    completion = restore_surroundings(completion, SceneRenderer(renderer))

    targets = []
    at_targets = set()
    for result in completion.targets:
        target = Target(result.target)
        is_here = [is_same_camera(photo.view.camera, result.target) for photo in held_out]
        if any(is_here):
            number = is_here.index(True)
            at_targets.add(number)
            view = held_out[number].view
            target = replace(
                target, frame=view.frame, photograph=view.image, ignore_mask=view.ignore_mask
            )
        targets.append(target)
    others = [photo for number, photo in enumerate(held_out) if number not in at_targets]
    return Judged(completion, targets, others, renderer)


@show_in_notebook()
@run_in_plain_torch
def score_result(completion: Completion, unused_views: Sequence[View]) -> dict[str, Any]:
    """Score a completion: the verdict, coverage, photographs and targets; see `Completion`."""
    judged = prepare_judged(completion, unused_views)
    completion = judged.completion
    at_targets = [
        render_before_after(completion, result.target, judged.renderer)
        for result in completion.targets
    ]
    gaps = measure_gaps(completion, judged.renderer)
    rows = make_score_rows(
        completion, judged.targets, at_targets, gaps, judged.renderer, judged.held_out
    )
    aside = sample_held_out_cameras(judged.cameras, completion.seed)
    coverage = compute_coverage(render_pairs(completion, aside, judged.renderer))
    return {"outcome": rows.pop("outcome"), "coverage": asdict(coverage), **rows}


@show_in_notebook()
@run_in_plain_torch
def save_result(
    completion: Completion,
    out: Path | str,
    unused_views: Sequence[View],
    splat: Path | str | None,
    overwrite: bool,
) -> Path:
    """Write all files of a completion to a folder; see `Completion.save`."""
    out = require_path(out)
    splat_file = None if splat is None else find_splat_file(require_path(splat), completion)
    judged = prepare_judged(completion, unused_views)
    with stage("report"), open_output_folder(out, overwrite, COMPLETE_COMMAND) as folder:
        write_result(folder, judged, splat_file)
    return out


@show_in_notebook()
@run_in_plain_torch
def write_result_page(
    completion: Completion, file: Path | str, unused_views: Sequence[View]
) -> Path:
    """Write the page of a completion alone; see `Completion.report`."""
    file = require_path(file)
    # A place where nothing can be written is refused before the scene is rendered.
    with reserve_file(file, overwrite=True):
        judged = prepare_judged(completion, unused_views)
        with stage("report"), tempfile.TemporaryDirectory(prefix="gscompleter-") as place:
            folder = Path(place)
            write_result(folder, judged, None)
            page = (folder / REPORT_FILE).read_bytes()
            with replace_file(file) as output:
                output.write(page)
    return file


def write_result(folder: Path, judged: Judged, splat_file: InputSplatFile | None) -> None:
    """Write scenes, pictures, scores, targets and the page."""
    completion = judged.completion
    aside = sample_held_out_cameras(judged.cameras, completion.seed)
    write_report(
        folder,
        completion,
        judged.targets,
        judged.renderer,
        describe_judged(judged, splat_file),
        splat_file,
        judged.cameras,
        partial(render_pairs, completion, aside, judged.renderer),
        judged.held_out,
        run=describe_python_run(completion, None if splat_file is None else splat_file.path),
        # Only a removal takes out Gaussians that were chosen.
        edit=EditDraft("remove" if len(completion.source.removed) else "complete"),
    )
    if completion.targets:
        write_cameras(folder / TARGETS_FILE, [result.target for result in completion.targets])
    write_completion_page(folder)


def describe_judged(judged: Judged, splat_file: InputSplatFile | None) -> Mapping[str, Any]:
    """Describe the input and the settings for `summary.json`, as `describe_run_values` does.

    What only a command is told is missing: format, frames and context of a folder, the use of
    masks, of given depth and of refined poses, and the change of these. So is the number of
    photographs to which the scene was fitted, which a completion does not keep. `near` and `far`,
    in scene units, are those that were used, which the command has in `depth_range` alone if it
    found them.
    """
    completion = judged.completion
    camera = completion.views[0].camera
    origin = np.array(completion.context.origin or (0.0, 0.0, 0.0))
    splat = None if splat_file is None else str(splat_file.path)
    return {
        "settings": {
            "folder": None,
            "scene": splat,
            **completion.models,
            "resolution": [camera.height, camera.width],
            "near": camera.near,
            "far": camera.far,
            "config": asdict(completion.config),
        },
        "device": completion.context.means.device.type,
        "scene": {
            "format": VALUES_FORMAT,
            "photographs": len(judged.cameras),
            "used": len(completion.views),
            "splat": splat,
            "renders_from": None,
            "notes": [],
        },
        # Photographs and result are in one frame, without the origin of the scene, which is added
        # when files are written: from photographs to files is a shift by it.
        "frame": {
            "method": "given",
            "transform": compute_frame_from_photographs(-origin).tolist(),
            "origin": [0.0, 0.0, 0.0],
        },
        "depth_range": {"near": camera.near, "far": camera.far, "from": {}},
        "seed": completion.seed,
    }


def find_splat_file(path: Path, completion: Completion) -> InputSplatFile:
    """Describe the file of a given scene, or the folder of a .sog; refuse that of another scene.

    All values count, since the file's own rows are written again. Rows that are not finite may have
    been dropped when it was loaded.
    """
    if not os.path.exists(path):
        raise InputError(f"There is no splat {quote_value(path)}; name the file of the scene.")
    # Of a trainer's model folder it is the newest iteration, as for `load_splat`.
    path = resolve_splat(path)
    context = completion.context
    # Whoever completed it has accepted what a file is refused for otherwise, and may have moved its
    # origin.
    loaded = load_splat(path, drop_nonfinite=True, ignore_properties=True)
    if not has_same_values(loaded.move_origin(context.origin), context.to("cpu")):
        raise InputError(
            f"{quote_value(path)} holds another scene than the one that was completed; name its "
            "own file, or none."
        )
    return locate_splat(path, drop_nonfinite=True)
