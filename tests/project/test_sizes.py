"""The method stays short enough to be read in one sitting."""

import re
from collections.abc import Iterator
from pathlib import Path

from paths import ROOT

PACKAGE = ROOT / "src" / "gscompleter"
METHOD = ("completer.py", "stages", "guards", "trust", "next_best_view")
CORE = (
    *(
        "__init__.py",
        "types.py",
        "geometry.py",
        "image_ops.py",
        "optim.py",
        "ransac.py",
        "sky.py",
        "errors.py",
    ),
    *("progress.py", "timing.py", "memory.py", "cpu_threads.py", "state.py", "cleaning.py"),
    *("plugins.py", "config", "render", *METHOD),
)
KERNELS = ("simd", "project", "composite", "tiles", "lod", "support", "parallel", "compiled")


def files_of(names: tuple[str, ...]) -> Iterator[Path]:
    for name in names:
        path = PACKAGE / name
        yield from sorted(path.rglob("*.py")) if path.is_dir() else (path,)


def count_lines(names: tuple[str, ...]) -> int:
    return sum(len(path.read_text().splitlines()) for path in files_of(names))


def test_the_completer_is_short():
    assert count_lines(("completer.py",)) <= 250


def test_the_method_seldom_asks_what_is_missing():
    texts = [path.read_text() for path in files_of(METHOD)]
    found = [line for text in texts for line in text.splitlines()]
    assert sum(bool(re.search(r"is (not )?None", line)) for line in found) <= 15


def test_the_core_is_short():
    kernels = tuple(f"kernels/{name}.py" for name in KERNELS)
    assert count_lines((*CORE, *kernels)) <= 10_000


def test_everything_but_the_learned_models_is_short():
    # Of these, 750 lines write the paper's tables and figures, and 2,400 open videos, panoramas,
    # phones, given depth and one photograph, remove objects and floaters, and write three formats.
    files = (path for path in PACKAGE.rglob("*.py") if "models" not in path.parts)
    assert sum(len(path.read_text().splitlines()) for path in files) <= 32_750
