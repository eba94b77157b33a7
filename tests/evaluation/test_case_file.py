"""The file of cases: what it holds, and a sentence for each mistake."""

from __future__ import annotations

import json
import re
from pathlib import Path

import pytest

from gscompleter.evaluation.case_file import CASE_KEYS, FILE_KEYS, read_case_file
from gscompleter.evaluation.cases import read_cases
from gscompleter.system.errors import InputError
from paths import ROOT

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
        ({"case": []}, "has the key 'case', which is none of resolution, cases"),
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
        ({"cases": [CASE, CASE]}, "case 2 has the scene, context and target of case 1"),
    ],
)
def test_a_mistake_is_one_sentence(tmp_path, changes, sentence):
    path = write(tmp_path, **changes)
    with pytest.raises(InputError, match=re.escape(sentence)) as error:
        read_case_file(path)
    assert "is no file of cases" in str(error.value)
    assert str(error.value).endswith(".")


def test_the_page_names_all_keys():
    text = (ROOT / "docs" / "reference" / "evaluating.md").read_text()
    section = text.partition("## cases.json")[2].partition("\n## ")[0]
    rows = re.findall(r"^\| (`[^|]+) \|", section, re.M)
    assert set(re.findall(r"`(\w+)`", " ".join(rows))) == {*FILE_KEYS, *CASE_KEYS}
    (example,) = re.findall(r"^```text\n(\{.*?)^```$", section, re.M | re.S)
    json.loads(example)
