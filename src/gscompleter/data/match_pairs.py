"""Which photographs are matched with which: neighbours in a sequence, and those that look alike.

Two photographs look alike where the few largest of their features match (Wu, "Towards Linear-time
Incremental Structure from Motion", 2013, calls it preemptive matching). It needs no vocabulary.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import PurePosixPath

import numpy as np
from jaxtyping import Float, Int

NEIGHBOURS = 10
"""Photographs before and after that each one of a sequence is matched with."""
MAX_EXHAUSTIVE = 60
"""Photographs without an order that are all matched with each other; of more, those alike."""
ALIKE = 20
"""Photographs that look most like a given one and are matched with it."""
FEW = 256
"""Features of the largest scale that likeness is decided by."""
MIN_SHARED = 4
"""Of these, how many must match."""
MIN_COSINE = 0.85
"""Between the descriptors of two features that match."""

Pairs = set[tuple[int, int]]
"""Numbers of two photographs, the smaller one first."""


def in_order(name: str) -> tuple[str, ...]:
    """A key that sorts names as people count: 2.jpg before 10.jpg."""
    return tuple(f"{int(p):030d}" if p.isdecimal() else p for p in re.split(r"(\d+)", name))


def is_sequence(names: Sequence[str]) -> bool:
    """Whether the names count: they lie in one folder and differ in their last number only."""

    def without_number(name: str) -> tuple[str, str]:
        path = PurePosixPath(name)
        return str(path.parent), re.sub(r"\d+(?=\D*$)", "#", path.name, count=1)

    forms = {without_number(name) for name in names}
    return len(forms) == 1 and "#" in next(iter(forms))[1]


def neighbours(count: int) -> Pairs:
    """Each of a sequence with the next ones, and with those 16, 32, 64, … further on."""
    steps = [*range(1, NEIGHBOURS + 1), *(2**n for n in range(4, count.bit_length()))]
    return {(i, i + step) for step in steps for i in range(count - step)}


def all_pairs(count: int) -> Pairs:
    """Each with each."""
    return {(i, j) for j in range(count) for i in range(j)}


def largest(
    scales: Float[np.ndarray, "n"], descriptors: Float[np.ndarray, "n 128"]
) -> Float[np.ndarray, "k 128"]:
    """The descriptors of the `FEW` features of the largest scale, of length 1."""
    chosen = descriptors[np.argsort(-scales, kind="stable")[:FEW]]
    return chosen / np.maximum(np.linalg.norm(chosen, axis=1, keepdims=True), 1e-9)


def shared_features(one: Float[np.ndarray, "k 128"], other: Float[np.ndarray, "l 128"]) -> int:
    """How many features are each other's best match, and a good one."""
    if len(one) == 0 or len(other) == 0:
        return 0
    cosines = one @ other.T
    best, back = cosines.argmax(axis=1), cosines.argmax(axis=0)
    here = np.arange(len(one))
    return int(np.count_nonzero((back[best] == here) & (cosines[here, best] > MIN_COSINE)))


def likeness(features: Sequence[Float[np.ndarray, "_ 128"]]) -> Int[np.ndarray, "n n"]:
    """`shared_features` of each photograph with each other one."""
    shared = np.zeros((len(features), len(features)), dtype=np.int64)
    for i, j in all_pairs(len(features)):
        shared[i, j] = shared[j, i] = shared_features(features[i], features[j])
    return shared


def alike(shared: Int[np.ndarray, "n n"]) -> Pairs:
    """Each photograph with the ones that share most features with it."""
    order = np.argsort(-shared, axis=1, kind="stable")[:, :ALIKE]
    found = ((i, int(j)) for i, row in enumerate(order) for j in row if shared[i, j] >= MIN_SHARED)
    return {(min(pair), max(pair)) for pair in found}
