"""What a run was made with: Ψ, Φ, the code, and whether cases that are kept apart were used.

Cases that are kept apart are test cases on which no setting may be decided (`apart`). The line
stands above every table, so that tables of two models cannot be confused.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path, PurePath
from typing import Any

from gscompleter.evaluation.apart import LEDGER
from gscompleter.evaluation.columns import RunRow
from gscompleter.evaluation.store import read_run_settings
from gscompleter.numerics.two_views import ERROR_SIDE
from gscompleter.system.plugins import is_in_file

WEIGHT_FILES = (".ckpt", ".onnx", ".pt", ".pth", ".safetensors")
"""Endings of files of weights."""
MAX_NAMED = 5
"""Most scenes of which the line says how their poses were refined."""
GENERATOR_PREFIX = "generator_"
"""Beginning of the names of the generator's settings among those of the run."""


@dataclass(frozen=True)
class RunFacts:
    """The facts of a run."""

    reconstructor: str
    """Name of Ψ, with its depth and its weights if it was given some."""
    generator: str
    """Name of Φ, with those of its settings that were given."""
    seed: int
    """Seed of all random numbers."""
    num_apart: int
    """Number of cases that are kept apart, and were used."""
    commits: tuple[str, ...]
    """Commits of the code that computed the rows; none outside of a checkout."""
    poses: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)
    """`PoseRefinement` as a dict, by the name of each scene with refined poses; those of all others
    are as given."""

    @property
    def sentence(self) -> str:
        """The facts in a line."""
        parts = [f"Ψ: {self.reconstructor}", f"Φ: {self.generator}", f"seed {self.seed}"]
        parts.append(f"poses: {describe_poses(self.poses)}")
        if self.commits:
            parts.append(f"commit {' and '.join(self.commits)}")
        if self.num_apart:
            cases = "1 case that is" if self.num_apart == 1 else f"{self.num_apart} cases that are"
            used = "was used" if self.num_apart == 1 else "were used"
            parts.append(f"{cases} kept apart {used} ({LEDGER})")
        return "; ".join(parts) + "."

    def to_json(self) -> dict[str, Any]:
        """Return the facts for a JSON file."""
        return {**asdict(self), "commits": list(self.commits)}


def read_run_facts(out: Path, rows: Sequence[RunRow]) -> RunFacts:
    """Read the facts of the run in a folder; `rows` are those of its tables."""
    settings = read_run_settings(out)
    depth = settings.get("depth", "none")
    # Folders of files are left out: a table can be published.
    extras = {
        "depth": None if depth == "none" else strip_folder(depth),
        "weights": settings["weights"],
        "depth weights": settings.get("depth_weights"),
    }
    generator_settings = {
        name.removeprefix(GENERATOR_PREFIX): value
        for name, value in settings.items()
        if name.startswith(GENERATOR_PREFIX)
    }
    return RunFacts(
        reconstructor=name_model_with_settings(settings["reconstructor"], extras),
        generator=name_model_with_settings(settings["generator"], generator_settings),
        seed=settings["seed"],
        num_apart=settings["source"].get("apart", 0),
        commits=tuple(sorted({row["commit"] for row in rows if row.get("commit")})),
        poses={
            row["task"]["scene"]: row["refined_poses"]
            for row in rows
            if row.get("refined_poses") is not None
        },
    )


def describe_poses(refined: Mapping[str, Mapping[str, Any]]) -> str:
    """Describe what was done to the poses of scenes."""
    if not refined:
        return "as given"
    errors = [
        f"{strip_folder(scene)} {done['given_error']:.2f} to {done['refined_error']:.2f}"
        for scene, done in list(refined.items())[:MAX_NAMED]
    ]
    if len(refined) > MAX_NAMED:
        errors.append(f"and {len(refined) - MAX_NAMED} more scenes")
    return (
        f"refined where matches missed them ({', '.join(errors)}, in pixels of images whose "
        f"shorter side has {ERROR_SIDE})"
    )


def name_model_with_settings(name: str, settings: Mapping[str, Any]) -> str:
    """Name a model with the settings that have a value."""
    known = {key: value for key, value in settings.items() if value is not None}
    described = [f"{key} {strip_folder(str(value))}" for key, value in known.items()]
    return f"{strip_folder(name)} ({', '.join(described)})" if described else strip_folder(name)


def strip_folder(name: str) -> str:
    """Strip the folder of a file, such as file.py:function; names on a hub are kept."""
    path = PurePath(name)
    # USER/NAME may be a folder or a repository; paths that begin with ~ or . are no repositories.
    is_path = path.is_absolute() or name.startswith(("~", "."))
    if not (is_path or is_in_file(name) or path.suffix in WEIGHT_FILES):
        return name
    # In full, since the last part of a path such as `.` names nothing.
    return os.path.basename(os.path.abspath(os.path.expanduser(name)))


def describe_facts(facts: Mapping[str, RunFacts]) -> list[str]:
    """Describe the facts of several runs: in one line if all agree, else in one for each."""
    sentences = {name: of_run.sentence for name, of_run in facts.items()}
    different = list(dict.fromkeys(sentences.values()))
    if len(different) == 1:
        return different
    return [f"{name}: {sentence}" for name, sentence in sentences.items()]


def spell_greek(text: str) -> str:
    """Spell the names of models for LaTeX, which has no such letters in plain text."""
    return text.replace("Ψ", "Psi").replace("Φ", "Phi")
