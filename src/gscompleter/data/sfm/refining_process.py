"""Refinement of the cameras of posed photographs, in a separate process as `mapping_process`.

Standard input is a `RefiningJob` as JSON. The last line of the output is the result, as JSON too.
Its `poses`, in the order of the copies, are camera to world (rows of 4 × 4) in the frame and unit
of the given ones, or null for a copy that kept its pose. `given_error` and `refined_error` are
median distances of kept-back matches from their epipolar lines, in pixels of the copies, or null.

Points are triangulated from the given cameras, and a bundle adjustment moves cameras and points
until the features of each point meet. Intrinsics stay; the centre of each camera is held to where
it was given, because forward motion with few near points leaves the lengths of steps free. A fifth
of the tracks of features is kept back: it tells whether the refined cameras agree better.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from jaxtyping import Float

from gscompleter.data.sfm.kept_matches import (
    Keypoints,
    NumberedMatches,
    keep_back_tracks,
    measure_pair_distances,
)
from gscompleter.data.sfm.matching import (
    ColmapJob,
    extract_features,
    match,
    prepare_colmap,
    read_image_number,
)
from gscompleter.data.sfm.placing import KnownCopy, PinholeNumbers
from gscompleter.data.sfm.placing_process import make_known_camera
from gscompleter.data.sfm.refining import MIN_REFINED, invert_pose_rows, move_to_given_frame

REFINING_ROUNDS = 3
"""Rounds of triangulation and adjustment; better cameras find more points."""
LOSS_SCALE = 1.0
"""Residual in pixels from which a feature counts less (soft L1): some matches are false."""
MIN_CAMERA_POINTS = 30
"""Fewest points that determine a camera; one with fewer keeps its pose."""

ViewmatRows = Sequence[Sequence[float]]
"""World to camera, as the rows of a 3 × 4 matrix."""


@dataclass(frozen=True, kw_only=True)
class RefiningJob(ColmapJob):
    """Input of the process."""

    copies: list[KnownCopy]
    pairs: list[tuple[int, int]]
    """Copies that are matched with each other."""
    position_sigma: float
    """Standard deviation of a given camera centre, in scene units."""


def main() -> None:
    """Run the job that standard input holds."""
    task = json.load(sys.stdin)
    copies = [KnownCopy(**one) for one in task.pop("copies")]
    pairs = [(i, j) for i, j in task.pop("pairs")]
    job = RefiningJob(copies=copies, pairs=pairs, **task)
    prepare_colmap()
    cameras = extract_refining_features(job)
    names = [copy.name for copy in job.copies]
    match(job, names, set(job.pairs))

    with pycolmap.Database.open(job.database) as database:
        numbers = [read_image_number(database, name) for name in names]
        kept_back = keep_back_tracks(database, numbers)
        keypoints = {number: database.read_keypoints(number)[:, :2] for number in numbers}
    model = adjust_bundle(job, cameras, numbers)
    copy_by_number = dict(zip(numbers, job.copies, strict=True))
    adjusted = {
        number: model.images[number].cam_from_world().matrix().tolist()
        for number in numbers
        if model.images[number].num_points3D >= MIN_CAMERA_POINTS
    }
    moved = move_adjusted(adjusted, copy_by_number)
    rows = [moved[n].tolist() if n in moved else None for n in numbers]

    intrinsics = {n: copy.pinhole for n, copy in copy_by_number.items()}
    errors: dict[str, float | None] = {}
    for title, refined in (("given_error", {}), ("refined_error", moved)):
        poses = join_poses(refined, copy_by_number)
        distances = measure_epipolar_distances(kept_back, keypoints, poses, intrinsics)
        # Without a match that was kept back, nothing tells which poses agree better.
        errors[title] = float(np.median(distances)) if len(distances) else None
    print(json.dumps({"poses": rows, **errors}))


def extract_refining_features(job: RefiningJob) -> list[int]:
    """Extract the features of all copies, and return the number of the camera of each."""
    cameras = []
    with pycolmap.Database.open(job.database) as database:
        for copy in job.copies:
            cameras.append(int(database.write_camera(make_known_camera(copy.pinhole, copy))))
    for copy, camera in zip(job.copies, cameras, strict=True):
        extract_features(job, copy.name, camera, copy.is_masked)
    return cameras


def make_pose(viewmat: ViewmatRows) -> pycolmap.Rigid3d:
    """Make COLMAP's pose, which is world to camera, too."""
    rows = np.array(viewmat)
    return pycolmap.Rigid3d(pycolmap.Rotation3d(rows[:, :3]), rows[:, 3])


def adjust_bundle(
    job: RefiningJob, cameras: list[int], numbers: list[int]
) -> pycolmap.Reconstruction:
    """Triangulate points, and adjust cameras and points, `REFINING_ROUNDS` times."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(job.database) as database:
        for copy, camera, number in zip(job.copies, cameras, numbers, strict=True):
            model.add_camera_with_trivial_rig(database.read_camera(camera))
            image = pycolmap.Image(name=copy.name, camera_id=camera, image_id=number)
            model.add_image_with_trivial_frame(image, make_pose(copy.viewmat))
    priors = make_position_priors(job, numbers, model)
    for number in range(REFINING_ROUNDS):
        folder = Path(job.work) / f"triangulated{number}"
        folder.mkdir()
        model = pycolmap.triangulate_points(
            model, job.database, job.images, folder, refine_intrinsics=False
        )
        adjust_once(model, job, priors)
    return model


def move_adjusted(
    adjusted: dict[int, ViewmatRows], copy_by_number: dict[int, KnownCopy]
) -> dict[int, Float[np.ndarray, "4 4"]]:
    """Move adjusted cameras into the frame of the copies; return them camera to world.

    Priors of centres alone leave the frame free: the cameras of a straight drive may all have
    turned about its line. Too few cameras determine no frame, and then none is returned.
    """
    if len(adjusted) < MIN_REFINED:
        return {}
    moved = move_to_given_frame(
        np.stack([invert_pose_rows(viewmat) for viewmat in adjusted.values()]),
        np.stack([invert_pose_rows(copy_by_number[n].viewmat) for n in adjusted]),
    )
    return dict(zip(adjusted, moved, strict=True))


def join_poses(
    refined: dict[int, Float[np.ndarray, "4 4"]], copy_by_number: dict[int, KnownCopy]
) -> dict[int, pycolmap.Rigid3d]:
    """Join refined poses, camera to world in the frame of the copies, and those of other copies."""
    poses = {n: make_pose(copy.viewmat) for n, copy in copy_by_number.items()}
    for number, c2w in refined.items():
        poses[number] = make_pose(np.linalg.inv(c2w)[:3].tolist())
    return poses


def make_position_priors(
    job: RefiningJob, numbers: list[int], model: pycolmap.Reconstruction
) -> list[pycolmap.PosePrior]:
    """Make the priors of the camera centres, which are where they were given."""
    priors = []
    for number in numbers:
        image = model.images[number]
        priors.append(
            pycolmap.PosePrior(
                pose_prior_id=number,
                corr_data_id=image.data_id,
                position=image.projection_center(),
                position_covariance=np.eye(3) * job.position_sigma**2,
                coordinate_system=pycolmap.PosePriorCoordinateSystem.CARTESIAN,
            )
        )
    return priors


def adjust_once(
    model: pycolmap.Reconstruction, job: RefiningJob, priors: list[pycolmap.PosePrior]
) -> None:
    """Adjust cameras and points, with cameras held to their priors."""
    config = pycolmap.BundleAdjustmentConfig()
    for number in model.reg_image_ids():
        config.add_image(number)
        config.set_constant_cam_intrinsics(model.images[number].camera_id)
    options = pycolmap.BundleAdjustmentOptions(
        refine_focal_length=False,
        refine_principal_point=False,
        refine_extra_params=False,
        print_summary=False,
    )
    options.ceres.loss_function_type = pycolmap.LossFunctionType.SOFT_L1
    options.ceres.loss_function_scale = LOSS_SCALE
    options.ceres.solver_options.num_threads = job.threads
    prior_options = pycolmap.PosePriorBundleAdjustmentOptions()
    adjuster = pycolmap.create_pose_prior_bundle_adjuster(
        options, prior_options, config, priors, model
    )
    adjuster.solve()


def measure_epipolar_distances(
    matches: NumberedMatches,
    keypoints: Keypoints,
    poses: dict[int, pycolmap.Rigid3d],
    intrinsics: dict[int, PinholeNumbers],
) -> Float[np.ndarray, "n"]:
    """Measure the distances of all matches from their epipolar lines, in pixels."""
    rays = {}
    for number, pixels in keypoints.items():
        fx, fy, cx, cy = intrinsics[number]
        flat = (pixels - [cx, cy]) / [fx, fy]
        rays[number] = np.concatenate([flat, np.ones((len(flat), 1))], axis=1)
    focals = {number: np.array(pinhole[:2]) for number, pinhole in intrinsics.items()}
    distances = measure_pair_distances(matches, rays, focals, poses)
    return np.concatenate([np.zeros(0), *distances.values()])


if __name__ == "__main__":
    main()
