"""Tables from the rows of a run: scores in one set of files, timings in another.

The tables of scores depend on nothing but scores, so that a run that was stopped and went on gives
the same bytes as one that was not.
"""

from __future__ import annotations

import json
import statistics
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from gscompleter.completer import STAGES
from gscompleter.errors import InputError
from gscompleter.io.files import replacing
from gscompleter.io.image import read_image
from gscompleter.metrics.fid import fid
from gscompleter.runs.methods import METHODS
from gscompleter.runs.store import CASES, RUN, case_folder, read_json, slug

Row = dict[str, Any]
"""What `evaluate` writes for a case and a method."""

Scores = dict[str, Any]
"""The scores of a row: `scores.Scores` as JSON."""


@dataclass(frozen=True)
class Column:
    """A score, as a table shows it."""

    key: str
    title: str
    digits: int
    of: Callable[[Scores], float | None]
    """Takes the scores of a row. None where no truth exists."""
    over: Literal["mean", "lowest"] = "mean"
    """What is made of the cases."""


def _target(key: str) -> Callable[[Scores], float | None]:
    return lambda scores: scores["target_after"][key]


def _gain(scores: Scores) -> float:
    return scores["target_after"]["psnr"] - scores["target_before"]["psnr"]


def _after(key: str) -> Callable[[Scores], float | None]:
    return lambda scores: None if scores[key] is None else scores[key]["after"]


def _change(key: str) -> Callable[[Scores], float | None]:
    return lambda scores: (
        None if scores[key] is None else scores[key]["after"] - scores[key]["before"]
    )


def _worst_view(scores: Scores) -> float:
    return min(view["after"] - view["before"] for view in scores["context_psnr"])


def _views(key: str) -> Callable[[Scores], float]:
    return lambda scores: statistics.fmean(view["after"] for view in scores[key])


def _score(key: str) -> Callable[[Scores], float | None]:
    return lambda scores: scores[key]


IMAGES = (
    Column("psnr", "PSNR", 2, _target("psnr")),
    Column("gain", "gain", 2, _gain),
    Column("lowest_gain", "lowest gain", 2, _gain, "lowest"),
    Column("ssim", "SSIM", 3, _target("ssim")),
    Column("lpips_vgg", "LPIPS (VGG)", 3, _target("lpips_vgg")),
    Column("lpips_alex", "LPIPS (Alex)", 3, _target("lpips_alex")),
    Column("hole_psnr", "in holes", 2, _score("hole_psnr")),
    Column("observed_psnr", "outside", 2, _after("observed_psnr")),
    Column("neighbours", "beside", 2, _after("neighbours_psnr")),
    Column("neighbours_gain", "gain beside", 2, _change("neighbours_psnr")),
    Column("context", "context", 2, _views("context_psnr")),
    Column("context_ssim", "SSIM of context", 3, _views("context_ssim")),
    Column("context_change", "worst context change", 2, _worst_view, "lowest"),
)
"""PSNR in dB: at the target; there in and outside of the holes of the context; beside the target;
at the context views. The worst change is that of the context view that lost most."""

GEOMETRY = (
    Column("depth_observed", "AbsRel observed", 3, _score("depth_observed")),
    Column("depth_hole", "AbsRel in holes", 3, _score("depth_hole")),
    Column("depth_rim", "step at rim", 4, _score("depth_rim")),
    Column("align_abs_rel", "AbsRel to context", 4, _score("align_abs_rel")),
    Column("align_chamfer", "Chamfer to context", 4, _score("align_chamfer")),
    Column("align_f_score", "F-score to context", 3, _score("align_f_score")),
)
"""Against true depth where it is known, and of what was added against the context. All lengths are
shares of the depth."""

COLUMNS = IMAGES + GEOMETRY

LPIPS_MISSING = (
    "LPIPS: weights not available. `gscompleter.metrics.lpips.load_lpips()` fetches them; then "
    "`gscompleter evaluate` with `--again scores` adds the column.\n"
)


@dataclass(frozen=True)
class Cell:
    """A mean (or the lowest value) over the cases that have the score."""

    value: float | None
    count: int


@dataclass(frozen=True)
class Summary:
    """All that the tables show."""

    methods: tuple[str, ...]
    cases: int
    """How many cases there are rows of."""
    common: tuple[str, ...]
    """Names of the cases that all methods finished."""
    rows: dict[str, tuple[Row, ...]]
    """By method, its rows of these cases, in their order."""
    cells: dict[str, dict[str, Cell]]
    """By method and column."""
    gains: dict[int, dict[str, Cell]]
    """By distance to the context in frames, and by method: the mean gain in dB."""
    finished: dict[str, int]
    """By method, the cases it finished."""
    failures: tuple[tuple[str, str, str], ...]
    """Case, method, reason."""


@dataclass(frozen=True)
class Fid:
    """Fréchet inception distance of each method's pictures, or the reason why there is none."""

    values: dict[str, float]
    reason: str | None = None


def tables(out: Path, with_fid: bool = False) -> Summary:
    """Read all rows below `out` and write tables.md, .tex and .json, and timings.md and .json.

    Args:
        out: Folder of results.
        with_fid: Compare the pictures of each method with the photographs by FID, too.

    Raises:
        InputError: where `out` is no folder of results, or has no rows or a damaged one.
    """
    summary = summarize(read_rows(out))
    asked = Fid({}, "not asked for; `gscompleter tables OUT --fid` adds it")
    fids = fid_of(out, summary) if with_fid else asked
    texts = {
        "tables.md": score_markdown(summary, fids),
        "tables.tex": score_latex(summary),
        "tables.json": score_json(summary, fids),
        "timings.md": timing_markdown(summary),
        "timings.json": timing_json(summary),
    }
    for name, text in texts.items():
        with replacing(out / name) as file:
            file.write(text.encode())
    return summary


def read_rows(out: Path) -> list[Row]:
    """The rows of a run, in the order of cases and methods.

    Raises:
        InputError: where there are none, or one is damaged.
    """
    if not (out / RUN).is_file():
        raise InputError(f"{out} holds no run; name a folder that `evaluate` wrote.")
    paths = sorted((out / CASES).glob("*/*.json"))
    if not paths:
        raise InputError(f"The run in {out} has no rows yet; let `evaluate` finish a case first.")
    rows = []
    for path in paths:
        row = read_json(path)
        try:
            row["case"]["name"], row["method"], row["error"], row["scores"], row["seconds"]
        except (KeyError, TypeError) as error:
            raise InputError(f"{path} is no row of scores; delete it and run again.") from error
        rows.append(row)
    return sorted(rows, key=lambda row: (row["case"]["name"], *place_of(row["method"])))


def fid_of(out: Path, summary: Summary) -> Fid:
    """FID between what each method shows at the targets and the photographs."""
    folders = [case_folder(out, name) for name in summary.common]
    try:
        truths = [read_image(folder / "truth.png") for folder in folders]
        values = {
            method: fid([read_image(folder / f"{slug(method)}.png") for folder in folders], truths)
            for method in summary.methods
        }
    except InputError as error:
        return Fid({}, f"not available ({error})")
    return Fid(values)


def place_of(method: str) -> tuple[int, str]:
    """What sorts methods into the order of the tables."""
    order = list(METHODS)
    return (order.index(method) if method in order else len(order), method)


def summarize(rows: Sequence[Row]) -> Summary:
    """Means over the cases that all methods finished, so that they compare the same cases."""
    methods = tuple(sorted({row["method"] for row in rows}, key=place_of))
    done: dict[str, dict[str, Row]] = {name: {} for name in methods}
    for row in rows:
        if row["error"] is None:
            done[row["method"]][row["case"]["name"]] = row
    cases = sorted({row["case"]["name"] for row in rows})
    common = tuple(name for name in cases if all(name in done[method] for method in methods))
    chosen = {method: tuple(done[method][name] for name in common) for method in methods}
    return Summary(
        methods,
        len(cases),
        common,
        chosen,
        {m: {c.key: cell_of(chosen[m], c) for c in COLUMNS} for m in methods},
        gains_by_gap(chosen),
        {method: len(done[method]) for method in methods},
        tuple((r["case"]["name"], r["method"], r["error"]) for r in rows if r["error"] is not None),
    )


def cell_of(rows: Iterable[Row], column: Column) -> Cell:
    """The mean (or the lowest value) of a column over the rows that have it."""
    values = [value for row in rows if (value := column.of(row["scores"])) is not None]
    if not values:
        return Cell(None, 0)
    return Cell(min(values) if column.over == "lowest" else statistics.fmean(values), len(values))


def gap_of(row: Row) -> int:
    """Frames from the target to the nearest context frame: k of the protocol n-k."""
    return min(abs(row["case"]["target"] - frame) for frame in row["case"]["context"])


def gains_by_gap(rows: dict[str, tuple[Row, ...]]) -> dict[int, dict[str, Cell]]:
    """The mean gain of each method at each distance from the context."""
    gain = next(column for column in COLUMNS if column.key == "gain")
    gaps = sorted({gap_of(row) for chosen in rows.values() for row in chosen})
    return {
        gap: {
            method: cell_of((row for row in chosen if gap_of(row) == gap), gain)
            for method, chosen in rows.items()
        }
        for gap in gaps
    }


def shown(cell: Cell, digits: int, cases: int) -> str:
    """The number, and of how many cases it is where that is not all of them."""
    if cell.value is None:
        return "–"
    number = f"{cell.value:.{digits}f}"
    return number if cell.count == cases else f"{number} ({cell.count})"


def present(summary: Summary, columns: Sequence[Column]) -> list[Column]:
    """The columns that any method has a value in."""
    return [
        c
        for c in columns
        if any(summary.cells[method][c.key].value is not None for method in summary.methods)
    ]


def score_cells(summary: Summary, columns: Sequence[Column]) -> list[list[str]]:
    """A table of scores as text, a row per method."""
    n = len(summary.common)
    return [
        [method, *(shown(summary.cells[method][c.key], c.digits, n) for c in columns)]
        for method in summary.methods
    ]


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table, its first column to the left and the others to the right."""
    lines = [head, ["---", *["---:"] * (len(head) - 1)], *rows]
    return "".join("| " + " | ".join(line) + " |\n" for line in lines)


def score_markdown(summary: Summary, fids: Fid) -> str:
    """Scores, what they are over, and what failed."""
    parts = [
        f"Over the {len(summary.common)} of {summary.cases} cases that all methods finished. A "
        "number in brackets is how many of them have the score, where not all have it.\n"
    ]
    for title, columns in (("Images", present(summary, IMAGES)), ("Geometry", GEOMETRY)):
        chosen = present(summary, columns)
        if chosen:
            head = ["method", *(column.title for column in chosen)]
            parts.append(f"### {title}\n\n" + markdown(head, score_cells(summary, chosen)))
    if not any(column.key.startswith("lpips") for column in present(summary, IMAGES)):
        parts.append(LPIPS_MISSING)
    parts.append(fid_markdown(summary, fids))
    if len(summary.gains) > 1:
        parts.append(gain_markdown(summary))
    if summary.failures:
        rows = [[cell.replace("|", "\\|") for cell in failure] for failure in summary.failures]
        parts.append("### Failed\n\n" + markdown(["case", "method", "reason"], rows))
    return "\n".join(parts)


def fid_markdown(summary: Summary, fids: Fid) -> str:
    """FID of each method, or the reason why there is none."""
    if fids.reason is not None:
        return f"FID: {fids.reason}.\n"
    rows = [[method, f"{value:.2f}"] for method, value in fids.values.items()]
    return (
        f"### FID\n\nOf {len(summary.common)} pictures against as many photographs; biased for "
        "few pictures.\n\n" + markdown(["method", "FID"], rows)
    )


def gain_markdown(summary: Summary) -> str:
    """The gain against the distance from the context."""
    counts = {gap: max(c.count for c in cells.values()) for gap, cells in summary.gains.items()}
    head = ["method", *(f"{gap} ({counts[gap]})" for gap in summary.gains)]
    rows = [
        [method, *(shown(cells[method], 2, counts[gap]) for gap, cells in summary.gains.items())]
        for method in summary.methods
    ]
    return (
        "### Gain by distance\n\nMean gain in dB by the frames between the target and the nearest "
        "context frame (k of n-k), and how many cases that is.\n\n" + markdown(head, rows)
    )


def score_latex(summary: Summary) -> str:
    """The tables of scores for LaTeX with booktabs."""
    blocks = [f"% Over the {len(summary.common)} of {summary.cases} cases that all finished."]
    for columns in (present(summary, IMAGES), present(summary, GEOMETRY)):
        if columns:
            blocks.append(_tabular(summary, columns))
    return "\n".join(blocks) + "\n"


def _tabular(summary: Summary, columns: Sequence[Column]) -> str:
    lines = [
        rf"\begin{{tabular}}{{l{'r' * len(columns)}}}",
        r"\toprule",
        " & ".join(["method", *(column.title for column in columns)]) + r" \\",
        r"\midrule",
    ]
    for row in score_cells(summary, columns):
        lines.append(" & ".join(row).replace("_", r"\_").replace("–", "--") + r" \\")
    return "\n".join([*lines, r"\bottomrule", r"\end{tabular}"])


def score_json(summary: Summary, fids: Fid) -> str:
    """The same with all digits."""
    methods = {
        method: {
            "finished": summary.finished[method],
            **{
                key: {"value": cell.value, "cases": cell.count}
                for key, cell in summary.cells[method].items()
            },
        }
        for method in summary.methods
    }
    gains = {
        str(gap): {method: cell.value for method, cell in cells.items()}
        for gap, cells in summary.gains.items()
    }
    failures = [
        {"case": case, "method": method, "reason": reason}
        for case, method, reason in summary.failures
    ]
    content = {
        "cases": summary.cases,
        "common": list(summary.common),
        "methods": methods,
        "gain_by_distance": gains,
        "fid": {"values": fids.values, "reason": fids.reason},
        "failures": failures,
    }
    return json.dumps(content, indent=1) + "\n"


def seconds_of(summary: Summary) -> dict[str, dict[str, float]]:
    """By method and stage, the median wall time over the cases.

    `reconstruct` is Ψ of the photographs, which is done once for all methods; `total` is without.
    """
    found = {}
    for method, rows in summary.rows.items():
        stages = sorted({s for row in rows for s in row["seconds"]}, key=stage_place)
        found[method] = {
            stage: statistics.median(row["seconds"].get(stage, 0.0) for row in rows)
            for stage in stages
        }
    return found


def stage_place(stage: str) -> tuple[int, str]:
    """What sorts stages into the order in which they run."""
    order = ["reconstruct", *STAGES, "optimize"]
    return (order.index(stage) if stage in order else len(order), stage)


def peak_of(summary: Summary) -> dict[str, int | None]:
    """By method, the most memory in bytes that any case took; None where no system told."""
    found = {}
    for method, rows in summary.rows.items():
        known = [row["peak_bytes"] for row in rows if row["peak_bytes"] is not None]
        found[method] = max(known, default=None)
    return found


def timing_markdown(summary: Summary) -> str:
    """Median seconds per case by stage, and the most memory."""
    seconds, peak = seconds_of(summary), peak_of(summary)
    stages = sorted({s for of_method in seconds.values() for s in of_method}, key=stage_place)

    def cell(value: float | None) -> str:
        return "–" if value is None else f"{value:.2f}"

    rows = [
        [
            method,
            *(cell(seconds[method].get(stage)) for stage in stages),
            "–" if peak[method] is None else f"{(peak[method] or 0) / 2**30:.2f}",
        ]
        for method in summary.methods
    ]
    return (
        f"Median seconds over the {len(summary.common)} cases that all methods finished, and the "
        "most memory (GiB) of any. The total is without the reconstruction of the context, which "
        "is done once for all methods.\n\n" + markdown(["method", *stages, "memory"], rows)
    )


def timing_json(summary: Summary) -> str:
    """The same with all digits."""
    seconds, peak = seconds_of(summary), peak_of(summary)
    content = {
        method: {"seconds": seconds[method], "peak_bytes": peak[method]}
        for method in summary.methods
    }
    return json.dumps(content, indent=1) + "\n"
