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

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.errors import InputError, quote_value
from gscompleter.evaluation.methods import Prediction
from gscompleter.io import json_file
from gscompleter.io.files import convert_write_errors, replace_file
from gscompleter.io.image import write_image
from gscompleter.jobs.places import open_place
from gscompleter.types import Gaussians, merge

RUN, TASKS = "run.json", "tasks"
"""Names of the file with the settings of a run, and of the folder that holds the tasks."""
VERSION = 3
"""Version of the files of a run."""
REGISTERED_PREFIX = "registered_"
"""Prefix of the arrays of registered Gaussians in the file of a prediction."""
_FIELDS = ("means", "quats", "scales", "opacities", "sh", "generated")

Arrays = dict[str, np.ndarray]


def make_file_name(name: str) -> str:
    """Turn a name into a valid file name."""
    return re.sub(r"[^\w.+-]+", "-", name.replace(">", "-to-"))


def get_task_folder(out: Path, task: str) -> Path:
    """Return the folder of a task."""
    return out / TASKS / make_file_name(task)


def get_row_path(out: Path, task: str, method: str) -> Path:
    """Return the path of the row of a task and a method."""
    return get_task_folder(out, task) / f"{make_file_name(method)}.json"


def get_step_path(folder: Path, method: str, number: int) -> Path:
    """Return the path of the prediction of step `number`, counted from 1."""
    return folder / make_file_name(method) / f"step-{number:03d}.npz"


def get_truth_path(folder: Path, number: int) -> Path:
    """Return the path of the target photograph of step `number`, counted from 1."""
    return folder / f"truth-{number:03d}.png"


def list_row_paths(out: Path) -> list[Path]:
    """List all rows of a run."""
    return sorted((out / TASKS).glob("*/*.json"))


def claim(out: Path, settings: Mapping[str, Any]) -> None:
    """Create the folder of a run, or check that it holds a run with the same settings.

    If several processes claim it simultaneously, one creates it and the others compare.
    """
    wanted = json.loads(json.dumps({"version": VERSION, **settings}))
    if not (out / RUN).is_file():
        # Listed at once, as another process may be creating the run.
        entries = open_place(out).list_names("")
        if entries and RUN not in entries:
            raise InputError(f"{out} holds something other than a run; name another folder.")
        write_json(out / RUN, wanted, keep_existing=True)
    found = read_settings(out)
    for key in {**wanted, **found}:
        if found.get(key) != wanted.get(key):
            old, new = quote_value(repr(found.get(key))), quote_value(repr(wanted.get(key)))
            raise InputError(
                f"{out} holds a run with {key} {old}, and this run has {new}; name another folder."
            )


def read_settings(out: Path) -> dict[str, Any]:
    """Read the settings of a run; raise InputError if `out` holds none of this version."""
    if not (out / RUN).is_file():
        raise InputError(f"{out} holds no run; name a folder that `evaluate` wrote.")
    found = read_json(out / RUN, "name another folder")
    version = found.get("version") if isinstance(found, dict) else None
    if version != VERSION:
        raise InputError(
            f"{out} holds a run of version {quote_value(version)}, and version {VERSION} is "
            "needed; name another folder and run it again."
        )
    return dict(found)


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
    arrays = {**_to_arrays(context.gaussians), "seconds_near_far": numbers}
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
    return SavedContext(_to_gaussians(arrays, device), near, far, seconds, gains)


def save_prediction(path: Path, prediction: Prediction) -> None:
    """Write the added Gaussians, or the whole scene if it was changed, and the registered ones."""
    changed, registered = prediction.added, prediction.registered
    numbers = {"anchor": prediction.anchor, "peak_bytes": prediction.peak_bytes}
    write_arrays(
        path,
        {
            **_to_arrays(prediction.scene if changed is None else changed),
            "whole": np.array(changed is None),
            "stages": np.array(list(prediction.seconds), dtype=np.str_),
            "seconds": np.array(list(prediction.seconds.values()), dtype=np.float64),
            "anchor_fallback": np.array(prediction.anchor_fallback),
            "notes": np.array(prediction.notes, dtype=np.str_),
            **{k: np.array(-1 if n is None else n, dtype=np.int64) for k, n in numbers.items()},
            **({} if registered is None else _to_arrays(registered, REGISTERED_PREFIX)),
        },
    )


def load_prediction(path: Path, before: Gaussians) -> Prediction | None:
    """Read the prediction for the scene `before`, or return None if there is no complete file."""
    arrays = load_arrays(path)
    if arrays is None:
        return None
    device, registered = before.means.device, None
    if f"{REGISTERED_PREFIX}means" in arrays:
        registered = _to_gaussians(arrays, device, REGISTERED_PREFIX)
    changed = _to_gaussians(arrays, device)
    whole = bool(arrays["whole"])
    anchor, peak = int(arrays["anchor"]), int(arrays["peak_bytes"])
    return Prediction(
        scene=changed if whole else merge([before, changed]),
        added=None if whole else changed,
        seconds=dict(zip(arrays["stages"].tolist(), arrays["seconds"].tolist(), strict=True)),
        anchor=None if anchor < 0 else anchor,
        anchor_fallback=bool(arrays["anchor_fallback"]),
        notes=tuple(arrays["notes"].tolist()),
        peak_bytes=None if peak < 0 else peak,
        registered=registered,
    )


def _to_arrays(gaussians: Gaussians, prefix: str = "") -> Arrays:
    return {f"{prefix}{name}": getattr(gaussians, name).detach().cpu().numpy() for name in _FIELDS}


def _to_gaussians(
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


def make_folder(folder: Path) -> None:
    """Create a folder; raise OutputError if that fails."""
    with convert_write_errors(folder):
        folder.mkdir(parents=True, exist_ok=True)


def write_arrays(path: Path, arrays: Arrays) -> None:
    """Write arrays atomically; raise OutputError if that fails."""
    make_folder(path.parent)
    with replace_file(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def write_json(path: Path, content: Any, keep_existing: bool = False) -> None:
    """Write JSON atomically; the arguments are those of `replace_file`."""
    make_folder(path.parent)
    with replace_file(path, keep_existing) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def save_image(path: Path, image: Float[Tensor, "h w 3"]) -> None:
    """Write an image; raise OutputError if that fails."""
    make_folder(path.parent)
    write_image(path, image)


def read_json(path: Path, advice: str = "delete it and run again") -> Any:
    """Read a JSON file of results."""
    return json_file.read_json(path, advice)
