"""The wheel in empty environments, one for each Python that is named: `make release-check`.

    python tests/support/release_check.py python3.10 python3.13 [--extras]

Each gets the wheel and what pip finds for it, a few GB with the torch that pip chooses; then the
commands run in another folder, with nothing on the PATH but the environment: no compiler, no Node.
With `--extras` each extra is installed on top, one after the other, and imported.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from gscompleter import __version__
from gscompleter.apps.installation import PURPOSES
from paths import ROOT
from scenes import camera_at, photographed

IMPORT_ALL = "import gscompleter; [getattr(gscompleter, name) for name in gscompleter.__all__]"
"""Every public name."""
IMPORT_EXTRA = """
import sys
from importlib import import_module
from importlib.metadata import distribution
from gscompleter.apps.installation import list_requirements
for name in {requirement.name for requirement in list_requirements(sys.argv[1])}:
    paths = [path.parts for path in distribution(name).files]
    folders = {parts[0] for parts in paths if parts[1:] == ("__init__.py",)}
    alone = {parts[0][:-3] for parts in paths if len(parts) == 1 and parts[0].endswith(".py")}
    modules = sorted(module for module in folders | alone if module.isidentifier())
    assert modules, name
    for module in modules:
        import_module(module)
        print("imported", module)
"""
"""The modules that the packages of an extra bring."""


def built(kind: str, folder: Path, root: Path = ROOT) -> Path:
    """Return the `wheel` or `sdist` that is built of the sources in `root`."""
    command = [sys.executable, "-m", "hatchling", "build", "-t", kind, "-d", str(folder)]
    subprocess.run(command, cwd=root, check=True, capture_output=True)
    (archive,) = folder.iterdir()
    return archive


def environment(python: str, folder: Path) -> Path:
    """Return an empty environment in `folder`: the folder of its programs."""
    subprocess.run([python, "-m", "venv", "--without-pip", str(folder)], check=True)
    return folder / "bin"


def install(programs: Path, *words: str) -> None:
    """Let the pip that runs this install something into an environment."""
    pip = [sys.executable, "-m", "pip", "--python", str(programs / "python"), "install", "--quiet"]
    subprocess.run([*pip, *words], check=True)


def ran(programs: Path, folder: Path, *words: object) -> str:
    """Run a program of an environment in `folder`, its home, and return its output."""
    alone = {"PATH": str(programs), "HOME": str(folder), "LANG": "C.UTF-8"}
    bounds = {name: value for name, value in os.environ.items() if name.endswith("_NUM_THREADS")}
    command = [str(programs / str(words[0])), *map(str, words[1:])]
    done = subprocess.run(command, cwd=folder, env=alone | bounds, capture_output=True, text=True)
    assert done.returncode == 0, f"{command} ended with {done.returncode}:\n{done.stderr}"
    return done.stdout


def check_answers(programs: Path, folder: Path) -> None:
    """Return the version, and what `doctor` finds."""
    assert ran(programs, folder, "gscompleter", "--version").strip() == __version__
    found = json.loads(ran(programs, folder, "gscompleter", "doctor", "--json"))
    there = {(one["kind"], one["name"]): one["there"] for one in found}
    assert all(there[name] for name in there if name[0] == "packages"), found
    assert there["renderers", "cpu"], found
    assert there["viewer", "libraries"], found


def check_completion(programs: Path, folder: Path) -> Path:
    """Complete a small room, and write a page that shows it; returns the folder of the result."""
    cameras = [camera_at(x, yaw=yaw, size=32) for x, yaw in ((-0.3, 0), (0.1, 0), (0.7, 12))]
    room, out = photographed(folder / "room", cameras), folder / "out"
    frames = ("--context", 0, 1, "--target", 2, "--near", 0.5, "--far", 20)
    ran(programs, folder, "gscompleter", "complete", room, *frames, "--out", out, "--quiet")
    check_page(programs, folder, out)
    return out


def check_demo(programs: Path, folder: Path) -> None:
    """Complete the demo, and write a page that shows it."""
    ran(programs, folder, "gscompleter", "demo", "--out", "demo", "--quiet")
    out = folder / "demo" / "completion"
    check_page(programs, folder, out)


def check_page(programs: Path, folder: Path, out: Path) -> None:
    """Check that a completion added something, and write a page that shows it."""
    assert json.loads((out / "summary.json").read_text())["gaussians"]["added"] > 0
    ran(programs, folder, "gscompleter", "view", out, "--save", "page.html")
    page = (folder / "page.html").read_text()
    assert "three.js authors" in page, "the licences are not in the page"


def check_extras(programs: Path, wheel: Path, folder: Path) -> Iterator[str]:
    """Install and import each extra; yields a line on each."""
    for extra in PURPOSES:
        try:
            install(programs, f"gscompleter[{extra}] @ {wheel.as_uri()}")
            imported = ran(programs, folder, "python", "-c", IMPORT_EXTRA, extra).split()[1::2]
            yield f"{extra}: imported {' '.join(imported)}"
        except (subprocess.CalledProcessError, AssertionError) as error:
            yield f"{extra}: FAILED, {error}"


def check(python: str, wheel: Path, with_extras: bool) -> bool:
    """Check everything with one Python, print a line each, and return True if all passed."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "elsewhere"
        folder.mkdir()
        programs = environment(python, Path(name) / "environment")
        install(programs, str(wheel))
        check_answers(programs, folder)
        ran(programs, folder, "python", "-c", IMPORT_ALL)
        check_demo(programs, folder)
        print(f"{python}: demo and view ran from the wheel", flush=True)
        lines = check_extras(programs, wheel, folder) if with_extras else iter(())
        return all(told(f"{python}: {line}") for line in lines)


def told(line: str) -> bool:
    """Print a line; returns whether it tells of no failure."""
    print(line, flush=True)
    return "FAILED" not in line


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("pythons", nargs="+")
    parser.add_argument("--extras", action="store_true")
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        wheel = built("wheel", Path(folder))
        went_well = [check(python, wheel, asked.extras) for python in asked.pythons]
    sys.exit(not all(went_well))


if __name__ == "__main__":
    main()
