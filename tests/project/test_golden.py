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
    now = {"machine": golden.describe_machine(), "room": found}
    if "ATEN_CPU_CAPABILITY" in os.environ:
        now["machine"] = None
    assert golden.compare(KNOWN, now) == []


def test_another_result_is_a_difference():
    worse = json.loads(json.dumps(KNOWN["room"]))
    scores = worse["room, default"]["scores"][-1]
    scores["psnr_after"] -= 2 * golden.CASE_TOLERANCE
    for machine in (KNOWN["machine"], {"processor": "another one"}):
        differences = golden.compare(KNOWN, {"machine": machine, "room": worse})
        assert any(line.startswith("room, default: ") for line in differences)


def test_texts_recorded_on_another_machine_leave_that_of_the_bytes(tmp_path, monkeypatch):
    file = tmp_path / "golden.json"
    file.write_text(json.dumps({"machine": {"processor": "another one"}, "texts": {}}))
    monkeypatch.setattr(golden, "run_texts", lambda: {"new": []})
    words = ["golden.py", "record", "--only", "texts", "--file", str(file)]
    monkeypatch.setattr("sys.argv", words)
    golden.main()
    expected = {"machine": {"processor": "another one"}, "texts": {"new": []}}
    assert json.loads(file.read_text()) == expected
