"""Compilation of all kernels in advance, once, with a message."""

import io
import os
import subprocess
import sys
from importlib import import_module
from pkgutil import iter_modules

import pytest
from numba.core.registry import CPUDispatcher
from rich.console import Console

from command import run
from gscompleter import GSCompleter, kernels
from gscompleter.apps.warmup import compilation, rehearsal
from gscompleter.kernels import compiled
from gscompleter.progress import show_progress
from paths import TESTS
from scenes import Room, camera_at, view_of

COMPLETE = """
import sys
import numba.core.event
sys.path[:0] = [sys.argv[1], f"{sys.argv[1]}/../support"]
from test_rehearsal import complete
with numba.core.event.install_recorder("numba:compile") as found:
    complete()
print(len(found.buffer))
"""


def complete() -> None:
    """Complete a room beside two and three photographs, reconstructed and given."""
    target = camera_at(0.7, yaw=12, size=64)
    for places in ((-0.3, 0.1), (-0.3, 0.1, 0.3)):
        views = [view_of(Room(), camera_at(x, size=64)) for x in places]
        completion = GSCompleter()(views, target)
    GSCompleter()(views, target, completion.scene)


def signatures() -> set[tuple[str, str]]:
    """Return the names and argument types of all kernels that ran in this process."""
    return {
        (f"{module.name}.{name}", str(types))
        for module in iter_modules(kernels.__path__)
        for name, value in vars(import_module(f"gscompleter.kernels.{module.name}")).items()
        if isinstance(value, CPUDispatcher)
        for types in value.signatures
    }


@pytest.fixture
def marked(monkeypatch, tmp_path) -> list[str]:
    """Use an empty folder of marks, and rehearse parts by writing their names."""
    done: list[str] = []
    monkeypatch.setattr(compiled, "get_cache_folder", lambda: tmp_path)
    monkeypatch.setattr(compilation, "PARTS", ("cpu", "plane-sweep"))
    monkeypatch.setattr(rehearsal, "PARTS", dict.fromkeys(compilation.PARTS, done.append))
    monkeypatch.setattr(compilation, "get_thread_count", lambda: 1)
    return done


def test_a_rehearsal_meets_every_kernel_of_a_completion():
    """It runs in a process of its own, because kernels may have run here before."""
    said = """
import sys
sys.path[:0] = [sys.argv[1], f"{sys.argv[1]}/../support"]
from test_rehearsal import complete, rehearsal, signatures
for name, rehearse in rehearsal.PARTS.items():
    rehearse(name)
rehearsed = signatures()
complete()
print(len(rehearsed), *sorted(signatures() - rehearsed), sep="\\n")
"""
    command = [sys.executable, "-c", said, str(TESTS / "apps")]
    life = subprocess.run(command, capture_output=True, text=True, check=True)
    number, *others = life.stdout.splitlines()
    assert int(number) > 15
    assert others == []


def test_each_part_that_is_named_is_rehearsed():
    assert tuple(rehearsal.PARTS) == compilation.PARTS


def test_what_is_compiled_is_compiled_once(marked):
    assert compilation.compile_kernels(["cpu", "mvsplat"]) > 0
    assert marked == ["cpu"]
    assert compilation.compile_kernels(["cpu"]) is None
    assert compilation.compile_kernels(["plane-sweep", "cpu"]) > 0
    assert marked == ["cpu", "plane-sweep"]


def test_kernels_are_compiled_anew_for_another_processor(marked, monkeypatch):
    compilation.compile_kernels(["cpu"])
    monkeypatch.setattr(compiled, "get_host_cpu_name", lambda: "another")
    compilation.compile_kernels(["cpu"])
    assert marked == ["cpu", "cpu"]


def test_one_line_says_so_before_it_happens(marked):
    console = Console(record=True, file=io.StringIO(), width=200)
    with show_progress(console):
        compilation.compile_kernels(["cpu"])
        compilation.compile_kernels(["cpu"])
    said = console.export_text()
    assert said == "compiling kernels for this machine, once\n"


def test_warmup_says_what_it_did(marked, monkeypatch, capsys):
    assert run(monkeypatch, "warmup") == 0
    assert capsys.readouterr().out.startswith("All kernels are compiled, in ")
    assert run(monkeypatch, "warmup") == 0
    assert capsys.readouterr().out.startswith("All kernels are compiled already: ")
    assert run(monkeypatch, "warmup", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert marked == ["cpu", "plane-sweep"]


def test_models_are_compiled_in_another_process_beside_the_renderer(monkeypatch):
    names = ["cpu", "brought", "plane-sweep"]
    monkeypatch.setattr(compilation, "get_thread_count", lambda: 2)
    assert compilation.split_parts(names) == (["cpu", "brought"], ["plane-sweep"])
    assert compilation.split_parts(["plane-sweep"]) == (["plane-sweep"], [])
    monkeypatch.setattr(compilation, "get_thread_count", lambda: 1)
    assert compilation.split_parts(names) == (names, [])


def test_a_part_that_fails_in_its_process_is_no_success(monkeypatch):
    with (
        pytest.raises(subprocess.CalledProcessError),
        compilation.rehearse_in_subprocess(["no such part"]),
    ):
        pass


@pytest.mark.slow
def test_after_a_warmup_a_completion_compiles_nothing(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    warm = [sys.executable, "-c", "from gscompleter.cli import main; main()", "warmup"]
    subprocess.run(warm, env=environment, check=True)
    command = [sys.executable, "-c", COMPLETE, str(TESTS / "apps")]
    life = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert life.stdout == "0\n"
