"""What is up in a splat: named, stated by its file, shown by its cameras, or by its floor."""

from dataclasses import replace

import pytest
import torch

import gscompleter as gsc
from gscompleter.render.loading import load_renderer
from gscompleter.splats.upward import read_upward
from gscompleter.system.errors import InputError
from gscompleter.types import Gaussians
from gscompleter.virtual_capture.upward import find_floor, find_upward, require_direction
from scenes import camera_at
from solids import ALL_FACES, CEILING, FLOOR, Y_UP, Z_UP, chair, garden, room, street, table

RENDERER = load_renderer("cpu")
Y_DOWN = torch.eye(3)
FRAMES = {"-y": Y_DOWN, "+y": Y_UP, "+z": Z_UP}
SCENES = {
    "room": lambda: room(ALL_FACES),
    "without a ceiling": lambda: room([face for face in ALL_FACES if face != CEILING]),
    "three walls": lambda: room([FLOOR, (0, -1), (0, 1), (2, 1)]),
    "garden": garden,
    "street": street,
}


def turn(scene: Gaussians, rotation: torch.Tensor) -> Gaussians:
    return replace(scene, means=scene.means @ rotation.T)


@pytest.fixture(scope="module")
def plain(tmp_path_factory):
    """Return a file that says nothing of what is up."""
    path = tmp_path_factory.mktemp("up") / "plain.ply"
    gsc.save_splat(path, chair(0.05))
    return path


@pytest.mark.parametrize(
    ("name", "frame"),
    # In short, every scene in one frame and one scene in every frame.
    [
        pytest.param(name, frame, marks=[pytest.mark.slow] * (number > 0 and frame != "+z"))
        for number, name in enumerate(SCENES)
        for frame in FRAMES
    ],
)
def test_up_is_away_from_the_floor(name, frame, plain):
    upward = find_upward(plain, turn(SCENES[name](), FRAMES[frame]), RENDERER)
    (line,) = upward.describe()
    assert line == f"Up is {frame}, from the splat's floor; --up X Y Z says otherwise."
    assert torch.equal(upward.direction, FRAMES[frame] @ torch.tensor([0.0, -1.0, 0.0]))


@pytest.mark.parametrize("frame", FRAMES)
def test_a_floor_that_was_seen_in_part_is_one_if_no_other_side_comes_near(frame):
    ground = garden()
    corner = ground[ground.means[:, 0] + ground.means[:, 2] < -1.0]
    up = FRAMES[frame] @ torch.tensor([0.0, -1.0, 0.0])
    assert find_floor(turn(corner, FRAMES[frame])) == tuple(up.tolist())
    # Half of a street: the wall of its houses is as large as the ground.
    half = street()
    half = half[half.means[:, 0] + 0.3 * half.means[:, 2] < 2.5]
    assert find_floor(turn(half, FRAMES[frame])) is None


def test_a_table_is_no_floor_and_without_one_it_is_as_in_most_files(plain):
    assert find_floor(table()) == (0.0, 1.0, 0.0)
    for scene in (table(), chair()):
        upward = find_upward(plain, scene, RENDERER)
        assert upward.direction.tolist() == [0, -1, 0]
        assert upward.describe() == [
            "Up is -y, as in most files, since neither the file nor a floor tells; --up X Y Z says "
            "otherwise."
        ]


def test_what_is_named_and_what_cameras_show_come_before_the_floor(plain):
    scene = turn(room(ALL_FACES), Z_UP)
    named = find_upward(plain, scene, RENDERER, (0.0, 3.0, 0.0), [camera_at()])
    assert named.direction.tolist() == [0, 1, 0]
    assert named.describe() == []
    shown = find_upward(plain, scene, RENDERER, cameras=[camera_at(), camera_at(yaw=90)])
    assert shown.describe() == ["Up is -y, from its cameras; --up X Y Z says otherwise."]


@pytest.mark.parametrize(
    ("comment", "direction"),
    [
        (b"comment Vertical Axis: z", (0, 0, 1)),
        (b"comment vertical axis = -Y", (0, -1, 0)),
        (b"obj_info vertical_axis x\r", (1, 0, 0)),
        (b"comment Vertical Axis: unknown", None),
    ],
)
def test_a_ply_may_say_it_in_a_comment(comment, direction, plain, tmp_path):
    path = tmp_path / "stated.ply"
    line = b"format binary_little_endian 1.0\n"
    path.write_bytes(plain.read_bytes().replace(line, line + comment + b"\n"))
    assert read_upward(path) == direction
    assert read_upward(plain) is None
    if direction == (0, 0, 1):
        upward = find_upward(path, room(ALL_FACES), RENDERER)
        assert upward.describe() == ["Up is +z, as its file says; --up X Y Z says otherwise."]


@pytest.mark.parametrize(
    ("name", "direction"),
    [("a.spz", (0, -1, 0)), ("a.glb", (0, -1, 0)), ("a.splat", None), ("a.sog", None)],
)
def test_some_formats_define_it(name, direction, tmp_path):
    gsc.save_splat(tmp_path / name, chair(0.05))
    assert read_upward(tmp_path / name) == direction


def test_no_direction_is_refused():
    require_direction((0.0, 0.0, -1.0))
    for up in ((0.0, 0.0, 0.0), (float("nan"), 0.0, 1.0), (float("inf"), 0.0, 0.0)):
        with pytest.raises(InputError, match="three numbers that are not all zero"):
            require_direction(up)
