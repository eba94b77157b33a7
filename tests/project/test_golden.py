"""A synthetic room is completed as it was when `benchmarks/golden.json` was recorded."""

import json
import os

import pytest

import golden
from paths import ROOT

KNOWN = json.loads((ROOT / "benchmarks" / "golden.json").read_text("utf-8"))


@pytest.mark.parametrize(
    "name", ["room, default", pytest.param("room, paper", marks=pytest.mark.slow)]
)
def test_the_room_is_completed_as_it_was_recorded(name, tmp_path):
    """Scores everywhere, and bytes on the type of processor that recorded them."""
    runs = dict(golden.list_room_runs(tmp_path))
    assert set(runs) == set(KNOWN["room"])
    found = golden.run_scenes({name: runs[name]}, tmp_path / "out")
    now = {"machines": {"room": golden.describe_machine()}, "room": found}
    if "ATEN_CPU_CAPABILITY" in os.environ:
        now["machines"] = {}
    assert golden.compare(KNOWN, now) == []


def test_another_result_is_a_difference():
    worse = json.loads(json.dumps(KNOWN["room"]))
    scores = worse["room, default"]["scores"][-1]
    scores["psnr_after"] -= 2 * golden.CASE_TOLERANCE
    for machine in (KNOWN["machines"]["room"], {"processor": "another one"}):
        differences = golden.compare(KNOWN, {"machines": {"room": machine}, "room": worse})
        assert any(line.startswith("room, default: ") for line in differences)


CPUINFO = """processor\t: 0
vendor_id\t: AuthenticAMD
cpu family\t: 25
model\t\t: {model}
model name\t: AMD EPYC
stepping\t: 1

processor\t: 1
model\t\t: 0
"""


def test_processors_of_one_name_are_told_apart():
    """Virtual machines call several generations the same, which round differently."""
    described = [golden.describe_processor(CPUINFO.format(model=model)) for model in (1, 17)]
    assert described[0] == "AMD EPYC, cpu family 25, model 1, stepping 1"
    assert described[1] == "AMD EPYC, cpu family 25, model 17, stepping 1"


def test_what_is_recorded_in_part_leaves_the_machine_of_the_rest(tmp_path, monkeypatch):
    file = tmp_path / "golden.json"
    another = {"processor": "another one"}
    here = golden.describe_machine()
    file.write_text(json.dumps({"machines": {"scenes": another, "room": another}}))
    monkeypatch.setattr(golden, "run_texts", lambda: {"new": []})
    monkeypatch.setattr(golden, "run_scenes", lambda runs, folder: {"room": {}})
    for section, machine in (("texts", another), ("room", here)):
        words = ["golden.py", "record", "--only", section, "--file", str(file)]
        monkeypatch.setattr("sys.argv", words)
        golden.main()
        machines = json.loads(file.read_text())["machines"]
        assert machines == {"scenes": another, "room": machine}
