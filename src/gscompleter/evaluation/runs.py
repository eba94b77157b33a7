"""Cases times methods: predict, save, score. A run that was stopped goes on where it was.

A folder of results holds `run.json` (what decided the numbers) and, for each case, a folder with
the context, and for each method what it made of it (.npz) and its row of scores (.json). Rows
are made from what is saved, so that to score again is to delete rows and run again.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar, runtime_checkable
from zipfile import BadZipFile

import numpy as np
import torch

from gscompleter.errors import InputError
from gscompleter.evaluation.cases import Outcome, ranged_truth, score
from gscompleter.evaluation.methods import (
    BASELINES,
    METHODS,
    Parts,
    Prediction,
    Start,
    check_methods,
    start_of,
)
from gscompleter.generators import load_generator
from gscompleter.io.files import replacing
from gscompleter.progress import shown_on, track
from gscompleter.reconstructors import load_reconstructor
from gscompleter.render import load_renderer
from gscompleter.types import Gaussians, View, merge

T = TypeVar("T")

VERSION = 1
"""Of the files in a folder of results."""

RUN = "run.json"
"""The file that says what decided the numbers of a folder."""

CASES = "cases"
"""Where the folders of the cases are."""

_FIELDS = ("means", "quats", "scales", "opacities", "sh", "generated")


@runtime_checkable
class EvaluationCase(Protocol):
    """A completion task: of a `cases.json`, or chosen by a protocol in a clip."""

    @property
    def name(self) -> str: ...

    @property
    def context(self) -> tuple[int, ...]: ...

    @property
    def target(self) -> int: ...

    @property
    def neighbours(self) -> tuple[int, ...]: ...

    def load(self, frames: tuple[int, ...]) -> list[View]:
        """Photographs of `frames`."""


@dataclass(frozen=True)
class RunConfig:
    """What decides the numbers, beside the cases."""

    reconstructor: str = "plane-sweep"
    generator: str = "warp-inpaint"
    device: Literal["cpu", "cuda"] = "cpu"
    seed: int = 0
    """Of everything random."""
    baseline_iterations: int | None = None
    """Most iterations of the baselines; their own numbers if None."""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Where the cases come from, so that no folder mixes two sources."""

    def parts(self, target: View) -> Parts:
        """The models for a case. Only the generator `oracle` looks at the image of `target`."""
        return Parts(
            load_reconstructor(self.reconstructor),
            load_generator(self.generator, self.seed, [target]),
            load_renderer(self.device),
            self.seed,
            0.0 if self.generator == "oracle" else None,
            self.baseline_iterations,
        )


@dataclass(frozen=True)
class Tally:
    """What a call of `evaluate` did, in pairs of a case and a method."""

    done: int
    failed: int
    """Of those that are done now, how many have a reason in place of scores."""
    skipped: int
    """Done by an earlier call."""


def evaluate(
    cases: Sequence[EvaluationCase],
    methods: Sequence[str],
    out: Path,
    config: RunConfig = RunConfig(),
    shard: tuple[int, int] = (0, 1),
) -> Tally:
    """Run every method on every case of the shard, and write a row of scores for each.

    What is there already stays. A case that fails gives rows that say why, and the others go on.

    Args:
        cases: The cases of all shards.
        methods: Names of methods.
        out: Folder of results: a new one, or that of an earlier call.
        config: What decides the numbers; the same as in earlier calls.
        shard: (i, n) takes the cases i, i + n, i + 2n, …; n calls with i from 0 do them all.

    Raises:
        InputError: a wrong name or shard, a folder that holds something else, a full disk.
    """
    check_methods(methods)
    check_shard(shard)
    check_cases(cases)
    slow = [name for name in methods if name in BASELINES]
    if slow and config.device != "cpu":
        raise InputError(f"{', '.join(slow)} can only run on a CPU; use --device cpu.")
    load_reconstructor(config.reconstructor)
    load_generator(config.generator)
    claim(out, config)

    jobs = [(case, name) for case in cases[shard[0] :: shard[1]] for name in methods]
    missing = [(case, name) for case, name in jobs if not row_path(out, case, name).exists()]
    failed, bench = 0, None
    for case, name in track(missing, "Evaluating"):
        with shown_on(None):  # one bar is enough
            if bench is None or bench.case is not case:
                bench = Bench(case, out, config)
            row = bench.row(name)
        write_json(row_path(out, case, name), row)
        failed += row["error"] is not None
    return Tally(len(missing) - failed, failed, len(jobs) - len(missing))


class Bench:
    """One case: its photographs and its context are read, or computed, once."""

    def __init__(self, case: EvaluationCase, out: Path, config: RunConfig) -> None:
        self.case = case
        self.folder = case_folder(out, case)
        self.config = config
        self._ready: tuple[Start, Parts, View, list[View]] | str | None = None

    def row(self, method: str) -> dict[str, Any]:
        """The scores of a method, or why there are none."""
        if self._ready is None:
            self._ready = attempt(self._prepare)
        if isinstance(self._ready, str):
            return self._row_of(method, error=self._ready)
        start, parts, target, neighbours = self._ready
        path = self.folder / f"{slug(method)}.npz"
        saved = load_arrays(path)
        if saved is None:
            prediction = attempt(lambda: METHODS[method](start, parts))
            if isinstance(prediction, str):
                return self._row_of(method, error=prediction)
            saved = arrays_of_prediction(prediction)
            write_arrays(path, saved)

        def scored() -> dict[str, Any]:
            prediction = prediction_of(saved, start)
            camera = start.target
            truth = ranged_truth(start.views, target, neighbours, camera.near, camera.far)
            outcome = Outcome(
                prediction.context,
                prediction.scene,
                prediction.added,
                prediction.hole_mask,
                prediction.seconds,
            )
            scores = asdict(score(self.case.name, outcome, truth, parts.renderer))
            del scores["name"], scores["seconds"]
            json.dumps(scores, allow_nan=False)
            return self._row_of(
                method,
                scores=scores,
                gaussians={"context": len(prediction.context), "after": len(prediction.scene)},
                notes=list(prediction.notes),
                seconds={"context": start.seconds, "method": prediction.seconds},
            )

        row = attempt(scored)
        return self._row_of(method, error=row) if isinstance(row, str) else row

    def _prepare(self) -> tuple[Start, Parts, View, list[View]]:
        case, device = self.case, self.config.device
        views = [view.to(device) for view in case.load(case.context)]
        (target,) = (view.to(device) for view in case.load((case.target,)))
        neighbours = [view.to(device) for view in case.load(case.neighbours)]
        parts = self.config.parts(target)
        path = self.folder / "start.npz"
        saved = load_arrays(path)
        if saved is None:
            start = start_of(views, target.camera, parts)
            write_arrays(path, arrays_of_start(start))
        else:
            start = start_from(saved, views, target)
        return start, parts, target, neighbours

    def _row_of(self, method: str, error: str | None = None, **content: Any) -> dict[str, Any]:
        empty: dict[str, Any] = {"scores": None, "gaussians": None, "notes": [], "seconds": None}
        case = {
            "name": self.case.name,
            "context": list(self.case.context),
            "target": self.case.target,
            "neighbours": list(self.case.neighbours),
        }
        return {
            "version": VERSION,
            "case": case,
            "method": method,
            "error": error,
            **empty,
            **content,
        }


def attempt(compute: Callable[[], T]) -> T | str:
    """What `compute` returns, or why it failed, in one line.

    Raises:
        OutputError: where a result could not be written, which no other case could either.
    """
    try:
        return compute()
    except OutputError:
        raise
    except InputError as error:
        return str(error)
    except Exception as error:  # a defect of one case must not cost the others
        return f"{type(error).__name__}: {' '.join(str(error).split())}"


class OutputError(InputError):
    """A result cannot be written: the run ends."""


def check_shard(shard: tuple[int, int]) -> None:
    """Refuse shards that do not exist."""
    number, count = shard
    if not 0 <= number < count:
        raise InputError(
            f"There is no shard {number}/{count}; of n shards the first is 0/n, the last (n-1)/n."
        )


def check_cases(cases: Sequence[EvaluationCase]) -> None:
    """Refuse no case at all, and two that would be written to one place."""
    if not cases:
        raise InputError(
            "There is no case to run: no clip has the frames that the protocol asks for; choose a "
            "protocol with a smaller step, or other data."
        )
    names: dict[str, str] = {}
    for case in cases:
        folder = slug(case.name)
        if folder in names:
            raise InputError(
                f"The cases {names[folder]} and {case.name} have the same name; rename a scene."
            )
        names[folder] = case.name


def claim(out: Path, config: RunConfig) -> None:
    """Make `out` the folder of this run, or see that it is.

    Raises:
        InputError: where it holds something else, or a run with other settings.
    """
    wanted = json.loads(json.dumps({"version": VERSION, **asdict(config)}))
    path = out / RUN
    if path.exists():
        found = read_json(path)
        keys = (
            key for key in wanted if not isinstance(found, dict) or found.get(key) != wanted[key]
        )
        differing = next(keys, None)
        if differing is not None:
            value = found.get(differing) if isinstance(found, dict) else None
            raise InputError(
                f"{out} holds a run with {differing} {value!r}, and {wanted[differing]!r} is asked "
                "for; name another folder."
            )
        return
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"{out} holds something other than a run; name another folder.")
    write_json(path, wanted)


def slug(name: str) -> str:
    """`name` as the name of a file."""
    return re.sub(r"[^\w.+-]+", "-", name.replace(">", "-to-"))


def case_folder(out: Path, case: EvaluationCase) -> Path:
    """Where everything about a case lies."""
    return out / CASES / slug(case.name)


def row_path(out: Path, case: EvaluationCase, method: str) -> Path:
    """Where the row of scores of a case and a method lies."""
    return case_folder(out, case) / f"{slug(method)}.json"


Arrays = dict[str, np.ndarray]


def arrays_of(gaussians: Gaussians) -> Arrays:
    return {name: getattr(gaussians, name).detach().cpu().numpy() for name in _FIELDS}


def gaussians_of(arrays: Mapping[str, np.ndarray], device: torch.device) -> Gaussians:
    return Gaussians(*(torch.from_numpy(arrays[name]).to(device) for name in _FIELDS))


def arrays_of_start(start: Start) -> Arrays:
    """The context, its hole mask, and the depth range that it was made with."""
    numbers = [start.seconds, start.target.near, start.target.far]
    mask = start.hole_mask.cpu().numpy()
    return {
        **arrays_of(start.context),
        "hole_mask": mask,
        "seconds_near_far": np.array(numbers, dtype=np.float64),
    }


def start_from(arrays: Arrays, views: Sequence[View], target: View) -> Start:
    """What `arrays_of_start` saved, with the photographs that are not saved."""
    seconds, near, far = arrays["seconds_near_far"].tolist()
    ranged = ranged_truth(views, target, (), near, far)
    device = target.image.device
    mask = torch.from_numpy(arrays["hole_mask"]).to(device)
    context = gaussians_of(arrays, device)
    return Start(ranged.views, ranged.target.camera, context, mask, seconds)


def arrays_of_prediction(prediction: Prediction) -> Arrays:
    """What differs from the context: what was added, or else the whole scene."""
    whole = prediction.added is None
    return {
        **arrays_of(prediction.scene if prediction.added is None else prediction.added),
        "whole": np.array(whole),
        "seconds": np.array(prediction.seconds, dtype=np.float64),
        "notes": np.array(prediction.notes, dtype=np.str_),
    }


def prediction_of(arrays: Arrays, start: Start) -> Prediction:
    """What `arrays_of_prediction` saved."""
    changed = gaussians_of(arrays, start.context.means.device)
    whole = bool(arrays["whole"])
    return Prediction(
        context=start.context,
        scene=changed if whole else merge([start.context, changed]),
        seconds=arrays["seconds"].item(),
        hole_mask=start.hole_mask,
        added=None if whole else changed,
        notes=tuple(arrays["notes"].tolist()),
    )


def load_arrays(path: Path) -> Arrays | None:
    """The arrays of a file; None where there is none that is whole."""
    try:
        with np.load(path, allow_pickle=False) as saved:
            return dict(saved)
    except (OSError, ValueError, EOFError, BadZipFile):
        return None


def write_arrays(path: Path, arrays: Arrays) -> None:
    """All at once, so that no reader sees half a file."""
    _make_folder(path.parent)
    try:
        with replacing(path) as file:
            np.savez(file, **arrays)  # type: ignore[arg-type]
    except InputError as error:
        raise OutputError(str(error)) from error


def write_json(path: Path, content: Any) -> None:
    """All at once, so that a file that is there is complete."""
    _make_folder(path.parent)
    with replacing(path) as file:
        file.write((json.dumps(content, indent=1) + "\n").encode())


def read_json(path: Path) -> Any:
    """The content of a file of results.

    Raises:
        InputError: where it cannot be read.
    """
    try:
        return json.loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}; make it readable.") from error
    except ValueError as error:
        raise InputError(f"{path} is damaged ({error}); delete it and run again.") from error


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"Cannot make the folder {folder}: {error.strerror}; choose another place."
        ) from error
