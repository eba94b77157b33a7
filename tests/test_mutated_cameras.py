"""Damaged files of cameras: each opens or is refused in one sentence, quickly, in little memory.

`MUTATIONS=500 pytest tests/test_mutated_cameras.py` tries more than the few of every run.
"""

import os
import random
import resource
import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from gscompleter import InputError, load_cameras
from gscompleter.data.formats import open_photographs
from gscompleter.data.sparse_points import with_depth_range
from pose_files import write_camera_list
from test_pose_formats import binary, camera_list, dgp, kitti, llff, text, transforms

MUTATIONS = int(os.environ.get("MUTATIONS", "40"))
MAX_SECONDS = 10.0
MAX_MEMORY = 500_000
"""By how many kilobytes the process may grow."""

TARGETS = {
    binary: ("sparse/0/cameras.bin", "sparse/0/images.bin", "sparse/0/points3D.bin"),
    text: ("sparse/cameras.txt", "sparse/images.txt", "sparse/points3D.txt"),
    camera_list: ("cameras.json",),
    llff: ("poses_bounds.npy",),
    kitti: ("calib.txt", "poses.txt"),
    dgp: ("scene_1.json", "calibration/abc.json"),
    transforms: ("transforms.json",),
}
"""The files that are damaged, of the scene of each kind."""

WORDS = (
    *(b"\xff" * 8, b"\0" * 8, b"\x7f" * 8, b"\xff\xff\xff\x7f", b"\0\0\0\0\0\0\xf0\x7f"),
    *(b"nan", b"1e999", b"-1", b"99999999999999999999", b"null", b"[", b"{}", b'"', b"\n", b"\r"),
    *(b"# ", b"../../x", b"\xc3\x28", b" " * 64, b"1 " * 64, b"PANORAMA", b"0.png"),
)


@pytest.fixture(scope="module")
def scenes(tmp_path_factory) -> dict:
    root = tmp_path_factory.mktemp("scenes")
    return {write: write(root / write.__name__) for write in TARGETS}


def mutated(content: bytes, chance: random.Random) -> bytes:
    """The content with one to four of its parts overwritten, lost, doubled or cut off."""
    for _ in range(chance.randint(1, 4)):
        place = chance.randrange(len(content) + 1)
        kind = chance.choice(("byte", "word", "insert", "delete", "double", "cut"))
        word = chance.choice(WORDS)
        length = chance.choice((1, 4, 8, 100))
        end = place + length
        if kind == "byte":
            content = content[:place] + bytes([chance.randrange(256)]) + content[place + 1 :]
        elif kind == "word":
            content = content[:place] + word + content[place + len(word) :]
        elif kind == "insert":
            content = content[:place] + word + content[place:]
        elif kind == "delete":
            content = content[:place] + content[end:]
        elif kind == "double":
            content = content[:end] + content[place:]
        elif chance.random() < 0.3:
            content = content[:place]
    return content


def use(scene: Path) -> None:
    """All that is done with posed photographs."""
    photographs = with_depth_range(open_photographs(scene), [0, 1], (32, 32))
    photographs.views([0, 1], (32, 32))
    photographs.mask(0)
    assert photographs.reason_to_skip() is None or photographs.reason_to_skip()


def refusal(action: Callable[[], object]) -> str:
    """The sentence with which an action is refused; nothing where it is not."""
    try:
        action()
    except InputError as error:
        return str(error)
    return ""


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("seed", range(MUTATIONS))
def test_a_damaged_scene_opens_or_is_refused(scenes, tmp_path, seed):
    chance = random.Random(seed)
    write = list(TARGETS)[seed % len(TARGETS)]
    scene = shutil.copytree(scenes[write], tmp_path / "scene")
    path = scene / chance.choice(TARGETS[write])
    path.write_bytes(mutated(path.read_bytes(), chance))
    before, started = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    said = refusal(lambda: use(scene))
    assert "\n" not in said
    assert len(said) < 2000
    assert time.monotonic() - started < MAX_SECONDS
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < MAX_MEMORY


@pytest.mark.parametrize("seed", range(MUTATIONS // 4))
def test_a_damaged_file_of_targets_is_read_or_refused(tmp_path, seed):
    path = write_camera_list(tmp_path / "cameras.json")
    path.write_bytes(mutated(path.read_bytes(), random.Random(seed)))
    assert "\n" not in refusal(lambda: load_cameras(path, (32, 32)))
