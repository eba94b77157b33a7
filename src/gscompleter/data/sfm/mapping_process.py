"""Structure from motion in a separate process, because COLMAP aborts on errors.

Standard input is a `Job` as JSON. The last line of the output is the result, as JSON too.

Beyond a few photographs, only neighbours in a sequence and photographs that look alike are matched:
those whose few largest features match (preemptive matching; Wu, "Towards Linear-time Incremental
Structure from Motion", 2013). It needs no vocabulary.
"""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float

from gscompleter.data.sfm.poses import UprightCopy

SEED = 0
MAX_FEATURES = 4096
"""Most features in a photograph."""
LENS = "SIMPLE_RADIAL"
"""COLMAP's camera model: one focal length, one distortion coefficient."""
GUESSED_FOCAL = 1.2
"""Focal length in longer image sides, if EXIF lacks it."""
MIN_MODEL = 3
"""Fewest photographs of a model."""
WANTED_SHARE = 0.5
"""Share of the photographs in a model below which other focal lengths are tried."""
FOV = 10.0, 150.0
"""Plausible range of the field of view along the longer side, in degrees."""
MAX_SHIFT = 0.5
"""Largest plausible shift of an image corner by distortion, relative to its radius."""
FIXED_FOVS = (75.0, 60.0, 90.0, 45.0)
"""Fields of view along the longer side, in degrees, to fix the focal length at, in order."""

MAX_EXHAUSTIVE = 60
"""Most unordered photographs that are all matched with each other."""
NEIGHBOURS = 10
"""Photographs before and after each one of a sequence to match it with."""
NUM_SIMILAR = 20
"""Most similar photographs to match each one with."""
NUM_LARGEST_FEATURES = 256
"""Largest-scale features that decide similarity."""
MIN_SHARED = 4
"""Fewest matches among these for a pair."""
MIN_COSINE = 0.85
"""Smallest cosine between descriptors of matching features."""

Pairs = set[tuple[int, int]]
"""Index pairs of photographs, the smaller index first."""


@dataclass(frozen=True)
class Job:
    """Input of the process."""

    images: str
    """Folder of the photographs."""
    work: str
    """Folder for the database and temporary files."""
    model: str
    """Folder for the largest model; it does not exist yet."""
    photographs: list[UprightCopy]
    threads: int

    @property
    def database(self) -> Path:
        """Path of COLMAP's database."""
        return Path(self.work) / "database.db"


def main() -> None:
    """Run the job that standard input holds."""
    task = json.load(sys.stdin)
    copies = [UprightCopy(**one) for one in task.pop("photographs")]
    job = Job(photographs=copies, **task)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(SEED)
    find_features(job)
    match(job, select_pairs(job))
    print(json.dumps(map_photographs(job)))


def find_features(job: Job) -> None:
    """Extract SIFT features; photographs of equal size and focal length share a camera."""
    extraction = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
    extraction.sift.max_num_features = MAX_FEATURES
    lenses = dict.fromkeys((one.width, one.height, one.focal) for one in job.photographs)
    numbers = {lens: _add_camera(job, *lens) for lens in lenses}
    for one in job.photographs:  # one by one, so that they are numbered in their order
        number = numbers[one.width, one.height, one.focal]
        pycolmap.extract_features(
            job.database,
            job.images,
            [one.name],
            reader_options=pycolmap.ImageReaderOptions(existing_camera_id=number),
            extraction_options=extraction,
            device=pycolmap.Device.cpu,
        )


def _add_camera(job: Job, width: int, height: int, focal: float | None) -> int:
    guess = GUESSED_FOCAL * max(width, height)
    camera = pycolmap.Camera.create_from_model_name(1, LENS, focal or guess, width, height)
    camera.has_prior_focal_length = focal is not None
    with pycolmap.Database.open(job.database) as database:
        return int(database.write_camera(camera))


def select_pairs(job: Job) -> Pairs:
    """Choose the photographs to match: sequence neighbours, all pairs, or similar photographs."""
    names = [one.name for one in job.photographs]
    neighbours = pair_neighbours(len(names)) if is_sequence(names) else set()
    if not neighbours and len(names) <= MAX_EXHAUSTIVE:
        return set(combinations(range(len(names)), 2))
    with pycolmap.Database.open(job.database) as database:
        return neighbours | pair_similar([_read_features(database, name) for name in names])


def is_sequence(names: Sequence[str]) -> bool:
    """Check whether the names differ only in the last number of the file name."""
    forms = {re.sub(r"\d+(?=[^\d/]*$)", "#", name) for name in names}
    return len(forms) == 1 and not forms & set(names)


def pair_neighbours(count: int) -> Pairs:
    """Pair each photograph of a sequence with the next ones, and those 16, 32, 64, … ahead."""
    steps = [*range(1, NEIGHBOURS + 1), *(2**n for n in range(4, count.bit_length()))]
    return {(i, i + step) for step in steps for i in range(count - step)}


def _read_features(database: Any, name: str) -> Float[np.ndarray, "k 128"]:
    """Read the normalized descriptors of the largest features of a photograph."""
    number = database.read_image_with_name(name).image_id
    scales = np.linalg.norm(database.read_keypoints(number)[:, 2:4], axis=1)
    largest = np.argsort(-scales, kind="stable")[:NUM_LARGEST_FEATURES]
    chosen = np.asarray(database.read_descriptors(number).data, dtype=np.float32)[largest]
    return chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1e-9)


def pair_similar(features: Sequence[Float[np.ndarray, "_ 128"]]) -> Pairs:
    """Pair each photograph with those that share most features with it."""
    shared = np.zeros((len(features), len(features)), dtype=np.int64)
    for i, j in combinations(range(len(features)), 2):
        shared[i, j] = shared[j, i] = _count_shared(features[i], features[j])
    order = np.argsort(-shared, axis=1, kind="stable")[:, :NUM_SIMILAR]
    found = ((i, int(j)) for i, row in enumerate(order) for j in row if shared[i, j] >= MIN_SHARED)
    return {(min(pair), max(pair)) for pair in found}


def _count_shared(a: Float[np.ndarray, "m 128"], b: Float[np.ndarray, "n 128"]) -> int:
    """Count the mutual best matches above `MIN_COSINE`."""
    if len(a) == 0 or len(b) == 0:
        return 0
    cosines = a @ b.T
    best, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    is_mutual = back[best] == np.arange(len(a))
    return int(np.count_nonzero(is_mutual & (cosines.max(axis=1) > MIN_COSINE)))


def match(job: Job, pairs: Pairs) -> None:
    """Match the features of all pairs and verify them with an essential matrix."""
    names = [one.name for one in job.photographs]
    listed = pycolmap.ImportedPairingOptions(match_list_path=Path(job.work) / "pairs.txt")
    listed.match_list_path.write_text("".join(f"{names[i]} {names[j]}\n" for i, j in sorted(pairs)))
    matching = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    pycolmap.match_image_pairs(job.database, matching, listed, verification, pycolmap.Device.cpu)


def map_photographs(job: Job) -> dict[str, Any]:
    """Find cameras and points with a free focal length, then with plausible fixed ones.

    With a wrong focal length the mapper still connects photographs that it cannot connect with a
    free one, and together they determine the right value. The best model is written.

    Returns:
        Its `registered` photographs by the names of their copies, its number of `points`, its mean
        reprojection `error` in pixels, and True if its lenses are plausible (`is_plausible`).
    """
    best = map_largest(job)
    for fov in FIXED_FOVS:
        if _rate_model(best) >= (True, math.ceil(WANTED_SHARE * len(job.photographs)), 0):
            break
        _fix_focals(job, fov)
        best = max(best, map_largest(job, is_focal_fixed=True), key=_rate_model)
    if best is None:
        return {"registered": []}
    Path(job.model).mkdir(parents=True)
    best.write(job.model)
    return {
        "registered": [best.images[i].name for i in best.reg_image_ids()],
        "points": best.num_points3D(),
        "error": best.compute_mean_reprojection_error(),
        "is_plausible": _rate_model(best)[0],
    }


def _fix_focals(job: Job, fov: float) -> None:
    """Fix the focal lengths in the database for a field of view in degrees, undistorted."""
    with pycolmap.Database.open(job.database) as database:
        for camera in database.read_all_cameras():
            side = max(camera.width, camera.height)
            camera.focal_length = side / 2 / math.tan(math.radians(fov / 2))
            camera.has_prior_focal_length = True
            database.update_camera(camera)


def map_largest(job: Job, is_focal_fixed: bool = False) -> pycolmap.Reconstruction | None:
    """Map the scene; return the model with most photographs, or None if there is none.

    A fixed focal length is set free once the model is complete.
    """
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads,
        random_seed=SEED,
        min_model_size=MIN_MODEL,
        ba_refine_focal_length=not is_focal_fixed,
        ba_refine_extra_params=not is_focal_fixed,
    )
    found = pycolmap.incremental_mapping(job.database, job.images, job.work, options)
    model = max(found.values(), key=lambda model: model.num_reg_images(), default=None)
    if model is not None and is_focal_fixed:
        pycolmap.bundle_adjustment(model, pycolmap.BundleAdjustmentOptions(print_summary=False))
        model.update_point_3d_errors()
    return model


def _rate_model(model: pycolmap.Reconstruction | None) -> tuple[bool, int, int]:
    """Rate a model by plausible lenses, then photographs, then points."""
    if model is None:
        return False, 0, 0
    lenses = (model.cameras[model.images[i].camera_id] for i in model.reg_image_ids())
    return all(map(is_plausible, lenses)), model.num_reg_images(), model.num_points3D()


def is_plausible(camera: pycolmap.Camera) -> bool:
    """Check whether a camera has a field of view and distortion of a real one."""
    focal, side = camera.mean_focal_length(), max(camera.width, camera.height)
    if not (math.isfinite(focal) and focal > 0):
        return False
    fov = math.degrees(2 * math.atan(side / 2 / focal))
    corner = (camera.width**2 + camera.height**2) / 4 / focal**2
    shift = camera.params[camera.extra_params_idxs()[0]] * corner
    return FOV[0] <= fov <= FOV[1] and bool(abs(shift) <= MAX_SHIFT)


if __name__ == "__main__":
    main()
