"""`make gpu` without a GPU: its parts run small on the CPU, and a failed one is a row."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

import gpu
from fake_gsplat import WHEEL, find_gsplat
from gpu_report import PartResult, Row, format_page
from paths import ROOT, SUPPORT

BENCHMARKS = ROOT / "benchmarks"
SMALL = gpu.Bench("cpu", ((64, 64), (64, 80)), ("plane-sweep", "mvsplat-re10k"), ("float32",), 1)

SCRIPT = """
import sys, time, subprocess
sys.path.append({benchmarks!r})
from gpu_report import Part, Row, main, try_rows

def good():
    yield Row("speed", 12.5, "ms", "twice as fast")

def failing():
    yield Row("first", 1.0)
    raise ValueError("no | such kernel\\nlog of a compiler")

def endless():
    yield Row("before", 2.0)
    subprocess.run([sys.executable, "-c", "import time; time.sleep(600)"])

def several():
    yield from try_rows("this one", failing)
    yield from try_rows("that one", good)

parts = {{
    "failing": Part("Fails", 60, failing),
    "needy": Part("Needs it", 60, good, needs="failing"),
    "endless": Part("Never ends", 3, endless),
    "crash": Part("Crashes", 60, lambda: __import__("os").abort()),
    "several": Part("Several", 60, several),
    "good": Part("Works", 60, good),
}}
main(parts, lambda: {{"device": "a test"}}, "Parts.")
"""


def call(folder: Path, *options: str) -> subprocess.CompletedProcess[str]:
    """Run the script as a user does, writing to `folder`."""
    script = folder / "script.py"
    script.write_text(SCRIPT.format(benchmarks=str(BENCHMARKS)))
    command = [sys.executable, str(script), "--out", str(folder), *options]
    return subprocess.run(command, capture_output=True, text=True, check=False)


def test_a_part_that_fails_or_never_ends_is_a_row_and_the_rest_goes_on(tmp_path):
    start = time.monotonic()
    done = call(tmp_path)
    assert done.returncode == 1, done.stderr
    assert time.monotonic() - start < 60
    parts = json.loads((tmp_path / "gpu.json").read_text())["parts"]
    assert list(parts) == ["failing", "needy", "endless", "crash", "several", "good"]
    rows = {name: part["rows"] for name, part in parts.items()}
    first, reason = rows["failing"]
    assert (first["what"], first["value"], first["failed"]) == ("first", 1.0, False)
    assert reason["failed"]
    assert reason["note"] == "ValueError: no / such kernel"
    assert [row["note"] for row in rows["needy"]] == ["left out, because 'Fails' failed"]
    assert [row["value"] for row in rows["endless"]] == [2.0, None]
    assert rows["endless"][1]["note"] == "stopped after 3 s"
    assert rows["crash"][0]["failed"]
    assert [row["failed"] for row in rows["several"]] == [False, True, False]
    assert rows["several"][1]["note"] == "ValueError: no / such kernel log of a compiler"
    assert not any(row["failed"] for row in rows["good"])


def test_the_page_names_the_device_and_every_row(tmp_path):
    assert call(tmp_path, "--only", "good").returncode == 0
    text = (tmp_path / "gpu.md").read_text()
    assert "| device | a test |" in text
    assert "## Works" in text
    assert "| speed | 12.5 ms; twice as fast |" in text
    assert "Fails" not in text
    failed = format_page({}, {"it": PartResult("It", 1.0, (Row("x", note="why", failed=True),))})
    assert "| x | **failed**: why |" in failed


def test_all_parts_together_keep_to_their_time(tmp_path):
    assert call(tmp_path, "--seconds", "0", "--only", "good", "several").returncode == 1
    parts = json.loads((tmp_path / "gpu.json").read_text())["parts"]
    for part in parts.values():
        assert [row["note"] for row in part["rows"]] == [
            "left out, because the 0 s of all parts are over"
        ]


def test_a_part_that_is_none_is_refused(tmp_path):
    done = call(tmp_path, "--only", "speed")
    assert done.returncode != 0
    assert "no part 'speed'; choose one of failing, needy" in done.stderr
    assert not (tmp_path / "gpu.json").exists()


@pytest.mark.slow
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_one_sentence_says_so_and_nothing_is_written(tmp_path):
    command = [sys.executable, str(BENCHMARKS / "gpu.py"), "--out", str(tmp_path)]
    folders = ("src", "tests/support", "tests/render", "benchmarks")
    paths = [str(BENCHMARKS.parent / name) for name in folders]
    done = subprocess.run(
        command, capture_output=True, text=True, check=False, env={"PYTHONPATH": ":".join(paths)}
    )
    assert done.returncode == 2
    assert done.stderr.strip().count("\n") == 0
    assert "needs a CUDA device" in done.stderr
    assert list(tmp_path.iterdir()) == []


def test_a_run_that_is_stopped_keeps_its_parts(tmp_path):
    script = tmp_path / "script.py"
    text = SCRIPT.format(benchmarks=str(BENCHMARKS))
    script.write_text(text.replace('Part("Never ends", 3,', 'Part("Never ends", 300,'))
    command = [sys.executable, str(script), "--out", str(tmp_path / "out")]
    with subprocess.Popen([*command, "--only", "failing", "endless", "good"]) as process:
        until = time.monotonic() + 60
        while not (tmp_path / "out" / "gpu.json").exists() and time.monotonic() < until:
            time.sleep(0.05)
        process.kill()
    parts = json.loads((tmp_path / "out" / "gpu.json").read_text())["parts"]
    assert list(parts) == ["failing"]


def test_parts_of_an_earlier_run_are_kept_if_it_was_on_the_same_machine(tmp_path):
    (tmp_path / "first").mkdir()
    (tmp_path / "second").mkdir()
    call(tmp_path / "first", "--only", "good", "failing")
    earlier = tmp_path / "first" / "gpu.json"
    content = json.loads(earlier.read_text())
    content["parts"]["good"]["date"] = "2026-01-01"
    earlier.write_text(json.dumps(content))
    done = call(tmp_path / "second", "--only", "several", "--earlier", str(earlier))
    assert done.returncode == 1
    parts = json.loads((tmp_path / "second" / "gpu.json").read_text())["parts"]
    assert list(parts) == ["failing", "several", "good"]
    assert parts["good"]["date"] == "2026-01-01"
    earlier.write_text(json.dumps({**content, "machine": {"device": "another one"}}))
    done = call(tmp_path / "second", "--only", "several", "--earlier", str(earlier))
    assert "another machine: its device differs" in done.stderr


def test_limits_leave_time_for_what_comes_after_the_build():
    assert all(part.limit <= 200 for part in gpu.PARTS.values())
    assert {part.needs for part in gpu.PARTS.values()} == {"build", None}


@pytest.mark.parametrize(
    "part",
    [
        *("build", "renderer", "models"),
        pytest.param("agreement", marks=pytest.mark.slow),
        # Up to minutes on a CPU.
        *(
            pytest.param(part, marks=pytest.mark.slow)
            for part in ("stages", "profile", "plane_sweep", "patches", "commands", "baselines")
        ),
    ],
)
def test_every_part_gives_rows(part):
    rows = list(getattr(gpu, f"measure_{part}")(SMALL))
    assert rows
    assert [row for row in rows if row.failed or row.value is None] == []
    if part == "agreement":
        assert max(row.value for row in rows) < 1e-4
    if part == "profile":
        assert [row.value > 0 for row in rows] == [True] * 10


@pytest.mark.slow
def test_every_reconstructor_completes_a_room_and_one_that_fails_is_a_row(monkeypatch):
    rows = list(gpu.measure_completions(SMALL))
    assert [row.what for row in rows if not row.failed] == list(SMALL.models)
    known = gpu.load_model
    monkeypatch.setattr(
        gpu, "load_model", lambda name, *a: known(name, *a) if "-" in name else 1 / 0
    )
    broken = gpu.Bench("cpu", SMALL.sizes, ("none", "plane-sweep"), repetitions=1)
    failed, fine = gpu.measure_completions(broken)
    assert failed.failed
    assert failed.note.startswith("ZeroDivisionError")
    assert not fine.failed


@pytest.mark.slow
def test_the_tests_count_where_they_passed_and_only_there(tmp_path):
    (tmp_path / "test_it.py").write_text("def test_good(): pass\ndef test_bad(): assert 0\n")
    path = str(tmp_path / "test_it.py")
    (passed,) = gpu.run_tests(path, "-k", "good", "-c", "/dev/null")
    assert not passed.failed
    assert "1 passed" in passed.note
    named, whole = gpu.run_tests(path, "-c", "/dev/null")
    assert named.failed
    assert "test_bad" in named.note
    assert whole.failed
    (nothing,) = gpu.run_tests(path, "-k", "no_such", "-c", "/dev/null")
    assert nothing.failed


@pytest.mark.slow
def test_pe_field_paints_with_any_model_of_its_kind():
    pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    pytest.importorskip("transformers", reason="needs gscompleter[diffusion]")
    import tiny_diffusion
    from gscompleter.models.diffusion.kontext import Kontext, Prompt
    from gscompleter.models.diffusion.rotary import enable_per_head_positions

    def tiny(device: str) -> Kontext:
        pipeline = tiny_diffusion.kontext_pipeline()
        enable_per_head_positions(pipeline.transformer)
        prompt = Prompt(torch.zeros(1, 4, 32), torch.zeros(1, 24))
        return Kontext(pipeline, prompt, device, torch.float32)

    (row,) = gpu.measure_pe_field(SMALL, tiny)
    assert row.what == "64x80, 4 steps"
    assert row.value > 0


@pytest.mark.slow
def test_free_models_run_where_their_files_are(monkeypatch):
    pytest.importorskip("diffusers", reason="needs gscompleter[diffusion]")
    pytest.importorskip("transformers", reason="needs gscompleter[diffusion]")
    import tiny_diffusion

    def tiny(device: str) -> object:
        return tiny_diffusion.flux2_klein()

    monkeypatch.setattr(gpu, "find_cached", lambda weights: None)
    painted, *others = gpu.measure_free_models(SMALL, tiny)
    assert (painted.what, painted.failed) == ("flux2-klein, 4 steps", False), painted
    assert [row.what for row in others] == [
        "migan",
        "lama",
        "da3-mono-large",
        "moge-2",
        "moge-2-base",
        "moge-2-large",
    ]
    assert {row.note for row in others} == {"its file is not on this machine"}


@pytest.mark.slow
@pytest.mark.linux
@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
@pytest.mark.skipif(find_gsplat() is None, reason=f"needs {WHEEL}: `make test` fetches it")
def test_the_script_runs_on_a_machine_without_a_network(tmp_path):
    """The fake CUDA device stands for the GPU, and a copy of the wheel for the network."""
    programs = tmp_path / "bin"
    programs.mkdir()
    (programs / "nvidia-smi").write_text("#!/bin/sh\necho 'GPU 0: fake'\n")
    (programs / "nvidia-smi").chmod(0o755)
    wheels = tmp_path / "wheels"
    wheels.mkdir()
    shutil.copy(find_gsplat(), wheels)
    folders = (SUPPORT / "fake_gpu_machine", SUPPORT, ROOT / "src")
    environment = os.environ | {
        "PATH": f"{programs}:{os.environ['PATH']}",
        "PYTHONPATH": ":".join(map(str, folders)),
        "PYTHON": sys.executable,
        "WHEELS": str(wheels),
        "GPU_SIZES": "24x24",
    }
    out = tmp_path / "out"
    # The others take minutes there.
    parts = ("build", "agreement", "renderer")
    command = ["bash", str(BENCHMARKS / "gpu.sh"), "--out", str(out), "--only", *parts]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((out / "gpu.json").read_text())
    assert report["machine"]["device"] == "fake device"
    assert list(report["parts"]) == list(parts)
    rows = [row for part in report["parts"].values() for row in part["rows"]]
    assert not any(row["failed"] for row in rows)
    assert {"first picture", "random: largest difference of image"} <= {row["what"] for row in rows}
