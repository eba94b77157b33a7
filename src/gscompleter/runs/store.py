"""The folder of a run: its files and how they are written (atomically) and read.

run.json                            settings that determine the numbers
tasks/TASK/context.npz              initial scene of all methods
tasks/TASK/truth-001.png            photograph of the first target
tasks/TASK/METHOD.json              row of a method: its steps and its error
tasks/TASK/METHOD/step-001.npz      prediction for the first target
tasks/TASK/METHOD/step-001.png      render at the first target after completion
tasks/TASK/METHOD/before-001.png    render at the first target before completion
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError, OutputError, quoted
from gscompleter.io import json_file
from gscompleter.io.files import replacing
from gscompleter.io.image import write_image
from gscompleter.io.unfinished import MARK
from gscompleter.runs.methods import Prediction
from gscompleter.types import Gaussians, merge

RUN = "run.json"
"""Name of the file with the settings of a run."""

TASKS = "tasks"
"""Name of the folder that holds the tasks."""

VERSION = 3
"""Version of the files of a run."""

REGISTERED = "registered_"
"""Prefix of the arrays of registered Gaussians in the file of a prediction."""

_FIELDS = ("means", "quats", "scales", "opacities", "sh", "generated")

Arrays = dict[str, np.ndarray]


def slug(name: str) -> str:
    """Turn a name into a valid file name."""
    return re.sub(r"[^\w.+-]+", "-", name.replace(">", "-to-"))


def task_folder(out: Path, task: str) -> Path:
    """Return the folder of a task."""
    return out / TASKS / slug(task)


def row_path(out: Path, task: str, method: str) -> Path:
    """Return the path of the row of a task and a method."""
    return task_folder(out, task) / f"{slug(method)}.json"


def step_path(folder: Path, method: str, number: int) -> Path:
    """Return the path of the prediction of step `number`, counted from 1."""
    return folder / slug(method) / f"step-{number:03d}.npz"


def truth_path(folder: Path, number: int) -> Path:
    """Return the path of the target photograph of step `number`, counted from 1."""
    return folder / f"truth-{number:03d}.png"


def row_paths(out: Path) -> list[Path]:
    """List all rows of a run."""
    return sorted((out / TASKS).glob("*/*.json"))


def claim(out: Path, settings: Mapping[str, Any]) -> None:
    """Create the folder of a run, or check that it holds a run with the same settings.

    If several processes claim it simultaneously, one creates it and the others compare.
    """
    wanted = json.loads(json.dumps({"version": VERSION, **settings}))
    if not is_run(out):
        if holds_something_else(out):
            raise InputError(f"{out} holds something other than a run; name another folder.")
        write_json(out / RUN, wanted, first_stays=True)
    found = settings_of(out)
    for key in {**wanted, **found}:
        if found.get(key) != wanted.get(key):
            old, new = quoted(repr(found.get(key))), quoted(repr(wanted.get(key)))
            raise InputError(
                f"{out} holds a run with {key} {old}, and this run has {new}; name another folder."
            )


def check_run(out: Path) -> None:
    """Raise InputError if `out` holds no run, or one of another version."""
    if not is_run(out):
        raise InputError(f"{out} holds no run; name a folder that `evaluate` wrote.")
    settings_of(out)


def settings_of(out: Path) -> dict[str, Any]:
    """Read the settings of a run; raise InputError if they are damaged or of another version."""
    found = read_json(out / RUN, "name another folder")
    version = found.get("version") if isinstance(found, dict) else None
    if version != VERSION:
        raise InputError(
            f"{out} holds a run of version {quoted(version)}, and version {VERSION} is needed; "
            "name another folder and run it again."
        )
    return dict(found)


def is_run(out: Path) -> bool:
    """Return True if `out` is the folder of a run."""
    return (out / RUN).is_file()


def holds_something_else(out: Path) -> bool:
    """Return True if `out` exists and is neither empty, unfinished, nor a run."""
    if not os.path.lexists(out):
        return False
    if not out.is_dir():
        return True
    entries = {name for name in os.listdir(out) if not name.startswith(MARK)}
    return bool(entries) and RUN not in entries and not is_run(out)


@dataclass(frozen=True)
class SavedContext:
    """The reconstruction of a task."""

    gaussians: Gaussians
    near: float
    """Depth range of the reconstruction in scene units."""
    far: float
    seconds: float
    gains: Float[Tensor, "v 3"] | None = None
    """Exposure gain of each photograph by channel, or None without exposure normalization."""


def save_context(path: Path, context: SavedContext) -> None:
    """Write the initial scene of a task."""
    numbers = np.array([context.seconds, context.near, context.far], dtype=np.float64)
    arrays = {**_arrays_of(context.gaussians), "seconds_near_far": numbers}
    if context.gains is not None:
        arrays["gains"] = context.gains.cpu().numpy()
    write_arrays(path, arrays)


def load_context(path: Path, device: torch.device | str) -> SavedContext | None:
    """Read the initial scene of a task, or return None if there is no complete file."""
    arrays = load_arrays(path)
    if arrays is None:
        return None
    seconds, near, far = arrays["seconds_near_far"].tolist()
    gains = torch.from_numpy(arrays["gains"]).to(device) if "gains" in arrays else None
    return SavedContext(_gaussians_of(arrays, device), near, far, seconds, gains)


def save_prediction(path: Path, prediction: Prediction) -> None:
    """Write the added Gaussians, or the whole scene if it was changed, and the registered ones."""
    registered = prediction.registered
    whole = prediction.added is None
    write_arrays(
        path,
        {
            **_arrays_of(prediction.scene if prediction.added is None else prediction.added),
            "whole": np.array(whole),
            "stages": np.array(list(prediction.seconds), dtype=np.str_),
            "seconds": np.array(list(prediction.seconds.values()), dtype=np.float64),
            "anchor": _optional(prediction.anchor),
            "anchor_fallback": np.array(prediction.anchor_fallback),
            "notes": np.array(prediction.notes, dtype=np.str_),
            "peak_bytes": _optional(prediction.peak_bytes),
            **({} if registered is None else _arrays_of(registered, REGISTERED)),
        },
    )


def load_prediction(path: Path, before: Gaussians) -> Prediction | None:
    """Read the prediction for the scene `before`, or return None if there is no complete file."""
    arrays = load_arrays(path)
    if arrays is None:
        return None
    changed = _gaussians_of(arrays, before.means.device)
    whole = bool(arrays["whole"])
    return Prediction(
        scene=changed if whole else merge([before, changed]),
        added=None if whole else changed,
        seconds=dict(zip(arrays["stages"].tolist(), arrays["seconds"].tolist(), strict=True)),
        anchor=_known(arrays["anchor"]),
        anchor_fallback=bool(arrays["anchor_fallback"]),
        notes=tuple(arrays["notes"].tolist()),
        peak_bytes=_known(arrays["peak_bytes"]),
        registered=(
            _gaussians_of(arrays, before.means.device, REGISTERED)
            if f"{REGISTERED}means" in arrays
            else None
        ),
    )


def _optional(number: int | None) -> np.ndarray:
    return np.array(-1 if number is None else number, dtype=np.int64)


def _known(number: np.ndarray) -> int | None:
    return None if number < 0 else int(number)


def _arrays_of(gaussians: Gaussians, prefix: str = "") -> Arrays:
    return {f"{prefix}{name}": getattr(gaussians, name).detach().cpu().numpy() for name in _FIELDS}


def _gaussians_of(
    arrays: Mapping[str, np.ndarray], device: torch.device | str, prefix: str = ""
) -> Gaussians:
    """Copy arrays to tensors with torch's own memory layout, on which rounding of sums depends."""
    found = (arrays[f"{prefix}{name}"] for name in _FIELDS)
    tensors: list[Any] = [torch.from_numpy(array).clone().to(device) for array in found]
    return Gaussians(*tensors)


def load_arrays(path: Path) -> Arrays | None:
    """Read the arrays of a file, or return None if there is no complete file."""
    try:
        with np.load(path, allow_pickle=False) as saved:
            return dict(saved)
    except (OSError, ValueError, EOFError, BadZipFile):
        return None  # an incomplete file is computed again


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays atomically; raise OutputError if that fails."""
    with _writing(path), replacing(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def write_json(path: Path, content: Any, first_stays: bool = False) -> None:
    """Write JSON atomically; the arguments are those of `replacing`."""
    with _writing(path), replacing(path, first_stays) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def save_image(path: Path, image: Float[Tensor, "h w 3"]) -> None:
    """Write an image; raise OutputError if that fails."""
    with _writing(path):
        write_image(path, image)


def read_json(path: Path, advice: str = "delete it and run again") -> Any:
    """Read a JSON file of results."""
    return json_file.read_json(path, advice)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Create the folder of `path` and turn write errors into OutputError, which ends the run."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except InputError as error:
        raise OutputError(str(error)) from error
    except OSError as error:
        raise OutputError(
            f"Cannot write {path}: {error.strerror}; choose another place."
        ) from error
