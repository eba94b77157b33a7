"""Structure from motion in a separate process, because COLMAP aborts on errors.

The argument is the JSON file of a `Job`. Output is one JSON object per line: `{"begin": phase,
"steps": n}`, then about n times `{"step": 1}` and `{"end": phase}`, and at last `{"result": ...}`.
COLMAP's own output goes to standard error.
"""

from __future__ import annotations

import json
import math
import os
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import pycolmap

from gscompleter.data.sfm.match_pairs import (
    Pairs,
    compute_similarity,
    is_sequence,
    pair_all,
    pair_neighbours,
    pair_similar,
    select_largest_features,
)
from gscompleter.data.sfm.upright import UprightCopy

SEED = 0
MAX_FEATURES = 4096
"""Most features in a photograph."""
MAX_EXHAUSTIVE = 60
"""Most unordered photographs that are all matched with each other."""
BATCH = 50
"""Pairs matched per step of the progress bar."""
LENS = "SIMPLE_RADIAL"
"""COLMAP's camera model: one focal length, one distortion coefficient."""
GUESSED_FOCAL = 1.2
"""Focal length in longer image sides, if EXIF lacks it."""
MIN_MODEL = 3
"""Fewest photographs of a disconnected part that is reported."""
MIN_FOR_CENTRE = 10
"""Fewest photographs per camera to refine its principal point."""
MAX_OFF_CENTRE = 0.1
"""Largest plausible distance of the principal point from the centre, in longer sides."""
FOV = 10.0, 150.0
"""Plausible range of the field of view along the longer side, in degrees."""
MAX_SHIFT = 0.5
"""Largest plausible shift of an image corner by distortion, relative to its radius."""
FIXED_FOVS = (75.0, 60.0, 90.0, 45.0)
"""Fields of view along the longer side, in degrees, to fix the focal length at, in order."""
MAX_ROUNDS = 4
"""Most rounds of mapping with a fixed focal length, each at the value last fitted."""
FOCAL_TOLERANCE = 0.02
"""Relative change of the focal length that counts as converged."""


@dataclass(frozen=True)
class Job:
    """Input of the process: folders, photographs, and when to stop searching a focal length."""

    images: str
    work: str
    """Folder for the database and temporary files."""
    model: str
    """Folder for the largest model; it does not exist yet."""
    photographs: list[UprightCopy]
    threads: int
    min_photographs: int
    """Fewest photographs in a model that end the search."""
    min_points: int
    """Fewest points in a model that end the search."""

    @property
    def database(self) -> Path:
        """Path of COLMAP's database."""
        return Path(self.work) / "database.db"


class ProgressWriter:
    """Reporter of progress as JSON lines."""

    def __init__(self, out: IO[str]) -> None:
        self.out = out

    def write_line(self, line: dict[str, Any]) -> None:
        """Write one line."""
        print(json.dumps(line), file=self.out, flush=True)

    def step(self) -> None:
        """Report one step."""
        self.write_line({"step": 1})

    @contextmanager
    def phase(self, name: str, steps: int) -> Iterator[None]:
        """Report the begin and end of a phase."""
        self.write_line({"begin": name, "steps": steps})
        yield
        self.write_line({"end": name})


def main() -> None:
    """Run the job in the file that the command line names."""
    progress = ProgressWriter(os.fdopen(os.dup(1), "w"))
    os.dup2(2, 1)  # keeps output of COLMAP apart from ours
    task = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    copies = [UprightCopy(**one) for one in task.pop("photographs")]
    job = Job(photographs=copies, **task)
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(SEED)
    find_features(job, progress)
    match(job, select_pairs(job), progress)
    progress.write_line({"result": map_all(job, progress)})


def find_features(job: Job, progress: ProgressWriter) -> None:
    """Extract SIFT features of all photographs; those of equal size and lens share a camera."""
    extraction = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
    extraction.sift.max_num_features = MAX_FEATURES
    cameras = {(one.width, one.height, one.lens): one for one in job.photographs}
    numbers = {key: _add_camera(job, one) for key, one in cameras.items()}
    with progress.phase("Finding features", len(job.photographs)):
        for one in job.photographs:
            number = numbers[one.width, one.height, one.lens]
            pycolmap.extract_features(
                job.database,
                job.images,
                [one.name],
                reader_options=pycolmap.ImageReaderOptions(existing_camera_id=number),
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
            )
            progress.step()


def _add_camera(job: Job, one: UprightCopy) -> int:
    focal = one.focal or GUESSED_FOCAL * max(one.width, one.height)
    camera = pycolmap.Camera.create_from_model_name(1, LENS, focal, one.width, one.height)
    camera.has_prior_focal_length = one.focal is not None
    with pycolmap.Database.open(job.database) as database:
        return int(database.write_camera(camera))


def select_pairs(job: Job) -> Pairs:
    """Choose the photographs to match: sequence neighbours, all pairs, or similar photographs."""
    names = [one.name for one in job.photographs]
    neighbours = pair_neighbours(len(names)) if is_sequence(names) else set()
    if not neighbours and len(names) <= MAX_EXHAUSTIVE:
        return pair_all(len(names))
    with pycolmap.Database.open(job.database) as database:
        features = [_read_features(database, name) for name in names]
    return neighbours | pair_similar(compute_similarity(features))


def _read_features(database: Any, name: str) -> np.ndarray:
    number = database.read_image_with_name(name).image_id
    scales = np.linalg.norm(database.read_keypoints(number)[:, 2:4], axis=1)
    return select_largest_features(
        scales, np.asarray(database.read_descriptors(number).data, dtype=np.float32)
    )


def match(job: Job, pairs: Pairs, progress: ProgressWriter) -> None:
    """Match the features of all pairs and verify them with an essential matrix."""
    matching = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    listed = pycolmap.ImportedPairingOptions(match_list_path=Path(job.work) / "pairs.txt")
    lines = [f"{job.photographs[i].name} {job.photographs[j].name}\n" for i, j in sorted(pairs)]
    starts = range(0, len(lines), BATCH)
    with progress.phase("Matching features", len(starts)):
        for start in starts:
            listed.match_list_path.write_text("".join(lines[start : start + BATCH]))
            pycolmap.match_image_pairs(
                job.database, matching, listed, verification, pycolmap.Device.cpu
            )
            progress.step()


def map_all(job: Job, progress: ProgressWriter) -> dict[str, Any]:
    """Find cameras and points from the matches, and write the largest model.

    Returns:
        Its `registered` photographs by the names of their copies, the sizes of all `models`
        (largest first), its number of `points`, its mean reprojection `error` in pixels, the
        `defect` of its lens or None, and the `focal` length in pixels if it was fixed at first,
        else None.
    """
    models, is_focal_fixed = select_attempt(job, progress)
    if not models:
        return {"registered": [], "models": [], "points": 0, "error": 0.0}
    largest = refine_principal_points(models[0])
    Path(job.model).mkdir(parents=True)
    largest.write(job.model)
    focal = list_used_cameras(largest)[0].mean_focal_length()
    return {
        "registered": sorted(largest.images[i].name for i in largest.reg_image_ids()),
        "models": count_parts([set(model.reg_image_ids()) for model in models]),
        "points": largest.num_points3D(),
        "error": largest.compute_mean_reprojection_error(),
        "defect": find_lens_defect(largest),
        "focal": focal if is_focal_fixed else None,
    }


Attempt = tuple[list[Any], bool]
"""Disconnected models, the largest first; and True if the focal length was fixed at first."""


def select_attempt(job: Job, progress: ProgressWriter) -> Attempt:
    """Map with a free focal length, then with each plausible fixed value, until it is good.

    Returns the best attempt.
    """
    best: Attempt = _map_models(job, progress), False
    for focals in list_focals(job):
        is_plausible, photographs, points = rate_models(best[0])
        if is_plausible and photographs >= job.min_photographs and points >= job.min_points:
            break
        attempt = map_with_fixed_focals(job, progress, focals), True
        best = max(best, attempt, key=lambda one: rate_models(one[0]))
    return best


def rate_models(models: list[Any]) -> tuple[bool, int, int]:
    """Rate the largest model: plausible lenses, then photographs, then points."""
    if not models:
        return False, 0, 0
    model = models[0]
    return find_lens_defect(model) is None, model.num_reg_images(), model.num_points3D()


def list_focals(job: Job) -> list[dict[int, float]]:
    """List fixed focal lengths (pixels) by camera: from EXIF if all have it, then `FIXED_FOVS`."""
    with pycolmap.Database.open(job.database) as database:
        cameras = database.read_all_cameras()
    in_exif = {one.camera_id: one.focal_length for one in cameras if one.has_prior_focal_length}
    sides = {one.camera_id: max(one.width, one.height) for one in cameras}
    tangents = [math.tan(math.radians(fov / 2)) for fov in FIXED_FOVS]
    guessed = [{number: side / 2 / tan for number, side in sides.items()} for tan in tangents]
    return ([in_exif] if len(in_exif) == len(cameras) else []) + guessed


def map_with_fixed_focals(
    job: Job, progress: ProgressWriter, focals: dict[int, float]
) -> list[Any]:
    """Map with fixed focal lengths, refine them, and repeat until they converge.

    With a wrong focal length the mapper still connects photographs that it cannot connect with a
    free one, and together they determine the right value.
    """
    best = list[Any]()
    for _ in range(MAX_ROUNDS):
        fix_focals(job, focals)
        models = _map_models(job, progress, is_focal_fixed=True)
        if not models or (best and models[0].num_reg_images() < best[0].num_reg_images()):
            break
        best = [refine_lenses(models[0], refine_extra_params=False), *models[1:]]
        fitted = {one.camera_id: one.mean_focal_length() for one in list_used_cameras(best[0])}
        if all(abs(fitted[n] / focals[n] - 1) < FOCAL_TOLERANCE for n in fitted):
            break
        focals = focals | fitted
    return [refine_lenses(best[0]), *best[1:]] if best else []


def fix_focals(job: Job, focals: dict[int, float]) -> None:
    """Fix focal lengths (pixels) in the database, without distortion."""
    with pycolmap.Database.open(job.database) as database:
        for camera in database.read_all_cameras():
            known = pycolmap.Camera.create_from_model_name(
                camera.camera_id, LENS, focals[camera.camera_id], camera.width, camera.height
            )
            known.has_prior_focal_length = True
            database.update_camera(known)


def list_used_cameras(model: pycolmap.Reconstruction) -> list[pycolmap.Camera]:
    """List the cameras of the model, that of most photographs first."""
    return [model.cameras[number] for number, _ in _count_photographs(model).most_common()]


def _count_photographs(model: pycolmap.Reconstruction) -> Counter[int]:
    return Counter(model.images[i].camera_id for i in model.reg_image_ids())


def find_lens_defect(model: pycolmap.Reconstruction) -> str | None:
    """Describe the first implausible lens of the model; None if all are plausible."""
    return next(filter(None, map(_find_camera_defect, list_used_cameras(model))), None)


def _find_camera_defect(camera: pycolmap.Camera) -> str | None:
    focal = camera.mean_focal_length()
    if not (math.isfinite(focal) and focal > 0):
        return f"a focal length of {focal:g} px"
    fov = math.degrees(2 * math.atan(max(camera.width, camera.height) / 2 / focal))
    corner = (camera.width**2 + camera.height**2) / 4 / focal**2
    shift = camera.params[camera.extra_params_idxs()[0]] * corner
    if FOV[0] <= fov <= FOV[1] and abs(shift) <= MAX_SHIFT:
        return None
    return (
        f"a focal length of {focal:.0f} px ({fov:.0f}° across) and a distortion that moves corners "
        f"by {100 * abs(shift):.0f} %"
    )


def count_parts(models: list[set[int]]) -> list[int]:
    """Count the photographs of each disconnected model, largest first.

    A second model among photographs that are already placed is no part.
    """
    sizes, placed = list[int](), set[int]()
    for model in models:
        if not sizes or len(model - placed) >= MIN_MODEL:
            sizes.append(len(model))
            placed |= model
    return sizes


def refine_principal_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Refine the principal points if there are enough photographs.

    The mapper leaves them at the image centres: few photographs cannot separate them from a
    rotation, and neither can similar photographs, so the result is rejected if far from the centre.
    """
    if min(_count_photographs(model).values()) < MIN_FOR_CENTRE:
        return model
    refined = refine_lenses(model, refine_principal_point=True)
    for camera in list_used_cameras(refined):
        x, y = camera.principal_point_x, camera.principal_point_y
        off = math.hypot(x - camera.width / 2, y - camera.height / 2)
        if not off <= MAX_OFF_CENTRE * max(camera.width, camera.height):
            return model
    return refined


def refine_lenses(model: pycolmap.Reconstruction, **options: bool) -> pycolmap.Reconstruction:
    """Bundle-adjust a copy with free focal lengths; return the input if a lens gets implausible."""
    refined = deepcopy(model)
    adjustment = pycolmap.BundleAdjustmentOptions(print_summary=False, **options)
    pycolmap.bundle_adjustment(refined, adjustment)
    refined.update_point_3d_errors()
    return refined if find_lens_defect(refined) is None else model


def _map_models(job: Job, progress: ProgressWriter, is_focal_fixed: bool = False) -> list[Any]:
    """Map the scene into disconnected models, the largest first."""
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads,
        random_seed=SEED,
        min_model_size=MIN_MODEL,
        ba_refine_focal_length=not is_focal_fixed,
        ba_refine_extra_params=not is_focal_fixed,
    )
    with progress.phase("Placing cameras", len(job.photographs)):
        found = pycolmap.incremental_mapping(
            job.database, job.images, job.work, options, next_image_callback=progress.step
        )
    return sorted(found.values(), key=lambda model: -model.num_reg_images())


if __name__ == "__main__":
    main()
