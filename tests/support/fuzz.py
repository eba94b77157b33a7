"""Mutated inputs of every kind, and the reactions of the commands.

python tests/support/fuzz.py --count 1500 --seed 0

Each mutation runs in a fork of one interpreter that has imported everything, with limits of time
and memory. Findings are a traceback, a signal, an exit code that docs/contracts.md does not have, a
failure with none or more than one sentence, files left by a refused run, a timeout, and more than
2 GB of memory. `--only KIND:NUMBER` repeats one.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import resource
import shutil
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

os.environ |= {"OMP_WAIT_POLICY": "PASSIVE", "NUMBA_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}

from splat_files import SPLAT_FILES, made, plausible  # after this, since it imports torch

ADDRESS_SPACE = 8 << 30
MAX_MEMORY = 2 << 20
"""Most memory of a run, in kilobytes."""
LONGEST_ERROR = 300
"""Most characters of an error, without the end of the line."""
SIZE = 32

NUMBERS: list[Any] = [
    *(0, -1, 1, 2, 0.5, -0.5, 1e-300, 1e300, -1e300, 1e38, 1e-45, 1e20, 2**31, 2**63, 2**64),
    *(10**9, 10**12, 10**399, float("nan"), float("inf"), -float("inf"), True, False, None),
]
STRINGS: list[Any] = ["", "²", "a" * 100_000, "../../..", "/dev/null", "nan", "0", "\0", "\ud800"]
OBJECTS: list[Any] = [[], {}, [[]], [0] * 5000, {"a": {"b": []}}]
MATRICES: list[Any] = [[[1e300] * 4] * 4, [[None] * 4] * 4, [[1], [1, 2]], [[0] * 4] * 4, [1] * 16]
ODD = NUMBERS + STRINGS + OBJECTS
WORDS = ["", "²", "--2", "-1", "0", "1,2", "9" * 5000, "1e300", "nan", "inf", "1e-300", "/dev/null"]
WORDS += ["99999999", str(2**64), "a" * 5000, "--", "-", "..", "1000000", "\udce4", "0.5", "None"]
YAML = [
    ".nan",
    ".inf",
    "-.5",
    "1e400",
    "9" * 400,
    "2024-13-45",
    "[" * 3000,
    "&a [*a]",
    "{a: {b: 1}}",
]
PARTS = [
    *(b"\xff" * 8, b"\0" * 8, b"\x7f" * 8, b"\xff\xff\xff\x7f", b"\0\0\0\0\0\0\xf0\x7f"),
    *(b"\0\0\xc0\x7f", b"\0\0\x80\x7f", b"\xff\xff\x7f\x7f", b"\x7f\xff\xff\xff", b"\xff" * 4),
    *(b"nan", b"1e999", b"-1", b"99999999999999999999", b"null", b"[", b"{}", b'"', b"\n", b"\r"),
    *(b"# ", b"../../x", b"\xc3\x28", b" " * 64, b"1 " * 64, b"PANORAMA", b"0.png"),
]
FILES = [b"", b"\0" * 100, b"PK\x03\x04", b"\x93NUMPY", b"ply\n", b"{", b"<html>", b"glTF", b"NGSP"]
COUNTS = [b"0", b"-1", b"1" + b"0" * 12, b"9" * 4000, b"nan"]
YAML += ["0x_", "1:", "1" + ":59" * 9000, "=", "{<<: 1}", "{<<: [[1]]}", "!!int ''", "!!float x"]
YAML += ["&a 1", "*a", "!!binary '='", "!!set {1, 2}", "!!omap [1]", "!!timestamp x", "? {a: 1}"]
YAML += ["!!python/object:os.system x", "~", "'²'", "0", "1", "-1", "1000000000000", "yes", "''"]


@dataclass(frozen=True)
class Outcome:
    """Result of a run with mutated files, or of a call with odd values."""

    name: str
    refused: bool
    finding: str | None
    """Problem in one line, if any."""
    command: Sequence[str] = ()
    """Words of the command, for a run."""


Mutation = Callable[[Path, random.Random], list[str]]
"""Function that changes the files of a folder and returns the words of the command."""


# ---- what is mutated ----------------------------------------------------------------------------


def build(folder: Path) -> None:
    """Write one valid input of every kind."""
    import numpy as np
    import torch

    from chunk_files import example, save_chunk
    from driving_files import write_drive, write_infos, write_swept_dgp
    from gscompleter import save_ply
    from gscompleter.data.scene import write_cameras
    from gscompleter.system.files.image import convert_to_pixels
    from gscompleter.system.files.video import write_video
    from phone_files import polycam, record3d, scanner_app, write_archive, write_folder
    from pose_files import WRITERS, write_camera_list
    from scenes import Room, camera_at, gaussians_of, photographed, view_of

    cameras = [camera_at(x, yaw=yaw, size=SIZE) for x, yaw in ((-0.3, 0), (0.1, 0), (0.7, 12))]
    views = [view_of(Room(), camera) for camera in cameras]
    scene = photographed(folder / "scene", cameras)
    index = json.loads((scene / "transforms.json").read_text())
    for number, frame in enumerate(index["frames"]):
        np.save(scene / f"{number}.npy", views[number].depth.numpy())
        frame["depth_file_path"] = f"{number}.npy"
    (scene / "transforms.json").write_text(json.dumps(index))
    write_cameras(folder / "target.json", cameras[2:])
    gaussians = gaussians_of(views[0])
    save_ply(folder / "scene.ply", gaussians)
    save_ply(folder / "small.ply", gaussians[:5])
    (folder / "ascii.ply").write_bytes(as_ascii((folder / "small.ply").read_bytes()))
    save_chunk(folder / "chunks" / "000000.torch", example("room", views=views))
    (folder / "chunks" / "index.json").write_text('{"room": "000000.torch"}')
    row = {"scene": "scene", "context": [0, 1], "target": 2, "near": 0.5, "far": 20.0}
    cases = {"resolution": [SIZE, SIZE], "cases": [{**row, "neighbours": [1]}]}
    (folder / "cases.json").write_text(json.dumps(cases))
    splits = {"room": {"context": [0, 1], "target": [2]}}
    (folder / "index.json").write_text(json.dumps(splits))
    shutil.copytree(scene, folder / "clips" / "room", ignore=shutil.ignore_patterns("*.json"))
    lines = ["https://example.org"]
    for number, camera in enumerate(cameras):
        K, pose = camera.K / SIZE, torch.linalg.inv(camera.c2w)[:3].flatten()
        os.rename(folder / f"clips/room/{number}.png", folder / f"clips/room/{number}.png")
        values = [K[0, 0], K[1, 1], K[0, 2], K[1, 2], 0, 0, *pose]
        lines.append(" ".join([str(number), *(f"{float(value):.6f}" for value in values)]))
    (folder / "clips" / "room.txt").write_text("\n".join(lines) + "\n")
    (folder / "config.yaml").write_text(
        "margin: 0.25\nregistration:\n  iterations: 2\n  beta1: 0.5\naffine:\n  max_trials: 64\n"
        "holes:\n  dilation: 1\n"
    )
    torch.save({"state_dict": {"encoder.a": torch.ones(3)}}, folder / "weights.ckpt")
    for kind, (_, write) in WRITERS.items():
        write(folder / kind)
    write_camera_list(folder / "target-list.json")
    (folder / "splats").mkdir()
    for name in SPLAT_FILES:
        made(folder / "splats", name, plausible(40, 1))
    write_infos(folder / "infos")
    write_drive(folder / "kitti-raw")
    write_swept_dgp(folder / "dgp-swept")
    write_folder(folder / "polycam", polycam())
    write_archive(folder / "polycam.zip", polycam())
    write_folder(folder / "scanner-app", scanner_app())
    write_folder(folder / "record3d", record3d())
    write_archive(folder / "record3d.r3d", record3d())
    write_video(folder / "walk.mp4", [convert_to_pixels(view.image) for view in views], 10)
    in_every_format(WRITERS["colmap-text"][1](folder / "photographs") / "images")


KINDS_OF_IMAGE = ("PNG", "JPEG", "WEBP", "TIFF", "BMP")


def in_every_format(images: Path) -> None:
    """Write the .png photographs of a folder in other formats, under the same names."""
    from PIL import Image

    for path, kind in zip(sorted(images.iterdir()), KINDS_OF_IMAGE, strict=True):
        with Image.open(path) as image:
            pixels = image.convert("RGB")
        pixels.save(path, format=kind)


def as_ascii(data: bytes) -> bytes:
    """Convert our binary .ply to ASCII."""
    import numpy as np

    head, body = data.split(b"end_header\n")
    columns = head.count(b"property float")
    rows = np.frombuffer(body, "<f4").reshape(-1, columns)
    text = "\n".join(" ".join(map(str, row)) for row in rows)
    head = head.replace(b"binary_little_endian", b"ascii")
    return head + b"end_header\n" + text.encode() + b"\n"


UPDATE = ["update", "scene", "--scene", "scene.ply", "--out", "out", "--quiet", "--near", "0.5"]
COMPLETE = ["complete", "scene", "--context", "0", "1", "--out", "out", "--quiet", "--target"]


def in_json(path: str, command: Sequence[str]) -> Mutation:
    """Replace a value of a JSON file by an odd one, or damage its text."""

    def mutate(folder: Path, chance: random.Random) -> list[str]:
        file = folder / path
        if chance.random() < 0.15:
            damage(file, chance)
            return list(command)
        content = json.loads(file.read_text())
        for _ in range(chance.choice([1, 1, 1, 2])):
            content = replaced(content, chance)
        sys.set_int_max_str_digits(0)
        text = json.dumps(content)
        file.write_text("[" * 5000 + text if chance.random() < 0.02 else text)
        return list(command)

    return mutate


def replaced(content: Any, chance: random.Random, odd: Sequence[Any] = ODD) -> Any:
    """Replace one value anywhere in `content` by an odd one, or remove it."""
    if not isinstance(content, (dict, list)) or not content or chance.random() < 0.08:
        return chance.choice(odd)
    keys = list(content) if isinstance(content, dict) else range(len(content))
    key = chance.choice(list(keys))
    if chance.random() < 0.05:
        del content[key]
    else:
        content[key] = replaced(content[key], chance, odd)
    return content


def in_bytes(path: str, command: Sequence[str]) -> Mutation:
    """Cut, change, double or replace bytes of one of the files that a pattern names."""

    def mutate(folder: Path, chance: random.Random) -> list[str]:
        damage(chance.choice(sorted(folder.glob(path))), chance)
        return list(command)

    return mutate


def damage(file: Path, chance: random.Random) -> None:
    """Change parts of a file, most often near its beginning, or replace it by another."""
    data = bytearray(file.read_bytes())
    if chance.random() < 0.05:
        data[:] = chance.choice(FILES)
    else:
        for _ in range(chance.choice([1, 1, 1, 2, 4, 30])):
            chance.choice(EDITS)(data, chance)
    file.write_bytes(bytes(data))


def place_in(data: bytearray, chance: random.Random) -> int:
    return chance.randrange(max(1, min(len(data), chance.choice([64, 512, len(data)]))))


def length_of(chance: random.Random) -> int:
    return chance.choice([1, 1, 4, 8, 100])


def overwrite(data: bytearray, chance: random.Random) -> None:
    at, part = place_in(data, chance), chance.choice([*PARTS, chance.randbytes(length_of(chance))])
    data[at : at + len(part)] = part


def insert(data: bytearray, chance: random.Random) -> None:
    at = place_in(data, chance)
    data[at:at] = chance.choice([*PARTS, chance.randbytes(length_of(chance))])


def lose(data: bytearray, chance: random.Random) -> None:
    at = place_in(data, chance)
    del data[at : at + length_of(chance)]


def cut(data: bytearray, chance: random.Random) -> None:
    if chance.random() < 0.3:
        del data[chance.randrange(len(data) + 1) :]


def double(data: bytearray, chance: random.Random) -> None:
    at = place_in(data, chance)
    data[at:at] = data[at // 2 : at] if chance.random() < 0.3 else data[at : at + length_of(chance)]


def count_otherwise(data: bytearray, chance: random.Random) -> None:
    digits = [match.span() for match in re.finditer(rb"\d+", bytes(data[:2000]))]
    start, stop = chance.choice(digits or [(0, 0)])
    data[start:stop] = chance.choice(COUNTS)


EDITS = [overwrite, overwrite, insert, lose, cut, double, count_otherwise]


def in_yaml(folder: Path, chance: random.Random) -> list[str]:
    """Replace a value of the settings by an odd one."""
    from dataclasses import fields, is_dataclass

    from gscompleter.config import CompleterConfig

    file = folder / "config.yaml"
    if chance.random() < 0.15:
        damage(file, chance)
    else:
        stage = chance.choice([f.name for f in fields(CompleterConfig)])
        settings = getattr(CompleterConfig(), stage)
        name = chance.choice([f.name for f in fields(settings)]) if is_dataclass(settings) else ""
        value = chance.choice(YAML)
        file.write_text(f"{stage}:\n  {name}: {value}\n" if name else f"{stage}: {value}\n")
    return [*COMPLETE, "2", "--near", "0.5", "--far", "20", "--config", "config.yaml"]


def in_words(folder: Path, chance: random.Random) -> list[str]:
    """Replace a word of the command line by an odd one."""
    options = {
        "--context": ["0", "1"],
        "--target": ["2"],
        "--near": ["0.5"],
        "--far": ["20"],
        "--seed": ["0"],
        "--resolution": [str(SIZE), str(SIZE)],
        "--scene": ["scene.ply"],
        "--config": ["default"],
        "--reconstructor": ["plane-sweep"],
        "--generator": ["warp-inpaint"],
        "--weights": ["weights.ckpt"],
    }
    for _ in range(chance.choice([1, 1, 2])):
        name = chance.choice(list(options))
        options[name][chance.randrange(len(options[name]))] = chance.choice(WORDS)
    if chance.random() < 0.8:
        del options["--weights"]
    if chance.random() < 0.5:
        del options["--scene"]
    words = [word for name, values in options.items() for word in (name, *values)]
    return ["complete", "scene", *words, "--out", "out", "--quiet"]


def in_infos(folder: Path, chance: random.Random) -> list[str]:
    """Replace values of a pickle of infos by odd ones, or by the whole."""
    import pickle

    file = folder / "infos" / "infos.pkl"
    if chance.random() < 0.2:
        damage(file, chance)
    else:
        content = pickle.loads(file.read_bytes())
        kinds = [ODD, MATRICES, [content], [{"car": [1]}, {1: 2}, {(1, 2): 3}, {1, 2}]]
        for _ in range(chance.choice([1, 1, 2])):
            content = replaced(content, chance, chance.choice(kinds))
        file.write_bytes(pickle.dumps(content, protocol=chance.choice([0, 2, 4])))
    return scene_words("infos/infos.pkl")


def in_chunk(folder: Path, chance: random.Random) -> list[str]:
    """Replace a value of a chunk by an odd one or an odd tensor, or a name in its index."""
    import torch

    file = folder / "chunks" / "000000.torch"
    if chance.random() < 0.2:
        name = chance.choice([*STRINGS, "000000.torch\0", "../chunks", 5])
        (folder / "chunks" / "index.json").write_text(json.dumps({"room": name}))
    else:
        content = torch.load(file, weights_only=True)
        torch.save(replaced(content, chance, [*ODD, *odd_tensors()]), file)
    return CHUNKS


def in_sweep(folder: Path, chance: random.Random) -> list[str]:
    """Damage the sweep of a laser, or replace it by another array."""
    import numpy as np

    file = folder / "dgp-swept" / "0.npz"
    if chance.random() < 0.5:
        damage(file, chance)
    else:
        arrays = [np.zeros(3), np.zeros((2, 2)), np.float64(1), np.full((4, 3), np.nan)]
        arrays += [np.full((4, 3), 1e300), np.array([["a"] * 3]), np.zeros((0, 3)), np.eye(4) > 0]
        arrays += [np.array([[None] * 3], dtype=object), np.zeros((9, 3), complex)]
        np.savez(file, **{chance.choice(["data", "other"]): chance.choice(arrays)})
    return scene_words("dgp-swept")


def odd_tensors() -> list[Any]:
    import torch

    return [
        torch.empty(3, device="meta"),
        torch.eye(3).to_sparse(),
        torch.full((3,), float("nan")),
        torch.ones(1).expand(10**6, 10**6),
        torch.ones(1, dtype=torch.uint8).expand(10**12),
        torch.ones(1, 1).expand(3, 18),
        torch.zeros(3, 18),
        torch.full((3, 18), 1e30),
        torch.zeros(3, 18, dtype=torch.float16, requires_grad=True),
        torch.eye(3, dtype=torch.complex64),
        torch.zeros(0),
    ]


KINDS_OF_FILE = ("pipe", "folder", "zero", "null", "socket", "link", "large")


def not_a_file(path: str, command: Sequence[str]) -> Mutation:
    """Replace one of the named files by a pipe, a device, a folder, or a file of a terabyte."""

    def mutate(folder: Path, chance: random.Random) -> list[str]:
        file = chance.choice([file for file in sorted(folder.glob(path)) if file.is_file()])
        kind = chance.choice(KINDS_OF_FILE)
        if kind == "large":
            os.truncate(file, 1 << 40)
            return list(command)
        file.unlink()
        if kind == "pipe":
            os.mkfifo(file)
        elif kind == "folder":
            file.mkdir()
        elif kind == "socket":
            with socket.socket(socket.AF_UNIX) as bound:
                bound.bind(str(file))
        else:
            file.symlink_to(file.name if kind == "link" else f"/dev/{kind}")
        return list(command)

    return mutate


def long_line(path: str, command: Sequence[str]) -> Mutation:
    """Make a line or number millions of characters long, or add very many lines."""

    def mutate(folder: Path, chance: random.Random) -> list[str]:
        file = chance.choice(sorted(folder.glob(path)))
        lines = file.read_bytes().splitlines(keepends=True)
        at = chance.randrange(len(lines))
        times = chance.choice([10**4, 10**6, 10**7])
        lines[at] = chance.choice([b"9" * times, lines[at] * (times // 100), b"1 " * times])
        file.write_bytes(b"".join(lines))
        return list(command)

    return mutate


def in_weights(folder: Path, chance: random.Random) -> list[str]:
    """Write a file of weights with other content."""
    import torch

    tensors = [*odd_tensors(), *ODD]
    name = chance.choice(["encoder.a", "a" * 10_000, "decoder.a", ""])
    if chance.random() < 0.5:
        torch.save({"state_dict": {name: chance.choice(tensors)}}, folder / "weights.ckpt")
    else:
        damage(folder / "weights.ckpt", chance)
    model = ["--reconstructor", "mvsplat-re10k", "--weights", "weights.ckpt"]
    return [*COMPLETE, "2", "--near", "0.5", "--far", "20", *model]


def posed(kind: str, pattern: str) -> Mutation:
    """Write a file of a scene format, by the table of `pose_files`."""
    return in_bytes(f"{kind}/{pattern}", scene_words(kind))


def scene_words(kind: str) -> list[str]:
    """Return the command that completes a scene of a format."""
    words = ["complete", kind, "--context", "0", "1", "--target", "2", "--out", "out", "--quiet"]
    return [*words, "--resolution", str(SIZE), str(SIZE)]


def splat(name: str) -> Mutation:
    """Return a file of Gaussians, or one of the files in its folder."""
    words = ["convert", f"splats/{name}", "out.ply", "--quiet"]
    return in_bytes(name_splat(name), words)


def name_splat(name: str) -> str:
    """Name a file of Gaussians by a pattern, or the files in its folder."""
    return f"splats/{name}" if "." in name else f"splats/{name}/*"


RANGE = ["--near", "0.5", "--far", "20"]
SCORES = ["--methods", "context", "--out", "run", "--quiet"]
CLIPS = ["index", "clips", "--protocol", "n-1", "--out", "i"]
CHUNKS = ["evaluate", "chunks", "--protocol", "n-1", "--limit", "1", *SCORES]
DRIVE = "kitti-raw/2011_09_26_drive_0001_sync"
ALONE = ["poses", "photographs/images", "--out", "out", "--quiet"]
KINDS: dict[str, Mutation] = {
    "transforms": in_json("scene/transforms.json", [*COMPLETE, "2", *RANGE]),
    "transforms-wide": in_json("scene/transforms.json", [*COMPLETE, "2"]),
    "camera": in_json("target.json", [*COMPLETE, "target.json", *RANGE]),
    "image": in_bytes("scene/1.png", [*COMPLETE, "2", *RANGE]),
    "depth": in_bytes("scene/1.npy", [*COMPLETE, "2", *RANGE]),
    "ply": in_bytes("scene.ply", [*COMPLETE, "2", *RANGE, "--scene", "scene.ply"]),
    "update": in_bytes("scene.ply", [*UPDATE, "--hold-out", "1"]),
    "update-image": in_bytes("scene/1.png", UPDATE),
    "small-ply": in_bytes("small.ply", ["convert", "small.ply", "out.ply", "--quiet"]),
    "ascii-ply": in_bytes("ascii.ply", ["convert", "ascii.ply", "out.ply", "--quiet"]),
    "cases": in_json("cases.json", ["evaluate", "cases.json", *SCORES]),
    "index": in_json("index.json", ["evaluate", "chunks", "--protocol", "index.json", *SCORES]),
    "chunk": in_bytes(
        "chunks/000000.torch", ["index", "chunks", "--protocol", "n-1", "--out", "i"]
    ),
    "chunk-run": in_bytes("chunks/000000.torch", CHUNKS),
    "txt": in_bytes("clips/room.txt", CLIPS),
    "colmap-binary": posed("colmap-binary", "sparse/0/*.bin"),
    "colmap-text": posed("colmap-text", "sparse/*.txt"),
    "cameras-json": posed("cameras-json", "cameras.json"),
    "llff": posed("llff", "poses_bounds.npy"),
    "kitti": posed("kitti", "*.txt"),
    "dgp": posed("dgp", "**/*.json"),
    "splits": posed("splits", "*.json"),
    "scannet": posed("scannet", "*/*.txt"),
    "scannet-depth": posed("scannet", "depth/*.png"),
    "replica": posed("replica", "*.txt"),
    "replica-lens": posed("replica", "*.json"),
    "mvsnet": posed("mvsnet", "cams/*.txt"),
    "mvsnet-depth": posed("mvsnet", "rendered_depth_maps/*.pfm"),
    "idr": posed("idr", "*.npz"),
    "photograph": posed("photographs", "images/*"),
    "one-photograph": in_bytes(
        "scene/0.png", ["complete", "scene/0.png", "--out", "out", "--quiet", "--auto", "1"]
    ),
    "photographs-alone": in_bytes("photographs/images/*", ALONE),
    "video": in_bytes("walk.mp4", ["poses", "walk.mp4", "--out", "out", "--quiet"]),
    "targets-list": in_bytes("target-list.json", [*COMPLETE, "target-list.json", *RANGE]),
    "targets-colmap": in_bytes(
        "colmap-text/sparse/images.txt", [*COMPLETE, "colmap-text/sparse/images.txt", *RANGE]
    ),
    **{f"splat-{name}": splat(name) for name in SPLAT_FILES},
    "polycam": in_bytes("polycam/keyframes/*/*2.*", scene_words("polycam")),
    "polycam-zip": in_bytes("polycam.zip", scene_words("polycam.zip")),
    "scanner-app": in_bytes("scanner-app/*_00002.*", scene_words("scanner-app")),
    "record3d": in_bytes("record3d/**/*[2at]*", scene_words("record3d")),
    "record3d-zip": in_bytes("record3d.r3d", scene_words("record3d.r3d")),
    "phone-file": not_a_file("polycam/keyframes/*/*2.*", scene_words("polycam")),
    "archive-file": not_a_file("record3d.r3d", scene_words("record3d.r3d")),
    "infos": in_infos,
    "chunk-values": in_chunk,
    "sweep": in_sweep,
    "kitti-raw": in_bytes("kitti-raw/**/*.txt", scene_words(DRIVE)),
    "kitti-long": long_line("kitti/*.txt", scene_words("kitti")),
    "kitti-raw-long": long_line("kitti-raw/**/*.txt", scene_words(DRIVE)),
    "colmap-long": long_line("colmap-text/sparse/*.txt", scene_words("colmap-text")),
    "txt-long": long_line("clips/room.txt", CLIPS),
    "txt-file": not_a_file("clips/room.txt", CLIPS),
    "scene-file": not_a_file("scene/*", [*COMPLETE, "2", *RANGE]),
    "kitti-file": not_a_file("kitti/**/*.*", scene_words("kitti")),
    "colmap-file": not_a_file("colmap-text/sparse/*", scene_words("colmap-text")),
    "dgp-file": not_a_file("dgp-swept/**/*.*", scene_words("dgp-swept")),
    "infos-file": not_a_file("infos/*", scene_words("infos/infos.pkl")),
    "chunk-file": not_a_file("chunks/*", CHUNKS),
    "config-file": not_a_file("config.yaml", [*COMPLETE, "2", *RANGE, "--config", "config.yaml"]),
    "sog-file": not_a_file("splats/folder/*", ["convert", "splats/folder", "out.ply", "--quiet"]),
    "splat-file": not_a_file(
        "splats/scene.s*", ["convert", "splats/scene.splat", "out.ply", "--quiet"]
    ),
    "ply-file": not_a_file("small.ply", ["convert", "small.ply", "out.ply", "--quiet"]),
    "yaml": in_yaml,
    "words": in_words,
    "weights": in_weights,
}


# ---- how it is run ------------------------------------------------------------------------------


def in_child(work: Callable[[], None], log: Path) -> int:
    """Run `work` in a fork of this process, and return its id."""
    sys.stdout.flush()
    child = os.fork()
    if child:
        return child
    code = 1
    try:
        os.setsid()
        # Rust and C libraries write past sys.stderr.
        with log.open("wb") as file:
            os.dup2(file.fileno(), 1)
            os.dup2(file.fileno(), 2)
        work()
        code = 0
    except SystemExit as stop:
        code = stop.code if isinstance(stop.code, int) else 1
    except BaseException:
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


def run_command(base: Path, folder: Path, kind: str, number: int, seed: int) -> None:
    """Mutate a copy of the base and run the command on it, within limits."""
    shutil.copytree(base, folder / "in")
    os.chdir(folder / "in")
    words = KINDS[kind](Path(), random.Random(f"{seed} {kind} {number}"))
    sys.set_int_max_str_digits(4300)
    Path("../words").write_bytes("\0".join(words).encode("utf-8", "surrogateescape"))
    resource.setrlimit(resource.RLIMIT_AS, (ADDRESS_SPACE, ADDRESS_SPACE))
    sys.argv = ["gscompleter", *words]
    from gscompleter.cli import main

    main()


def finding_of(status: int, outlived: bool, memory: int, log: str, left: set[str]) -> str | None:
    """Describe the problem of a run, which took `memory` kilobytes and `left` files, if any."""
    if outlived:
        return "outlives its limit"
    if os.WIFSIGNALED(status):
        return f"killed by {signal.Signals(os.WTERMSIG(status)).name}"
    code = os.waitstatus_to_exitcode(status)
    if "Traceback (most recent call last)" in log:
        places = re.findall(r'File "[^"]*gscompleter/([^"]+)", line (\d+)', log)
        last = log.strip().splitlines()[-1][:150]
        return f"traceback at {':'.join(places[-1]) if places else '?'}: {last}"
    # A scene that did not reconstruct ends with 1, and failed cases with 1 or 3. A lack of memory
    # does so too, with the words of `failures`, but no input of this size may need so much.
    if code not in (0, 1, 2, 3) or "The memory ran out" in log:
        return f"exit {code}: {log.strip()[-150:]}"
    if memory > MAX_MEMORY:
        return f"takes {memory // 1024:,} MB"
    if code and (len(log) > LONGEST_ERROR + 1 or log.count("\n") != 1):
        return f"exit {code} with {len(log):,} characters: {log[:80]!r}"
    if code == 2 and left:
        return f"exit 2, and {', '.join(sorted(left)[:3])} was written"
    return None


@dataclass
class Running:
    """A running fork."""

    name: str
    folder: Path
    deadline: float


def fuzz(
    chosen: Sequence[tuple[str, int]], seed: int, limit_s: float, workers: int
) -> list[Outcome]:
    """Run the mutations, and return their outcomes in order."""
    import_everything()
    outcomes: list[Outcome] = []
    with tempfile.TemporaryDirectory() as name:
        root = Path(name)
        base = root / "base"
        base.mkdir()
        _, status = os.waitpid(in_child(lambda: build(base), root / "log"), 0)
        if status:
            raise RuntimeError((root / "log").read_text())
        given = files_below(base)
        waiting, running = list(reversed(chosen)), dict[int, Running]()
        while waiting or running:
            while waiting and len(running) < workers:
                kind, number = waiting.pop()
                folder = root / f"{kind}-{number}"
                folder.mkdir()
                work = lambda: run_command(base, folder, kind, number, seed)  # noqa: B023, E731
                child = in_child(work, folder / "log")
                running[child] = Running(f"{kind}:{number}", folder, time.monotonic() + limit_s)
            outcomes += finished(running, given)
            time.sleep(0.01)
    return outcomes


def files_below(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def finished(running: dict[int, Running], given: set[str]) -> list[Outcome]:
    """Remove ended or overdue forks from `running`, and return their outcomes.

    The files that were `given` to them are no results.
    """
    outcomes = []
    for child, run in list(running.items()):
        outlived = time.monotonic() > run.deadline
        if outlived:
            os.killpg(child, signal.SIGKILL)
        ended, status, used = os.wait4(child, 0 if outlived else os.WNOHANG)
        if not ended:
            continue
        del running[child]
        log = (run.folder / "log").read_text(errors="replace")
        left = files_below(run.folder / "in") - given
        finding = finding_of(status, outlived, used.ru_maxrss, log, left)
        written = run.folder / "words"
        words = written.read_text(errors="replace").split("\0") if written.exists() else []
        refused = os.WIFEXITED(status) and os.WEXITSTATUS(status) == 2
        outcomes.append(Outcome(run.name, refused, finding, [word[:60] for word in words]))
        shutil.rmtree(run.folder, ignore_errors=True)
    return outcomes


def import_everything() -> None:
    """Import everything once for all forks. Nothing is computed, as threads do not survive."""
    sys.path.insert(0, str(Path(__file__).parent / "support"))
    import chunk_files  # noqa: F401  (its photographs are drawn in one thread)
    import gscompleter.apps.completing.complete
    import gscompleter.apps.evaluating.reproduction
    import gscompleter.cli
    import gscompleter.generators.warp_inpaint
    import gscompleter.reconstructors.plane_sweep  # noqa: F401
    import pose_files  # noqa: F401  (likewise)


def print_findings(outcomes: Sequence[Outcome], kind: str, seconds: float) -> int:
    """Print each kind of finding with its first example, then the counts; return their number."""
    findings = [outcome for outcome in outcomes if outcome.finding is not None]
    for what, count in Counter(finding.finding for finding in findings).most_common():
        first = next(finding for finding in findings if finding.finding == what)
        print(f"{count:4d}  {first.name}  {what}")
        if first.command:
            print(f"      {' '.join(first.command)[:300]!r}")
    refused = sum(outcome.refused for outcome in outcomes)
    print(f"{len(outcomes)} {kind}, {len(findings)} findings, {refused} refused, {seconds:.0f} s")
    return len(findings)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--limit", type=float, default=20, help="seconds of one run")
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--kinds", nargs="*", default=list(KINDS), choices=list(KINDS))
    parser.add_argument("--only", help="KIND:NUMBER, as a finding names it")
    given = parser.parse_args()
    chosen = [(given.kinds[i % len(given.kinds)], i) for i in range(given.count)]
    if given.only:
        kind, number = given.only.split(":")
        chosen = [(kind, int(number))]
    start = time.monotonic()
    outcomes = fuzz(chosen, given.seed, given.limit, given.workers)
    sys.exit(1 if print_findings(outcomes, "mutations", time.monotonic() - start) else 0)


if __name__ == "__main__":
    main()
