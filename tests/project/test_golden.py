"""A synthetic room is completed as it was when `benchmarks/golden.json` was recorded."""

import json
import os

import pytest

import golden
from paths import ROOT

KNOWN = json.loads((ROOT / "benchmarks" / "golden.json").read_text("utf-8"))


@pytest.fixture(scope="module")
def room(tmp_path_factory):
    folder = tmp_path_factory.mktemp("golden")
    return golden.run_scenes(dict(golden.list_room_runs(folder)), folder / "out")


def test_the_room_is_completed_as_it_was_recorded(room):
    """Scores everywhere, and bytes on the type of processor that recorded them."""
    found = {"machine": golden.describe_machine(), "room": room}
    if "ATEN_CPU_CAPABILITY" in os.environ:
        found["machine"] = None
    assert set(room) == set(KNOWN["room"])
    assert golden.compare(KNOWN, found) == []


def test_another_result_is_a_difference(room):
    worse = json.loads(json.dumps(room))
    scores = worse["room, default"]["scores"][-1]
    scores["psnr_after"] -= 2 * golden.CASE_TOLERANCE
    for machine in (KNOWN["machine"], {"processor": "another one"}):
        differences = golden.compare(KNOWN, {"machine": machine, "room": worse})
        assert any(line.startswith("room, default: ") for line in differences)
