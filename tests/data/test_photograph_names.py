"""Names of photographs and targets: number and file, and what tells targets apart."""

import pytest

from gscompleter.data.photograph_names import (
    describe_offset,
    name_photograph,
    name_render,
    name_target,
)
from scenes import camera_at


def test_a_photograph_has_its_number_and_its_file():
    assert name_photograph(5, "IMG_0012.jpg") == "5 (IMG_0012.jpg)"
    assert name_photograph(5, None) == "5"
    assert name_photograph(None, None) == "–"


def test_a_render_in_place_of_a_photograph_has_one_number():
    """Its number among the frames, from 0, and that of its name, from 1, told nothing together."""
    assert name_photograph(0, name_render(1)) == "1"
    assert name_target(0, name_render(1), None, None) == "render 1"
    assert name_target(None, name_render(1), 0, None) == "near render 1"


def test_targets_near_one_photograph_are_told_apart():
    base = camera_at()
    names = [
        name_target(None, "a.jpg", 3, describe_offset(camera, base))
        for camera in (camera_at(x=0.5), camera_at(x=-0.5), camera_at(yaw=20), camera_at(z=0.5))
    ]
    assert names == [
        "near photograph 3 (a.jpg), moved right by 0.5",
        "near photograph 3 (a.jpg), moved left by 0.5",
        "near photograph 3 (a.jpg), turned right by 20°",
        "near photograph 3 (a.jpg), moved forward by 0.5",
    ]
    assert name_target(4, "b.jpg", None, None) == "photograph 4 (b.jpg)"
    assert name_target(None, None, None, None) == "a given camera"


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        (camera_at(), "at the same place"),
        (camera_at(y=0.3), "moved down by 0.3"),
        (camera_at(y=-2), "moved up by 2"),
        (camera_at(x=0.2, yaw=-12), "moved right by 0.2 and turned left by 12°"),
    ],
)
def test_an_offset_is_described_as_the_photograph_looks(camera, said):
    assert describe_offset(camera, camera_at()) == said
