"""The file of refined poses, beside the splat that was made with them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from gscompleter.data.formats import open_photographs
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.refined_file import hash_poses, take_refined, write_refined
from gscompleter.data.sfm.refining import PoseRefinement
from gscompleter.system.errors import InputError
from gscompleter.system.files.result_names import REFINED_POSES_FILE
from scenes import camera_at, photographed

DONE = PoseRefinement(2, given_error=0.3, refined_error=0.1, moved=0.05)


@pytest.fixture
def given(tmp_path) -> Photographs:
    """Open three photographs with cameras."""
    return open_photographs(photographed(tmp_path / "scene", [camera_at(x=x) for x in range(3)]))


@pytest.fixture
def refined(given) -> Photographs:
    """Move two of them."""
    frames = list(given.frames)
    for number in range(2):
        c2w = frames[number].c2w.copy()
        c2w[0, 3] += 0.01
        frames[number] = replace(frames[number], c2w=c2w)
    return replace(given, frames=tuple(frames))


def test_poses_come_back_bit_for_bit_and_others_stay(given, refined, tmp_path):
    path = tmp_path / REFINED_POSES_FILE
    write_refined(path, given, refined, DONE)
    taken = take_refined(given, path)
    assert taken is not None
    again, done = taken
    assert done == DONE
    for frame, wanted in zip(again.frames, refined.frames, strict=True):
        assert np.array_equal(frame.c2w, wanted.c2w)
    assert again.frames[2] is given.frames[2]
    content = json.loads(path.read_text())
    assert [row["file_path"] for row in content["frames"]] == [
        frame.file_name for frame in given.frames[:2]
    ]
    # Programs that read nerfstudio's cameras find intrinsics, too.
    assert content["frames"][0]["w"] == given.camera(0).width
    assert content["frames"][0]["fl_x"] == pytest.approx(given.camera(0).K[0, 0].item())


def test_photographs_with_other_poses_do_not_take_them(given, refined, tmp_path):
    path = tmp_path / REFINED_POSES_FILE
    write_refined(path, given, refined, DONE)
    assert take_refined(refined, path) is None
    assert take_refined(replace(given, frames=given.frames[:2]), path) is None
    assert hash_poses(given) != hash_poses(refined)


def test_photographs_that_were_placed_among_the_given_ones_are_left_out(given, refined, tmp_path):
    path = tmp_path / REFINED_POSES_FILE
    joined = replace(refined, frames=(*refined.frames, given.frames[0]))
    write_refined(path, given, joined, DONE)
    assert take_refined(given, path) is not None


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda content: content["frames"][0].pop("transform_matrix"), "transform_matrix"),
        (lambda content: content["frames"][0]["transform_matrix"].pop(), "it has no pose of"),
        (lambda content: content.pop("given"), "given"),
    ],
)
def test_a_damaged_file_is_named(given, refined, tmp_path, change, words):
    path = tmp_path / REFINED_POSES_FILE
    write_refined(path, given, refined, DONE)
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))
    with pytest.raises(InputError, match=words):
        take_refined(given, path)
