"""Compilation of all kernels in advance, once, with a message."""

import io
import logging
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from rich.console import Console

from command import run
from gscompleter.apps import installation, warmup
from gscompleter.numerics import kernels
from gscompleter.numerics.geometry import pad_camera
from gscompleter.numerics.kernels import compiled
from gscompleter.numerics.kernels.cache import KernelCache
from gscompleter.system.children import start_python
from gscompleter.system.errors import InputError
from gscompleter.system.progress import show_progress, stage
from paths import TESTS

COMPLETE = """
import sys
import numba.core.event
sys.path.insert(0, sys.argv[1])
from kernel_signatures import complete
with numba.core.event.install_recorder("numba:compile") as found:
    complete(is_short=False)
print(len(found.buffer))
"""


@pytest.fixture
def rehearsed(monkeypatch, tmp_path) -> list[list[str]]:
    """Use an empty folder of marks and one process; note each rehearsal instead of running it."""
    done: list[list[str]] = []
    monkeypatch.setattr(compiled, "get_cache_folder", lambda: tmp_path)
    monkeypatch.setattr(warmup, "get_thread_count", lambda: 1)
    monkeypatch.setattr(warmup, "time_compilation", lambda: 0.5)
    monkeypatch.setattr(warmup, "rehearse", lambda parts: done.append(list(parts)))
    return done


@pytest.fixture
def children(rehearsed, monkeypatch) -> list[subprocess.Popen[bytes]]:
    """Have two cores, and keep the processes that are started."""
    started: list[subprocess.Popen[bytes]] = []

    def start(program: str, words: list[str]) -> subprocess.Popen[bytes]:
        started.append(start_python(program, words))
        return started[-1]

    monkeypatch.setattr(warmup, "get_thread_count", lambda: 2)
    monkeypatch.setattr(warmup, "start_python", start)
    return started


PLACES = """
import os, sys
from gscompleter.numerics.kernels.cache import CACHE, _probe, njit
njit()(_probe)()
print(CACHE.folder)
print(CACHE.note)
"""


@pytest.mark.linux
@pytest.mark.parametrize(
    "temporary", ["private", "of-others", pytest.param("missing", marks=pytest.mark.slow)]
)
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


# `make kernels` rehearses before all tests.
@pytest.mark.slow
@pytest.mark.parametrize("is_short", [True, False])
def test_a_rehearsal_meets_every_kernel_of_a_completion(is_short):
    """It runs in a process of its own, because kernels may have run here before."""
    said = """
import sys
sys.path.insert(0, sys.argv[1])
from gscompleter.apps import warmup
from kernel_signatures import complete, signatures
for parts in warmup.split_work(warmup.PARTS, 2):
    warmup.rehearse(parts)
rehearsed = signatures()
complete(is_short=sys.argv[2] == "True")
print(len(rehearsed), *sorted(signatures() - rehearsed), sep="\\n")
"""
    command = [sys.executable, "-c", said, str(TESTS / "support"), str(is_short)]
    life = subprocess.run(command, capture_output=True, text=True, check=True)
    number, *others = life.stdout.splitlines()
    assert int(number) > 15
    assert others == []


def test_what_is_compiled_is_compiled_once(rehearsed):
    assert warmup.compile_kernels(["cuda", "mvsplat"]) is None
    assert warmup.compile_kernels(["cpu", "mvsplat"]) > 0
    assert warmup.compile_kernels(["cpu"]) is None
    assert rehearsed == [["cpu"]]
    # Only what is missing, and only what was asked for.
    assert warmup.compile_kernels(["plane-sweep", "cpu"]) > 0
    assert warmup.compile_kernels(["cpu", warmup.SPLAT_PART]) > 0
    assert warmup.compile_kernels(["cpu", warmup.SPLAT_PART]) is None
    assert rehearsed == [["cpu"], ["plane-sweep"], [warmup.SPLAT_PART]]


def test_the_models_are_compiled_in_a_process_beside_the_block(
    rehearsed, children, monkeypatch, tmp_path
):
    noted = tmp_path / "parts"
    note = f"import sys; open({str(noted)!r}, 'w').write(' '.join(sys.argv[1:]))"
    monkeypatch.setattr(warmup, "CHILD", note)
    with warmup.compile_beside(warmup.PARTS):
        # It ends without the end of the block, within which nothing is compiled here.
        assert children[0].wait() == 0
        assert noted.read_text() == "plane-sweep warp-inpaint"
        assert rehearsed == []
    assert rehearsed == [["cpu", warmup.SPLAT_PART]]
    assert warmup.list_uncompiled(warmup.PARTS) == []


def test_a_process_that_fails_is_told_and_its_part_compiled_here(
    rehearsed, children, monkeypatch, caplog
):
    # A command with `--quiet` may have run in this process before.
    caplog.set_level(logging.WARNING, "gscompleter")
    monkeypatch.setattr(warmup, "CHILD", "raise SystemExit(3)")
    warmup.compile_kernels(["cpu", "plane-sweep"])
    assert rehearsed == [["cpu"], ["plane-sweep"]]
    assert "ended with code 3" in caplog.text


def test_an_error_beside_the_compilation_ends_it(rehearsed, children, monkeypatch):
    monkeypatch.setattr(warmup, "CHILD", "import time; time.sleep(60)")
    with pytest.raises(InputError, match="damaged"), warmup.compile_beside(warmup.PARTS):
        raise InputError("A photograph is damaged.")
    assert children[0].poll() is not None
    assert rehearsed == []
    assert warmup.list_uncompiled(warmup.PARTS) == list(warmup.PARTS)


def test_without_the_renderer_one_process_is_enough(rehearsed, children):
    warmup.compile_kernels(["cuda", "plane-sweep", "warp-inpaint"])
    assert rehearsed == [["plane-sweep", "warp-inpaint"]]
    assert children == []


def test_a_wall_of_the_rehearsal_is_the_same_from_all_cameras():
    """Or stereo would find nothing, and a completion would skip stages."""
    first, second = (view.image for view in warmup.make_photographs())
    shift = warmup.DISPARITY_PX
    assert torch.equal(first[:, shift:], second[:, :-shift])
    padded = pad_camera(warmup.make_wall_camera(0), 0.25)
    assert torch.equal(padded.crop(warmup.draw_wall(padded.padded)), first)


@pytest.mark.parametrize(
    ("seconds", "text"), [(0.3, "about 5 s"), (22.6, "about 25 s"), (76.0, "about 80 s")]
)
def test_a_rough_time_is_rounded(seconds, text):
    assert warmup.format_duration(seconds) == text


def test_the_time_of_a_compilation_is_measured_each_time():
    """What is compiled by then takes no time, and would tell nothing about this machine."""
    assert [warmup.time_compilation() > 0.01 for _ in range(2)] == [True, True]


def test_a_log_has_one_line_about_the_compilation(rehearsed, monkeypatch, capsys):
    def work(parts: list[str]) -> None:
        with stage("context"):
            pass

    monkeypatch.setattr(warmup, "rehearse", work)
    with show_progress(Console(stderr=True)):
        warmup.compile_kernels(["cpu"])
    line = "compiling kernels for this machine, once, about 30 s\n"
    assert capsys.readouterr().err == line


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
    assert said == "compiling kernels for this machine, once, about 30 s\n"


def test_warmup_says_what_it_did(rehearsed, monkeypatch, capsys):
    assert run(monkeypatch, "warmup") == 0
    assert capsys.readouterr().out.startswith("All kernels are compiled, in ")
    assert run(monkeypatch, "warmup") == 0
    assert capsys.readouterr().out.startswith("All kernels are compiled already: ")
    assert run(monkeypatch, "warmup", "--quiet") == 0
    assert capsys.readouterr() == ("", "")
    assert [sorted(parts) for parts in rehearsed] == [sorted(warmup.PARTS)]


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
