"""Compilation of all kernels in advance, once, with a message."""

import io
import os
import subprocess
import sys
from pathlib import Path

import pytest
from rich.console import Console

from command import run
from gscompleter.apps import installation, warmup
from gscompleter.numerics import kernels
from gscompleter.numerics.kernels import compiled
from gscompleter.numerics.kernels.cache import KernelCache
from gscompleter.system.progress import show_progress, stage
from paths import TESTS

COMPLETE = """
import sys
import numba.core.event
sys.path.insert(0, sys.argv[1])
from kernel_signatures import complete
with numba.core.event.install_recorder("numba:compile") as found:
    complete()
print(len(found.buffer))
"""


@pytest.fixture
def rehearsed(monkeypatch, tmp_path) -> list[bool]:
    """Use an empty folder of marks, and note each rehearsal instead of running it."""
    done: list[bool] = []
    monkeypatch.setattr(compiled, "get_cache_folder", lambda: tmp_path)
    monkeypatch.setattr(warmup, "rehearse", lambda with_splat: done.append(with_splat))
    return done


PLACES = """
import os, sys
from gscompleter.numerics.kernels.cache import CACHE, _probe, njit
njit()(_probe)()
print(CACHE.folder)
print(CACHE.note)
"""


@pytest.mark.linux
@pytest.mark.parametrize("temporary", ["private", "of-others", "missing"])
def test_without_a_writable_cache_kernels_are_kept_elsewhere_or_nowhere(tmp_path, temporary):
    """The installation is a read-only copy, and the home and NUMBA_CACHE_DIR are no folders."""
    package = Path(kernels.__file__).parents[2]
    for file in ("__init__.py", "cache.py"):
        place = tmp_path / "lib" / "gscompleter" / "numerics" / "kernels" / file
        place.parent.mkdir(parents=True, exist_ok=True)
        place.write_bytes((package / "numerics" / "kernels" / file).read_bytes())
    (tmp_path / "lib" / "gscompleter" / "__init__.py").touch()
    # In the place of the folder for compiled code is a file, so that also root cannot write there.
    (place.parent / "__pycache__").write_text("")
    environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "TMPDIR")}
    environment |= {"HOME": "/proc/none", "XDG_CACHE_HOME": "/proc/none"}
    environment |= {"NUMBA_CACHE_DIR": "/proc/none", "PYTHONPATH": str(tmp_path / "lib")}
    environment |= {"TMPDIR": str(tmp_path / "tmp"), "PYTHONDONTWRITEBYTECODE": "1"}
    (tmp_path / "tmp").mkdir()
    folder = tmp_path / "tmp" / f"gscompleter-kernels-{os.getuid()}"
    if temporary == "of-others":
        folder.mkdir()
        folder.chmod(0o777)
    elif temporary == "missing":
        folder.write_text("")
    command = [sys.executable, "-c", PLACES]
    done = subprocess.run(command, capture_output=True, text=True, env=environment, check=False)
    assert done.returncode == 0, done.stderr
    where, note = done.stdout.splitlines()
    assert "cannot be written to /proc/none" in note
    assert note in done.stderr
    if temporary == "private":
        assert Path(where).is_relative_to(folder)
        assert folder.stat().st_mode & 0o077 == 0
        assert any(folder.rglob("*.nbi"))
    else:
        assert where == "None"
        assert "compiled again in each run" in note


def test_the_doctor_says_why_kernels_are_kept_elsewhere(monkeypatch, capsys):
    note = "Compiled kernels cannot be written to /proc/none."
    monkeypatch.setattr(installation, "CACHE", KernelCache(None, note))
    found = installation.inspect_kernel_cache()
    assert (found.there, found.told) == (False, note)


def test_a_rehearsal_meets_every_kernel_of_a_completion():
    """It runs in a process of its own, because kernels may have run here before."""
    said = """
import sys
sys.path.insert(0, sys.argv[1])
from gscompleter.apps import warmup
from kernel_signatures import complete, signatures
warmup.rehearse(with_splat=True)
rehearsed = signatures()
complete()
print(len(rehearsed), *sorted(signatures() - rehearsed), sep="\\n")
"""
    command = [sys.executable, "-c", said, str(TESTS / "support")]
    life = subprocess.run(command, capture_output=True, text=True, check=True)
    number, *others = life.stdout.splitlines()
    assert int(number) > 15
    assert others == []


def test_what_is_compiled_is_compiled_once(rehearsed):
    assert warmup.compile_kernels(["cuda", "mvsplat"]) is None
    assert warmup.compile_kernels(["cpu", "mvsplat"]) > 0
    assert warmup.compile_kernels(["plane-sweep", "cpu"]) is None
    assert rehearsed == [False]
    assert warmup.compile_kernels(["cpu", warmup.SPLAT_PART]) > 0
    assert warmup.compile_kernels(["cpu", warmup.SPLAT_PART]) is None
    assert rehearsed == [False, True]


def test_a_log_has_one_line_about_the_compilation(rehearsed, monkeypatch, capsys):
    def work(with_splat: bool) -> None:
        with stage("context"):
            pass

    monkeypatch.setattr(warmup, "rehearse", work)
    with show_progress(Console(stderr=True)):
        warmup.compile_kernels(["cpu"])
    assert capsys.readouterr().err == "compiling kernels for this machine, once\n"


def test_kernels_are_compiled_anew_for_another_processor(rehearsed, monkeypatch):
    warmup.compile_kernels(["cpu"])
    monkeypatch.setattr(compiled, "get_host_cpu_name", lambda: "another")
    warmup.compile_kernels(["cpu"])
    assert len(rehearsed) == 2


def test_one_line_says_so_before_it_happens(rehearsed):
    console = Console(record=True, file=io.StringIO(), width=200)
    with show_progress(console):
        warmup.compile_kernels(["cpu"])
        warmup.compile_kernels(["cpu"])
    said = console.export_text()
    assert said == "compiling kernels for this machine, once\n"


def test_warmup_says_what_it_did(rehearsed, monkeypatch, capsys):
    assert run(monkeypatch, "warmup") == 0
    assert capsys.readouterr().out.startswith("All kernels are compiled, in ")
    assert run(monkeypatch, "warmup") == 0
    assert capsys.readouterr().out.startswith("All kernels are compiled already: ")
    assert run(monkeypatch, "warmup", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert rehearsed == [True]


@pytest.mark.slow
def test_after_a_warmup_a_completion_compiles_nothing(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    warm = [sys.executable, "-c", "from gscompleter.cli import main; main()", "warmup"]
    subprocess.run(warm, env=environment, check=True)
    command = [sys.executable, "-c", COMPLETE, str(TESTS / "support")]
    life = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
    assert life.stdout == "0\n"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("--generator", "pe-field", "--generator-steps", -3), "(--generator-steps)"),
        (("--depth", "no-such-depth"), "There is no depth 'no-such-depth'"),
        (("--generator", "no.py:phi"), "no.py"),
        (("--reconstructor", "mvsplat-re10k", "--weights", "no.ckpt"), "no.ckpt"),
    ],
)
def test_what_is_wrong_with_a_model_is_told_before_kernels_are_compiled(
    room, rehearsed, tmp_path, monkeypatch, capsys, words, sentence
):
    out = tmp_path / "out"
    named = ("complete", room, "--context", 0, 1, "--target", 2, "--out", out)
    assert run(monkeypatch, *named, *words) == 2
    assert sentence in capsys.readouterr().err
    assert rehearsed == []
