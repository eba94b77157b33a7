"""Structure from motion in a separate process, because COLMAP aborts on errors.

The argument is the JSON file of a job. Output is one JSON object per line: `{"begin": phase,
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

from gscompleter.data.match_pairs import (
    MAX_EXHAUSTIVE,
    Pairs,
    alike,
    all_pairs,
    is_sequence,
    largest,
    likeness,
    neighbours,
)
from gscompleter.data.upright import Upright

SEED = 0
MAX_FEATURES = 4096
"""Most features in a photograph."""
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
HELD_FOVS = (75.0, 60.0, 90.0, 45.0)
"""Fields of view along the longer side, in degrees, to fix the focal length at, in order."""
MAX_ROUNDS = 4
"""Most rounds of mapping with a fixed focal length, each at the value last fitted."""
SETTLED = 0.02
"""Relative change of the focal length that counts as converged."""


@dataclass(frozen=True)
class Job:
    """Input of the process."""

    images: Path
    work: Path
    """Folder for the database and temporary files."""
    model: Path
    """Folder for the largest model; it does not exist yet."""
    photographs: list[Upright]
    threads: int
    wanted: int
    """Fewest photographs in a model that end the search for a focal length."""
    min_points: int
    """Fewest points in a model that end the search."""

    @property
    def database(self) -> Path:
        """Path of COLMAP's database."""
        return self.work / "database.db"


class Teller:
    """Reporter of progress as JSON lines."""

    def __init__(self, out: IO[str]) -> None:
        self.out = out

    @contextmanager
    def phase(self, name: str, steps: int) -> Iterator[None]:
        """Report the begin and end of a phase."""
        self.say({"begin": name, "steps": steps})
        yield
        self.say({"end": name})

    def step(self) -> None:
        """Report one step."""
        self.say({"step": 1})

    def say(self, line: dict[str, Any]) -> None:
        """Write one line."""
        print(json.dumps(line), file=self.out, flush=True)


def main() -> None:
    """Run the job in the file that the command line names."""
    progress = Teller(os.fdopen(os.dup(1), "w"))
    os.dup2(2, 1)  # keeps output of COLMAP apart from ours
    task = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    photographs = [Upright(**one) for one in task["photographs"]]
    images, work, model = (Path(task[name]) for name in ("images", "work", "model"))
    job = Job(images, work, model, photographs, task["threads"], task["wanted"], task["min_points"])
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(SEED)
    find_features(job, progress)
    match(job, pairs_of(job), progress)
    progress.say({"result": map_all(job, progress)})


def find_features(job: Job, teller: Teller) -> None:
    """Extract SIFT features of all photographs; those of equal size and lens share a camera."""

    def make_key(one: Upright) -> tuple[int, int, str]:
        return one.width, one.height, one.lens

    extraction = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
    extraction.sift.max_num_features = MAX_FEATURES
    cameras = {make_key(one): one for one in job.photographs}
    numbers = {key: _add_camera(job, one) for key, one in cameras.items()}
    with teller.phase("Finding features", len(job.photographs)):
        for one in job.photographs:
            pycolmap.extract_features(
                job.database,
                job.images,
                [one.name],
                reader_options=pycolmap.ImageReaderOptions(
                    existing_camera_id=numbers[make_key(one)]
                ),
                extraction_options=extraction,
                device=pycolmap.Device.cpu,
            )
            teller.step()


def _add_camera(job: Job, one: Upright) -> int:
    focal = one.focal or GUESSED_FOCAL * max(one.width, one.height)
    camera = pycolmap.Camera.create_from_model_name(1, LENS, focal, one.width, one.height)
    camera.has_prior_focal_length = one.focal is not None
    with pycolmap.Database.open(job.database) as database:
        return int(database.write_camera(camera))


def pairs_of(job: Job) -> Pairs:
    """Choose the photographs to match: sequence neighbours, all pairs, or similar photographs."""
    names = [one.name for one in job.photographs]
    if is_sequence(names):
        return neighbours(len(names)) | alike(likeness(_largest_features(job)))
    if len(names) <= MAX_EXHAUSTIVE:
        return all_pairs(len(names))
    return alike(likeness(_largest_features(job)))


def _largest_features(job: Job) -> list[np.ndarray]:
    with pycolmap.Database.open(job.database) as database:
        return [_features_of(database, one.name) for one in job.photographs]


def _features_of(database: Any, name: str) -> np.ndarray:
    number = database.read_image_with_name(name).image_id
    scales = np.linalg.norm(database.read_keypoints(number)[:, 2:4], axis=1)
    return largest(scales, np.asarray(database.read_descriptors(number).data, dtype=np.float32))


def match(job: Job, pairs: Pairs, teller: Teller) -> None:
    """Match the features of all pairs and verify them with an essential matrix."""
    matching = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = SEED
    batches = list(_batches(sorted(pairs)))
    listed = pycolmap.ImportedPairingOptions(match_list_path=job.work / "pairs.txt")
    with teller.phase("Matching features", len(batches)):
        for batch in batches:
            names = [(job.photographs[i].name, job.photographs[j].name) for i, j in batch]
            listed.match_list_path.write_text("".join(f"{a} {b}\n" for a, b in names))
            pycolmap.match_image_pairs(
                job.database, matching, listed, verification, pycolmap.Device.cpu
            )
            teller.step()


def _batches(pairs: list[tuple[int, int]]) -> Iterator[list[tuple[int, int]]]:
    return (pairs[i : i + BATCH] for i in range(0, len(pairs), BATCH))


@dataclass(frozen=True)
class Attempt:
    """Models from one treatment of the focal length."""

    models: list[Any]
    """Disconnected models, the largest first."""
    was_held: bool = False
    """True if the focal length was fixed at first."""

    @property
    def quality(self) -> tuple[bool, int, int]:
        """Sort key: plausible lenses, then photographs, then points of the largest model."""
        if not self.models:
            return False, 0, 0
        model = self.models[0]
        return lens_defect(model) is None, model.num_reg_images(), model.num_points3D()


def map_all(job: Job, teller: Teller) -> dict[str, Any]:
    """Find cameras and points from the matches, and write the largest model.

    Returns:
        Its `registered` photographs by the names of their copies, the sizes of all `models`
        (largest first), its number of `points`, its mean reprojection `error` in pixels, the
        `defect` of its lens or None, and the `focal` length in pixels if it was fixed at first,
        else None.
    """
    attempt = select_attempt(job, teller)
    if not attempt.models:
        return {"registered": [], "models": [], "points": 0, "error": 0.0}
    largest_one = with_principal_points(attempt.models[0])
    job.model.mkdir(parents=True)
    largest_one.write(job.model)
    return {
        "registered": sorted(largest_one.images[i].name for i in largest_one.reg_image_ids()),
        "models": parts([set(model.reg_image_ids()) for model in attempt.models]),
        "points": largest_one.num_points3D(),
        "error": largest_one.compute_mean_reprojection_error(),
        "defect": lens_defect(largest_one),
        "focal": used_cameras(largest_one)[0].mean_focal_length() if attempt.was_held else None,
    }


def select_attempt(job: Job, teller: Teller) -> Attempt:
    """Return the first attempt that is good enough, or else the best."""
    best = Attempt([])
    for attempt in attempts(job, teller):
        best = max(best, attempt, key=lambda one: one.quality)
        is_plausible, photographs, points = best.quality
        if is_plausible and photographs >= job.wanted and points >= job.min_points:
            break
    return best


def attempts(job: Job, teller: Teller) -> Iterator[Attempt]:
    """Map with a free focal length, then with each plausible fixed value."""
    yield Attempt(_models(job, teller))
    for focals in focals_to_hold(job):
        yield Attempt(map_held(job, teller, focals), was_held=True)


def focals_to_hold(job: Job) -> list[dict[int, float]]:
    """List fixed focal lengths (pixels) by camera: from EXIF if all have it, then `FIXED_FOVS`."""
    with pycolmap.Database.open(job.database) as database:
        cameras = database.read_all_cameras()
    in_exif = {one.camera_id: one.focal_length for one in cameras if one.has_prior_focal_length}
    sides = {one.camera_id: max(one.width, one.height) for one in cameras}
    return [
        *([in_exif] if len(in_exif) == len(cameras) else []),
        *(
            {number: side / 2 / math.tan(math.radians(fov / 2)) for number, side in sides.items()}
            for fov in HELD_FOVS
        ),
    ]


def map_held(job: Job, teller: Teller, focals: dict[int, float]) -> list[Any]:
    """Map with fixed focal lengths, refine them, and repeat until they converge.

    With a wrong focal length the mapper still connects photographs that it cannot connect with a
    free one, and together they determine the right value.
    """
    best = list[Any]()
    for _ in range(MAX_ROUNDS):
        hold(job, focals)
        models = _models(job, teller, is_held=True)
        if not models or (best and models[0].num_reg_images() < best[0].num_reg_images()):
            break
        best = [with_fitted_lenses(models[0], refine_extra_params=False), *models[1:]]
        fitted = {one.camera_id: one.mean_focal_length() for one in used_cameras(best[0])}
        if all(abs(fitted[n] / focals[n] - 1) < SETTLED for n in fitted):
            break
        focals = focals | fitted
    return [with_fitted_lenses(best[0]), *best[1:]] if best else []


def hold(job: Job, focals: dict[int, float]) -> None:
    """Fix focal lengths (pixels) in the database, without distortion."""
    with pycolmap.Database.open(job.database) as database:
        for camera in database.read_all_cameras():
            known = pycolmap.Camera.create_from_model_name(
                camera.camera_id, LENS, focals[camera.camera_id], camera.width, camera.height
            )
            known.has_prior_focal_length = True
            database.update_camera(known)


def used_cameras(model: pycolmap.Reconstruction) -> list[pycolmap.Camera]:
    """List the cameras of the model, that of most photographs first."""
    numbers = Counter(model.images[i].camera_id for i in model.reg_image_ids())
    return [model.cameras[number] for number, _ in numbers.most_common()]


def lens_defect(model: pycolmap.Reconstruction) -> str | None:
    """Describe the first implausible lens of the model; None if all are plausible."""
    return next(filter(None, map(_defect_of, used_cameras(model))), None)


def _defect_of(camera: pycolmap.Camera) -> str | None:
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


def parts(models: list[set[int]]) -> list[int]:
    """Count the photographs of each disconnected model, largest first.

    A second model among photographs that are already placed is no part.
    """
    sizes, placed = list[int](), set[int]()
    for model in models:
        if not sizes or len(model - placed) >= MIN_MODEL:
            sizes.append(len(model))
            placed |= model
    return sizes


def with_principal_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """Refine the principal points if there are enough photographs.

    The mapper leaves them at the image centres: few photographs cannot separate them from a
    rotation, and neither can similar photographs, so the result is rejected if far from the centre.
    """
    numbers = Counter(model.images[i].camera_id for i in model.reg_image_ids())
    if min(numbers.values()) < MIN_FOR_CENTRE:
        return model
    refined = with_fitted_lenses(model, refine_principal_point=True)
    return refined if all(map(_is_centred, used_cameras(refined))) else model


def with_fitted_lenses(model: pycolmap.Reconstruction, **options: bool) -> pycolmap.Reconstruction:
    """Bundle-adjust a copy with free focal lengths; return the input if a lens gets implausible."""
    refined = deepcopy(model)
    adjustment = pycolmap.BundleAdjustmentOptions(print_summary=False, **options)
    pycolmap.bundle_adjustment(refined, adjustment)
    refined.update_point_3d_errors()
    return refined if lens_defect(refined) is None else model


def _is_centred(camera: pycolmap.Camera) -> bool:
    x, y = camera.principal_point_x, camera.principal_point_y
    off = math.hypot(x - camera.width / 2, y - camera.height / 2)
    return bool(off <= MAX_OFF_CENTRE * max(camera.width, camera.height))


def _models(job: Job, teller: Teller, is_held: bool = False) -> list[Any]:
    """Map the scene into disconnected models, the largest first."""

    def count_first_pair() -> None:
        teller.step()
        teller.step()

    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads,
        random_seed=SEED,
        min_model_size=MIN_MODEL,
        ba_refine_focal_length=not is_held,
        ba_refine_extra_params=not is_held,
    )
    with teller.phase("Placing cameras", len(job.photographs)):
        found = pycolmap.incremental_mapping(
            job.database,
            job.images,
            job.work,
            options,
            initial_image_pair_callback=count_first_pair,
            next_image_callback=teller.step,
        )
    return sorted(found.values(), key=lambda model: -model.num_reg_images())


if __name__ == "__main__":
    main()
