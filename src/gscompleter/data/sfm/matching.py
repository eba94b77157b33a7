"""Features of photographs and their matches, by COLMAP on the CPU.

Both processes of this folder begin with them. Of many unordered photographs, those are matched
whose few largest features match (preemptive matching; Wu, "Towards Linear-time Incremental
Structure from Motion", 2013).
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from jaxtyping import Float

MATCHING_SEED = 0
MAX_FEATURES = 4096
"""Most features in a photograph."""
MAX_EXHAUSTIVE = 60
"""Most unordered photographs that are all matched with each other."""
NEIGHBOURS = 10
"""Photographs before and after each one of a sequence to match it with."""
NUM_SIMILAR = 20
"""Most similar photographs to match each one with."""
NUM_LARGEST_FEATURES = 256
"""Largest-scale features that decide similarity."""
MIN_SHARED_MATCHES = 4
"""Fewest matches among these for a pair."""
MIN_COSINE = 0.85
"""Smallest cosine between descriptors of matching features."""

Pairs = set[tuple[int, int]]
"""Index pairs of photographs, the smaller index first."""


@dataclass(frozen=True, kw_only=True)
class ColmapJob:
    """Input of a process of COLMAP."""

    images: str
    """Folder of the copies of photographs."""
    masks: str
    """Folder of the masks of some photographs."""
    work: str
    """Folder for the database and temporary files."""
    model: str
    """Folder for the model that is found; it does not exist yet."""
    threads: int

    @property
    def database(self) -> Path:
        """Path of COLMAP's database."""
        return Path(self.work) / "database.db"


def prepare_colmap() -> None:
    """Let COLMAP print errors only, and choose its random numbers."""
    pycolmap.logging.minloglevel = pycolmap.logging.Level.ERROR.value
    pycolmap.set_random_seed(MATCHING_SEED)


def extract_features(job: ColmapJob, name: str, camera: int, is_masked: bool) -> None:
    """Extract the SIFT features of a photograph, taken by this camera of the database."""
    extraction = pycolmap.FeatureExtractionOptions(num_threads=job.threads, use_gpu=False)
    extraction.sift.max_num_features = MAX_FEATURES
    reading = pycolmap.ImageReaderOptions(existing_camera_id=camera)
    if is_masked:
        reading.mask_path = job.masks
    pycolmap.extract_features(
        job.database,
        job.images,
        [name],
        reader_options=reading,
        extraction_options=extraction,
        device=pycolmap.Device.cpu,
    )


def read_image_number(database: pycolmap.Database, name: str) -> int:
    """Return the number of a photograph in the database."""
    image = database.read_image_with_name(name)
    assert image is not None
    return int(image.image_id)


def select_pairs(job: ColmapJob, names: Sequence[str]) -> Pairs:
    """Choose the photographs to match: sequence neighbours, all pairs, or similar photographs."""
    # The neighbours of a sequence are known; in a set of unknown order all pairs, or for many
    # photographs the most similar ones.
    pairs = pair_neighbours(len(names)) if is_sequence(names) else set()
    if not pairs and len(names) <= MAX_EXHAUSTIVE:
        return pair_all(len(names))
    with pycolmap.Database.open(job.database) as database:
        return pairs | pair_similar([_read_features(database, name) for name in names])


def _read_features(database: Any, name: str) -> Float[np.ndarray, "k 128"]:
    """Read the normalized descriptors of a photograph's `NUM_LARGEST_FEATURES` largest features."""
    number = database.read_image_with_name(name).image_id
    scales = np.linalg.norm(database.read_keypoints(number)[:, 2:4], axis=1)
    descriptors = np.asarray(database.read_descriptors(number).data, dtype=np.float32)
    # SIFT's largest blobs, not its strongest, are those that other distances and cameras find too.
    largest = descriptors[np.argsort(-scales, kind="stable")[:NUM_LARGEST_FEATURES]]
    return largest / np.maximum(np.linalg.norm(largest, axis=1, keepdims=True), 1e-9)


def match(job: ColmapJob, names: Sequence[str], pairs: Pairs) -> None:
    """Match the features of pairs of photographs, and verify them with an essential matrix."""
    listed = pycolmap.ImportedPairingOptions(match_list_path=write_pairs(job, names, pairs))
    matching = pycolmap.FeatureMatchingOptions(num_threads=job.threads, use_gpu=False)
    verification = choose_verification()
    pycolmap.match_image_pairs(job.database, matching, listed, verification, pycolmap.Device.cpu)


def write_pairs(job: ColmapJob, names: Sequence[str], pairs: Pairs) -> Path:
    """Write the pairs of photographs as COLMAP reads them; return the file."""
    listed = Path(job.work) / "pairs.txt"
    lines = "".join(f"{names[i]} {names[j]}\n" for i, j in sorted(pairs))
    listed.write_bytes(lines.encode())
    return listed


def choose_verification() -> pycolmap.TwoViewGeometryOptions:
    """Return the options of the verification of matches, with a fixed seed."""
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = MATCHING_SEED
    return verification


def is_sequence(names: Sequence[str]) -> bool:
    """Check whether the names differ only in the last number of the file name."""
    forms = {re.sub(r"\d+(?=[^\d/]*$)", "#", name) for name in names}
    return len(forms) == 1 and not forms & set(names)


def pair_neighbours(count: int) -> Pairs:
    """Pair each photograph of a sequence with the next ones, and those 16, 32, 64, … ahead."""
    # Doubling steps close loops, and bridge a blurred or covered stretch.
    steps = [*range(1, NEIGHBOURS + 1), *(2**n for n in range(4, count.bit_length()))]
    return {(i, i + step) for step in steps for i in range(count - step)}


def pair_all(count: int) -> Pairs:
    """Pair each photograph with each other."""
    return set(combinations(range(count), 2))


def pair_similar(features: Sequence[Float[np.ndarray, "_ 128"]]) -> Pairs:
    """Pair each photograph with those that share most features with it."""
    shared = np.zeros((len(features), len(features)), dtype=np.int64)
    for i, j in pair_all(len(features)):
        count = _count_shared(features[i], features[j])
        shared[i, j] = count
        shared[j, i] = count
    order = np.argsort(-shared, axis=1, kind="stable")[:, :NUM_SIMILAR]
    pairs: Pairs = set()
    for i, row in enumerate(order.tolist()):
        pairs.update((min(i, j), max(i, j)) for j in row if shared[i, j] >= MIN_SHARED_MATCHES)
    return pairs


def _count_shared(a: Float[np.ndarray, "m 128"], b: Float[np.ndarray, "n 128"]) -> int:
    """Count the mutual best matches above `MIN_COSINE`."""
    if len(a) == 0 or len(b) == 0:
        return 0
    cosines = a @ b.T
    best = cosines.argmax(axis=1)
    back = cosines.argmax(axis=0)
    # Each feature has one best match; only those that choose each other count.
    is_mutual = back[best] == np.arange(len(a))
    return int(np.count_nonzero(is_mutual & (cosines.max(axis=1) > MIN_COSINE)))
