"""The file of cases: what it holds, and a sentence for each mistake."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from gscompleter.evaluation.case_file import CASE_KEYS, FILE_KEYS, read_case_file
from gscompleter.evaluation.cases import read_cases
from gscompleter.system.errors import InputError
from paths import ROOT
from scenes import camera_at, photographed

CASE = {"scene": "room", "context": [0, 4], "target": 8, "neighbours": [7, 9]}


def write(folder: Path, **changes: object) -> Path:
    path = folder / "cases.json"
    path.write_text(json.dumps({"resolution": [48, 64], "cases": [CASE], **changes}))
    return path


def with_case(**changes: object) -> dict[str, object]:
    return {"cases": [{**CASE, **changes}]}


def test_a_case_is_read(tmp_path, monkeypatch):
    monkeypatch.setenv("PLACE", "there")
    rows = [CASE, {**CASE, "scene": "$PLACE/room", "near": 1, "far": 2.5, "neighbours": []}]
    first, second = read_cases(write(tmp_path, cases=rows, about="two cases"))
    assert first.scene == tmp_path / "room"
    assert (first.context, first.target, first.neighbours) == ((0, 4), 8, (7, 9))
    assert (first.resolution, first.near, first.far) == ((48, 64), None, None)
    assert second.scene == tmp_path / "there" / "room"
    assert (second.near, second.far) == (1.0, 2.5)


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"resolution": [48]}, "resolution has to be height and width"),
        ({"resolution": [0, 48]}, "and is [0, 48]."),
        ({"cases": []}, "cases has to be a list of cases, and is []."),
        ({"cases": 3}, "and is 3."),
        ({"cases": ["room"]}, "case 1 has to be an object"),
        ({"case": []}, "cases: it has the key 'case', which is none of resolution, cases"),
        ({"scenes": ["room"]}, "a protocol chooses the frames; give one."),
        (with_case(neighbors=[1]), "case 1 has the key 'neighbors', which is none of scene"),
        (with_case(scene=""), 'needs scene, a folder relative to the file; it has "".'),
        (with_case(context=[0]), "a list of at least two frames"),
        (with_case(context=None), "has context nothing"),
        (with_case(context=[0, 0]), "has frame 0 twice in context"),
        (with_case(context=[0, -1]), "a list of numbers of frames counted from 0"),
        (with_case(target=None), "needs target, the number of a frame"),
        (with_case(target=True), "it has true."),
        (with_case(target=4), "has its target 4 in the context"),
        (with_case(neighbours=[8]), "has frame 8 among its neighbours"),
        (with_case(near="a"), 'has near "a", and a positive z-depth'),
        (with_case(near=0), "has near 0"),
        (with_case(near=3, far=2), "near 3, which is not before far 2"),
        (with_case(ignore=[]), "has ignore [], and a list of polygons is needed"),
        (with_case(ignore=[[[0, 0], [1, 1]]]), "of three corners"),
        (with_case(ignore=[[[0, 0], [1, 0], [1, 20]]]), "in shares of width and height"),
        (with_case(ignore=True), "has ignore true"),
        (with_case(ignore="none.png"), 'has ignore "none.png", and there is no such file'),
        (
            {"cases": [CASE, {**CASE, "scene": "./there/../room/"}]},
            "case 2 has the scene, context and target of case 1",
        ),
        ({"cases": [CASE, CASE]}, "case 2 has the scene, context and target of case 1"),
    ],
)
def test_a_mistake_is_one_sentence(tmp_path, changes, sentence):
    path = write(tmp_path, **changes)
    with pytest.raises(InputError, match=re.escape(sentence)) as error:
        read_case_file(path)
    assert "is no file of cases" in str(error.value)
    assert str(error.value).endswith(".")


LOWER_QUARTER = [[[0, 0.75], [1, 0.75], [1, 1], [0, 1]]]


@pytest.mark.parametrize("is_mask", [False, True])
def test_what_is_ignored_is_hidden_in_every_photograph(tmp_path, is_mask):
    photographed(tmp_path / "room", [camera_at(x=x, size=32) for x in (0.0, 0.2, 0.4)])
    ignore: object = LOWER_QUARTER
    if is_mask:
        # Of another size than the photographs, which are scaled to it.
        mask = np.full((8, 8), 255, np.uint8)
        mask[6:] = 0
        Image.fromarray(mask).save(tmp_path / "bonnet.png")
        ignore = "bonnet.png"
    row = {"scene": "room", "context": [0, 1], "target": 2, "ignore": ignore}
    (case,) = read_cases(write(tmp_path, cases=[row], resolution=[16, 16]))
    for view in replace(case, uses_masks=False).load((0, 1, 2)):
        assert view.ignore_mask is not None
        assert view.ignore_mask[12:].all()
        assert not view.ignore_mask[:12].any()


@pytest.mark.parametrize(("level", "what"), [(0, "everything"), (255, "nothing")])
def test_a_mask_that_leaves_all_or_nothing_is_refused(tmp_path, level, what):
    pixels = np.full((8, 8), level, np.uint8)
    Image.fromarray(pixels).save(tmp_path / "mask.png")
    with pytest.raises(InputError, match=f"case 1 has ignore with {what} in it"):
        read_cases(write(tmp_path, **with_case(ignore="mask.png")))


def test_the_page_names_all_keys():
    text = (ROOT / "docs" / "reference" / "evaluating.md").read_text()
    section = text.partition("## cases.json")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`[^|]+) \|", section, re.M)
    assert set(re.findall(r"`(\w+)`", " ".join(rows))) == {*FILE_KEYS, *CASE_KEYS}
    (example,) = re.findall(r"^```text\n(\{.*?)^```$", section, re.M | re.S)
    json.loads(example)
