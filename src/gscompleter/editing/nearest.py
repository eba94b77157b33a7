"""The nearest Gaussians of points, kept up to date while Gaussians are taken away."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Bool, Float, Int32, Int64
from numpy import ndarray
from torch import Tensor

from gscompleter.system.progress import track

QUERIES = 50_000
"""Points whose neighbours are searched for at a time: it takes a second or so, and says so."""
FEW_LOST = 0.02
"""Share of the points up to which those that lost a neighbour ask the tree of an earlier round."""
SPARE = 2
"""Neighbours that are asked for there, for each one that is needed."""


class NearestGaussians:
    """The nearest of n Gaussians to each of m points, by their centres.

    When Gaussians are taken away, only points that had one of them near are searched for again.
    """

    def __init__(
        self, points: Float[Tensor, "m 3"], means: Float[Tensor, "n 3"], count: int, name: str
    ) -> None:
        """Find the `count` nearest of `means` to each point; `name` is for the progress."""
        self._means = means.double().cpu().numpy()
        # Often they are the same, and a copy would take 24 bytes a Gaussian.
        self._points = self._means if points is means else points.double().cpu().numpy()
        self._name = name
        self.rows: Int32[ndarray, "m k"] = np.empty((len(points), count), np.int32)
        """Numbers of the nearest Gaussians, the nearest first."""
        self._search(np.arange(len(points)), np.arange(len(means)))

    def take_away(
        self, gone: Bool[Tensor, "n"], left: Bool[Tensor, "n"], asked: Bool[Tensor, "m"]
    ) -> Int64[ndarray, "l"]:
        """Replace the Gaussians in `gone` by the next ones of those in `left`.

        Points that are not `asked` for keep theirs. Returns the points that had one of them.
        """
        is_gone = gone.cpu().numpy()
        rows = np.flatnonzero(asked.cpu().numpy())
        parts = np.array_split(rows, max(1, len(rows) // QUERIES))
        # Some at a time, since what is looked up takes as much memory as the numbers themselves.
        lost = np.concatenate([part[is_gone[self.rows[part]].any(axis=1)] for part in parts])
        is_left = left.cpu().numpy()
        short = self._search_before(lost, is_left) if len(lost) < FEW_LOST * len(rows) else lost
        self._search(short, np.flatnonzero(is_left))
        return lost

    def _search_before(
        self, points: Int64[ndarray, "l"], is_left: Bool[ndarray, "n"]
    ) -> Int64[ndarray, "s"]:
        """Search in the tree of an earlier round, whose making takes longer than few questions.

        Returns the points of whose `SPARE` times as many neighbours too few are left.
        """
        count = self.rows.shape[1]
        asked = min(SPARE * count, self._tree.n)
        found = self._among[self._tree.query(self._points[points], asked)[1]]
        stays = is_left[found]
        # Those that are left come first, in the order of their distances.
        order = np.argsort(~stays, axis=1, kind="stable")[:, :count]
        has_enough = stays.sum(axis=1) >= count
        nearest = np.take_along_axis(found, order, axis=1)
        self.rows[points[has_enough]] = nearest[has_enough]
        return points[~has_enough]

    def _search(self, points: Int64[ndarray, "l"], among: Int64[ndarray, "k"]) -> None:
        """Search for the nearest Gaussians of the numbers `among` to points of given numbers."""
        # Imported here, since SciPy is slow to import.
        from scipy.spatial import cKDTree

        if len(points) == 0:
            return
        # The tree holds what it is given; a copy is only made of a part.
        self._tree = cKDTree(self._means if len(among) == len(self._means) else self._means[among])
        self._among = among
        blocks = [points[start : start + QUERIES] for start in range(0, len(points), QUERIES)]
        count = self.rows.shape[1]
        for block in track(blocks, self._name):
            found = self._tree.query(self._points[block], count, workers=torch.get_num_threads())[1]
            self.rows[block] = among[found.reshape(len(block), count)]
