"""The folder of a run: where things lie in it, and how they are written and read.

    run.json                         what decided the numbers
    cases/CASE/start.npz             the context that all methods begin with
    cases/CASE/METHOD.npz            what a method made of it
    cases/CASE/METHOD.json           its row of scores, or why it has none
    cases/CASE/METHOD.png            what the target camera sees afterwards
    cases/CASE/before.png, truth.png the same before, and the photograph
    sequences/NAME/start.npz              the context that all methods begin with
    sequences/NAME/METHOD/step-001.npz    what a method added in its first step
    sequences/NAME/METHOD/step-001.png    what the camera of that step sees afterwards
    sequences/NAME/METHOD.json            its row: all steps, and why there are no more

Everything appears under its name once it is complete.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch

from gscompleter.errors import InputError
from gscompleter.io import json_file
from gscompleter.io.files import replacing
from gscompleter.metrics.scores import Outcome, ranged_truth
from gscompleter.runs.methods import Start
from gscompleter.types import Gaussians, View, merge

RUN = "run.json"
"""The file that says what decided the numbers of a folder."""

CASES = "cases"
"""Where the folders of the cases are."""

SEQUENCES = "sequences"
"""Where the folders of the sequences are."""

_FIELDS = ("means", "quats", "scales", "opacities", "sh", "generated")


Arrays = dict[str, np.ndarray]


class OutputError(InputError):
    """A result cannot be written: the run ends."""


def slug(name: str) -> str:
    """`name` as the name of a file."""
    return re.sub(r"[^\w.+-]+", "-", name.replace(">", "-to-"))


def case_folder(out: Path, case: str) -> Path:
    """Where everything about the case of that name lies."""
    return out / CASES / slug(case)


def sequence_folder(out: Path, sequence: str) -> Path:
    """Where everything about the sequence of that name lies."""
    return out / SEQUENCES / slug(sequence)


@dataclass(frozen=True)
class Saved:
    """What a method made of a case, and the most memory that this took."""

    outcome: Outcome
    peak_bytes: int | None


def save_start(path: Path, start: Start) -> None:
    """Write the context, its hole mask, and the depth range that it was made with.

    Raises:
        OutputError: where it cannot be written.
    """
    numbers = [start.seconds, start.target.near, start.target.far]
    write_arrays(
        path,
        {
            **_arrays_of(start.context),
            "hole_mask": start.hole_mask.cpu().numpy(),
            "seconds_near_far": np.array(numbers, dtype=np.float64),
        },
    )


def load_start(path: Path, views: Sequence[View], target: View) -> Start | None:
    """What `save_start` wrote, with the photographs that it does not; None if it is not whole."""
    arrays = load_arrays(path)
    if arrays is None:
        return None
    seconds, near, far = arrays["seconds_near_far"].tolist()
    ranged = ranged_truth(views, target, (), near, far)
    device = target.image.device
    mask = torch.from_numpy(arrays["hole_mask"]).to(device)
    context = _gaussians_of(arrays, device)
    return Start(ranged.views, ranged.target.camera, context, mask, seconds)


def save_outcome(path: Path, saved: Saved) -> None:
    """Write what differs from the context: what was added, or else the whole scene.

    Raises:
        OutputError: where it cannot be written.
    """
    outcome = saved.outcome
    whole = outcome.added is None
    peak = -1 if saved.peak_bytes is None else saved.peak_bytes
    write_arrays(
        path,
        {
            **_arrays_of(outcome.scene if outcome.added is None else outcome.added),
            "whole": np.array(whole),
            "stages": np.array(list(outcome.seconds), dtype=np.str_),
            "seconds": np.array(list(outcome.seconds.values()), dtype=np.float64),
            "peak_bytes": np.array(peak, dtype=np.int64),
            "notes": np.array(outcome.notes, dtype=np.str_),
        },
    )


def keep_outcome(path: Path, saved: Saved, start: Start) -> Saved:
    """Save it and read it back, so that a run that was stopped goes on with the very same tensors.

    Raises:
        OutputError: where it cannot be written.
    """
    save_outcome(path, saved)
    return load_outcome(path, start) or saved


def load_outcome(path: Path, start: Start) -> Saved | None:
    """What `save_outcome` wrote; None where there is nothing whole."""
    arrays = load_arrays(path)
    if arrays is None:
        return None
    changed = _gaussians_of(arrays, start.context.means.device)
    whole = bool(arrays["whole"])
    peak = int(arrays["peak_bytes"])
    outcome = Outcome(
        context=start.context,
        scene=changed if whole else merge([start.context, changed]),
        added=None if whole else changed,
        hole_mask=start.hole_mask,
        seconds=dict(zip(arrays["stages"].tolist(), arrays["seconds"].tolist(), strict=True)),
        notes=tuple(arrays["notes"].tolist()),
    )
    return Saved(outcome, None if peak < 0 else peak)


def _arrays_of(gaussians: Gaussians) -> Arrays:
    return {name: getattr(gaussians, name).detach().cpu().numpy() for name in _FIELDS}


def _gaussians_of(arrays: Mapping[str, np.ndarray], device: torch.device) -> Gaussians:
    """Copies, which lie in memory as torch's own tensors do: how a sum is rounded depends on it."""
    return Gaussians(*(torch.from_numpy(arrays[name]).clone().to(device) for name in _FIELDS))


def load_arrays(path: Path) -> Arrays | None:
    """The arrays of a file; None where there is none that is whole."""
    try:
        with np.load(path, allow_pickle=False) as saved:
            return dict(saved)
    except (OSError, ValueError, EOFError, BadZipFile):
        return None  # a part of a file that another program left is computed again


def write_arrays(path: Path, arrays: Arrays) -> None:
    """All at once, so that no reader sees half a file.

    Raises:
        OutputError: where it cannot be written.
    """
    _make_folder(path.parent)
    try:
        with replacing(path) as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
    except InputError as error:
        raise OutputError(str(error)) from error


def write_json(path: Path, content: Any) -> None:
    """All at once, so that a file that is there is complete.

    Raises:
        OutputError: where it cannot be written.
    """
    _make_folder(path.parent)
    try:
        with replacing(path) as file:
            file.write((json.dumps(content, indent=1) + "\n").encode())
    except InputError as error:
        raise OutputError(str(error)) from error


def read_json(path: Path, advice: str = "delete it and run again") -> Any:
    """The content of a file of results; `advice` is what to do where it is no JSON.

    Raises:
        InputError: where it cannot be read.
    """
    return json_file.read_json(path, advice)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"Cannot make the folder {folder}: {error.strerror}; choose another place."
        ) from error
