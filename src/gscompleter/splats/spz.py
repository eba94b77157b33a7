"""The .spz format of Niantic: versions 2, 3 and 4 are read, version 3 is written.

One attribute after the other: positions in 24-bit fixed point, opacities, colours and log-scales
in one byte, rotations (version 2: three bytes; later: 2 + 3 x 10 bits), SH in one byte. Versions
2 and 3 are one gzip stream with a header of 16 bytes. Version 4 has a header of 32 bytes and one
zstd stream per attribute. Axes are x right, y up, z back.
"""

from __future__ import annotations

import gzip
import io
import struct
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int, UInt8
from numpy import ndarray

from gscompleter.splats.packing import (
    NUM_SH_REST,
    BandError,
    UnsupportedError,
    assemble_sh,
    build_gaussians,
    check_count,
    drop_largest,
    pack_fractions,
    restore_largest,
    unpack_fractions,
)
from gscompleter.splats.ply import encode
from gscompleter.splats.splat_format import FormatTexts, SplatFormat
from gscompleter.splats.transform import HALF_TURN_X, rotate_half_turn
from gscompleter.system.damage import DamagedError, check_rows
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import read_bytes
from gscompleter.system.files.writing import replace_file
from gscompleter.types import SH_C0, Gaussians

SPZ_MAGIC = b"NGSP"
GZIP = b"\x1f\x8b"
SPZ_HEADER = struct.Struct("<4sIIBBBB")
"""Magic, version, count, SH degree, fractional bits, flags, and the number of streams."""
ANTIALIASED_FLAG = 0x1
EXTENSIONS_FLAG = 0x2
"""Flag of a file with records of other programs, such as the orbit of a viewer's camera."""
MAX_WINDOW = 1 << 27
"""Largest window of zstd, in bytes, which it keeps in memory."""
COLOR_SCALE = 0.15
"""The constant SH coefficient is stored as `0.5 + 0.15 sh`."""
SIGN_SIZE_BITS = (1, 9) * 3
"""Bits of sign and size of three components of a rotation."""
MAX_FRACTIONAL_BITS = 16
ENCODED_BLOCK = 1 << 16
"""Gaussians that are encoded at a time."""
SPZ_REST_VALUES = (np.arange(256, dtype=np.float32) - 128) / 128
"""Coefficient of SH of degree 1 and above that each byte stands for."""
GZIP_HEADER = gzip.compress(b"", compresslevel=6, mtime=0)[:10]
"""Signature, method, no time and the mark of the system, as the module `gzip` writes them."""


GZIP_BITS = 31
"""Window of zlib, 15 bits, and 16 for a header of gzip."""
ATTRIBUTES = ("positions", "opacities", "colours", "sizes", "rotations", "harmonics")
"""Attributes in the order of the file."""


class SpzHeader(NamedTuple):
    """The header of a .spz."""

    magic: bytes
    version: int
    num_gaussians: int
    degree: int
    fractional_bits: int
    flags: int
    num_streams: int

    @property
    def widths(self) -> list[int]:
        """Bytes of position, opacity, colour, scale, rotation and SH of a Gaussian."""
        return [9, 1, 3, 3, 3 if self.version == 2 else 4, 3 * ((self.degree + 1) ** 2 - 1)]

    @property
    def stream_sizes(self) -> list[int]:
        """Bytes of all positions, opacities, colours, scales, rotations and SH."""
        return [width * self.num_gaussians for width in self.widths]


def read_spz(path: Path, leaves_out_band_4: bool = False) -> Gaussians:
    """Read a .spz in the axes of a .ply; of SH degree 4 three bands are read, on request."""
    return decode_spz(read_bytes(path), 4 if leaves_out_band_4 else 3)


def decode_spz(data: bytes, max_degree: int = 3) -> Gaussians:
    """Decode the bytes of a .spz, in the axes of a .ply; bands above the third are left out."""
    if data.startswith(GZIP):
        data = _unpack_gzip(data, max_degree)
    header = _parse_header(data, max_degree)
    if header.version < 4:
        ends = np.cumsum([SPZ_HEADER.size, *header.stream_sizes]).tolist()
        streams = [data[start:end] for start, end in pairwise(ends)]
    else:
        streams = _read_zstd(header, data)
    turned = rotate_half_turn(_decode_streams(header, streams), HALF_TURN_X)
    return replace(turned, is_antialiased=bool(header.flags & ANTIALIASED_FLAG))


def list_spz_names(path: Path) -> list[str]:
    """List what is stored besides the attributes, and is not read."""
    data = read_bytes(path)
    if data.startswith(GZIP):
        data = zlib.decompressobj(wbits=GZIP_BITS).decompress(data, SPZ_HEADER.size)
    return ["extensions"] if _parse_header(data, 4).flags & EXTENSIONS_FLAG else []


def _parse_header(data: bytes, max_degree: int) -> SpzHeader:
    if len(data) < SPZ_HEADER.size:
        raise DamagedError("it ends within its header")
    header = SpzHeader(*SPZ_HEADER.unpack_from(data))
    if header.magic != SPZ_MAGIC:
        raise DamagedError("it is no .spz but other data")
    if header.version not in (2, 3, 4) or header.degree > 4:
        raise UnsupportedError(
            f"is .spz version {header.version} of SH degree {header.degree}, and version 2 to 4 of "
            "degree 0 to 3 are read"
        )
    if header.degree > max_degree:
        raise BandError(f"has harmonics of degree {header.degree}")
    return header


def _unpack_gzip(data: bytes, max_degree: int) -> bytes:
    # The header says how long the content is; a bomb is refused before it is unpacked.
    unpacker = zlib.decompressobj(wbits=GZIP_BITS)
    start = unpacker.decompress(data, SPZ_HEADER.size)
    header = _parse_header(start, max_degree)
    check_count(header.num_gaussians, len(data))
    size = sum(header.stream_sizes)
    # One byte more than there should be reaches the end, where the checksum is compared. What a cut
    # file has of its content is returned: how far it reaches is told by the missing rows.
    body = unpacker.decompress(unpacker.unconsumed_tail, size + 1)
    if len(body) == size and not unpacker.eof:
        raise DamagedError("it ends after its Gaussians, before their checksum")
    return start + body[:size]


def _read_zstd(header: SpzHeader, data: bytes) -> list[bytes]:
    """Decompress the attributes of version 4, each from its own stream; SH may be absent."""
    import zstandard  # only version 4 needs it

    check_count(header.num_gaussians, len(data))
    # After the header lies the offset of a table with the packed and unpacked size of each stream.
    if len(data) < SPZ_HEADER.size + 4:
        raise DamagedError("it ends within its header")
    (place,) = struct.unpack_from("<I", data, SPZ_HEADER.size)
    check_rows(len(data) - place, 16, header.num_streams, "entries of its table of contents")
    table = np.frombuffer(data, "<u8", 2 * header.num_streams, place).reshape(-1, 2)
    start = place + table.nbytes
    streams = []
    # No more than the stated size is unpacked of a stream.
    for packed, size in zip(table[:, 0].tolist(), header.stream_sizes, strict=False):
        unpacker = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)
        try:
            streams.append(unpacker.stream_reader(data[start : start + packed]).read(size))
        except zstandard.ZstdError as error:
            # What a stream lacks that ends too early is told by the missing rows.
            raise DamagedError("its compressed content is damaged") from error
        start += packed
    return [*streams, b""][: len(header.stream_sizes)]


def _decode_streams(header: SpzHeader, streams: list[bytes]) -> Gaussians:
    """Decode the Gaussians, in the axes of the file."""
    n = header.num_gaussians
    for stream, width, what in zip(streams, header.widths, ATTRIBUTES, strict=True):
        check_rows(len(stream), width, n, what)
    positions, opacities, colours, scales, rotations, rest = [
        np.frombuffer(stream, np.uint8).reshape(n, width)
        for stream, width in zip(streams, header.widths, strict=True)
    ]
    colour = 0.5 + SH_C0 * (colours.astype(np.float32) / 255 - 0.5) / COLOR_SCALE
    higher = SPZ_REST_VALUES[rest].reshape(n, -1, 3)[:, : NUM_SH_REST[min(header.degree, 3)]]
    return build_gaussians(
        np.ldexp(_decode_int24(positions).astype(np.float32), -header.fractional_bits),
        _decode_quats_v2(rotations) if header.version == 2 else _decode_quats_v3(rotations),
        np.exp(scales.astype(np.float32) / 16 - 10),
        opacities[:, 0].astype(np.float32) / 255,
        assemble_sh(colour, higher),
    )


def _decode_int24(positions: UInt8[ndarray, "n 9"]) -> Int[ndarray, "n 3"]:
    """Decode three signed 24-bit numbers from each row of 9 bytes."""
    low, middle, high = np.moveaxis(positions.reshape(-1, 3, 3).astype(np.int32), 2, 0)
    # Flipping the sign bit and subtracting it extends the sign to 32 bits.
    return ((low | (middle << 8) | (high << 16)) ^ (1 << 23)) - (1 << 23)


def _decode_quats_v2(rotations: UInt8[ndarray, "n 3"]) -> Float[ndarray, "n 4"]:
    # w is positive, and follows from the length of 1.
    xyz = rotations.astype(np.float32) / 127.5 - 1
    w = np.sqrt(np.maximum(0, 1 - np.square(xyz).sum(1, keepdims=True)))
    return np.concatenate([w, xyz], axis=1)


def _decode_quats_v3(rotations: UInt8[ndarray, "n 4"]) -> Float[ndarray, "n 4"]:
    """Decode the number of the dropped component and three of 10 bits (xyzw, sign and size)."""
    packed = np.ascontiguousarray(rotations).view("<u4")[:, 0]
    fields = unpack_fractions(packed, SIGN_SIZE_BITS)
    sizes = fields[:, 1::2] * np.float32(np.sqrt(0.5))
    smaller = np.where(fields[:, ::2] > 0, -sizes, sizes)
    # The file has xyzw.
    return np.roll(restore_largest(packed >> np.uint32(30), smaller), 1, axis=1)


def write_spz(path: Path, gaussians: Gaussians) -> None:
    """Write a .spz of version 3."""
    content = encode_spz(path, gaussians)
    with replace_file(path) as file:
        file.write(content)


def encode_spz(path: Path, gaussians: Gaussians) -> bytes:
    """Encode a .spz of version 3 in the finest possible steps; `path` is for errors."""
    return encode_spz_blocks(path, lambda: (gaussians[block] for block in _cut(len(gaussians))))


def encode_spz_blocks(path: Path, make_blocks: Callable[[], Iterable[Gaussians]]) -> bytes:
    """Encode a .spz of the blocks of a scene, which are made twice, one after the other."""
    parts = [(len(block), block.means.abs().amax().item()) for block in make_blocks() if len(block)]
    bits = _choose_fractional_bits(path, max(farthest for _, farthest in parts))
    # Each attribute of all Gaussians is one stream.
    streams: list[list[bytes]] = [[] for _ in range(6)]
    for block in make_blocks():
        for stream, content in zip(streams, _encode_streams(block, bits), strict=True):
            stream.append(content)
        degree = block.sh_degree
        flags = ANTIALIASED_FLAG if block.is_antialiased else 0
    header = SPZ_HEADER.pack(SPZ_MAGIC, 3, sum(count for count, _ in parts), degree, bits, flags, 0)
    # What `gzip.compress` gives for all of it at once: a header, the packed data, and its checksum.
    packer = zlib.compressobj(6, zlib.DEFLATED, -zlib.MAX_WBITS)
    packed = io.BytesIO()
    packed.write(GZIP_HEADER)
    checksum = 0
    size = 0
    for stream in ([header], *streams):
        for content in stream:
            packed.write(packer.compress(content))
            checksum = zlib.crc32(content, checksum)
            size += len(content)
        stream.clear()
    packed.write(packer.flush())
    packed.write(struct.pack("<II", checksum, size % 2**32))
    return packed.getvalue()  # the bytes themselves, without a copy


def _cut(count: int) -> Iterator[slice]:
    return (slice(start, start + ENCODED_BLOCK) for start in range(0, count, ENCODED_BLOCK))


def _encode_streams(gaussians: Gaussians, bits: int) -> tuple[bytes, ...]:
    """Encode positions, opacities, colours, scales, rotations and SH, in the axes of a .ply."""
    turned = rotate_half_turn(gaussians, HALF_TURN_X)
    constant = 0.5 + COLOR_SCALE * turned.sh[:, 0].numpy()
    rest = turned.sh[:, 1:].reshape(len(turned), -1).numpy()
    log_scales = encode(gaussians)[:, :3].numpy()
    return (
        _pack_positions(turned.means.numpy(), bits),
        _quantize_to_bytes(turned.opacities.numpy() * 255),
        _quantize_to_bytes(constant * 255),
        _quantize_to_bytes((log_scales + 10) * 16),
        _pack_rotations(turned.quats.numpy()),
        _quantize_to_bytes(rest * 128 + 128),
    )


def _choose_fractional_bits(path: Path, farthest: float) -> int:
    """Choose the fractional bits that the farthest coordinate leaves of 23."""
    # Positions are signed numbers of 24 bits: what the whole part leaves of 23 is for the fraction.
    bits = 23 - int(np.ceil(np.log2(farthest + 1)))
    if bits < 0:
        raise InputError(
            f"{quote_value(path)} cannot hold Gaussians {farthest:.3g} from the origin; remove the "
            "floaters or write a .ply."
        )
    return min(bits, MAX_FRACTIONAL_BITS)


def _quantize_to_bytes(values: Float[ndarray, "*n"]) -> bytes:
    return np.clip(np.rint(values), 0, 255).astype(np.uint8).tobytes()


def _pack_positions(means: Float[ndarray, "n 3"], bits: int) -> bytes:
    fixed = np.rint(means.astype(np.float64) * 2**bits).clip(-(2**23), 2**23 - 1).astype("<i4")
    # The three lower bytes of each little-endian number.
    return fixed.view(np.uint8).reshape(-1, 3, 4)[:, :, :3].tobytes()


def _pack_rotations(quats: Float[ndarray, "n 4"]) -> bytes:
    # From wxyz to the file's xyzw; sign and size take 1 and 9 bits of each component.
    largest, smaller = drop_largest(np.roll(quats, -1, axis=1))
    fields = np.stack([smaller < 0, np.abs(smaller) / np.sqrt(0.5)], axis=2).reshape(-1, 6)
    packed = (largest.astype(np.uint32) << np.uint32(30)) | pack_fractions(fields, SIGN_SIZE_BITS)
    return packed.astype("<u4").tobytes()


def is_spz(path: Path, head: bytes) -> bool:
    """Check that a file is no other one that is packed with gzip, by the start of its content."""
    if not head.startswith(GZIP):
        return True
    content = b""
    with suppress(zlib.error):
        content = zlib.decompressobj(GZIP_BITS).decompress(head, max_length=SPZ_HEADER.size)
    # The reader says what is wrong with one whose content is damaged.
    return content.startswith(SPZ_MAGIC) or path.suffix.lower() == ".spz"


SPZ = SplatFormat(
    name="spz",
    endings=(".spz",),
    texts=FormatTexts(
        title="Niantic",
        read="versions 2, 3 and 4; 2 and 3 also unpacked",
        written="version 3",
        precision="position in steps of 2⁻¹⁶, coarser for far Gaussians; log-scale in steps of "
        "1/16 from -10 to 5.9; rotation 9 bits a component; colour and opacity 8 bits; harmonics "
        "in steps of 1/128 up to ±1",
        axes="x right, y up, z back",
        places={"marks_antialiased": "a flag", "list_names": "extensions"},
    ),
    read=read_spz,
    starts=(SPZ_MAGIC, GZIP),
    recognize=is_spz,
    write=write_spz,
    list_names=list_spz_names,
    marks_antialiased=True,
    is_y_up=True,
    rounds_geometry=True,
    can_leave_out_band_4=True,
)
