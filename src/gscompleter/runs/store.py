"""The folder of a run: where things lie in it, and how they are written and read.

    run.json                            what decided the numbers
    tasks/TASK/context.npz              the scene that all methods begin with
    tasks/TASK/truth-001.png            the photograph of the first target
    tasks/TASK/METHOD.json              the row of a method: its steps, and why there are no more
    tasks/TASK/METHOD/step-001.npz      what it made of the scene for the first target
    tasks/TASK/METHOD/step-001.png      what the camera of that target sees afterwards
    tasks/TASK/METHOD/before-001.png    the same before

Everything appears under its name once it is complete.
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
"""The file that says what decided the numbers of a folder."""

TASKS = "tasks"
"""Where the folders of the tasks are."""

VERSION = 3
"""Of the files in a folder of results."""

REGISTERED = "registered_"
"""Before the names of the arrays of what was registered, in the file of a prediction."""

_FIELDS = ("means", "quats", "scales", "opacities", "sh", "generated")

Arrays = dict[str, np.ndarray]


def slug(name: str) -> str:
    """`name` as the name of a file."""
    return re.sub(r"[^\w.+-]+", "-", name.replace(">", "-to-"))


def task_folder(out: Path, task: str) -> Path:
    """Where everything about the task of that name lies."""
    return out / TASKS / slug(task)


def row_path(out: Path, task: str, method: str) -> Path:
    """Where the row of a task and a method lies."""
    return task_folder(out, task) / f"{slug(method)}.json"


def step_path(folder: Path, method: str, number: int) -> Path:
    """What a method made of the step `number`, counted from 1, of the task in `folder`."""
    return folder / slug(method) / f"step-{number:03d}.npz"


def truth_path(folder: Path, number: int) -> Path:
    """The photograph of the target of the step `number` of the task in `folder`."""
    return folder / f"truth-{number:03d}.png"


def row_paths(out: Path) -> list[Path]:
    """All rows of a run."""
    return sorted((out / TASKS).glob("*/*.json"))


def claim(out: Path, settings: Mapping[str, Any]) -> None:
    """Make `out` the folder of the run with these settings, or see that it is.

    Of any number of processes that claim a folder at the same time one makes it, and the others
    compare. Only a file system without hard links cannot tell at the very same moment that two of
    them differ in their settings.

    Raises:
        InputError: where it holds something else, or a run with other settings.
    """
    wanted = json.loads(json.dumps({"version": VERSION, **settings}))
    if not is_run(out):
        if holds_something_else(out):
            raise InputError(f"{out} holds something other than a run; name another folder.")
        write_json(out / RUN, wanted, first_stays=True)
    found = settings_of(out)
    for key in {**wanted, **found}:
        if found.get(key) != wanted.get(key):
            there, asked = quoted(repr(found.get(key))), quoted(repr(wanted.get(key)))
            raise InputError(
                f"{out} holds a run with {key} {there}, and {asked} is asked for; name another "
                "folder."
            )


def check_run(out: Path) -> None:
    """See that `out` is the folder of a run.

    Raises:
        InputError: where it is none, or one of another version.
    """
    if not is_run(out):
        raise InputError(f"{out} holds no run; name a folder that `evaluate` wrote.")
    settings_of(out)


def settings_of(out: Path) -> dict[str, Any]:
    """What `out` says of its run; an InputError where that is damaged or of another version."""
    found = read_json(out / RUN, "name another folder")
    version = found.get("version") if isinstance(found, dict) else None
    if version != VERSION:
        raise InputError(
            f"{out} holds a run of version {quoted(version)}, and version {VERSION} is needed; "
            "name another folder and run it again."
        )
    return dict(found)


def is_run(out: Path) -> bool:
    """Whether `out` is the folder of a run."""
    return (out / RUN).is_file()


def holds_something_else(out: Path) -> bool:
    """Whether `out` is there and is neither empty nor the folder of a run.

    What another process is writing does not count; and where it has written more than that, it has
    claimed the folder before.
    """
    if not os.path.lexists(out):
        return False
    if not out.is_dir():
        return True
    entries = {name for name in os.listdir(out) if not name.startswith(MARK)}
    return bool(entries) and RUN not in entries and not is_run(out)


@dataclass(frozen=True)
class SavedContext:
    """What Ψ makes of the photographs of a task."""

    gaussians: Gaussians
    near: float
    """Depth range in scene units that it was made with."""
    far: float
    seconds: float
    """What it took."""
    gains: Float[Tensor, "v 3"] | None = None
    """By how much each photograph is brighter, by channel; None where exposures were not evened
    out."""


def save_context(path: Path, context: SavedContext) -> None:
    """Write the scene that all methods begin with, as by `write_arrays`."""
    numbers = np.array([context.seconds, context.near, context.far], dtype=np.float64)
    arrays = {**_arrays_of(context.gaussians), "seconds_near_far": numbers}
    if context.gains is not None:
        arrays["gains"] = context.gains.cpu().numpy()
    write_arrays(path, arrays)


def load_context(path: Path, device: torch.device | str) -> SavedContext | None:
    """What `save_context` wrote; None where there is nothing whole."""
    arrays = load_arrays(path)
    if arrays is None:
        return None
    seconds, near, far = arrays["seconds_near_far"].tolist()
    gains = torch.from_numpy(arrays["gains"]).to(device) if "gains" in arrays else None
    return SavedContext(_gaussians_of(arrays, device), near, far, seconds, gains)


def save_prediction(path: Path, prediction: Prediction) -> None:
    """Write what differs from the scene before, what was added or else the whole scene, and what
    was registered."""
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
    """What `save_prediction` wrote of the scene `before`; None where there is nothing whole."""
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
    """A number that is not negative, or its absence."""
    return np.array(-1 if number is None else number, dtype=np.int64)


def _known(number: np.ndarray) -> int | None:
    return None if number < 0 else int(number)


def _arrays_of(gaussians: Gaussians, prefix: str = "") -> Arrays:
    return {f"{prefix}{name}": getattr(gaussians, name).detach().cpu().numpy() for name in _FIELDS}


def _gaussians_of(
    arrays: Mapping[str, np.ndarray], device: torch.device | str, prefix: str = ""
) -> Gaussians:
    """Copies, which lie in memory as torch's own tensors do: how a sum is rounded depends on it."""
    found = (arrays[f"{prefix}{name}"] for name in _FIELDS)
    tensors: list[Any] = [torch.from_numpy(array).clone().to(device) for array in found]
    return Gaussians(*tensors)


def load_arrays(path: Path) -> Arrays | None:
    """The arrays of a file; None where there is none that is whole."""
    try:
        with np.load(path, allow_pickle=False) as saved:
            return dict(saved)
    except (OSError, ValueError, EOFError, BadZipFile):
        return None  # a part of a file that another program left is computed again


def write_arrays(path: Path, arrays: Arrays) -> None:
    """All at once, so that no reader sees half a file; an OutputError where that cannot be."""
    with _writing(path), replacing(path) as file:
        np.savez(file, **arrays)  # type: ignore[arg-type]


def write_json(path: Path, content: Any, first_stays: bool = False) -> None:
    """All at once, like `write_arrays`; arguments as those of `replacing`."""
    with _writing(path), replacing(path, first_stays) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def save_image(path: Path, image: Float[Tensor, "h w 3"]) -> None:
    """A picture among the results; an OutputError where it cannot be written."""
    with _writing(path):
        write_image(path, image)


def read_json(path: Path, advice: str = "delete it and run again") -> Any:
    """`json_file.read_json` of a file of results."""
    return json_file.read_json(path, advice)


@contextlib.contextmanager
def _writing(path: Path) -> Iterator[None]:
    """Make the folder of `path`; what then cannot be written ends the run."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    except InputError as error:
        raise OutputError(str(error)) from error
    except OSError as error:
        raise OutputError(
            f"Cannot write {path}: {error.strerror}; choose another place."
        ) from error
