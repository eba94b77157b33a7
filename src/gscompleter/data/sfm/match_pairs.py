"""Choice of photograph pairs to match: sequence neighbours and similar photographs.

Photographs are similar if the few largest of their features match (preemptive matching; Wu,
"Towards Linear-time Incremental Structure from Motion", 2013). It needs no vocabulary.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import combinations

import numpy as np
from jaxtyping import Float

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


def make_sort_key(name: str) -> tuple[str, ...]:
    """Return a key that sorts names by their numbers: 2.jpg before 10.jpg."""
    return tuple(f"{int(p):030d}" if p.isdecimal() else p for p in re.split(r"(\d+)", name))


def is_sequence(names: Sequence[str]) -> bool:
    """Check whether the names differ only in the last number of the file name."""
    forms = {re.sub(r"\d+(?=[^\d/]*$)", "#", name) for name in names}
    return len(forms) == 1 and not forms & set(names)


def pair_neighbours(count: int) -> Pairs:
    """Pair each photograph of a sequence with the next ones, and those 16, 32, 64, … ahead."""
    steps = [*range(1, NEIGHBOURS + 1), *(2**n for n in range(4, count.bit_length()))]
    return {(i, i + step) for step in steps for i in range(count - step)}


def pair_all(count: int) -> Pairs:
    """Pair each photograph with each other."""
    return set(combinations(range(count), 2))


def select_largest_features(
    scales: Float[np.ndarray, "n"], descriptors: Float[np.ndarray, "n 128"]
) -> Float[np.ndarray, "k 128"]:
    """Select the normalized descriptors of the `NUM_LARGEST_FEATURES` largest features."""
    chosen = descriptors[np.argsort(-scales, kind="stable")[:NUM_LARGEST_FEATURES]]
    return chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1e-9)


def pair_similar(features: Sequence[Float[np.ndarray, "_ 128"]]) -> Pairs:
    """Pair each photograph with those that share most features with it."""
    shared = np.zeros((len(features), len(features)), dtype=np.int64)
    for i, j in pair_all(len(features)):
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
