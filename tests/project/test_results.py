"""Figures of the documentation are those of stored outputs, and held-out cases are held out."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gscompleter.evaluation.cases import read_cases
from paths import ROOT

BENCHMARKS = ROOT / "benchmarks"


def run_script(name: str, *words: str, **environment: str) -> subprocess.CompletedProcess[str]:
    path = os.pathsep.join(filter(None, [str(ROOT / "src"), os.environ.get("PYTHONPATH")]))
    command = [sys.executable, str(BENCHMARKS / name), *words]
    env = {**os.environ, "PYTHONPATH": path, **environment}
    return subprocess.run(command, capture_output=True, text=True, env=env, check=False)


def test_pages_hold_the_figures_of_the_stored_outputs():
    ended = run_script("write_results.py", "--check")
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.fixture
def cases(monkeypatch: pytest.MonkeyPatch) -> list:
    monkeypatch.setenv("GSCOMPLETER_DATA", "/photographs")
    return read_cases(BENCHMARKS / "held_out.json")


def test_held_out_cases_are_in_the_folder_that_the_environment_names(cases):
    assert {case.scene.parent for case in cases} == {Path("/photographs/data")}
    assert len({case.name for case in cases}) == len(cases) == 16


def test_no_two_held_out_cases_of_a_scene_share_a_frame(cases):
    for scene in {case.scene for case in cases}:
        frames = [
            frame
            for case in cases
            if case.scene == scene
            for frame in (*case.context, case.target, *case.neighbours)
        ]
        assert len(set(frames)) == len(frames)


def test_no_frame_of_a_held_out_case_is_in_a_development_case(shared, cases):
    developed = read_cases(shared / "data" / "cases.json")
    seen = {
        (case.scene.name, frame)
        for case in developed
        for frame in (*case.context, case.target, *case.neighbours)
    }
    for case in cases:
        for frame in (*case.context, case.target, *case.neighbours):
            assert (case.scene.name, frame) not in seen


def test_held_out_cases_are_those_of_the_rule(shared, tmp_path):
    """The script writes beside itself; a copy of it gives the same file."""
    script = tmp_path / "choose_held_out.py"
    script.write_bytes((BENCHMARKS / "choose_held_out.py").read_bytes())
    environment = {**os.environ, "GSCOMPLETER_DATA": str(shared)}
    subprocess.run([sys.executable, str(script)], env=environment, check=True, capture_output=True)
    written = (tmp_path / "held_out.json").read_bytes()
    assert written == (BENCHMARKS / "held_out.json").read_bytes()
    assert json.loads(written)["apart"] == ["fountain_p11", "kitti_city"]
