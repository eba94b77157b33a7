"""Progress on a terminal, in a log, and nowhere."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import time
from functools import partial

import pytest
from rich.console import Console

from command import run
from gscompleter import save_ply
from gscompleter.system import progress
from gscompleter.system.progress import show_preparation, show_progress, stage, track
from scenes import random_gaussians

CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f]")
"""Characters that do not belong into a log."""


SMALL = ("--context", 0, 1, "--target", 2, "--resolution", 32, "--near", 0.5, "--far", 20)


def terminal() -> Console:
    return Console(force_terminal=True, file=io.StringIO(), width=100, _environ={"TERM": "xterm"})


def written(console: Console) -> str:
    assert isinstance(console.file, io.StringIO)
    return console.file.getvalue()


def work_at_target() -> None:
    """Run a stage, and two steps with a stage and steps of its own each."""
    with stage("context"):
        pass
    for _ in track(range(2), "target"):
        with stage("register"):
            for _ in track(range(3), "Registering"):
                pass


def test_a_log_has_a_line_for_each_stage():
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console):
        work_at_target()
    lines = [line.split(":") for line in written(console).splitlines()]
    assert [line[0] for line in lines] == ["context", *["target 1 of 2"] * 2, "target 2 of 2"]
    assert [line[1].strip() for line in lines[2:]] == ["register", "register"]


def test_a_log_counts_what_takes_long(monkeypatch):
    """A line of its own for each step that is `LOG_SECONDS` after the last line."""
    clock = iter(range(100))
    monkeypatch.setattr(progress.time, "monotonic", lambda: 12.0 * next(clock))
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console):
        for _ in track(range(3), "scores"):
            pass
    assert written(console).splitlines() == [f"scores {i} of 3" for i in (1, 2, 3)]
    assert not CONTROL.search(written(console))


def test_a_log_has_no_line_for_each_step_that_is_short():
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console):
        for _ in track(range(3), "scores"):
            pass
    assert written(console) == "scores 1 of 3\n"


def test_a_log_hears_of_what_takes_long_within_a_step(monkeypatch):
    """A stage without steps, or a step that is slow, says again that it runs, and since when."""
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.05)
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console), stage("clean"):
        for _ in track(range(2), "Comparing photographs"):
            time.sleep(0.3)
    lines = written(console).splitlines()
    assert lines[0] == "clean"
    assert any(re.fullmatch(r"clean: Comparing photographs 1 of 2 \(\d+ s\)", x) for x in lines)
    assert not CONTROL.search(written(console))


def test_a_log_is_silent_after_its_end(monkeypatch):
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.01)
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console), stage("clean"):
        pass
    said = written(console)
    time.sleep(0.1)
    assert written(console) == said


def test_a_log_does_not_repeat_a_stage_after_its_steps():
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console), stage("clean"):
        for name in ("Searching", "Comparing"):
            for _ in track(range(2), name):
                pass
    assert written(console) == "clean\n"


def test_a_log_does_not_hear_of_preparations():
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console), show_preparation("reading"):
        pass
    assert written(console) == ""


def test_a_terminal_has_a_line_that_goes_away():
    console = terminal()
    with show_progress(console):
        work_at_target()
    said = written(console)
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", said)
    assert "context" in shown
    for label in ("target 2 of 2", "register", "Registering"):
        assert label in shown
    assert said.rstrip("\n").endswith(("\x1b[2K", "\x1b[?25h"))  # the line erased, the cursor shown


def test_a_terminal_shows_only_what_runs():
    console = terminal()
    with show_progress(console), stage("outer"):
        for _ in track(range(2), "steps"):
            pass
    assert "steps 1 of 2" in written(console)
    assert "steps" not in written(console).rpartition("outer")[2]


def test_an_iteration_that_outlives_its_stage_ends_quietly():
    """As after an exception, whose traceback keeps the generator of a loop."""
    console = terminal()
    with show_progress(console):
        with stage("poses"):
            photographs = iter(track(range(5), "photographs"))
            next(photographs)
        with stage("report"):
            photographs.close()  # type: ignore[attr-defined]
    assert "report" in written(console)


def test_a_terminal_has_its_cursor_back_after_an_interrupt():
    console = terminal()
    with pytest.raises(KeyboardInterrupt), show_progress(console), stage("context"):
        raise KeyboardInterrupt
    assert written(console).rfind("\x1b[?25h") > written(console).rfind("\x1b[?25l") >= 0


def test_a_library_call_says_nothing(capfd):
    work_at_target()
    assert track([1, 2], "numbers") == [1, 2]
    with show_progress(terminal()), show_progress(None):
        work_at_target()
    assert capfd.readouterr() == ("", "")


def test_a_loop_that_ends_early_is_over():
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console):
        with stage("poses"):
            for number in track(range(5), "photographs"):
                if number == 1:
                    break
        with stage("report"):
            pass
    assert written(console).splitlines() == ["poses", "report"]


@pytest.mark.slow
def test_a_completion_names_the_stages_of_the_paper(room, tmp_path, monkeypatch, capfd):
    assert run(monkeypatch, "complete", room, *SMALL, "--out", tmp_path / "out") == 0
    out, log = capfd.readouterr()
    # Without the lines on what takes long, which a busy machine adds.
    begun = [line.split(": ")[0:2] for line in log.splitlines() if not line.endswith(" s)")]
    assert "context" in [line[0] for line in begun]
    inside = [line[1] for line in begun if line[0] == "target 1 of 1" and len(line) > 1]
    assert inside[-4:] == ["generate", "lift", "register", "integrate"]
    assert [line[0] for line in begun][-1] == "report"
    assert not CONTROL.search(log)
    assert "register" not in out


def test_a_quiet_completion_says_nothing(room, tmp_path, monkeypatch, capfd):
    assert run(monkeypatch, "complete", room, *SMALL, "--out", tmp_path / "out", "--quiet") == 0
    assert capfd.readouterr() == ("", "")


def test_results_of_other_commands_are_alone_in_the_standard_output(tmp_path, monkeypatch, capfd):
    save_ply(tmp_path / "a.ply", random_gaussians(50))
    assert run(monkeypatch, "convert", tmp_path / "a.ply", tmp_path / "b.spz") == 0
    out, log = capfd.readouterr()
    rounding, sentence = out.splitlines()
    assert rounding.startswith("Largest rounding: ")
    assert sentence.endswith("b.spz")
    assert log == ""


def read_terminal(file: int) -> str:
    """Read the next bytes of a pseudo-terminal; nothing once its process has ended."""
    try:
        return os.read(file, 2**16).decode(errors="ignore")
    except OSError:  # Linux raises EIO at the end.
        return ""


# Lines with bars are written to a terminal without a process above.
@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminal")
def test_on_a_terminal_there_is_a_line_with_a_bar(room, tmp_path):
    import pty

    mine, theirs = pty.openpty()
    words = ["complete", room, *SMALL, "--out", tmp_path / "out"]
    program = [sys.executable, "-c", "from gscompleter.cli import main; main()", *map(str, words)]
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "120"}
    process = subprocess.Popen(program, stderr=theirs, stdout=subprocess.DEVNULL, env=environment)
    os.close(theirs)
    said = "".join(iter(partial(read_terminal, mine), ""))
    assert process.wait() == 0
    assert "\x1b[?25l" in said
    assert "target 1 of 1" in said
    assert "━" in said


def test_a_stage_of_a_log_is_never_silent_for_long(monkeypatch):
    """Also the steps inside of a stage are told then, which have no lines else."""
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.05)
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console), stage("clean"):
        time.sleep(0.3)
        for _ in track(range(3), "photographs"):
            time.sleep(0.1)
    lines = written(console).splitlines()
    assert lines[0] == "clean"
    assert lines.count("clean (0 s)") >= 2
    assert any(re.fullmatch(r"clean: photographs [123] of 3 \(0 s\)", line) for line in lines)


def test_a_log_says_nothing_after_the_last_stage(monkeypatch):
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.02)
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console):
        with stage("clean"):
            pass
        time.sleep(0.1)
        # Counted steps have a line as each ends, and the wait for the next one has none.
        for _ in track(range(1), "scenes"):
            time.sleep(0.1)
    time.sleep(0.1)
    assert written(console).splitlines()[:2] == ["clean", "scenes 1 of 1"]
    assert set(written(console).splitlines()) == {"clean", "scenes 1 of 1"}
