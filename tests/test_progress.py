"""Progress on a terminal, in a log, and nowhere."""

from __future__ import annotations

import io
import os
import re
import subprocess
import sys
import time

import pytest
from rich.console import Console

from command import run
from gscompleter import progress, save_ply
from gscompleter.progress import (
    Activity,
    Work,
    expect_stages,
    format_seconds,
    show_preparation,
    show_progress,
    stage,
    track,
)
from scenes import random_gaussians

CONTROL = re.compile(r"[\x00-\x09\x0b-\x1f\x7f]")
"""Characters that do not belong into a log."""


SMALL = ("--context", 0, 1, "--target", 2, "--resolution", 32, "--near", 0.5, "--far", 20)


class Clock:
    """A clock that tests advance."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.now = 1000.0
        monkeypatch.setattr(progress.time, "monotonic", lambda: self.now)

    def pass_by(self, seconds: float) -> None:
        self.now += seconds


@pytest.fixture
def clock(monkeypatch) -> Clock:
    return Clock(monkeypatch)


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


def test_a_log_is_told_again_what_takes_long(monkeypatch):
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.05)
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console):
        for number in track(range(3), "scores"):
            time.sleep(0.12 if number == 1 else 0)
    told = written(console).splitlines()
    assert told[0] == "scores 1 of 3: 0%"
    assert set(told[1:]) >= {"scores 2 of 3: 33%, about 0 s left"}
    assert len(told) > 2
    assert not CONTROL.search(written(console))


def test_nothing_is_said_once_all_is_done(monkeypatch):
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.02)
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console):
        with stage("reading"):
            pass
        said = written(console)
        time.sleep(0.1)
        assert written(console) == said == "reading\n"


def test_a_log_hears_of_preparations_only_where_they_take_long(monkeypatch):
    monkeypatch.setattr(progress, "LOG_SECONDS", 0.2)
    console = Console(file=io.StringIO(), width=200)
    with show_progress(console):
        with show_preparation("reading"):
            pass
        assert written(console) == ""
        with show_preparation("placing"):
            time.sleep(0.5)
    assert set(written(console).splitlines()) == {"placing"}


def test_a_terminal_has_a_line_that_goes_away():
    console = terminal()
    with show_progress(console), expect_stages([("context", 3.0), ("target", 7.0)]):
        work_at_target()
    said = written(console)
    shown = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", said)
    assert "context" in shown
    assert "target 2 of 2: register" in shown
    assert "about 10 s left" in shown
    assert "Registering" not in shown  # it is the same
    assert said.rstrip("\n").endswith(("\x1b[2K", "\x1b[?25h"))  # the line erased, the cursor shown


def test_a_terminal_has_its_cursor_back_after_an_interrupt():
    console = terminal()
    with pytest.raises(KeyboardInterrupt), show_progress(console), stage("context"):
        raise KeyboardInterrupt
    assert written(console).rfind("\x1b[?25h") > written(console).rfind("\x1b[?25l") >= 0


def test_what_is_left_of_counted_steps_is_told_by_those_that_are_done(clock):
    work = Work([Activity("film", 10)])
    assert work.estimate_left() is None
    for _ in range(4):
        clock.pass_by(2.0)
        work.running[0].count_step()
    assert work.estimate_left() == pytest.approx(12.0)
    clock.pass_by(0.5)  # of a step that goes on
    assert work.estimate_left() == pytest.approx(11.5)
    assert work.estimate_fraction() == pytest.approx(0.4)


def test_what_is_left_of_stages_follows_the_pace_of_those_that_are_over(clock):
    work = Work()
    work.expect([("context", 10.0), ("target", 20.0), ("report", 2.0)])
    context = Activity("context")
    work.begin(context)
    assert work.estimate_left() == pytest.approx(32.0)
    clock.pass_by(15.0)  # half as long again
    assert work.estimate_left() == pytest.approx(1.5 + 22.0)
    work.end(context)
    assert work.estimate_left() == pytest.approx(1.5 * 22.0)
    work.begin(Activity("target", 2))
    clock.pass_by(6.0)
    assert work.estimate_left() == pytest.approx(1.5 * 22.0 - 6.0)
    work.begin(Activity("context"))  # of that target: it is no stage of its own
    assert work.estimate_left() == pytest.approx(1.5 * 22.0 - 6.0)


def test_a_stage_that_is_left_out_takes_no_time(clock):
    work = Work()
    work.expect([("context", 10.0), ("target", 20.0), ("report", 2.0)])
    report = Activity("report")
    work.begin(report)
    assert work.estimate_left() == pytest.approx(2.0)
    work.end(report)
    assert work.estimate_left() == 0.0


def test_the_share_that_is_done_never_goes_back(clock):
    work = Work()
    work.expect([("context", 1.0), ("target", 9.0)])
    context = Activity("context")
    work.begin(context)
    clock.pass_by(10.0)
    work.expected = [("context", 1.0), ("target", 0.1)]
    first = work.estimate_fraction()
    work.expected = [("context", 1.0), ("target", 9.0)]
    work.end(context)
    assert first == pytest.approx(0.9, abs=0.01)
    assert work.estimate_left() == pytest.approx(90.0)
    assert work.estimate_fraction() == first
    clock.pass_by(890.0)
    assert first < work.estimate_fraction() < 1


def test_stages_that_were_not_timed_tell_the_share_that_is_done(clock):
    work = Work()
    inside = [("context", 2.0), ("generate", 1.0), ("register", 1.0)]
    work.expect([("context", 2.0), *inside, ("report", 2.0)], is_timed=False)
    shares, target = [], Activity("target", 1)
    for name in ("context", "generate", "register", "report"):
        if name == "generate":
            work.begin(target)
        activity = Activity(name)
        work.begin(activity)
        shares.append(work.estimate_fraction())
        clock.pass_by(3.0)
        work.end(activity)
    assert shares == pytest.approx([0.0, 0.5, 0.625, 0.75])
    assert work.estimate_fraction() == pytest.approx(1.0)


def test_steps_inside_of_a_stage_count_for_the_share(clock):
    work = Work()
    work.expect([("generate", 1.0), ("register", 3.0)], is_timed=False)
    work.begin(Activity("register"))
    steps = Activity("Registering", 10)
    work.begin(steps)
    for _ in range(5):
        clock.pass_by(1.0)
        steps.count_step()
    assert work.estimate_fraction() == pytest.approx(0.25 + 0.75 * 0.5)
    assert work.estimate_left() == pytest.approx(5.0)


def test_progress_on_a_given_splat_advances_over_the_stages(room, tmp_path, monkeypatch, capfd):
    first, out = tmp_path / "first", tmp_path / "out"
    assert run(monkeypatch, "complete", room, *SMALL, "--out", first, "--quiet") == 0
    splat = ("--scene", first / "context.ply")
    assert run(monkeypatch, "complete", room, *SMALL, *splat, "--out", out) == 0
    log = capfd.readouterr().err
    shares = [int(n) for n in re.findall(r"^target 1 of 1: \w+: (\d+)%", log, re.MULTILINE)]
    assert len(set(shares)) > 3
    assert shares == sorted(shares)
    assert shares[0] > 0


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


def test_times_in_words():
    assert [format_seconds(s) for s in (0.4, 59.6, 125.0, 4830.0)] == [
        "0 s",
        "1 min 0 s",
        "2 min 5 s",
        "1 h 20 min",
    ]


def test_a_completion_names_the_stages_of_the_paper(room, tmp_path, monkeypatch, capfd):
    assert run(monkeypatch, "complete", room, *SMALL, "--out", tmp_path / "out") == 0
    out, log = capfd.readouterr()
    begun = [line.split(": ")[0:2] for line in log.splitlines()]
    assert "context" in [line[0] for line in begun]
    inside = [line[1] for line in begun if line[0] == "target 1 of 1"]
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
    assert out.count("\n") == 1
    assert log == ""


@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no pseudo-terminal")
def test_on_a_terminal_there_is_a_line_with_a_bar(room, tmp_path):
    import pty

    mine, theirs = pty.openpty()
    words = ["complete", room, *SMALL, "--out", tmp_path / "out"]
    program = [sys.executable, "-c", "from gscompleter.cli import main; main()", *map(str, words)]
    environment = {**os.environ, "TERM": "xterm-256color", "COLUMNS": "120"}
    subprocess.run(program, stderr=theirs, stdout=subprocess.PIPE, env=environment, check=True)
    os.close(theirs)
    said = os.read(mine, 2**20).decode(errors="ignore")
    assert "\x1b[?25l" in said
    assert "target 1 of 1: " in said
    assert "%" in said
