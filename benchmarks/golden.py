"""Record what the commands give, and compare a later state of the code with it.

    python benchmarks/golden.py record [--only scenes|room|texts] [--data DIR] [--file FILE]
    python benchmarks/golden.py check  [--only scenes|room|texts] [--data DIR] [--file FILE]

`scenes` holds the SHA-256 of every .ply and the PSNR and SSIM of every view: the development cases
that are not kept apart, with the settings `default` and `paper`, a trained splat at seven targets,
and eight targets in sequence. `room` is the same for a synthetic room, which needs no data: the
tests check it everywhere. `texts` holds the help of every command, and exit code and sentence of
wrong input. Bytes are compared on the machine that recorded them (`machines`, which has one for
each of `scenes` and `room`); other machines round otherwise and compare scores. A method that gave
the recorded bytes of all scenes is listed by its digest (`methods`), so that figures measured with
another one of the list still hold (write_results.py).
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import platform
import re
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import torch

from apart import HELP, read_used_cases
from gscompleter.cli import COMMANDS
from gscompleter.evaluation.measured_code import compute_method_digest

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("GSCOMPLETER_DATA", ROOT.parent / "shared"))
DEVELOPMENT = ROOT / "benchmarks" / "development.json"
PROGRAM = (sys.executable, "-c", "from gscompleter.cli import run; run()")
MEAN_TOLERANCE, CASE_TOLERANCE = 0.02, 0.1
"""dB by which the mean PSNR, and the PSNR of one view, may fall on another machine."""
SECTIONS = ("scenes", "room", "texts")
PROCESSOR_NUMBERS = ("cpu family", "model", "stepping")
"""Numbers of a processor in /proc/cpuinfo that tell it from others of the same name."""
RUN_COMMENT = b"comment gscompleter-provenance/"


def main() -> None:
    """Record or check, as the command line asks; exit code 1 where something differs."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("action", choices=("record", "check"))
    parser.add_argument("--only", choices=SECTIONS)
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--apart", action="store_true", help=HELP)
    parser.add_argument("--file", type=Path, default=ROOT / "benchmarks" / "golden.json")
    options = parser.parse_args()
    sections = (options.only,) if options.only else SECTIONS
    if "scenes" in sections and not (options.data / "data").is_dir():
        parser.error(f"{options.data} has no folder data; name the data by GSCOMPLETER_DATA")
    known = json.loads(options.file.read_text()) if options.file.is_file() else {}
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        present = {
            "scenes": lambda: run_scenes(
                dict(list_runs(options.data, options.apart)), place / "scenes"
            ),
            "room": lambda: run_scenes(dict(list_room_runs(place)), place / "rooms"),
            "texts": run_texts,
        }
        found = {name: present[name]() for name in sections}
    # Texts are the same everywhere.
    found["machines"] = {name: describe_machine() for name in sections if name != "texts"}
    if options.action == "record":
        if "scenes" in found:
            found["methods"] = [compute_method_digest()]
        # What is not recorded now stays that of the machine that recorded it.
        found["machines"] = known.get("machines", {}) | found["machines"]
        write(options.file, known | found)
    elif differences := compare(known, found):
        sys.exit("\n".join([*differences, f"{len(differences)} differences"]))
    else:
        if "scenes" in found and is_same_machine(known, found, "scenes"):
            methods = dict.fromkeys([*known.get("methods", []), compute_method_digest()])
            write(options.file, known | {"methods": [*methods]})
        counts = [
            f"{len(found[name])} {name}"
            + ("" if is_same_machine(known, found, name) else " (by scores: another machine)")
            for name in sections
        ]
        print(f"equal: {', '.join(counts)}")


def write(path: Path, content: Mapping[str, Any]) -> None:
    """Write what was recorded."""
    path.write_text(json.dumps(content, indent=1, sort_keys=True, ensure_ascii=False) + "\n")


def describe_machine() -> dict[str, str]:
    """Describe what decides how numbers round: processor, vector instructions, libraries."""
    info = Path("/proc/cpuinfo")
    return {
        "processor": describe_processor(info.read_text() if info.is_file() else ""),
        "capability": torch.backends.cpu.get_cpu_capability(),
        "torch": torch.__version__,
    }


def describe_processor(info: str) -> str:
    """Describe the first processor of the text of /proc/cpuinfo; empty text for what Python says.

    The name alone does not tell one: virtual machines shorten it, so that several generations are
    an "AMD EPYC". Family, model and stepping are what libraries choose their kernels by.
    """
    first = info.partition("\n\n")[0]
    fields = dict(re.findall(r"^(.+?)\s*: (.+)$", first, re.M))
    if "model name" not in fields:
        return platform.processor()
    numbers = [f"{key} {fields[key]}" for key in PROCESSOR_NUMBERS if key in fields]
    return ", ".join([fields["model name"], *numbers])


def list_runs(data: Path, uses_apart: bool = False) -> Iterator[tuple[str, list[str]]]:
    """List the completions, by name, with their arguments."""
    os.environ["GSCOMPLETER_DATA"] = str(data)  # development.json names its scenes by it
    for case in read_used_cases(DEVELOPMENT, uses_apart):
        height, width = case.resolution
        context = [str(frame) for frame in case.context]
        given = [str(case.scene), "--context", *context, "--resolution", str(height), str(width)]
        given += ["--near", str(case.near), "--far", str(case.far)]
        for config in ("default", "paper"):
            name = f"{case.scene.name} {'+'.join(context)} to {case.target}, {config}"
            yield name, [*given, "--target", str(case.target), "--config", config]
    splat = data / "splats" / "fox"
    unseen = [str(frame) for frame in (27, 29, 31, 33, 35, 37, 39)]
    given = [str(splat), "--scene", str(splat / "splat.ply"), "--resolution", "320"]
    yield "fox splat, 7 targets", [*given, "--target", *unseen]
    scene = str(data / "data" / "re10k_0d4de33c")
    given = [scene, "--context", "0", "4", "--resolution", "256", "256", "--near", "1"]
    frames = [str(frame) for frame in range(8, 24, 2)]
    yield "re10k_0d4de33c, 8 targets", [*given, "--far", "100", "--target", *frames]


def list_room_runs(folder: Path) -> Iterator[tuple[str, list[str]]]:
    """Write photographs of a synthetic room, and list completions of it with their arguments."""
    sys.path.insert(0, str(ROOT / "tests" / "support"))
    from scenes import camera_at, photographed

    places = ((-0.3, 0), (0.1, 0), (0.7, 12))
    cameras = [camera_at(x, yaw=yaw, size=96) for x, yaw in places]
    scene = photographed(folder / "room", cameras)
    given = [str(scene), "--context", "0", "1", "--target", "2", "--near", "0.5", "--far", "20"]
    for config in ("default", "paper"):
        yield f"room, {config}", [*given, "--config", config]


def run_scenes(runs: Mapping[str, list[str]], folder: Path) -> dict[str, Any]:
    """Run every completion, two at a time."""
    with ThreadPoolExecutor(2) as pool:
        outputs = [folder / str(number) for number in range(len(runs))]
        return dict(zip(runs, pool.map(run_scene, runs.values(), outputs), strict=True))


def run_scene(arguments: list[str], out: Path) -> dict[str, Any]:
    """Run one completion into `out` and record its files and scores."""
    words = [*arguments, "--quiet", "--threads", "1", "--out", str(out)]
    subprocess.run([*PROGRAM, "complete", *words], check=True)
    summary = json.loads((out / "summary.json").read_text())
    views = [*summary["context"], *summary["targets"]]
    keys = ("psnr_before", "psnr_after", "ssim_before", "ssim_after")
    return {
        "sha256": {
            path.name: hashlib.sha256(drop_runs(path.read_bytes())).hexdigest()
            for path in sorted(out.glob("*.ply"))
        },
        "scores": [{key: view[key] for key in keys} for view in views],
    }


def drop_runs(content: bytes) -> bytes:
    """Drop who made a .ply from its header: it names the version, and says nothing of Gaussians."""
    head, end, rows = content.partition(b"end_header\n")
    lines = [line for line in head.splitlines(keepends=True) if RUN_COMMENT not in line]
    return b"".join([*lines, end, rows])


def run_texts() -> dict[str, Any]:
    """Run every command with --help and with wrong input."""
    lines = [[], ["--version"], ["--help"], ["complet"], *([name, "--help"] for name in COMMANDS)]
    lines += [[name, "--no-such-option"] for name in COMMANDS]
    lines += [
        ["complete", "nowhere", "--out", "out"],
        ["complete", ".", "--out", "out"],
        ["complete", ".", "--out", "out", "--config", "no-such-config"],
        ["complete", ".", "--out", "out", "--resolution", "0"],
        ["complete", ".", "--out", "out", "--config.holes.dilation", "-1"],
        ["complete", ".", "--out", "out", "--generator", "no-such-model"],
        ["complete", ".", "--out", "out", "--seed", "-1"],
        ["convert", "nothing.ply", "nothing.spz"],
        ["strip", "nothing", "--out", "context.ply"],
        ["clean", ".", "--scene", "nothing.ply", "--out", "out"],
        ["view", "nothing.ply", "--save", "page.html"],
        ["report", "nothing"],
        ["live", "nothing"],
        ["poses", "nothing", "--out", "out"],
        ["batch", "nothing.csv", "--out", "out"],
        ["evaluate", "nothing", "--protocol", "n-10", "--out", "out"],
        ["tables", "nothing"],
        ["models", "no-such-model"],
        ["bench", "--quick"],
    ]
    with ThreadPoolExecutor(2) as pool:
        names = [" ".join(["gscompleter", *words]) for words in lines]
        return dict(zip(names, pool.map(run_text, lines), strict=True))


def run_text(words: list[str]) -> dict[str, Any]:
    """Run one command in an empty folder and record its exit code and texts."""
    environment = dict(os.environ, COLUMNS="100", NO_COLOR="1")
    with tempfile.TemporaryDirectory() as folder:
        done = subprocess.run(
            [*PROGRAM, *words], cwd=folder, env=environment, capture_output=True, text=True
        )
        left = sorted(path.name for path in Path(folder).iterdir())
    clean = {"out": done.stdout, "err": done.stderr}
    texts = {name: text.replace(folder, "FOLDER").splitlines() for name, text in clean.items()}
    return {"exit": done.returncode, "left behind": left, **texts}


def compare(known: Mapping[str, Any], found: Mapping[str, Any]) -> list[str]:
    """Describe every difference, in a line each."""
    if not known:
        return ["nothing was recorded; run `make golden` on the state to compare with"]
    differences = []
    for section in ("scenes", "room"):
        match = match_bytes if is_same_machine(known, found, section) else match_scores
        for name, row in found.get(section, {}).items():
            recorded = known.get(section, {}).get(name)
            differences += [f"{name}: {text}" for text in match(recorded, row)]
    if "scenes" in found and not is_same_machine(known, found, "scenes"):
        same = {name: row for name, row in known["scenes"].items() if name in found["scenes"]}
        fall = mean_psnr(same) - mean_psnr(found["scenes"])
        differences += [f"mean PSNR fell by {fall:.3f} dB"] * (fall > MEAN_TOLERANCE)
    for name, row in found.get("texts", {}).items():
        before = known["texts"].get(name, {})
        differences += [f"{name}: {key} differs" for key in row if row[key] != before.get(key)]
    return differences


def is_same_machine(known: Mapping[str, Any], found: Mapping[str, Any], section: str) -> bool:
    """Check that the machine that recorded a section is this one; texts are the same everywhere."""
    before, now = (table.get("machines", {}).get(section) for table in (known, found))
    return section == "texts" or before == now


def match_bytes(known: Mapping[str, Any] | None, found: Mapping[str, Any]) -> list[str]:
    """List the files and scores that are not the same."""
    if known is None:
        return ["not recorded"]
    names = sorted({*known["sha256"], *found["sha256"]})
    files = [n for n in names if known["sha256"].get(n) != found["sha256"].get(n)]
    scores = ["scores"] if known["scores"] != found["scores"] else []
    return [f"{name} differs" for name in files + scores]


def match_scores(known: Mapping[str, Any] | None, found: Mapping[str, Any]) -> list[str]:
    """List the views whose PSNR fell by more than the tolerance."""
    if known is None:
        return ["not recorded"]
    falls = [
        before["psnr_after"] - after["psnr_after"]
        for before, after in zip(known["scores"], found["scores"], strict=True)
        if before["psnr_after"] is not None
    ]
    return [f"PSNR of a view fell by {fall:.3f} dB" for fall in falls if fall > CASE_TOLERANCE]


def mean_psnr(scenes: Mapping[str, Any]) -> float:
    """Average the PSNR after completion over all views that have one."""
    values = [row["psnr_after"] for scene in scenes.values() for row in scene["scores"]]
    known = [value for value in values if value is not None]
    return sum(known) / len(known)


if __name__ == "__main__":
    main()
