"""Cases times methods: predict, save, score. A run that was stopped goes on where it was.

Rows of scores are made from what is saved, so that to score again needs no method to run again.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, Literal, Protocol, TypeVar, runtime_checkable

from jaxtyping import Float
from torch import Tensor

from gscompleter.config.generators import GeneratorSettings
from gscompleter.errors import InputError
from gscompleter.generators import Generator, load_generator
from gscompleter.io.image import write_image
from gscompleter.metrics.scores import Truth, ranged_truth, score
from gscompleter.progress import shown_on, track
from gscompleter.reconstructors import Reconstructor, load_reconstructor
from gscompleter.render import load_renderer
from gscompleter.runs.memory import peak_memory
from gscompleter.runs.methods import (
    METHODS,
    Parts,
    Start,
    check_methods,
    start_of,
)
from gscompleter.runs.store import (
    RUN,
    OutputError,
    Saved,
    case_folder,
    keep_outcome,
    load_outcome,
    load_start,
    read_json,
    save_start,
    slug,
    write_json,
)
from gscompleter.types import View

T = TypeVar("T")
C = TypeVar("C", bound="Named")

VERSION = 2
"""Of the files in a folder of results."""


@runtime_checkable
class Named(Protocol):
    """Anything that a method is run on and that has a place in the folder of results."""

    @property
    def name(self) -> str: ...


@runtime_checkable
class EvaluationCase(Named, Protocol):
    """A completion task: of a `cases.json`, or chosen by a protocol in a clip."""

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
    weights: str | None = None
    """The file of the reconstructor's weights; None takes the published ones."""
    generator: str = "warp-inpaint"
    generator_settings: GeneratorSettings | None = None
    """What the generator is told; None leaves all as it is."""
    device: Literal["cpu", "cuda"] = "cpu"
    seed: int = 0
    """Of everything random."""
    baseline_iterations: int | None = None
    """Most iterations of the baselines; their own numbers if None."""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Where the cases come from, so that no folder mixes two sources."""

    def load_reconstructor(self) -> Reconstructor:
        """Ψ. One with weights is kept from one case to the next."""
        weights = None if self.weights is None else Path(self.weights)
        return load_reconstructor(self.reconstructor, weights, self.device)

    def load_generator(self, targets: Sequence[View] = ()) -> Generator:
        """Φ. One with weights is kept from one case to the next."""
        return load_generator(
            self.generator, self.seed, targets, self.device, self.generator_settings
        )

    def parts(self, *targets: View) -> Parts:
        """The models for a case. Only the generator `oracle` looks at the images of `targets`."""
        return Parts(
            self.load_reconstructor(),
            self.load_generator(targets),
            load_renderer(self.device),
            self.seed,
            self.baseline_iterations,
        )


Again = Literal["nothing", "failures", "scores"]
"""What an earlier call did that is to be done once more: cases that failed, or all scores, from
what is saved."""


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
    again: Again = "nothing",
) -> Tally:
    """Run every method on every case of the shard, and write a row of scores for each.

    What is there already stays. A case that fails gives rows that say why, and the others go on.

    Args:
        cases: The cases of all shards.
        methods: Names of methods.
        out: Folder of results: a new one, or that of an earlier call.
        config: What decides the numbers; the same as in earlier calls.
        shard: (i, n) takes the cases i, i + n, i + 2n, …; n calls with i from 0 do them all.
        again: What of an earlier call is done once more.

    Raises:
        InputError: a wrong name or shard, a folder that holds something else, a full disk.
    """
    begin(cases, methods, out, config, shard)
    return make_rows(
        cases[shard[0] :: shard[1]],
        methods,
        partial(row_path, out),
        lambda case: Bench(case, out, config).row,
        again,
    )


def begin(
    cases: Sequence[Named],
    methods: Sequence[str],
    out: Path,
    config: RunConfig,
    shard: tuple[int, int],
) -> None:
    """See that a run is possible, and make `out` its folder.

    Raises:
        InputError: a wrong name or shard, a folder that holds something else, a full disk.
    """
    check_methods(methods)
    check_shard(shard)
    check_cases(cases)
    config.load_reconstructor()
    config.load_generator()
    claim(out, config)


def make_rows(
    cases: Sequence[C],
    methods: Sequence[str],
    path_of: Callable[[C, str], Path],
    rows_of: Callable[[C], Callable[[str], dict[str, Any]]],
    again: Again,
) -> Tally:
    """Write the rows that are missing, case by case.

    Args:
        cases: What the methods are run on.
        methods: Names of methods.
        path_of: Where the row of a case and a method lies.
        rows_of: Of a case, what makes the row of a method; it is asked for once per case.
        again: What of an earlier call is done once more.
    """
    jobs = [(case, name) for case in cases for name in methods]
    missing = [job for job in jobs if is_missing(path_of(*job), again)]
    failed, current, row_of = 0, None, None
    for case, name in track(missing, "Evaluating"):
        with shown_on(None):  # one bar is enough
            if row_of is None or current is not case:
                current, row_of = case, rows_of(case)
            row = row_of(name)
        write_json(path_of(case, name), row)
        failed += row["error"] is not None
    return Tally(len(missing) - failed, failed, len(jobs) - len(missing))


def is_missing(path: Path, again: Again) -> bool:
    """Whether a row is to be made."""
    if again == "scores" or not path.exists():
        return True
    return again == "failures" and read_json(path).get("error") is not None


class Bench:
    """One case: its photographs and its context are read, or computed, once."""

    def __init__(self, case: EvaluationCase, out: Path, config: RunConfig) -> None:
        self.case = case
        self.folder = case_folder(out, case.name)
        self.config = config
        self._ready: tuple[Start, Parts, Truth] | str | None = None

    def row(self, method: str) -> dict[str, Any]:
        """The scores of a method, or why there are none.

        Raises:
            OutputError: where a result cannot be written.
        """
        if self._ready is None:
            self._ready = attempt(self._prepare)
        if isinstance(self._ready, str):
            return self._row_of(method, error=self._ready)
        start, parts, truth = self._ready
        path = self.folder / f"{slug(method)}.npz"
        saved = load_outcome(path, start)
        if saved is None:
            made = attempt(lambda: measured(method, start, parts))
            if isinstance(made, str):
                return self._row_of(method, error=made)
            saved = keep_outcome(path, made, start)
        row = attempt(lambda: self._scored(method, saved, start, parts, truth))
        return self._row_of(method, error=row) if isinstance(row, str) else row

    def _prepare(self) -> tuple[Start, Parts, Truth]:
        case, device = self.case, self.config.device
        views = [view.to(device) for view in case.load(case.context)]
        (target,) = (view.to(device) for view in case.load((case.target,)))
        neighbours = [view.to(device) for view in case.load(case.neighbours)]
        parts = self.config.parts(target)
        start = start_at(self.folder / "start.npz", views, target, parts)
        camera = start.target
        truth = ranged_truth(start.views, target, neighbours, camera.near, camera.far)
        return start, parts, truth

    def _scored(
        self, method: str, saved: Saved, start: Start, parts: Parts, truth: Truth
    ) -> dict[str, Any]:
        outcome = saved.outcome
        scores, seen = score(outcome, truth, parts.renderer)
        content = asdict(scores)
        json.dumps(content, allow_nan=False)
        for name, image in (
            (slug(method), seen.after.image),
            ("before", seen.before.image),
            ("truth", truth.target.image),
        ):
            save_image(self.folder / f"{name}.png", image)
        return self._row_of(
            method,
            scores=content,
            gaussians={"context": len(outcome.context), "after": len(outcome.scene)},
            notes=list(outcome.notes),
            seconds={"reconstruct": start.seconds, **outcome.seconds},
            peak_bytes=saved.peak_bytes,
        )

    def _row_of(self, method: str, error: str | None = None, **content: Any) -> dict[str, Any]:
        nothing = dict.fromkeys(("scores", "gaussians", "notes", "seconds", "peak_bytes"))
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
            **nothing,
            **content,
        }


def start_at(path: Path, views: Sequence[View], target: View, parts: Parts) -> Start:
    """The context that is saved at `path`, where it is computed and saved first if it is not there.

    It is read back in any case, so that a run that was stopped goes on with the very same tensors.
    """
    start = load_start(path, views, target)
    if start is None:
        save_start(path, start_of(views, target.camera, parts))
        start = load_start(path, views, target)
    if start is None:
        raise OutputError(f"{path} cannot be read back; look whether the disk is sound.")
    return start


def measured(method: str, start: Start, parts: Parts) -> Saved:
    """What a method makes of a case, and the most memory that this took."""
    with peak_memory(start.context.means.device) as peak:
        outcome = METHODS[method](start, parts)
    return Saved(outcome, peak.bytes)


def row_path(out: Path, case: EvaluationCase, method: str) -> Path:
    """Where the row of scores of a case and a method lies."""
    return case_folder(out, case.name) / f"{slug(method)}.json"


def save_image(path: Path, image: Float[Tensor, "h w 3"]) -> None:
    """A picture among the results.

    Raises:
        OutputError: where it cannot be written.
    """
    try:
        write_image(path, image)
    except InputError as error:
        raise OutputError(str(error)) from error


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


def check_shard(shard: tuple[int, int]) -> None:
    """Refuse shards that do not exist."""
    number, count = shard
    if not 0 <= number < count:
        raise InputError(
            f"There is no shard {number}/{count}; of n shards the first is 0/n, the last (n-1)/n."
        )


def check_cases(cases: Sequence[Named]) -> None:
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


def deciding(config: RunConfig) -> dict[str, Any]:
    """All that decides the numbers, by the names of the command line.

    Where the parts of a generator wait is not among it.
    """
    values = asdict(config)
    settings = values.pop("generator_settings") or {}
    settings.pop("offload", None)
    return {**values, **{f"generator_{name}": value for name, value in settings.items()}}


def claim(out: Path, config: RunConfig) -> None:
    """Make `out` the folder of this run, or see that it is.

    Raises:
        InputError: where it holds something else, or a run with other settings.
    """
    wanted = json.loads(json.dumps({"version": VERSION, **deciding(config)}))
    path = out / RUN
    if path.exists():
        found = read_json(path, "name another folder")
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
