"""Photographs with poses that have damaged files: a short sentence each, and soon."""

from __future__ import annotations

import io
import json
import os
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from chunk_files import example, save_chunk
from driving_files import infos, write_drive, write_infos, write_swept_dgp
from gscompleter import InputError
from gscompleter.data.driving.mmdet3d import load_plain
from gscompleter.data.formats import open_photographs
from gscompleter.system.errors import MAX_MESSAGE_LENGTH
from measured_photographs import find_moving
from pose_files import WRITERS, write_photographs


def sentence(path: Path) -> str:
    """Read all of a scene, and return the message of the error."""
    with pytest.raises(InputError) as error:
        read(path)
    assert len(str(error.value)) < MAX_MESSAGE_LENGTH
    assert "\n" not in str(error.value)
    return str(error.value)


def read(path: Path) -> None:
    photographs = open_photographs(path)
    for frame in range(len(photographs)):
        photographs.views([frame])
        find_moving(photographs, frame)


# ---- infos of nuScenes and Waymo ----------------------------------------------------------------


def endless() -> list[Any]:
    content: list[Any] = []
    content.append(content)
    return content


def repeated(times: int) -> list[Any]:
    """Create a list of a few kilobytes that is endless if it is traversed."""
    content: list[Any] = [0.0] * 10
    for _ in range(times):
        content = [content] * 10
    return content


def deep(depth: int) -> list[Any]:
    content: list[Any] = []
    for _ in range(depth):
        content = [content]
    return content


MATRIX = [[1e300] * 4] * 4
PLACES = {
    "a sample": ("data_list", 0),
    "its images": ("data_list", 0, "images"),
    "an image": ("data_list", 0, "images", "CAM_FRONT"),
    "a path": ("data_list", 0, "images", "CAM_FRONT", "img_path"),
    "intrinsics": ("data_list", 0, "images", "CAM_FRONT", "cam2img"),
    "the pose of a camera": ("data_list", 0, "images", "CAM_FRONT", "lidar2cam"),
    "the pose of the vehicle": ("data_list", 0, "ego2global"),
    "the time": ("data_list", 0, "timestamp"),
    "the drive": ("data_list", 0, "context_name"),
    "a box": ("data_list", 0, "instances", 0, "bbox_3d"),
    "a speed": ("data_list", 0, "instances", 0, "velocity"),
}


def replaced(place: tuple[Any, ...], value: Any) -> dict[str, Any]:
    content = infos()
    held: Any = content
    for key in place[:-1]:
        held = held[key]
    held[place[-1]] = value
    return content


@pytest.mark.parametrize("value", [[1, [2]], MATRIX, {"a": 1}, 1e300, [None] * 4], ids=str)
@pytest.mark.parametrize("place", PLACES)
def test_infos_with_something_else_in_a_place_are_refused(tmp_path, place, value):
    sentence(write_infos(tmp_path, replaced(PLACES[place], value)))


@pytest.mark.parametrize("value", [endless(), repeated(9), deep(70)], ids=["own", "wide", "deep"])
@pytest.mark.parametrize("place", [("data_list", 0, "ego2global"), ("metainfo",), ("other",)])
def test_infos_without_end_are_refused_before_they_are_walked(tmp_path, place, value):
    assert "nested too deeply or without end" in sentence(
        write_infos(tmp_path, replaced(place, value))
    )


def test_a_pickle_changes_no_class(tmp_path):
    path = tmp_path / "infos.pkl"
    path.write_bytes(b"\x80\x02cnumpy\ndtype\n}X\x01\0\0\0aK\x01sb.")
    with pytest.raises(InputError, match="is no pickle of plain values"):
        load_plain(path)


# ---- chunks -------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a\0.torch", "\ud800.torch", "a" * 5000, "..", "/dev/zero", ""])
def test_an_index_with_a_name_that_no_file_has_is_refused(tmp_path, name):
    save_chunk(tmp_path / "000000.torch", example("room"))
    (tmp_path / "index.json").write_text(json.dumps({"room": name}))
    sentence(tmp_path)


def changed(**parts: Any) -> dict[str, Any]:
    return {**example("room"), **parts}


COUNT = len(example("room")["images"])
BYTES = torch.zeros(9, dtype=torch.uint8)


@pytest.mark.parametrize(
    "parts",
    [
        {"images": [b"png"] * COUNT},
        {"images": [[0]] * COUNT},
        {"images": [BYTES[:1].expand(10**12)] * COUNT},
        {"images": [BYTES.float()] * COUNT},
        {"images": [torch.nested.nested_tensor([BYTES, BYTES[:2]])] * COUNT},
        {"images": {"a": BYTES}},
        {"images": BYTES},
        {"cameras": torch.ones(1, 1).expand(COUNT, 18)},
        {"cameras": torch.ones(COUNT, 18, dtype=torch.complex64)},
        {"cameras": torch.ones(COUNT, 18).to_sparse()},
        {"cameras": torch.empty(COUNT, 18, device="meta")},
        {"key": "room\n" * 1000, "cameras": []},
        {"key": 5},
    ],
    ids=str,
)
def test_a_scene_of_a_chunk_that_is_no_scene_is_refused(tmp_path, parts):
    sentence(save_chunk(tmp_path / "000000.torch", changed(**parts)))


def test_a_chunk_that_claims_more_than_there_is_room_for_is_refused(tmp_path):
    path = save_chunk(tmp_path / "000000.torch", example("room"))
    torch.save([example("room")], path, _use_new_zipfile_serialization=False)
    data = path.read_bytes()
    count = example("room")["images"][0].numel()
    claimed = data.replace(b"M" + count.to_bytes(2, "little"), b"\x8a\x06" + b"\xff" * 5 + b"\x7f")
    assert claimed != data
    path.write_bytes(claimed)
    assert "or too large" in sentence(path)


def test_cameras_that_were_trained_are_read(tmp_path):
    cameras = example("room")["cameras"].requires_grad_()
    read(save_chunk(tmp_path / "000000.torch", changed(cameras=cameras)))


# ---- sweeps of DGP ------------------------------------------------------------------------------


def npz(content: bytes) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("data.npy", content)
    return buffer.getvalue()


def npy(array: Any) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, array)
    return buffer.getvalue()


SWEEPS: dict[str, bytes | Callable[[], bytes]] = {
    "nothing": b"",
    "one dimension": npz(npy(np.zeros(3))),
    "no dimension": npz(npy(np.float64(3))),
    "objects": npz(npy(np.array([[None] * 3], dtype=object))),
    "texts": npz(npy(np.array([["a"] * 3]))),
    "two columns": npz(npy(np.zeros((3, 2)))),
    "half": npz(npy(np.zeros((3, 4))))[:-40],
    "half an array": npz(npy(np.zeros((3, 4)))[:-9]),
    "a large promise": npz(npy(np.zeros((2, 3))).replace(b"(2, 3),", b"(9999999999, 3),")),
    "an array alone": npy(np.zeros((3, 4))),
    # Made by its test alone: each process that collects it would take seconds.
    "zeros by the gigabyte": lambda: npz(b"\0" * (1 << 28) + b"\0"),
}


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[pytest.mark.slow] * (name == "zeros by the gigabyte"))
        for name in SWEEPS
    ],
)
def test_a_sweep_that_is_none_is_refused(tmp_path, name):
    folder = write_swept_dgp(tmp_path)
    read(folder)
    sweep = SWEEPS[name]
    (folder / "0.npz").write_bytes(sweep() if callable(sweep) else sweep)
    assert "is no point cloud of DGP" in sentence(folder)


# ---- text files ---------------------------------------------------------------------------------


def clips(folder: Path) -> Path:
    write_photographs(folder / "room")
    line = " ".join(["0", *["0.9", "0.9", "0.5", "0.5", "0", "0"], *["1 0 0 0 0 1 0 0 0 0 1 0"]])
    (folder / "room.txt").write_text(f"https://example.org\n{line}\n")
    return folder / "room.txt"


TEXTS: dict[str, tuple[Callable[[Path], Path], str]] = {
    "kitti poses": (WRITERS["kitti"][1], "poses.txt"),
    "kitti calibration": (WRITERS["kitti"][1], "calib.txt"),
    "raw kitti": (write_drive, "../calib_cam_to_cam.txt"),
    "raw kitti readings": (write_drive, "oxts/data/0000000002.txt"),
    "real estate": (clips, "../room.txt"),
}


@pytest.mark.parametrize("name", TEXTS)
def test_a_line_or_a_file_that_is_too_long_is_refused_before_it_is_parsed(tmp_path, name):
    write, part = TEXTS[name]
    path = write(tmp_path)
    file = (path / part).resolve() if path.is_dir() else path
    with file.open("a") as added:
        added.write("1 " * 3000 + "\n")
    assert "a line of more than 4,096 characters" in sentence(path)
    os.truncate(file, 1 << 40)  # takes no space on the disk
    assert "1,099,511,627,776 bytes, and at most" in sentence(path)


@pytest.mark.linux
@pytest.mark.parametrize("name", TEXTS)
def test_a_text_that_is_a_pipe_is_not_waited_for(tmp_path, name):
    write, part = TEXTS[name]
    path = write(tmp_path)
    file = (path / part).resolve() if path.is_dir() else path
    file.unlink()
    os.mkfifo(file)
    sentence(path)
