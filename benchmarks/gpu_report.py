"""Measurements in processes of their own: what fails or takes too long is a row, the rest goes on.

A script hands its parts to `main`. A person calls it once, and it calls itself once for each part.
Rows are written to a file as they come, so that a part that is stopped keeps what it had.
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
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import tyro

MEASURE = "measure-part"
"""First argument of the process that measures one part; its name and a file for rows follow."""

EXCEPTION = re.compile(r"[\w.]+(Error|Exception|Exit)\b")
"""Begins the line of a traceback that names its reason."""


@dataclass(frozen=True)
class Row:
    """One measurement, or why there is none."""

    what: str
    value: float | None = None
    """None where it failed, or where the note says it all."""
    unit: str = ""
    note: str = ""
    failed: bool = False

    def shown(self) -> str:
        """The result as a person reads it."""
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
    """Runs in a process of its own."""
    needs: str | None = None
    """Name of the part without which this one is pointless."""


@dataclass(frozen=True)
class Found:
    """What became of a part."""

    title: str
    seconds: float
    rows: tuple[Row, ...]

    @property
    def failed(self) -> bool:
        return any(row.failed for row in self.rows)


@dataclass(frozen=True)
class Options:
    seconds: float = 480.0
    """For all parts together."""
    out: Path = Path("docs")
    """Folder of gpu.md and gpu.json."""
    only: tuple[str, ...] = ()
    """Names of parts; all if none is given."""


def main(parts: Mapping[str, Part], machine: Callable[[], dict[str, str]], about: str) -> None:
    """The command line of a script with `parts`; `machine` refuses where they cannot be measured.

    Args:
        parts: By name, in their order.
        machine: What the numbers hold for; raises SystemExit on a machine without a GPU.
        about: The script's help.
    """
    if sys.argv[1:2] == [MEASURE]:
        name, path = sys.argv[2:]
        append(Path(path), parts[name].rows())
        return
    options = tyro.cli(Options, description=about)
    unknown = [name for name in options.only if name not in parts]
    if unknown:
        raise SystemExit(f"There is no part {unknown[0]!r}; choose of {', '.join(parts)}.")
    described = machine()
    wanted = {name: p for name, p in parts.items() if not options.only or name in options.only}
    found = measured(wanted, Path(sys.argv[0]), options.seconds)
    write(options.out, described, found)
    if any(part.failed for part in found.values()):
        raise SystemExit(1)


def append(path: Path, rows: Iterable[Row]) -> None:
    """Write rows as they come, a line each."""
    with path.open("a") as file:
        for row in rows:
            file.write(json.dumps(asdict(row)) + "\n")
            file.flush()


def tried(what: str, compute: Callable[[], Iterable[Row]]) -> Iterator[Row]:
    """The rows of one of several alike: where it fails, the others of the part go on."""
    try:
        yield from compute()
    except Exception as error:
        yield Row(what, note=f"{type(error).__name__}: {shortened(str(error))}", failed=True)


def measured(parts: Mapping[str, Part], script: Path, seconds: float) -> dict[str, Found]:
    """Run the parts one after the other, all of them within `seconds`."""
    end = time.monotonic() + seconds
    found: dict[str, Found] = {}
    for name, part in parts.items():
        needed = None if part.needs is None else found.get(part.needs)
        left = min(part.limit, end - time.monotonic())
        if needed is not None and needed.failed:
            reason = f"left out, for '{needed.title}' failed"
        elif left <= 0:
            reason = f"left out, for the {seconds:.0f} s of all parts were over"
        else:
            found[name] = in_process(name, part, script, left)
            continue
        found[name] = Found(part.title, 0.0, (Row(part.title, note=reason, failed=True),))
    return found


def in_process(name: str, part: Part, script: Path, limit: float) -> Found:
    """The rows of a part, and one more that says why where it did not come to its end."""
    print(f"{part.title} ...", flush=True)
    start = time.monotonic()
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rows.jsonl"
        path.touch()
        command = [sys.executable, str(script), MEASURE, name, str(path)]
        reason = reason_of(command, limit)
        rows = [Row(**json.loads(line)) for line in path.read_text().splitlines()]
    if reason is not None:
        rows.append(Row(part.title, note=reason, failed=True))
    return Found(part.title, time.monotonic() - start, tuple(rows))


def reason_of(command: list[str], limit: float) -> str | None:
    """Run a command, and all that it starts, for at most `limit` seconds; why it failed, if so."""
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
    # A compiler's log may follow the line that says what failed.
    told = [line for line in lines if EXCEPTION.match(line)]
    return shortened((told or lines)[-1])


def shortened(text: str, most: int = 200) -> str:
    """One line of at most `most` characters, without what would break a table."""
    line = " ".join(text.split()).replace("|", "/")
    return line if len(line) <= most else line[: most - 1] + "…"


def write(folder: Path, machine: Mapping[str, str], found: Mapping[str, Found]) -> None:
    """gpu.md to read and gpu.json to compute with."""
    content = {"machine": machine, "parts": {name: asdict(part) for name, part in found.items()}}
    (folder / "gpu.json").write_text(json.dumps(content, indent=2) + "\n")
    (folder / "gpu.md").write_text(page(machine, found))


def page(machine: Mapping[str, str], found: Mapping[str, Found]) -> str:
    """All rows as tables."""
    lines = ["# On a GPU", "", "Written by `make gpu`; [gpu.json](gpu.json) holds the same.", ""]
    lines += ["| | |", "|---|---|", *(f"| {key} | {value} |" for key, value in machine.items())]
    for part in found.values():
        lines += ["", f"## {part.title} ({part.seconds:.0f} s)", "", "| | |", "|---|---|"]
        lines += [f"| {row.what} | {row.shown()} |" for row in part.rows]
    return "\n".join(lines) + "\n"
