"""The settings in `summary.json` tell two runs apart whose options give different results."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from gscompleter.apps.completing.run_info import describe_run_values
from gscompleter.apps.inputs.task import CompletionTask, Opened
from gscompleter.apps.requests.scene import (
    AloneRequest,
    PhotographsRequest,
    PosesRequest,
    SceneRequest,
)
from gscompleter.apps.requests.splat import SplatRequest
from gscompleter.config import CompleterConfig
from gscompleter.data.formats import open_photographs
from gscompleter.data.mask_reading import MaskReading
from scenes import camera_at, photographed

SPLAT = SplatRequest(Path("splat.ply"))


@pytest.fixture(scope="module")
def describe(tmp_path_factory):
    folder = photographed(tmp_path_factory.mktemp("scene"), [camera_at(0, size=16)] * 2)
    reading = SceneRequest(folder, resolution=None)
    photographs = open_photographs(folder)
    opened = Opened(reading, photographs, "nerfstudio", 2)
    views = photographs.views([0, 1])
    task = CompletionTask(views, [], frame=np.eye(4), origin=np.zeros(3), depths={})

    def describe_settings(splat: SplatRequest = SPLAT, alone: dict | None = None, **more) -> dict:
        scene = replace(reading, **more)
        source = PhotographsRequest(scene, PosesRequest(folder))
        if alone is not None:
            source = AloneRequest(scene, **alone)
        values = describe_run_values(source, splat, opened, task, CompleterConfig())
        return json.loads(json.dumps(values))["settings"]

    return describe_settings


@pytest.mark.parametrize(
    ("name", "value", "given"),
    [
        ("ignore", "masks", {"masks": MaskReading(folder=Path("masks"))}),
        ("drop_nonfinite", True, {"splat": replace(SPLAT, drop_nonfinite=True)}),
        ("forget_edits", True, {"splat": replace(SPLAT, forget_edits=True)}),
        ("cameras", "some.json", {"alone": {"cameras": Path("some.json")}}),
        ("up", [0, 0, 1], {"alone": {"up": (0.0, 0.0, 1.0)}}),
    ],
)
def test_an_option_that_changes_the_result_is_written_down(describe, name, value, given):
    without = describe(alone={} if "alone" in given else None)
    assert without[name] in (None, False)
    assert describe(**given) == {**without, name: value}
