"""Refined poses as a property of a data set.

Poses that matches contradict are refined once for a scene, over all of its photographs, those of
targets among them, as structure from motion would do. All methods of a table see these cameras. A
file beside the results keeps them, so that a resumed run and other shards go on with the same ones.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.placing import choose_known
from gscompleter.data.sfm.refined_file import hash_poses, take_refined, write_refined
from gscompleter.data.sfm.refining import MIN_REFINED, PoseRefinement, refine_poses
from gscompleter.evaluation.store import make_file_name
from gscompleter.reconstructors.features.epipolar import measure_pose_fit
from gscompleter.system.errors import InputError
from gscompleter.system.jobs.jobs import make_folder

POSES = "poses"
"""Folder in OUT with the poses of each scene."""
MAX_PAIRS = 6
"""Most pairs of neighbouring photographs that tell whether matches contradict the poses."""
SIDE = 512
"""Longer side of these photographs, in pixels."""


def refine_scene(photographs: Photographs, out: Path) -> tuple[Photographs, PoseRefinement | None]:
    """Return the photographs of a scene with their poses for the run in `out`, and what was done.

    None where matches do not contradict the given poses. A refinement that is not accepted leaves
    the poses as they were given.
    """
    file = out / POSES / f"{make_file_name(photographs.name)} {hash_poses(photographs)[:8]}.json"
    if not file.is_file():
        refined: Photographs = photographs
        done = None
        if is_contradicted(photographs):
            refined, done = refine_poses(photographs)
        make_folder(file.parent)
        write_refined(file, photographs, refined, done, keep_existing=True)
    # Always read back: another shard may have written it meanwhile.
    taken = take_refined(photographs, file)
    assert taken is not None
    return taken


def is_contradicted(photographs: Photographs) -> bool:
    """Check whether matches contradict the poses of a scene, in one of some pairs at even steps.

    One pair is enough: whether refined poses agree better is then measured over all photographs.
    """
    frames = choose_known(photographs)
    if len(frames) < MIN_REFINED:
        return False
    last = len(frames) - 2
    starts = np.linspace(0, last, min(MAX_PAIRS, last + 1)).round().astype(int)
    for start in starts:
        # A damaged photograph tells nothing, and other pairs do.
        try:
            pair = photographs.views(frames[start : start + 2], SIDE)
        except InputError:
            continue
        fit = measure_pose_fit(pair)
        if fit is not None and fit.is_contradicted:
            return True
    return False
