"""Commands refuse what would cost the user's files or work, before they do any."""

import json
import os
import shutil
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from command import run
from gscompleter.apps.completing import preparation
from gscompleter.apps.inputs import opening
from gscompleter.splats.ply import save_ply
from gscompleter.types import Gaussians

SMALL = ("--resolution", 48, 64, "--config.refine.iterations", 1, "--quiet")
LONG = "a" * 300
CODE = "from gscompleter.cli import run; run()"


@pytest.fixture(scope="module")
def splat(tmp_path_factory) -> Path:
    """Write a few Gaussians."""
    path = tmp_path_factory.mktemp("splat") / "splat.ply"
    count = 200
    random = torch.Generator().manual_seed(0)
    save_ply(
        path,
        Gaussians(
            torch.rand(count, 3, generator=random),
            torch.tensor([[1.0, 0, 0, 0]]).repeat(count, 1),
            torch.full((count, 3), 0.1),
            torch.full((count,), 0.5),
            torch.zeros(count, 1, 3),
            torch.zeros(count, dtype=torch.uint8),
        ),
    )
    return path


@pytest.fixture
def photographs(tmp_path) -> Path:
    """Write photographs without cameras."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    random = np.random.default_rng(0)
    for number in range(4):
        pixels = random.integers(0, 255, (48, 64, 3), dtype=np.uint8)
        Image.fromarray(pixels).save(folder / f"{number}.png")
    return folder


def read_all(folder: Path) -> dict[str, bytes]:
    files = (path for path in sorted(folder.rglob("*")) if path.is_file())
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def refused(monkeypatch, capsys, *words: object) -> str:
    """Run a command that has to end with one sentence, and return it."""
    assert run(monkeypatch, *words) == 2
    said = capsys.readouterr().err.strip()
    assert said.startswith("gscompleter: ")
    assert "\n" not in said
    assert len(said) <= 300
    return said


def run_apart(*words: object, shell: str = "", **more: object) -> subprocess.CompletedProcess:
    """Run a command in a process of its own, in a shell with a prefix or suffix."""
    line = " ".join([f"'{sys.executable}'", "-c", f"'{CODE}'", *(f"'{word}'" for word in words)])
    options = {"capture_output": True, "check": False, "errors": "replace", **more}
    return subprocess.run(["sh", "-c", shell.format(line) or line], **options)


@pytest.mark.parametrize("name", ["complete", "poses", "live", "evaluate"])
@pytest.mark.parametrize("place", ["", "images", "images/out", "out", ".."])
def test_photographs_are_never_an_output(photographs, monkeypatch, capsys, name, place):
    """`complete SCENE --out SCENE --overwrite` deleted them."""
    (photographs / "images").mkdir()
    for file in photographs.glob("*.png"):
        file.rename(photographs / "images" / file.name)
    before = read_all(photographs)
    more = {"evaluate": ["--protocol", "n-10"]}.get(name, ["--overwrite"])
    said = refused(
        monkeypatch, capsys, name, photographs, "--out", os.path.join(photographs, place), *more
    )
    assert any(f" {relation} the input " in said for relation in ("is", "holds", "lies in"))
    assert read_all(photographs) == before


def test_the_splat_and_its_folder_are_never_an_output(splat, monkeypatch, capsys):
    before = read_all(splat.parent)
    copy = splat.with_name("copy.ply")
    for words in (
        ("convert", splat, splat, "--overwrite"),
        ("clean", "--scene", splat, "--out", splat.parent, "--overwrite"),
        ("clean", "--scene", splat, "--out", splat, "--overwrite"),
        ("strip", splat, "--out", splat.parent / "removed.ply" / ".." / splat.name),
    ):
        assert "the input" in refused(monkeypatch, capsys, *words)
    copy.write_bytes(splat.read_bytes())
    removed = splat.with_name("removed.ply")
    removed.write_bytes(splat.read_bytes())
    said = refused(monkeypatch, capsys, "strip", copy, "--out", removed, "--overwrite")
    assert "is the input" in said
    for path in (copy, removed):
        path.unlink()
    assert read_all(splat.parent) == before


def test_a_scene_is_cleaned_in_place_and_given_back(splat, tmp_path, monkeypatch, capsys):
    """Files of the earlier run alone do not stay beside the new summary."""
    out = tmp_path / "out"
    assert run(monkeypatch, "clean", "--scene", splat, "--out", out, "--quiet") == 0
    (out / "report.html").write_text("mine")
    again = ("clean", "--scene", out / "completed.ply", "--out", out, "--quiet", "--overwrite")
    assert run(monkeypatch, *again) == 0
    assert (out / "report.html").read_text() == "mine"
    summary = json.loads((out / "summary.json").read_text())
    assert {"completed.ply", "summary.json"} <= set(summary["files"])
    assert summary["command"] == "clean"
    assert "holds a result of `clean`" in refused(monkeypatch, capsys, "report", out)


@pytest.mark.parametrize(
    "words",
    [
        ("complete", ""),
        ("complete", "scene", "--out", ""),
        ("complete", "scene", "--out="),
        ("batch", "", "--out", "o"),
        ("live", "scene", "--host", ""),
    ],
)
def test_an_empty_word_is_no_working_folder(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    assert "is empty" in refused(monkeypatch, capsys, *words)
    assert os.listdir(tmp_path) == []


@pytest.mark.parametrize(
    "words",
    [
        ("convert", LONG, "o.ply"),
        ("convert", "SPLAT", f"{LONG}.ply"),
        ("clean", "--scene", LONG, "--out", "O"),
        ("clean", "--scene", "SPLAT", "--out", LONG),
        ("complete", LONG, "--out", "O"),
        ("complete", "SCENE", "--scene", LONG, "--out", "O"),
        ("remove", "SCENE", "--scene", "SPLAT", "--select", LONG, "--out", "O"),
        ("strip", LONG, "--out", "x.ply"),
        ("view", LONG, "--save", "p.html"),
        ("view", "SPLAT", "--cameras", LONG, "--save", "p.html"),
        ("batch", LONG, "--out", "O"),
        ("batch", f"{LONG}.csv", "--out", "O"),
        ("tables", LONG),
        ("report", LONG),
        ("evaluate", LONG, "--out", "O"),
        ("evaluate", LONG, "--protocol", "n-10", "--out", "O"),
        ("index", LONG, "--protocol", "n-10", "--out", "i.json"),
        ("index", "SCENE", "--protocol", "n-10", "--out", f"{LONG}.json"),
        ("poses", LONG, "--out", "O"),
        ("poses", "SCENE", "--out", LONG),
        ("demo", "--out", LONG),
    ],
)
def test_a_name_that_is_too_long_is_a_sentence(
    splat, photographs, tmp_path, monkeypatch, capsys, words
):
    monkeypatch.chdir(tmp_path)
    named = [{"SPLAT": splat, "SCENE": photographs}.get(word, word) for word in words]
    refused(monkeypatch, capsys, *named)
    assert os.listdir(tmp_path) == ["photographs"]


@pytest.mark.parametrize(
    "more",
    [
        ("--generator-weights", "missing"),
        ("--generator-steps", 4),
        ("--generator", "nothing"),
        ("--reconstructor", "nothing"),
        ("--reconstructor", "depthsplat-small-re10k", "--weights", "missing.ckpt"),
        ("--depth", "nothing"),
        ("--scene", "missing.ply"),
        ("--target", "missing.json"),
        ("--target", "photographs/9.png"),
        ("--target", 4),
        ("--context", 0, 4),
        ("--context", 0, 0),
        ("--near", 3, "--far", 2),
        ("--near", -1),
        ("--resolution", 0),
        ("--target", 1, "--auto", 2),
        ("--video", "--config", "missing.yaml"),
    ],
)
def test_what_is_wrong_is_said_before_cameras_are_searched_for(
    photographs, tmp_path, monkeypatch, capsys, more
):
    """The search takes minutes, and its result is written to OUT."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(opening, "find_poses", lambda *_: pytest.fail("it searches"))
    refused(monkeypatch, capsys, "complete", photographs, "--out", "out", *more)
    assert os.listdir(tmp_path) == ["photographs"]


def test_a_dry_run_replaces_no_result(splat, tmp_path, monkeypatch, capsys):
    out = tmp_path / "out"
    assert run(monkeypatch, "clean", "--scene", splat, "--out", out, "--quiet") == 0
    before = read_all(out)
    words = ("complete", tmp_path / "scene", "--out", out, "--dry-run", "--overwrite")
    assert "holds a result" in refused(monkeypatch, capsys, *words)
    assert read_all(out) == before


@pytest.mark.linux
def test_a_device_and_a_pipe_stay_what_they_are(splat, tmp_path, monkeypatch, capsys):
    os.mkfifo(tmp_path / "pipe.ply")
    (tmp_path / "null.ply").symlink_to("/dev/null")
    for name in ("pipe.ply", "null.ply"):
        words = ("convert", splat, tmp_path / name, "--overwrite")
        assert "a device or a pipe" in refused(monkeypatch, capsys, *words)
    assert sorted(os.listdir(tmp_path)) == ["null.ply", "pipe.ply"]


@pytest.mark.linux
def test_the_host_is_wrong_and_not_the_port(tmp_path, monkeypatch, capsys):
    """It is said before the scene is read."""
    monkeypatch.setattr(preparation, "open_scene", lambda *_: pytest.fail("it reads"))
    for host in ("no.such.host.invalid", "192.0.2.1", "a" * 70, "\udce4"):
        said = refused(monkeypatch, capsys, "live", tmp_path, "--no-open", "--host", host)
        assert said.endswith("(--host).")
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        said = refused(monkeypatch, capsys, "live", tmp_path, "--no-open", "--port", port)
        assert said.endswith("(--port).")


@pytest.mark.linux
def test_a_closed_or_full_output_is_no_traceback(splat, tmp_path):
    out = tmp_path / "o.splat"
    closed = run_apart("convert", splat, out, shell="{} >&-")
    assert (closed.returncode, closed.stderr) == (0, "")
    assert out.is_file()
    both = run_apart("nonsense", shell="{} >&- 2>&-")
    assert both.returncode == 2
    full = run_apart("models", shell="{} > /dev/full")
    assert full.returncode == 1
    # The library that draws tables fails, and its error does not name what is full.
    assert full.stderr == (
        "gscompleter: A file or the standard output cannot be written: No space left on device; "
        "free some space.\n"
    )
    assert run_apart("--version", shell="{} > /dev/full").stderr == (
        "gscompleter: the standard output cannot be written: No space left on device.\n"
    )
    # The sentence is lost there, and the code is not.
    assert run_apart("nonsense", shell="{} 2> /dev/full").returncode == 2


@pytest.mark.linux
def test_a_working_folder_that_was_deleted_is_a_sentence(tmp_path):
    done = run_apart("doctor", shell=f"mkdir {tmp_path}/d && cd {tmp_path}/d && rmdir $PWD && {{}}")
    assert done.returncode == 2
    assert done.stderr.startswith("gscompleter: The working folder was deleted")


@pytest.mark.linux
@pytest.mark.parametrize(
    "megabytes", [300, *(pytest.param(limit, marks=pytest.mark.slow) for limit in (1500, 2500))]
)
def test_a_limit_of_memory_is_a_sentence(splat, tmp_path, megabytes):
    """Every limit ends with a result or a sentence; the libraries' own lines are not ours."""
    limit = f"ulimit -v {megabytes * 1024}; {{}}"
    done = run_apart("convert", splat, tmp_path / "a.splat", shell=limit)
    if done.returncode != 0:
        said = done.stderr.strip().splitlines()
        assert "Traceback (most recent call last):" not in said
        assert done.returncode == 1
        assert any("memory ran out" in line for line in said)
    assert (tmp_path / "a.splat").exists() == (done.returncode == 0)


@pytest.mark.slow
@pytest.mark.linux
def test_names_that_are_no_utf_8_lose_no_run(splat, tmp_path, monkeypatch, capsys):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/B\xe4r"))
    folder.mkdir()
    given = folder / os.fsdecode(b"caf\xe9.ply")
    shutil.copy(splat, given)
    out = folder / "out"
    assert run_apart("clean", "--scene", given, "--out", out).returncode == 0
    assert json.loads((out / "summary.json").read_text())["settings"]["scene"] == str(given)
    place = folder / os.fsdecode(b"\xff.splat")
    assert run(monkeypatch, "convert", given, place, "--quiet") == 0
    words = ("strip", out / "completed.ply", "--out", folder / "back.ply", "--quiet")
    assert run(monkeypatch, *words) == 0
    assert (folder / "back.ply").read_bytes() == splat.read_bytes()
    capsys.readouterr()
    refused(monkeypatch, capsys, "complete", folder / os.fsdecode(b"\xe4"), "--out", out / "o")


@pytest.mark.linux
def test_a_second_conversion_to_one_file_is_refused(splat, tmp_path, monkeypatch, capsys):
    from gscompleter.system.files.unfinished import make_unfinished_name

    with subprocess.Popen(["sleep", "60"]) as other:
        with monkeypatch.context() as elsewhere:
            elsewhere.setattr(os, "getpid", lambda: other.pid)
            mark = tmp_path / make_unfinished_name("o.splat")
        mark.touch()
        words = ("convert", splat, tmp_path / "o.splat")
        said = refused(monkeypatch, capsys, *words)
        assert f"Another run (process {other.pid}) is writing" in said
        other.kill()
    assert run(monkeypatch, *words, "--quiet") == 0
    assert os.listdir(tmp_path) == ["o.splat"]
