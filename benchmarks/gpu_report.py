"""Measurements in separate processes: a failure or timeout is a row, and the rest continues.

Rows are written at once, so that a part that is stopped keeps what it measured. The report is
written after each part, so that a run that is stopped keeps its parts.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import date
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro

MEASURE = "measure-part"
"""First argument of the process of one part, followed by its name and a file for rows."""

EXCEPTION = re.compile(r"[\w.]+(Error|Exception|Exit)\b")
"""Start of the line of a traceback that names the error."""


@dataclass(frozen=True)
class Row:
    """One measurement, or the reason of a failure."""

    what: str
    value: float | None = None
    """None if it failed or if the note is the result."""
    unit: str = ""
    note: str = ""
    failed: bool = False

    def format(self) -> str:
        number = "" if self.value is None else f"{self.value:.4g} {self.unit}".strip()
        text = "; ".join(part for part in (number, self.note) if part)
        return f"**failed**: {text}" if self.failed else text


@dataclass(frozen=True)
class Part:
    """Measurements that share a process."""

    title: str
    limit: float
    """Seconds after which it is stopped."""
    rows: Callable[[], Iterable[Row]]
    """Function that measures, called in the process."""
    needs: str | None = None
    """Name of a part that has to succeed first."""


@dataclass(frozen=True)
class PartResult:
    title: str
    seconds: float
    rows: tuple[Row, ...]
    date: str = field(default_factory=lambda: date.today().isoformat())
    commit: str = field(default_factory=lambda: name_commit())
    """Commit of the code that was measured."""

    @property
    def failed(self) -> bool:
        return any(row.failed for row in self.rows)


def name_commit() -> str:
    """Name the commit of the code; a copy of a checkout has none."""
    from gscompleter.evaluation.measured_code import find_commit  # imports torch

    return find_commit() or "unknown"


@dataclass(frozen=True)
class Options:
    seconds: float = 480.0
    """Time limit of all parts together."""
    out: Path = Path("docs")
    """Folder of gpu.md and gpu.json."""
    only: tuple[str, ...] = ()
    """Names of parts; default: all."""
    earlier: Path | None = None
    """A gpu.json of the same machine: parts that are not measured now are taken from it, so that
    several short runs make one report."""
    patience: float = 1.0
    """Factor of the time limit of each part, for a device that is slow."""


def main(parts: Mapping[str, Part], machine: Callable[[], dict[str, str]], about: str) -> None:
    """Run the command line of a script with `parts`.

    Args:
        parts: Parts by name, in order.
        machine: Describes the machine; raises SystemExit without a GPU.
        about: Help text of the script.
    """
    if sys.argv[1:2] == [MEASURE]:
        name, path = sys.argv[2:]
        append(Path(path), parts[name].rows())
        return
    options = tyro.cli(Options, description=about)
    unknown = [name for name in options.only if name not in parts]
    if unknown:
        raise SystemExit(f"There is no part {unknown[0]!r}; choose one of {', '.join(parts)}.")
    described = machine()
    results = read_earlier(options.earlier, described)
    wanted = {name: p for name, p in parts.items() if not options.only or name in options.only}
    patient = {
        name: replace(part, limit=options.patience * part.limit) for name, part in wanted.items()
    }
    for name, result in measure_parts(patient, Path(sys.argv[0]), options.seconds):
        results[name] = result
        ordered = {name: results[name] for name in parts if name in results}
        write_report(options.out, described, ordered)
    if any(results[name].failed for name in wanted):
        raise SystemExit(1)


def read_earlier(path: Path | None, machine: Mapping[str, str]) -> dict[str, PartResult]:
    """Read the parts of an earlier report; exit if it is of another machine."""
    if path is None:
        return {}
    content = json.loads(path.read_text())
    differing = [
        name for name in machine if name != "date" and content["machine"].get(name) != machine[name]
    ]
    if differing:
        raise SystemExit(f"{path} is of another machine: its {differing[0]} differs; leave it out.")
    return {
        name: PartResult(
            part["title"],
            part["seconds"],
            tuple(Row(**row) for row in part["rows"]),
            part["date"],
            part["commit"],
        )
        for name, part in content["parts"].items()
    }


def append(path: Path, rows: Iterable[Row]) -> None:
    with path.open("a") as file:
        for row in rows:
            file.write(json.dumps(asdict(row)) + "\n")
            file.flush()


def try_rows(what: str, compute: Callable[[], Iterable[Row]]) -> Iterator[Row]:
    """Yield rows, or a failed row if they raise, so that the other rows continue."""
    try:
        yield from compute()
    except Exception as error:
        yield Row(what, note=f"{type(error).__name__}: {shorten(str(error))}", failed=True)


def measure_parts(
    parts: Mapping[str, Part], script: Path, seconds: float
) -> Iterator[tuple[str, PartResult]]:
    """Run the parts one after the other, within `seconds` in total, and yield each when it ends."""
    end = time.monotonic() + seconds
    failed = {}
    for name, part in parts.items():
        left = min(part.limit, end - time.monotonic())
        if part.needs is not None and failed.get(part.needs):
            reason = f"left out, because '{parts[part.needs].title}' failed"
        elif left <= 0:
            reason = f"left out, because the {seconds:.0f} s of all parts are over"
        else:
            result = measure_in_process(name, part, script, left)
            failed[name] = result.failed
            yield name, result
            continue
        failed[name] = True
        yield name, PartResult(part.title, 0.0, (Row(part.title, note=reason, failed=True),))


def measure_in_process(name: str, part: Part, script: Path, limit: float) -> PartResult:
    print(f"{part.title} ...", flush=True)
    start = time.monotonic()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rows.jsonl"
        path.touch()
        command = [sys.executable, str(script), MEASURE, name, str(path)]
        reason = run_limited(command, limit)
        rows = [Row(**json.loads(line)) for line in path.read_text().splitlines()]
    if reason is not None:
        rows.append(Row(part.title, note=reason, failed=True))
    return PartResult(part.title, time.monotonic() - start, tuple(rows))


def run_limited(command: list[str], limit: float) -> str | None:
    """Run a command for at most `limit` seconds, and return the reason if it fails."""
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.PIPE}
    process = subprocess.Popen(command, text=True, start_new_session=True, **quiet)
    try:
        _, errors = process.communicate(timeout=limit)
    except subprocess.TimeoutExpired:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()
        return f"stopped after {limit:.0f} s"
    if process.returncode == 0:
        return None
    lines = errors.strip().splitlines() or [f"exit code {process.returncode}, no message"]
    # A compiler's log may follow the line that names the error.
    named = [line for line in lines if EXCEPTION.match(line)]
    return shorten((named or lines)[-1])


def shorten(text: str, most: int = 200) -> str:
    """Shorten to one line of at most `most` characters, without table syntax."""
    line = " ".join(text.split()).replace("|", "/")
    return line if len(line) <= most else line[: most - 1] + "…"


def write_report(folder: Path, machine: Mapping[str, str], found: Mapping[str, PartResult]) -> None:
    content = {"machine": machine, "parts": {name: asdict(part) for name, part in found.items()}}
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in (
        ("gpu.json", json.dumps(content, indent=2) + "\n"),
        ("gpu.md", format_page(machine, found)),
    ):
        draft = folder / f".{name}.draft"
        draft.write_text(text)
        draft.replace(folder / name)


def format_page(machine: Mapping[str, str], found: Mapping[str, PartResult]) -> str:
    lines = [
        "# On a GPU",
        "",
        "Written by `make gpu`; [gpu.json](gpu.json) holds the same. Data are synthetic rooms and",
        "the weights of networks are random: times and agreement are measured here, not quality.",
        "",
    ]
    lines += ["| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in machine.items())]
    for part in found.values():
        lines += [
            "",
            f"## {part.title} ({part.date}, commit {part.commit}, {part.seconds:.0f} s)",
            "",
            "| | |",
            "|---|---|",
        ]
        lines += [f"| {row.what} | {row.format()} |" for row in part.rows]
    return "\n".join(lines) + "\n"
