"""Describe the difference of a completion to what a page has got, and send new Gaussians only.

A page holds chunks of Gaussians, which never change: the scene as it was given, in the layers of
the viewer, then one chunk of whatever is new after a step. A completion is told by what is hidden
of each chunk, so that undo and redo send no Gaussian again.
"""

from __future__ import annotations

import base64
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Int64
from torch import Tensor

from gscompleter.apps.viewer.page import PageFrame, compute_page_frame, is_within_page
from gscompleter.splats.spz import encode_spz
from gscompleter.state import Completion
from gscompleter.types import Gaussians, merge

MAX_SH = 16
"""Spherical harmonics of the highest degree, to which all others are padded in a comparison."""

Key = tuple[bytes, int]
"""Bytes of a Gaussian, and the number of equal ones before it."""


class PageScene:
    """Keep what the pages of a session hold, which grows with each step that adds Gaussians."""

    def __init__(self, given: Gaussians) -> None:
        """Begin with the scene as it was given, in the layers in which the viewer's page has it."""
        self.frame: PageFrame = compute_page_frame(given)
        self._chunks: dict[str, bytes] = {}
        # Where each Gaussian that was sent is: its chunk and its number there, by its key.
        self._places: dict[Key, tuple[str, int]] = {}
        self._counts: dict[str, int] = {}
        is_near = is_within_page(given, self.frame)
        layers = {"observed": given.generated == 0, "generated": given.generated > 0}
        rows = {name: torch.nonzero(mask & is_near)[:, 0] for name, mask in layers.items()}
        self._layers = {name: numbers for name, numbers in rows.items() if len(numbers)}

    def get_chunk(self, name: str) -> bytes | None:
        """Return the .spz of a chunk in the frame of the page; None if there is no such chunk."""
        return self._chunks.get(name)

    def describe(self, completion: Completion) -> dict[str, Any]:
        """Describe what a page shows of each chunk, and keep what it has not got as a new one.

        `hidden` has the numbers of the Gaussians that are not shown, as unsigned integers of 32
        bits in base64; null hides all.
        """
        gone = completion.source.gone_mask
        recolored = completion.recolored_mask
        hidden: dict[str, str | None] = {
            name: self._list_hidden(rows, gone | recolored) for name, rows in self._layers.items()
        }
        # A Gaussian with new colours is another one.
        new = merge([completion.recolored[~gone[recolored]], *completion.parts[1:]])
        shown = self._place(new[is_within_page(new, self.frame)].to("cpu").detach())
        for name, count in self._counts.items():
            left = np.setdiff1d(np.arange(count), np.array(shown.get(name, []), int))
            hidden[name] = None if len(left) == count else encode_numbers(left)
        return {"chunks": [{"name": name, "hidden": text} for name, text in hidden.items()]}

    def _list_hidden(self, rows: Int64[Tensor, "_n"], mask: Bool[Tensor, "n"]) -> str:
        """List the numbers, within a layer of the given scene, of what a mask of all hides."""
        return encode_numbers(torch.nonzero(mask[rows])[:, 0].cpu().numpy())

    def _place(self, gaussians: Gaussians) -> Mapping[str, list[int]]:
        """Return the numbers of Gaussians on the CPU within their chunks; new ones make a chunk."""
        keys = list_keys(gaussians)
        unknown = [number for number, key in enumerate(keys) if key not in self._places]
        if unknown:
            name = f"added-{len(self._chunks) + 1}"
            for number, row in enumerate(unknown):
                self._places[keys[row]] = name, number
            chunk = gaussians[torch.tensor(unknown)]
            self._chunks[name] = encode_spz(Path(name), self.frame.normalize(chunk))
            self._counts[name] = len(chunk)
        shown: dict[str, list[int]] = {}
        for key in keys:
            name, number = self._places[key]
            shown.setdefault(name, []).append(number)
        return shown


def list_keys(gaussians: Gaussians) -> list[Key]:
    """List a key of each Gaussian, by which it is known again; they are on the CPU.

    Equal Gaussians have keys of their own: two of them in one place hide more than one does.
    """
    n = len(gaussians)
    sh = torch.nn.functional.pad(gaussians.sh, (0, 0, 0, MAX_SH - gaussians.sh.shape[1]))
    columns = (
        gaussians.means,
        gaussians.quats,
        gaussians.scales,
        gaussians.opacities[:, None],
        sh.reshape(n, 3 * MAX_SH),
        gaussians.generated[:, None],
    )
    rows = torch.cat([column.float() for column in columns], dim=1).numpy()
    counts: Counter[bytes] = Counter()
    keys = []
    for row in rows:
        content = row.tobytes()
        keys.append((content, counts[content]))
        counts[content] += 1
    return keys


def encode_numbers(numbers: np.ndarray) -> str:
    """Encode numbers as unsigned integers of 32 bits, little-endian, in base64."""
    return base64.b64encode(numbers.astype("<u4").tobytes()).decode()
