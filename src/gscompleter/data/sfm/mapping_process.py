"""Structure from motion in a separate process, because COLMAP aborts on errors.

Standard input is a `MappingJob` as JSON. The last line of the output is the result, as JSON too.
"""

from __future__ import annotations

import json
import math
import sys
from collections import Counter
from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap

from gscompleter.data.panorama import VIEWS, compute_view_rotation
from gscompleter.data.sfm.kept_matches import CheckedPlaces, drop_wrong_places, keep_back_tracks
from gscompleter.data.sfm.learned_features import (
    LearnedMatcher,
    load_learned_matcher,
    match_learned,
)
from gscompleter.data.sfm.matching import (
    MATCHING_SEED,
    ColmapJob,
    Pairs,
    extract_features,
    match,
    prepare_colmap,
    read_image_number,
    select_pairs,
)
from gscompleter.data.sfm.poses import (
    LEARNED,
    MIN_MODEL_POINTS,
    MIN_PHOTOGRAPHS,
    SIFT,
    WANTED_SHARE,
    UprightCopy,
)

LENS_MODEL = "SIMPLE_RADIAL"
"""COLMAP's camera model: one focal length, one distortion coefficient."""
GUESSED_FOCAL = 1.2
"""Focal length in longer image sides, if EXIF lacks it."""
MIN_FOR_CENTRE = 10
"""Fewest photographs per camera to refine its principal point."""
MAX_OFF_CENTRE = 0.1
"""Largest plausible distance of the principal point from the centre, in longer sides."""
FOV = 10.0, 150.0
"""Plausible range of the field of view along the longer side, in degrees."""
MAX_DISTORTION_SHIFT = 0.5
"""Largest plausible shift of an image corner by distortion, relative to its radius."""
FIXED_FOVS = (75.0, 60.0, 90.0, 45.0)
"""Fields of view along the longer side, in degrees, to fix the focal length at, in order."""
MAPPING_ROUNDS = 2
"""Rounds of mapping with a fixed focal length, the second at the value that the first fitted."""


@dataclass(frozen=True, kw_only=True)
class MappingJob(ColmapJob):
    """Input of the process; `model` is the folder for the largest model."""

    photographs: list[UprightCopy]
    is_panoramic: bool
    """True if these are views of panoramas, in the folders view_0, view_1, …"""


PlaceCheck = Callable[[pycolmap.Reconstruction], CheckedPlaces]
"""Takes photographs in wrong places out of a model."""


@dataclass(frozen=True)
class Mapped:
    """The best model of the photographs."""

    model: pycolmap.Reconstruction | None
    is_focal_fixed: bool
    """True if its focal length was fixed at first."""
    features: str = SIFT
    contradicted: tuple[str, ...] = ()
    """Photographs that were taken out, since matches that were kept back contradict them."""
    kept_distance: float = 0.0
    """Median distance of matches that were kept back from their epipolar lines; 0 without such."""

    @property
    def rating(self) -> tuple[bool, int, float, int]:
        """Plausible lenses, photographs, agreement with kept matches, and points, in this order."""
        if self.model is None:
            return False, 0, -math.inf, 0
        photographs = self.model.num_reg_images()
        points = self.model.num_points3D()
        # By less than a tenth of a pixel they tell no model from another.
        agreement = -round(self.kept_distance, 1)
        return has_plausible_lenses(self.model), photographs, agreement, points

    def is_usable(self, wanted: int) -> bool:
        """Check for plausible lenses, and enough photographs and points."""
        is_plausible, photographs, _, points = self.rating
        return is_plausible and photographs >= wanted and points >= MIN_MODEL_POINTS


def main() -> None:
    """Run the job that standard input holds."""
    task = json.load(sys.stdin)
    copies = [UprightCopy(**one) for one in task.pop("photographs")]
    job = MappingJob(photographs=copies, **task)
    prepare_colmap()
    find_features(job)
    if job.is_panoramic:
        join_views(job)
    names = [one.name for one in job.photographs]
    # Between views of one panorama there is no baseline.
    centres = [name.partition("/")[2] if job.is_panoramic else name for name in names]
    pairs = {(i, j) for i, j in select_pairs(job, names) if centres[i] != centres[j]}
    match(job, names, pairs)
    found = map_photographs(job)

    lacks_learned = False
    # The views of a panorama overlap all around, and their rig was not tried with other features.
    if not job.is_panoramic and not found.is_usable(count_wanted(job)):
        matcher = load_learned_matcher()
        lacks_learned = matcher is None
        if matcher is not None:
            learned = map_with_learned_features(job, matcher, names, pairs)
            # Where both place as many, SIFT's features are the more precise ones.
            found = max(found, learned, key=rate_use)
    print(json.dumps({**write_model(job, found), "lacks_learned": lacks_learned}))


def rate_use(found: Mapped) -> tuple[bool, int]:
    """Rate a model of some features by whether it can be used, then by its photographs."""
    return found.is_usable(MIN_PHOTOGRAPHS), found.rating[1]


def count_wanted(job: MappingJob) -> int:
    """Count the photographs that a model should have."""
    return max(MIN_PHOTOGRAPHS, math.ceil(WANTED_SHARE * len(job.photographs)))


def find_features(job: MappingJob) -> None:
    """Extract SIFT features of all photographs; those of equal size and lens share a camera."""
    cameras = {(one.width, one.height, one.lens): one for one in job.photographs}
    numbers = {}
    with pycolmap.Database.open(job.database) as database:
        for key, one in cameras.items():
            focal = one.focal or GUESSED_FOCAL * max(one.width, one.height)
            camera = pycolmap.Camera.create_from_model_name(
                1, LENS_MODEL, focal, one.width, one.height
            )
            camera.has_prior_focal_length = one.focal is not None
            numbers[key] = int(database.write_camera(camera))

    for one in job.photographs:  # one by one, so that they are numbered in their order
        number = numbers[one.width, one.height, one.lens]
        extract_features(job, one.name, number, one.is_masked)


def join_views(job: MappingJob) -> None:
    """Join the views of each panorama to a rig, with known rotations and one centre."""
    rig = pycolmap.RigConfig()
    for number, view in enumerate(VIEWS):
        # COLMAP's rig maps from the rig to the camera; `compute_view_rotation` leads from it to the
        # axes of the panorama. The first camera is the reference and has no pose of its own.
        turn = pycolmap.Rigid3d(pycolmap.Rotation3d(compute_view_rotation(*view).T), np.zeros(3))
        camera = pycolmap.RigConfigCamera(image_prefix=f"view_{number}/", ref_sensor=number == 0)
        camera.cam_from_rig = turn if number else None
        rig.cameras = [*rig.cameras, camera]
    with pycolmap.Database.open(job.database) as database:
        pycolmap.apply_rig_config([rig], database)


def map_photographs(job: MappingJob, check: PlaceCheck | None = None) -> Mapped:
    """Find cameras and points from the matches in the database; `check` is of `select_model`."""
    found = select_model(job, check)
    if found.model is None or job.is_panoramic:
        return found
    if min(_count_photographs(found.model).values()) < MIN_FOR_CENTRE:
        # Fewer photographs cannot separate the principal point from a rotation.
        return found
    return replace(found, model=refine_lenses(found.model, refine_principal_point=True))


def map_with_learned_features(
    job: MappingJob, matcher: LearnedMatcher, names: list[str], pairs: Pairs
) -> Mapped:
    """Map again with learned features, and leave out what matches that were kept back contradict.

    Learned features also match what only looks alike, so that a photograph can be in a wrong place
    though the lens is plausible and hundreds of matches agree.
    """
    masked = [copy.name for copy in job.photographs if copy.is_masked]
    match_learned(job, matcher, names, masked, pairs)
    with pycolmap.Database.open(job.database) as database:
        numbers = [read_image_number(database, name) for name in names]
        kept = keep_back_tracks(database, numbers)
        keypoints = {number: database.read_keypoints(number)[:, :2] for number in numbers}
    mapped = map_photographs(job, lambda model: drop_wrong_places(model, kept, keypoints))
    return replace(mapped, features=LEARNED)


def write_model(job: MappingJob, found: Mapped) -> dict[str, Any]:
    """Write a model and return its quality.

    `registered` are the names of the copies, `error` is the mean reprojection error in pixels, and
    `focal` the focal length in pixels of the camera with most photographs if it was fixed at first,
    else None.
    """
    quality = {"features": found.features, "contradicted": list(found.contradicted)}
    model = found.model
    if model is None:
        nothing = {"registered": [], "points": 0, "error": 0.0, "is_plausible": True}
        return {**quality, **nothing, "focal": None}
    Path(job.model).mkdir(parents=True)
    model.write(job.model)
    ((main_camera, _),) = _count_photographs(model).most_common(1)
    focal = model.cameras[main_camera].mean_focal_length()
    return {
        **quality,
        "registered": [model.images[i].name for i in model.reg_image_ids()],
        "points": model.num_points3D(),
        "error": model.compute_mean_reprojection_error(),
        "is_plausible": has_plausible_lenses(model),
        "focal": focal if found.is_focal_fixed else None,
    }


def select_model(job: MappingJob, check: PlaceCheck | None = None) -> Mapped:
    """Map with a free focal length, then with plausible fixed ones, until the model is good.

    `check` takes photographs in wrong places out of each model before these are compared. With it
    all focal lengths are tried: a wrong one bends a model that otherwise looks good.
    """
    if job.is_panoramic:  # the focal length of views is known
        return Mapped(map_largest(job, is_focal_fixed=True), is_focal_fixed=False)
    best = check_places(map_largest(job), is_focal_fixed=False, check=check)
    # A plausible model with enough photographs is kept; until then further focal lengths are tried.
    for fov in FIXED_FOVS:
        if check is None and best.rating[:2] >= (True, count_wanted(job)):
            break
        with_fixed_focals = check_places(
            map_with_fixed_focals(job, fov), is_focal_fixed=True, check=check
        )
        if with_fixed_focals.rating > best.rating:
            best = with_fixed_focals
    return best


def check_places(
    model: pycolmap.Reconstruction | None, is_focal_fixed: bool, check: PlaceCheck | None
) -> Mapped:
    """Take out of a model the photographs that `check` finds in wrong places, in the model itself.

    No model is left if too few photographs are.
    """
    if model is None or check is None:
        return Mapped(model, is_focal_fixed and model is not None)
    checked = check(model)
    dropped = tuple(model.images[number].name for number in checked.dropped)
    left = model if model.num_reg_images() >= MIN_PHOTOGRAPHS else None
    return Mapped(
        left,
        is_focal_fixed and left is not None,
        contradicted=dropped,
        kept_distance=checked.distance,
    )


def map_with_fixed_focals(job: MappingJob, fov: float) -> pycolmap.Reconstruction | None:
    """Map with focal lengths fixed for a field of view in degrees, then with the refined ones.

    With a wrong focal length the mapper still connects photographs that it cannot connect with a
    free one, and together they determine the right value.
    """
    focals = dict[int, float]()
    model: pycolmap.Reconstruction | None = None
    for _ in range(MAPPING_ROUNDS):
        _fix_focals(job, focals, fov)
        mapped = map_largest(job, is_focal_fixed=True)
        if mapped is None:
            return model
        # The focal length alone; distortion is refined with it at the end.
        model = refine_lenses(mapped, refine_extra_params=False)
        focals = {n: model.cameras[n].mean_focal_length() for n in _count_photographs(model)}
    return None if model is None else refine_lenses(model)


def _fix_focals(job: MappingJob, focals: dict[int, float], fov: float) -> None:
    """Fix focal lengths (pixels by camera, or else as of `fov`) in the database, undistorted."""
    with pycolmap.Database.open(job.database) as database:
        for camera in database.read_all_cameras():
            width = camera.width
            height = camera.height
            number = camera.camera_id
            focal = max(width, height) / 2 / math.tan(math.radians(fov / 2))
            known = pycolmap.Camera.create_from_model_name(
                number, LENS_MODEL, focals.get(number, focal), width, height
            )
            known.has_prior_focal_length = True
            database.update_camera(known)


def map_largest(job: MappingJob, is_focal_fixed: bool = False) -> pycolmap.Reconstruction | None:
    """Map the scene; return the model with most photographs, or None if there is none."""
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads,
        random_seed=MATCHING_SEED,
        min_model_size=MIN_PHOTOGRAPHS,
        ba_refine_focal_length=not is_focal_fixed,
        ba_refine_extra_params=not is_focal_fixed,
        ba_refine_sensor_from_rig=False,
    )
    models = pycolmap.incremental_mapping(job.database, job.images, job.work, options)
    return max(models.values(), key=lambda model: model.num_reg_images(), default=None)


def refine_lenses(model: pycolmap.Reconstruction, **options: bool) -> pycolmap.Reconstruction:
    """Bundle-adjust a copy with free focal lengths; return the input if a lens gets implausible."""
    refined = deepcopy(model)
    adjustment = pycolmap.BundleAdjustmentOptions(print_summary=False, **options)
    pycolmap.bundle_adjustment(refined, adjustment)
    refined.update_point_3d_errors()
    return refined if has_plausible_lenses(refined) else model


def has_plausible_lenses(model: pycolmap.Reconstruction) -> bool:
    """Check the cameras of the photographs in the model."""
    return all(is_plausible(model.cameras[number]) for number in _count_photographs(model))


def is_plausible(camera: pycolmap.Camera) -> bool:
    """Check whether a camera has a field of view, distortion and principal point of a real one."""
    focal = camera.mean_focal_length()
    side = max(camera.width, camera.height)
    if not (math.isfinite(focal) and focal > 0):
        return False
    # Angles of the whole side, and of the ray through a corner at z = 1.
    fov = math.degrees(2 * math.atan(side / 2 / focal))
    corner = (camera.width**2 + camera.height**2) / 4 / focal**2
    # The model k r² of SIMPLE_RADIAL moves a point by this share of its radius.
    shift = camera.params[camera.extra_params_idxs()[0]] * corner
    off = math.hypot(
        camera.principal_point_x - camera.width / 2, camera.principal_point_y - camera.height / 2
    )
    is_bent = bool(abs(shift) > MAX_DISTORTION_SHIFT)
    return FOV[0] <= fov <= FOV[1] and not is_bent and off <= MAX_OFF_CENTRE * side


def _count_photographs(model: pycolmap.Reconstruction) -> Counter[int]:
    """Count the photographs of each camera in the model."""
    return Counter(model.images[i].camera_id for i in model.reg_image_ids())


if __name__ == "__main__":
    main()
