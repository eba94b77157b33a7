"""Structure from motion in a process of its own, because COLMAP aborts on what it cannot handle.

Its argument is the JSON file of a job. It writes a JSON object per line: `{"begin": phase, "steps":
n}`, then `{"step": 1}` about n times and `{"end": phase}`, and at last `{"result": ...}`. What
COLMAP itself has to say goes to the standard error.
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
"""In a photograph."""
BATCH = 50
"""Pairs that are matched between two steps of the progress bar."""
LENS = "SIMPLE_RADIAL"
"""COLMAP's camera model: one focal length, one coefficient of distortion."""
GUESSED_FOCAL = 1.2
"""Focal length as a multiple of the longer side, where EXIF does not tell it."""
MIN_MODEL = 3
"""Photographs of a part that does not connect to the others for it to be told of."""
MIN_FOR_CENTRE = 10
"""Photographs by one camera that its principal point can be told from."""
MAX_OFF_CENTRE = 0.1
"""Distance of a believable principal point from the centre, in longer sides of the image."""


@dataclass(frozen=True)
class Job:
    """What is to be done."""

    images: Path
    """Folder of the photographs."""
    work: Path
    """Folder for the database and all that is not kept."""
    model: Path
    """Folder for the largest model. It does not exist yet."""
    photographs: list[Upright]
    """In the order of their names."""
    threads: int

    @property
    def database(self) -> Path:
        return self.work / "database.db"


class Teller:
    """Says how far the work is."""

    def __init__(self, out: IO[str]) -> None:
        self.out = out

    @contextmanager
    def phase(self, name: str, steps: int) -> Iterator[None]:
        self.say({"begin": name, "steps": steps})
        yield
        self.say({"end": name})

    def step(self) -> None:
        self.say({"step": 1})

    def say(self, line: dict[str, Any]) -> None:
        print(json.dumps(line), file=self.out, flush=True)


def main() -> None:
    """Do the job in the file that the command line names."""
    teller = Teller(os.fdopen(os.dup(1), "w"))
    os.dup2(2, 1)  # nothing that COLMAP prints is taken for ours
    told = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    photographs = [Upright(**one) for one in told["photographs"]]
    images, work, model = (Path(told[name]) for name in ("images", "work", "model"))
    job = Job(images, work, model, photographs, told["threads"])
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(SEED)
    find_features(job, teller)
    match(job, pairs_of(job), teller)
    teller.say({"result": map_all(job, teller)})


def find_features(job: Job, teller: Teller) -> None:
    """SIFT features of all photographs. Those of one size and lens share a camera."""

    def camera(one: Upright) -> tuple[int, int, str]:
        return one.width, one.height, one.lens

    extraction = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
    extraction.sift.max_num_features = MAX_FEATURES
    cameras = {camera(one): one for one in job.photographs}
    numbers = {key: _add_camera(job, one) for key, one in cameras.items()}
    with teller.phase("Finding features", len(job.photographs)):
        for one in job.photographs:
            pycolmap.extract_features(
                job.database,
                job.images,
                [one.name],
                reader_options=pycolmap.ImageReaderOptions(existing_camera_id=numbers[camera(one)]),
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
    """The photographs to match: neighbours where the names count, and all, or else those alike."""
    names = [one.name for one in job.photographs]
    if is_sequence(names):
        return neighbours(len(names)) | alike(likeness(_largest_features(job)))
    if len(names) <= MAX_EXHAUSTIVE:
        return all_pairs(len(names))
    return alike(likeness(_largest_features(job)))


def _largest_features(job: Job) -> list[np.ndarray]:
    """Of each photograph, those that its likeness to others is decided by."""
    with pycolmap.Database.open(job.database) as database:
        return [_features_of(database, one.name) for one in job.photographs]


def _features_of(database: Any, name: str) -> np.ndarray:
    number = database.read_image_with_name(name).image_id
    scales = np.linalg.norm(database.read_keypoints(number)[:, 2:4], axis=1)
    return largest(scales, np.asarray(database.read_descriptors(number).data, dtype=np.float32))


def match(job: Job, pairs: Pairs, teller: Teller) -> None:
    """Match the features of all pairs, and keep what an essential matrix explains."""
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


def map_all(job: Job, teller: Teller) -> dict[str, Any]:
    """Cameras and points from the matches. The largest model is written.

    Returns:
        The `registered` photographs of it by the names of their copies, how many each of the
        `models` has, the largest first, its number of `points` and its mean reprojection `error`
        in pixels.
    """
    models = sorted(_models(job, teller), key=lambda model: -model.num_reg_images())
    if not models:
        return {"registered": [], "models": [], "points": 0, "error": 0.0}
    largest_one = with_principal_points(models[0])
    job.model.mkdir(parents=True)
    largest_one.write(job.model)
    return {
        "registered": sorted(largest_one.images[i].name for i in largest_one.reg_image_ids()),
        "models": parts([set(model.reg_image_ids()) for model in models]),
        "points": largest_one.num_points3D(),
        "error": largest_one.compute_mean_reprojection_error(),
    }


def parts(models: list[set[int]]) -> list[int]:
    """How many photographs each of the models has, given by the numbers of their photographs, the
    largest first.

    The mapper may begin another model among photographs that it has placed; that is no part.
    """
    sizes, placed = list[int](), set[int]()
    for model in models:
        if not sizes or len(model - placed) >= MIN_MODEL:
            sizes.append(len(model))
            placed |= model
    return sizes


def with_principal_points(model: pycolmap.Reconstruction) -> pycolmap.Reconstruction:
    """The model with principal points that fit it, where they can be told.

    The mapper leaves them in the centres of the images, because few photographs cannot tell one
    from a turn of the camera; nor can photographs that all look alike, which is why a point far
    from the centre is not believed.
    """
    numbers = Counter(model.images[i].camera_id for i in model.reg_image_ids())
    if min(numbers.values()) < MIN_FOR_CENTRE:
        return model
    refined = deepcopy(model)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    pycolmap.bundle_adjustment(refined, options)
    refined.update_point_3d_errors()
    return refined if all(map(_is_centred, (refined.cameras[n] for n in numbers))) else model


def _is_centred(camera: pycolmap.Camera) -> bool:
    x, y = camera.principal_point_x, camera.principal_point_y
    off = math.hypot(x - camera.width / 2, y - camera.height / 2)
    return bool(off <= MAX_OFF_CENTRE * max(camera.width, camera.height))


def _models(job: Job, teller: Teller) -> list[Any]:
    """All models; they do not connect."""

    def first_pair() -> None:
        teller.step()
        teller.step()

    with teller.phase("Placing cameras", len(job.photographs)):
        found = pycolmap.incremental_mapping(
            job.database,
            job.images,
            job.work,
            pycolmap.IncrementalPipelineOptions(
                num_threads=job.threads, random_seed=SEED, min_model_size=MIN_MODEL
            ),
            initial_image_pair_callback=first_pair,
            next_image_callback=teller.step,
        )
    return list(found.values())


if __name__ == "__main__":
    main()
