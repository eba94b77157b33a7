"""Writers of Gaussians in every splat format, to test the readers with."""

from __future__ import annotations

import gzip
import io
import json
import re
import struct
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
import zstandard
from PIL import Image

from gscompleter import Render, load_renderer, save_ply, save_splat
from gscompleter.splats.table import SPLAT_FORMATS
from gscompleter.splats.transform import HALF_TURN_Z, rotate_half_turn
from gscompleter.types import SH_C0, Gaussians
from scenes import camera_at, random_gaussians

CPU = load_renderer("cpu")
SH_NAME = "KHR_gaussian_splatting:SH_DEGREE_{}_COEF_{}"


def rgb_bytes(gaussians: Gaussians) -> np.ndarray:
    rgb = 0.5 + SH_C0 * gaussians.sh[:, 0].numpy()
    rgba = np.concatenate([rgb, gaussians.opacities.numpy()[:, None]], axis=1)
    return np.rint(np.clip(rgba, 0, 1) * 255).astype(np.uint8)


def write_ksplat(path: Path, gaussians: Gaussians, level: int, bucket_size: int = 7) -> Path:
    """Write one section; each bucket is centred on its Gaussians."""
    n, block, steps = len(gaussians), 64.0, 32767
    means = gaussians.means.numpy()
    buckets = -(-n // bucket_size)
    full, left = divmod(n, bucket_size)
    of_bucket = np.arange(n) // bucket_size
    centres = np.stack([means[of_bucket == b].mean(0) for b in range(buckets)]).astype("<f4")
    rest, start = [], 1
    for degree in range(1, gaussians.sh_degree + 1):
        band = gaussians.sh[:, start : start + 2 * degree + 1].numpy()
        rest.append(band.transpose(0, 2, 1).reshape(n, -1))
        start += 2 * degree + 1
    rest = np.concatenate([np.empty((n, 0), np.float32), *rest], axis=1)
    number = "<f4" if level == 0 else "<f2"
    if level == 0:
        positions = means.astype("<f4")
    else:
        offset = (means - centres[of_bucket]) / (block / 2 / steps) + steps
        positions = np.rint(offset).clip(0, 65535).astype("<u2")
    harmonics = rest.astype(number)
    if level == 2:
        harmonics = np.rint((rest + 4) / 8 * 255).clip(0, 255).astype(np.uint8)
    columns = [
        positions,
        gaussians.scales.numpy().astype(number),
        gaussians.quats.numpy().astype(number),
        rgb_bytes(gaussians),
        harmonics,
    ]
    rows = np.concatenate([np.ascontiguousarray(c).view(np.uint8) for c in columns], axis=1)
    partial = [left] if left else []
    header = bytearray(4096)
    struct.pack_into("<BBxxIIII", header, 0, 0, 1, 1, 1, n, n)
    struct.pack_into("<H", header, 20, level)
    struct.pack_into("<ff", header, 36, -4, 4)
    section = bytearray(1024)
    struct.pack_into("<IIIIfH", section, 0, n, n, bucket_size, buckets, block, 12)
    struct.pack_into("<I", section, 24, steps)
    struct.pack_into("<IIH", section, 32, full, len(partial), gaussians.sh_degree)
    sizes = np.array(partial, "<u4").tobytes()
    path.write_bytes(bytes(header + section) + sizes + centres.tobytes() + rows.tobytes())
    return path


def write_spz_4(path: Path, version_3: Path) -> Path:
    """Convert a file of version 3 to version 4, with one stream per attribute."""
    raw = gzip.decompress(version_3.read_bytes())
    magic, _, n, degree, bits, flags, _ = struct.unpack_from("<4sIIBBBB", raw)
    widths = [9, 1, 3, 3, 4, (0, 9, 24, 45)[degree]]
    streams, start = [], 16
    for width in widths[: 6 if degree else 5]:
        streams.append(raw[start : start + width * n])
        start += width * n
    packed = [zstandard.compress(stream) for stream in streams]
    header = struct.pack("<4sIIBBBBI12x", magic, 4, n, degree, bits, flags, len(streams), 32)
    table = b"".join(
        struct.pack("<QQ", len(p), len(s)) for p, s in zip(packed, streams, strict=True)
    )
    path.write_bytes(header + table + b"".join(packed))
    return path


def write_spz_2(path: Path, version_3: Path, gaussians: Gaussians) -> Path:
    """Convert a file of version 3 to the rotations of version 2: xyz in bytes, w positive."""
    raw = gzip.decompress(version_3.read_bytes())
    n = len(gaussians)
    quats = gaussians.quats.numpy() * (1, 1, -1, -1)
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    quats *= np.where(quats[:, :1] < 0, -1, 1)
    rotations = np.rint((quats[:, 1:] + 1) * 127.5).astype(np.uint8).tobytes()
    start = 16 + 16 * n
    body = raw[:4] + struct.pack("<I", 2) + raw[8:start] + rotations + raw[start + 4 * n :]
    path.write_bytes(gzip.compress(body))
    return path


def webp(pixels: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "WEBP", lossless=True, exact=True)
    return file.getvalue()


def square(values: np.ndarray) -> np.ndarray:
    """Arrange bytes [n, k] as an image [h, w, 4] that is opaque if k is 3."""
    n, k = values.shape
    side = int(np.ceil(np.sqrt(n)))
    image = np.full((side * side, 4), 255, np.uint8)
    image[:n, :k] = values
    return image.reshape(side, side, 4)


def sog_files(gaussians: Gaussians, version: int = 2) -> dict[str, bytes]:
    """Make the files of a .sog, with evenly spaced codebooks, so that both versions agree."""
    n, k = len(gaussians), gaussians.sh.shape[1] - 1
    means = gaussians.means.numpy()
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = logs.min(0), logs.max(0)
    steps = np.rint((logs - low) / (high - low) * 65535).astype(np.uint16)
    quats = gaussians.quats.numpy()
    quats = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    largest = np.abs(quats).argmax(1)
    quats *= np.where(np.take_along_axis(quats, largest[:, None], 1) < 0, -1, 1)
    smaller = np.stack([np.delete(q, i) for q, i in zip(quats, largest, strict=True)])
    rotation = np.concatenate(
        [np.rint((smaller / np.sqrt(2) + 0.5) * 255), 252 + largest[:, None]], axis=1
    )
    logit = gaussians.opacities.logit().clamp(-8, 8).numpy()[:, None]
    opacity = gaussians.opacities.numpy()[:, None] if version == 2 else (logit + 8) / 16
    colour = np.concatenate([(gaussians.sh[:, 0].numpy() + 4) / 8, opacity], axis=1)
    files = {
        "means_l.webp": webp(square((steps & 255).astype(np.uint8))),
        "means_u.webp": webp(square((steps >> 8).astype(np.uint8))),
        "quats.webp": webp(square(rotation.astype(np.uint8))),
        "scales.webp": webp(
            square(np.rint((gaussians.scales.log().numpy() + 10) / 20 * 255).astype(np.uint8))
        ),
        "sh0.webp": webp(square(np.rint(colour.clip(0, 1) * 255).astype(np.uint8))),
    }
    book = {
        "scales": np.linspace(-10, 10, 256),
        "sh0": np.linspace(-4, 4, 256),
        "shN": np.linspace(-4, 4, 256),
    }
    bounds = {
        "scales": {"mins": [-10] * 3, "maxs": [10] * 3},
        "sh0": {"mins": [-4, -4, -4, -8], "maxs": [4, 4, 4, 8]},
        "shN": {"mins": -4, "maxs": 4},
    }
    meta = {"version": 2, "count": n} if version == 2 else {}
    meta["means"] = {
        "mins": low.tolist(),
        "maxs": high.tolist(),
        "files": ["means_l.webp", "means_u.webp"],
        "shape": [n, 3],
    }
    meta["quats"] = {"files": ["quats.webp"]}
    meta["scales"] = {"files": ["scales.webp"]}
    meta["sh0"] = {"files": ["sh0.webp"]}
    if k:
        meta["shN"] = {
            "files": ["shN_centroids.webp", "shN_labels.webp"],
            "bands": gaussians.sh_degree,
            "count": n,
        }
        palette = np.full((-(-n // 64), 64 * k, 4), 255, np.uint8)
        flat = np.rint((gaussians.sh[:, 1:].numpy() + 4) / 8 * 255).clip(0, 255)
        palette.reshape(-1, k, 4)[:n, :, :3] = flat
        number = np.arange(n)
        label = np.stack([number & 255, number >> 8, 0 * number], axis=1)
        files["shN_centroids.webp"] = webp(palette)
        files["shN_labels.webp"] = webp(square(label.astype(np.uint8)))
    for name in [name for name in book if name in meta]:
        meta[name] |= {"codebook": book[name].tolist()} if version == 2 else bounds[name]
    return {"meta.json": json.dumps(meta).encode(), **files}


def write_sog(path: Path, files: dict[str, bytes]) -> Path:
    """Write a bundle if the name ends in .sog, otherwise a folder."""
    if path.suffix == ".sog":
        with zipfile.ZipFile(path, "w") as bundle:
            for name, data in files.items():
                bundle.writestr(name, data)
        return path
    path.mkdir()
    for name, data in files.items():
        (path / name).write_bytes(data)
    return path


def write_supersplat(path: Path, gaussians: Gaussians) -> Path:
    """Write Gaussians as SuperSplat 2.32 exports a .ply, by its source.

    It turns a splat by 180° about z when it reads it, and back when it writes it, with matrices of
    float32. It writes these properties alone, and not those that it does not know.
    """
    turns = []
    for angle in (-np.pi, np.pi):
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
        turns.append(turn.astype(np.float32).astype(np.float64))
    both = (turns[0] @ turns[1]).astype(np.float32).astype(np.float64)
    rest = gaussians.sh[:, 1:].transpose(1, 2).reshape(len(gaussians), -1)
    columns = {
        **dict(zip("xyz", (gaussians.means.double().numpy() @ both.T).T, strict=True)),
        **{f"rot_{n}": column for n, column in enumerate(gaussians.quats.T)},
        **{f"scale_{n}": column for n, column in enumerate(gaussians.scales.log().T)},
        "opacity": gaussians.opacities.logit(),
        **{f"f_dc_{n}": column for n, column in enumerate(gaussians.sh[:, 0].T)},
        **{f"f_rest_{n}": column for n, column in enumerate(rest.T)},
    }
    table = np.zeros(len(gaussians), [(name, "<f4") for name in columns])
    for name, column in columns.items():
        table[name] = column
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}"]
    head += [f"property float {name}" for name in columns]
    path.write_bytes("\n".join([*head, "end_header\n"]).encode() + table.tobytes())
    return path


def glb_table(gaussians: Gaussians) -> tuple[dict, bytes]:
    """Make description and binary part of a .glb with the Gaussians in its axes."""
    prefix = "KHR_gaussian_splatting:"
    columns = {
        "POSITION": gaussians.means,
        f"{prefix}ROTATION": gaussians.quats.roll(-1, 1),
        f"{prefix}SCALE": gaussians.scales,
        f"{prefix}OPACITY": gaussians.opacities[:, None],
    }
    for degree in range(gaussians.sh_degree + 1):
        for i in range(2 * degree + 1):
            columns[SH_NAME.format(degree, i)] = gaussians.sh[:, degree**2 + i]
    binary, views, accessors = b"", [], []
    for values in columns.values():
        data = values.contiguous().numpy().astype("<f4").tobytes()
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": len(data)})
        kind = {1: "SCALAR", 3: "VEC3", 4: "VEC4"}[values.shape[1]]
        accessors.append(
            {
                "bufferView": len(accessors),
                "componentType": 5126,
                "count": len(gaussians),
                "type": kind,
            }
        )
        binary += data
    primitive = {
        "attributes": {name: i for i, name in enumerate(columns)},
        "mode": 0,
        "extensions": {"KHR_gaussian_splatting": {"kernel": "ellipse"}},
    }
    table = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [{"primitives": [primitive]}],
        "buffers": [{"byteLength": len(binary)}],
        "bufferViews": views,
        "accessors": accessors,
    }
    return table, binary


def parse_glb(data: bytes) -> tuple[dict, bytes]:
    """Parse the header and both chunks of a .glb by the words of its specification."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    text_size, text_kind = struct.unpack_from("<I4s", data, 12)
    size, kind = struct.unpack_from("<I4s", data, 20 + text_size)
    assert (text_kind, kind) == (b"JSON", b"BIN\0")
    assert text_size % 4 == size % 4 == 0
    assert 28 + text_size + size == length
    return json.loads(data[20 : 20 + text_size]), data[28 + text_size :]


def write_glb(path: Path, table: dict, binary: bytes) -> Path:
    text = json.dumps(table).encode()
    text += b" " * (-len(text) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text
    chunks += struct.pack("<I4s", len(binary), b"BIN\0") + binary
    path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
    return path


def write_degree_4_ply(path: Path, scene: Gaussians) -> None:
    """Write a .ply of degree 4 beside one of degree 3: nine more coefficients for each channel."""
    plain = path.with_name("plain.ply")
    save_ply(plain, scene)
    header, _, data = plain.read_bytes().partition(b"end_header\n")
    names = re.findall(rb"property float (\w+)", header)
    rows = np.frombuffer(data, "<f4").reshape(len(scene), len(names))
    first = names.index(b"f_rest_0")
    rest = rows[:, first : first + 45].reshape(-1, 3, 15)
    fourth = np.full((len(scene), 3, 9), 7.0, "<f4")
    wide = np.concatenate([rest, fourth], axis=2).reshape(len(scene), 72)
    rows = np.concatenate([rows[:, :first], wide, rows[:, first + 45 :]], axis=1)
    lines = b"".join(b"property float f_rest_%d\n" % i for i in range(72))
    start = header.index(b"property float f_rest_0")
    end = header.index(b"property float opacity")
    content = header[:start] + lines + header[end:] + b"end_header\n"
    path.write_bytes(content + rows.astype("<f4").tobytes())


def plausible(n: int = 200, degree: int = 3) -> Gaussians:
    """Make Gaussians with colours and harmonics within the range of every format."""
    gaussians = random_gaussians(n, seed=3, sh_degree=degree)
    sh = gaussians.sh * 0.5
    sh[:, 0] = sh[:, 0].clamp(-1.7, 1.7)
    return replace(gaussians, sh=sh.clamp(-0.98, 0.98))


def pack_spz_4(path: Path, gaussians: Gaussians) -> None:
    write_spz_4(path, made(path.parent, "scene.spz", gaussians))


def unpack_spz(path: Path, gaussians: Gaussians) -> None:
    path.write_bytes(gzip.decompress(made(path.parent, "scene.spz", gaussians).read_bytes()))


BY_HAND = {
    "four.spz": pack_spz_4,
    "plain.spz": unpack_spz,
    "scene.ksplat": lambda path, gaussians: write_ksplat(path, gaussians, level=1),
    "scene.sog": lambda path, gaussians: write_sog(path, sog_files(gaussians)),
    "folder": lambda path, gaussians: write_sog(path, sog_files(gaussians)),
    "scene.glb": lambda path, gaussians: write_glb(
        path, *glb_table(rotate_half_turn(gaussians, HALF_TURN_Z))
    ),
}
"""Writers of this file by file name, for what the package only reads or writes in another way."""
WRITTEN = tuple(
    f"{'written' if f'scene{row.endings[0]}' in BY_HAND else 'scene'}{row.endings[0]}"
    for row in SPLAT_FORMATS.values()
    if row.write is not None and not row.extra
)
"""A file of each format that the package writes without an extra."""
SPLAT_FILES = (*WRITTEN, *BY_HAND)
"""A file of each kind that the tests write, and a folder."""
FORMATS_BUT_PLY = tuple(
    # What is unpacked has no checksum, and a folder no bytes of its own.
    name
    for name in SPLAT_FILES
    if name not in ("scene.ply", "plain.spz", "folder")
)


def made(folder: Path, name: str, gaussians: Gaussians) -> Path:
    """Write a file of the Gaussians in the format of `name`."""
    path = folder / name
    if name in BY_HAND:
        BY_HAND[name](path, gaussians)
    else:
        save_splat(path, gaussians)
    return path


def read_parts(path: Path) -> dict[str, bytes]:
    """Read all files of a .zip, by name."""
    with zipfile.ZipFile(path) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def write_parts(path: Path, parts: dict[str, bytes]) -> Path:
    """Write a .zip with right checksums; each file begins at 64 bytes, as OpenUSD asks for."""
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in parts.items():
            entry = zipfile.ZipInfo(name)
            assert archive.fp is not None
            # The header has 30 bytes, then come the name and this field, whose own head has 4.
            free = -(archive.fp.tell() + 30 + len(name.encode()) + 4) % 64
            entry.extra = struct.pack("<HH", 0x1986, free) + bytes(free)
            archive.writestr(entry, data)
    return path


def psnr(a: Gaussians, b: Gaussians) -> float:
    """Compute the PSNR between two scenes in dB, the worst of three cameras."""
    cameras = [
        camera_at(size=64),
        camera_at(0.5, -0.3, yaw=20, size=64),
        camera_at(yaw=-30, size=64),
    ]

    def error(camera) -> float:
        drawn: list[Render] = [CPU.render(scene, camera) for scene in (a, b)]
        return (drawn[0].image - drawn[1].image).square().mean().item()

    return -10 * torch.tensor(max(error(camera) for camera in cameras) + 1e-12).log10().item()


def covariances(gaussians: Gaussians) -> torch.Tensor:
    """Compute [n, 3, 3], which unlike quaternions is independent of axis order and sign."""
    w, x, y, z = torch.nn.functional.normalize(gaussians.quats.double(), dim=1).unbind(1)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    rotation = torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)
    axes = rotation * gaussians.scales.double()[:, None]
    return axes @ axes.transpose(1, 2)
