"""The folder of a run: its files and how they are written (atomically) and read.

run.json                            settings that determine the numbers
tasks/TASK/context.pt               initial scene of all methods
tasks/TASK/truth-001.png            photograph of the first target
tasks/TASK/context-001.png          first given photograph
tasks/TASK/METHOD.json              row of a method: its steps and its error
tasks/TASK/METHOD/step-001.pt       prediction for the first target
tasks/TASK/METHOD/step-001.png      render at the first target after completion
tasks/TASK/METHOD/before-001.png    render at the first target before completion
tasks/TASK/METHOD/holes-001.png     mask of the holes before completion
tasks/TASK/METHOD/gaps-001.png      window with most thin gaps after completion, magnified
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from gscompleter.evaluation.methods import Prediction
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files import reading
from gscompleter.system.files.names import make_valid_name
from gscompleter.system.files.writing import replace_file
from gscompleter.system.jobs.jobs import claim_folder, make_folder
from gscompleter.types import Gaussians, merge

RUN = "run.json"
"""File with the settings of a run."""
TASKS = "tasks"
"""Folder that holds the tasks."""
RUN_VERSION = 4
"""Version of the files of a run."""
TENSORS = ("means", "quats", "scales", "opacities", "sh", "generated")
"""Tensors of Gaussians that are saved; the values as a file of a splat had them are not."""
GAUSSIANS = ("gaussians", "scene", "added", "registered")
"""Names of saved values that are Gaussians, of `SavedContext` and `Prediction`."""


def make_file_name(name: str) -> str:
    """Turn a name into a valid file name."""
    return make_valid_name(name.replace(">", "-to-"))


def get_task_folder(out: Path, task: str) -> Path:
    """Return the folder of a task."""
    return out / TASKS / make_file_name(task)


def get_score_path(out: Path, task: str, method: str) -> Path:
    """Return the path of the row of a task and a method."""
    return get_task_folder(out, task) / f"{make_file_name(method)}.json"


def get_step_path(folder: Path, method: str, number: int) -> Path:
    """Return the path of the prediction of step `number`, counted from 1."""
    return folder / make_file_name(method) / f"step-{number:03d}.pt"


def get_truth_path(folder: Path, number: int) -> Path:
    """Return the path of the target photograph of step `number`, counted from 1."""
    return folder / f"truth-{number:03d}.png"


def get_photograph_path(folder: Path, number: int) -> Path:
    """Return the path of a given photograph, counted from 1."""
    return folder / f"context-{number:03d}.png"


def list_row_paths(out: Path) -> list[Path]:
    """List all rows of a run."""
    return sorted((out / TASKS).glob("*/*.json"))


def claim(out: Path, settings: Mapping[str, Any]) -> None:
    """Create the folder of a run, or check that it holds a run with the same settings."""
    # Through JSON, which turns tuples into lists: compared is what the file holds.
    wanted = json.loads(json.dumps({"version": RUN_VERSION, **settings}))
    claim_folder(out, "run", wanted)
    existing = read_run_settings(out)
    difference = find_difference(existing, wanted)
    if difference is not None:
        name, old, new = difference
        raise InputError(
            f"{quote_value(out)} holds a run with {name} {quote_value(repr(old))}, and this run "
            f"has {quote_value(repr(new))}; name another folder."
        )


def find_difference(
    existing: Mapping[str, Any], wanted: Mapping[str, Any]
) -> tuple[str, object, object] | None:
    """Find the first setting that differs: its name with dots, and both values; None for none.

    A setting that is not there has the value None.
    """
    for key in {**wanted, **existing}:
        old = existing.get(key)
        new = wanted.get(key)
        if old == new:
            continue
        # Of settings within settings only one may differ, and a sentence holds few.
        if isinstance(old, Mapping) and isinstance(new, Mapping):
            inner = find_difference(old, new)
            if inner is None:
                continue
            return f"{key}.{inner[0]}", *inner[1:]
        return key, old, new
    return None


def read_run_settings(out: Path) -> dict[str, Any]:
    """Read the settings of a run; raise InputError if `out` holds none of this version."""
    if not (out / RUN).is_file():
        raise InputError(f"{quote_value(out)} holds no run; name a folder that `evaluate` wrote.")
    settings = read_run_file(out / RUN, "name another folder")
    version = settings.get("version") if isinstance(settings, dict) else None
    if version != RUN_VERSION:
        raise InputError(
            f"{quote_value(out)} holds a run of version {quote_value(version)}, and version "
            f"{RUN_VERSION} is needed; name another folder and run it again."
        )
    return dict(settings)


@dataclass(frozen=True)
class SavedContext:
    """The reconstruction of a task."""

    gaussians: Gaussians
    near: float
    far: float
    seconds: float
    gains: Float[Tensor, "v 3"] | None = None
    """Exposure gain of each photograph by channel, or None without exposure normalization."""
    notes: tuple[str, ...] = ()
    """Sentences of Ψ about the photographs."""


def save_prediction(path: Path, prediction: Prediction) -> None:
    """Write the added Gaussians, or the whole scene if it was changed, and the registered ones."""
    # What a method adds follows the scene before, which is saved already.
    scene = prediction.scene if prediction.added is None else None
    seconds = dict(prediction.seconds)
    save_values(path, {**vars(prediction), "seconds": seconds, "scene": scene})


def load_prediction(path: Path, before: Gaussians) -> Prediction:
    """Read the prediction for the scene `before`."""
    saved = load_values(path, before.means.device)
    if saved["scene"] is None:
        saved["scene"] = merge([before, saved["added"]])
    return Prediction(**saved)


def save_values(path: Path, content: Mapping[str, Any]) -> None:
    """Write Gaussians and plain values atomically; raise OutputError if that fails."""
    make_folder(path.parent)
    packed = dict(content)
    for name, value in content.items():
        if isinstance(value, Gaussians):
            # On the CPU, and in torch's own layout, on which the rounding of sums depends.
            tensors = {field: getattr(value, field).detach().cpu() for field in TENSORS}
            packed[name] = {
                **{
                    field: tensor.clone(memory_format=torch.contiguous_format)
                    for field, tensor in tensors.items()
                },
                "is_antialiased": value.is_antialiased,
                "origin": value.origin,
            }
    with replace_file(path) as file:
        torch.save(packed, file)


def load_values(path: Path, device: torch.device | str) -> dict[str, Any]:
    """Read what `save_values` wrote, with Gaussians and tensors on a device."""
    saved = torch.load(path, map_location="cpu", weights_only=True)
    content = {k: Gaussians(**v) if k in GAUSSIANS and v else v for k, v in saved.items()}
    return {
        name: value.to(device) if isinstance(value, (Gaussians, Tensor)) else value
        for name, value in content.items()
    }


def is_complete(path: Path) -> bool:
    """Return True if a file of `save_values` exists and has its end."""
    # A zip archive has its directory at its end.
    return reading.is_zip_file(path)


def read_run_file(path: Path, advice: str = "delete it and run again") -> Any:
    """Read a JSON file of results."""
    return reading.read_json(path, advice)
