"""Placing of new photographs among posed ones, in a separate process as `mapping_process`.

Standard input is a `PlacingJob` as JSON. The last line of the output is the result, as JSON too.
Points are triangulated from the known cameras, which stay as they are; the new photographs are
registered to these points one after the other, with focal lengths that are refined.
"""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float

from gscompleter.data.sfm.mapping_process import GUESSED_FOCAL, LENS_MODEL, is_plausible
from gscompleter.data.sfm.matching import (
    MATCHING_SEED,
    ColmapJob,
    extract_features,
    match,
    prepare_colmap,
    read_image_number,
    select_pairs,
)
from gscompleter.data.sfm.placing import KnownCopy, NewCopy, PinholeNumbers


@dataclass(frozen=True, kw_only=True)
class PlacingJob(ColmapJob):
    """Input of the process; `model` is the folder for the cameras that were found."""

    known: list[KnownCopy]
    new: list[NewCopy]
    origin: list[float]
    """Origin of the poses of `known`, to which the model is shifted back."""

    @property
    def copies(self) -> list[KnownCopy | NewCopy]:
        """All copies, the known ones first."""
        return [*self.known, *self.new]

    @property
    def names(self) -> list[str]:
        """Names of all copies, the known ones first."""
        return [copy.name for copy in self.copies]


def main() -> None:
    """Run the job that standard input holds."""
    task = json.load(sys.stdin)
    known = [KnownCopy(**one) for one in task.pop("known")]
    new = [NewCopy(**one) for one in task.pop("new")]
    job = PlacingJob(known=known, new=new, **task)
    prepare_colmap()
    cameras = extract_placing_features(job)
    match(job, job.names, select_pairs(job, job.names))
    model = register_new(job, cameras)
    placed = find_placed(job, model)
    write_placed(job, model, placed)
    print(json.dumps(describe_placed(job, placed)))


def extract_placing_features(job: PlacingJob) -> dict[str, int]:
    """Extract the features of all copies, and return the number of the camera of each."""
    cameras: dict[str, int] = {}
    with pycolmap.Database.open(job.database) as database:
        for known in job.known:
            cameras[known.name] = database.write_camera(make_known_camera(known.pinhole, known))

        # New photographs of one lens share a camera, whose focal length they determine together.
        # Copies of one size may be of photographs of two, and only one of these sizes that of a
        # known lens, by which its copies were undistorted.
        numbers: dict[tuple[int, int, str, tuple[float, ...] | None], int] = {}
        for new in job.new:
            pinhole = None if new.pinhole is None else tuple(new.pinhole)  # a list in JSON
            lens = new.width, new.height, new.lens, pinhole
            if lens not in numbers:
                numbers[lens] = database.write_camera(make_new_camera(new))
            cameras[new.name] = numbers[lens]

    for copy in job.copies:
        extract_features(job, copy.name, cameras[copy.name], copy.is_masked)
    return cameras


def make_known_camera(pinhole: PinholeNumbers, copy: KnownCopy | NewCopy) -> pycolmap.Camera:
    """Make the camera of an undistorted copy with known intrinsics."""
    camera = pycolmap.Camera(
        model="PINHOLE", width=copy.width, height=copy.height, params=list(pinhole)
    )
    camera.has_prior_focal_length = True
    return camera


def make_new_camera(copy: NewCopy) -> pycolmap.Camera:
    """Make the camera of a new photograph, whose intrinsics may have to be guessed."""
    if copy.pinhole is not None:
        return make_known_camera(copy.pinhole, copy)
    focal = copy.focal or GUESSED_FOCAL * max(copy.width, copy.height)
    camera = pycolmap.Camera.create_from_model_name(1, LENS_MODEL, focal, copy.width, copy.height)
    camera.has_prior_focal_length = copy.focal is not None
    return camera


def register_new(job: PlacingJob, cameras: dict[str, int]) -> pycolmap.Reconstruction:
    """Triangulate points from the known cameras, and register the new photographs to them."""
    model = pycolmap.Reconstruction()
    with pycolmap.Database.open(job.database) as database:
        for copy in job.known:
            camera = database.read_camera(cameras[copy.name])
            model.add_camera_with_trivial_rig(camera)
            number = read_image_number(database, copy.name)
            image = pycolmap.Image(name=copy.name, camera_id=camera.camera_id, image_id=number)
            viewmat = np.array(copy.viewmat)
            pose = pycolmap.Rigid3d(pycolmap.Rotation3d(viewmat[:, :3]), viewmat[:, 3])
            model.add_image_with_trivial_frame(image, pose)

    # The mapper continues the model of a folder. Intrinsics of a new photograph that come from a
    # known one of its lens are refined like guessed ones: focus changes the focal length, and
    # without EXIF all photographs of one size count as of one lens.
    triangulated = Path(job.work) / "triangulated"
    mapped = Path(job.work) / "mapped"
    triangulated.mkdir()
    mapped.mkdir()
    known = pycolmap.triangulate_points(model, job.database, job.images, triangulated)
    known.write(triangulated)
    options = pycolmap.IncrementalPipelineOptions(
        num_threads=job.threads,
        random_seed=MATCHING_SEED,
        multiple_models=False,
        fix_existing_frames=True,
        constant_cameras={cameras[copy.name] for copy in job.known},
        ba_refine_sensor_from_rig=False,
    )
    models = pycolmap.incremental_mapping(
        job.database, job.images, mapped, options, input_path=triangulated
    )
    # Without a photograph that fits, there is no further model.
    return max(models.values(), key=lambda one: one.num_reg_images(), default=known)


def find_placed(job: PlacingJob, model: pycolmap.Reconstruction) -> dict[str, pycolmap.Image]:
    """Find the new photographs that were registered, by a lens that a camera can have."""
    images = {model.images[number].name: model.images[number] for number in model.reg_image_ids()}
    placed = {}
    for copy in job.new:
        image = images.get(copy.name)
        if image is None:
            continue
        # A known lens may be an odd one, and its copies have no distortion that could be judged; a
        # lens that was guessed has to be a usual one.
        if copy.pinhole is not None or is_plausible(model.cameras[image.camera_id]):
            placed[copy.name] = image
    return placed


def write_placed(
    job: PlacingJob, model: pycolmap.Reconstruction, placed: dict[str, pycolmap.Image]
) -> None:
    """Write the cameras of the placed photographs as a model of their own, without points."""
    if not placed:
        return
    out = pycolmap.Reconstruction()
    for name, found in placed.items():
        if not out.exists_camera(found.camera_id):
            out.add_camera_with_trivial_rig(model.cameras[found.camera_id])
        image = pycolmap.Image(
            name=name.partition("/")[2], camera_id=found.camera_id, image_id=found.image_id
        )
        out.add_image_with_trivial_frame(image, shift_pose(found, np.array(job.origin)))
    Path(job.model).mkdir(parents=True)
    out.write(job.model)


def shift_pose(image: pycolmap.Image, origin: Float[np.ndarray, "3"]) -> pycolmap.Rigid3d:
    """Return the pose of an image, world to camera, in coordinates before `origin` was taken."""
    pose = image.cam_from_world()
    rotation = pose.rotation.matrix()
    # x_camera = R (x_world - origin) + t
    return pycolmap.Rigid3d(pose.rotation, pose.translation - rotation @ origin)


def describe_placed(job: PlacingJob, placed: dict[str, pycolmap.Image]) -> dict[str, Any]:
    """Describe what became of each new photograph, in the order of the job.

    `matches` are the features that fit one known photograph best, and `like` is its name.
    """
    rows = []
    with pycolmap.Database.open(job.database) as database:
        numbers = {name: read_image_number(database, name) for name in job.names}
        for copy in job.new:
            # Pairs that do not look alike were not matched.
            counts = {
                known.name: count_matches(database, numbers[known.name], numbers[copy.name])
                for known in job.known
            }
            like = max(counts, key=lambda name: counts[name])
            is_placed = copy.name in placed
            rows.append({"is_placed": is_placed, "like": like, "matches": counts[like]})
    return {"new": rows}


def count_matches(database: pycolmap.Database, one: int, other: int) -> int:
    """Count the matches of two images that fit one relative pose; 0 if they were not matched."""
    if not database.exists_two_view_geometry(one, other):
        return 0
    return len(database.read_two_view_geometry(one, other).inlier_matches)


if __name__ == "__main__":
    main()
