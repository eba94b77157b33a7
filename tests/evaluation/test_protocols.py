"""Protocols: which frames of a clip are context and which are targets."""

import json
import os

import numpy as np
import pytest

from chunk_files import VIEWS, example, save_chunk
from gscompleter import InputError
from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.real_estate import open_chunks
from gscompleter.evaluation.cases import open_clips
from gscompleter.evaluation.protocols import (
    INDICES,
    EvaluationIndex,
    Split,
    build_index,
    find_neighbour_frames,
    list_indices,
    make_tasks,
    parse_protocol,
    read_evaluation_index,
    write_evaluation_index,
)
from gscompleter.types import View

README = (INDICES / "README.md").read_text("utf-8")


class Frames(Photographs):
    """A clip with frame numbers only."""

    name, names, origin = "", (), np.zeros(3)

    def __init__(self, name: str, count: int) -> None:
        vars(self).update(name=name, count=count)

    def __len__(self) -> int:
        return self.count

    def views(self, frames, resolution=None) -> list[View]:
        return [VIEWS[frame % len(VIEWS)] for frame in frames]

    def find_skip_reason(self) -> None:
        return None


def test_two_frames_are_extrapolated_to_a_third_in_both_directions():
    index = build_index(
        parse_protocol("n-10-stride-2"), [Frames("a", 24), Frames("b", 21), Frames("c", 20)]
    )
    there = [((n, n + 10), (n + 20,)) for n in (0, 2)]
    back = [((n + 20, n + 10), (n,)) for n in (0, 2)]
    found = [(split.context, split.targets) for split in index.scenes["a"]]
    assert found == [there[0], back[0], there[1], back[1]]
    assert len(index.scenes["b"]) == 2
    assert index.scenes["c"] == ()
    assert index.name == "n-10-stride-2"


def test_without_a_stride_no_two_starts_share_a_frame():
    splits = parse_protocol("n-3").select_splits(Frames("a", 50))
    used = [sorted({*split.context, *split.targets}) for split in splits[::2]]
    assert used == [[n, n + 3, n + 6] for n in range(0, 44, 7)]


def test_the_stress_test_needs_a_hundred_frames():
    assert parse_protocol("stress").select_splits(Frames("a", 100)) == (Split((0, 30), (99,)),)
    assert parse_protocol("stress").select_splits(Frames("a", 99)) == ()


@pytest.mark.parametrize("text", ["n-10", "n-30-stride-5", "stress"])
def test_a_protocol_is_called_what_it_was_asked_for_as(text):
    assert parse_protocol(text).name == text
    assert parse_protocol(text) == parse_protocol(text)


@pytest.mark.parametrize("text", ["n-", "n-x", "n--1", "n-1.5", "m-10", "", "n-١", "missing.json"])
def test_what_is_no_protocol_is_told_what_would_be_one(text):
    with pytest.raises(InputError, match="There is no protocol .* n-K .* stress"):
        parse_protocol(text)


@pytest.mark.parametrize("text", ["n-0", "n-5-stride-0"])
def test_an_extrapolation_over_nothing_is_refused(text):
    with pytest.raises(InputError, match="at least 1"):
        parse_protocol(text)


@pytest.mark.parametrize(
    ("name", "num_scenes", "split"),
    [
        ("re10k-n-30", 5387, Split((0, 30), (60,))),
        ("acid-n-30", 1343, Split((0, 30), (60,))),
        ("dl3dv-n-10", 140, Split((0, 10), (20,))),
        ("dl3dv-n-20", 140, Split((0, 20), (40,))),
        ("dl3dv-n-30", 140, Split((0, 30), (60,))),
        ("dl3dv-stress", 140, Split((0, 30), (99,))),
    ],
)
def test_our_indices_are_the_first_case_of_the_rule_in_every_scene(name, num_scenes, split):
    index = parse_protocol(name)
    assert name in list_indices()
    assert (index.name, len(index.scenes)) == (name, num_scenes)
    assert set(index.scenes.values()) == {(split,)}
    rule = parse_protocol(name.partition("-")[2])
    assert rule.split(1 + split.targets[0])[0] == split
    line = next(line for line in README.splitlines() if line.startswith(f"| `{name}.json`"))
    cells = [cell.strip() for cell in line.strip("|").split("|")]
    assert cells[1:4] == ["0, " + str(split.context[1]), str(split.targets[0]), str(num_scenes)]


def test_scenes_of_one_data_set_are_the_same_in_all_of_our_indices():
    scenes = [set(parse_protocol(name).scenes) for name in list_indices() if "dl3dv" in name]
    assert all(of == scenes[0] for of in scenes)


def test_scenes_of_our_indices_are_long_enough_by_the_published_ones(shared):
    """Frames that the published indices of interpolation name do exist."""
    for name in ("re10k", "acid"):
        file = shared / "formats" / "evaluation_index" / f"evaluation_index_{name}.json"
        published = json.loads(file.read_text())
        for scene in parse_protocol(f"{name}-n-30").scenes:
            split = published[scene]
            assert max(*split["context"], *split["target"]) >= 60


def test_neighbours_exist_and_are_not_context():
    assert find_neighbour_frames(5, (0, 1), 10) == (4, 6)
    assert find_neighbour_frames(2, (0, 1), 10) == (3,)
    assert find_neighbour_frames(9, (0, 1), 10) == (8,)
    assert find_neighbour_frames(0, (2, 1), 10) == ()


def test_a_case_has_one_target_and_loads_its_views():
    index = EvaluationIndex("x", {"a": (Split((0, 2), (3, 4)),)})
    first, second = make_tasks(index, Frames("a", 5))
    assert (first.scene, first.name, first.targets) == ("a", "a 0+2>3", (3,))
    assert (first.neighbours, second.neighbours) == ((4,), (3,))
    assert second.targets == (4,)
    assert first.load(first.context) == [VIEWS[0], VIEWS[2]]
    assert make_tasks(index, Frames("b", 5)) == []
    with pytest.raises(InputError, match="The protocol x needs frame 4 of a, which has 4"):
        make_tasks(index, Frames("a", 4))


def test_an_index_is_read_back_as_it_was_written(tmp_path):
    clips = [Frames("a", 64), Frames('odd "ü" name', 30), Frames("short", 3)]
    index = build_index(parse_protocol("n-10-stride-4"), clips)
    write_evaluation_index(tmp_path / "index.json", index)
    assert read_evaluation_index(tmp_path / "index.json") == index
    assert parse_protocol(str(tmp_path / "index.json")) == index
    again = build_index(index, clips)
    write_evaluation_index(tmp_path / "again.json", again)
    assert (tmp_path / "again.json").read_bytes() == (tmp_path / "index.json").read_bytes()
    assert sorted(os.listdir(tmp_path)) == ["again.json", "index.json"]
    content = json.loads((tmp_path / "index.json").read_text())
    assert (content["version"], content["protocol"]) == (1, "n-10-stride-4")


def test_an_index_of_no_clips_is_an_index(tmp_path):
    index = build_index(parse_protocol("n-10"), [])
    write_evaluation_index(tmp_path / "index.json", index)
    assert read_evaluation_index(tmp_path / "index.json") == index


def test_two_clips_of_one_name_are_refused():
    with pytest.raises(InputError, match="Two clips are called a"):
        build_index(parse_protocol("n-10"), [Frames("a", 30), Frames("a", 30)])


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ("{", "is not JSON"),
        ("[]", "is no evaluation index of version 1 .scenes: "),
        ('{"s": 3}', "scenes.s.*object"),
        ('{"s": []}', "scenes.s"),
        ('{"s": {"target": [1]}}', r"scenes\.s.*\.context: Field required"),
        ('{"s": {"context": [0, 1]}}', r"scenes\.s.*\.target: Field required"),
        ('{"s": {"context": [], "target": [1]}}', r"scenes\.s.*\.context"),
        ('{"s": {"context": [0, -1], "target": [1]}}', r"scenes\.s.*\.context\.1"),
        ('{"s": {"context": [0, true], "target": [1]}}', r"scenes\.s.*\.context\.1"),
        ('{"s": {"context": [0], "target": [1.5]}}', r"scenes\.s.*\.target\.0"),
        (
            '{"version": 2, "protocol": "x", "scenes": {}}',
            "version: Input should be 1",
        ),
        ('{"version": 1, "scenes": {}}', "protocol: Field required"),
    ],
)
def test_an_evaluation_index_that_is_wrong_is_named(tmp_path, content, sentence):
    (tmp_path / "index.json").write_text(content)
    with pytest.raises(InputError, match=sentence):
        read_evaluation_index(tmp_path / "index.json")


def test_an_evaluation_index_that_is_missing_is_named(tmp_path):
    with pytest.raises(InputError, match="index.json cannot be read: No such file"):
        read_evaluation_index(tmp_path / "index.json")


def test_cases_of_a_chunk_load_photographs_at_a_resolution(tmp_path):
    (clip,) = open_chunks(save_chunk(tmp_path / "000000.torch", example()))
    there, back = make_tasks(parse_protocol("n-2"), clip, (32, 32))
    assert (there.name, back.name) == ("room 0+2>4", "room 4+2>0")
    (target,) = back.load(back.targets)
    assert target.image.shape == (32, 32, 3)


@pytest.mark.parametrize(
    ("name", "scenes", "skipped", "first"),
    [
        ("evaluation_index_re10k", 6474, 720, ("5aca87f95a9412c6", (58, 133), (84, 102, 129))),
        ("evaluation_index_acid", 1595, 253, ("675a09ccbf601dff", (7, 54), (10, 20, 49))),
        ("dl3dv_start_0_distance_10_ctx_2v_tgt_4v", 140, 0, (None, (0, 9), (1, 3, 5, 7))),
    ],
)
def test_published_indices_are_read_unchanged(shared, tmp_path, name, scenes, skipped, first):
    index = read_evaluation_index(shared / "formats" / "evaluation_index" / f"{name}.json")
    empty = [name for name, splits in index.scenes.items() if not splits]
    assert (index.name, len(index.scenes), len(empty)) == (name, scenes + skipped, skipped)
    scene, splits = next((name, splits) for name, splits in index.scenes.items() if splits)
    assert first[0] in (None, scene)
    assert splits == (Split(first[1], first[2]),)
    write_evaluation_index(tmp_path / "ours.json", index)
    assert read_evaluation_index(tmp_path / "ours.json") == index


# Real scenes are opened as clips by test_waymo.py, too.
@pytest.mark.slow
def test_the_scenes_of_the_development_cases_are_clips(shared):
    clips = list(open_clips(shared / "data"))
    assert len({clip.name for clip in clips}) == len(clips) > 1
    clip = next(clip for clip in clips if clip.name == "re10k_0d4de33c")
    assert len(clip) == len(open_photographs(shared / "data" / "re10k_0d4de33c"))
    assert clip.find_skip_reason() is None
    (case, *_) = make_tasks(parse_protocol("n-4"), clip, (64, 64))
    assert [view.frame for view in case.load(case.context)] == [0, 4]
