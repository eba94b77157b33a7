"""The size to which an LZFSE stream unpacks, read from the headers of its blocks.

pyliblzfse has no limit of its own: it doubles its buffer until a stream ends, so that a small file
can fill the memory. Layout: https://github.com/lzfse/lzfse, `lzfse_internal.h`.
"""

from __future__ import annotations

import struct

from gscompleter.system.damage import DamagedError

END = b"bvx$"
RAW = b"bvx-"
"""Block of bytes as they are: magic, number of bytes."""
LZVN = b"bvxn"
"""Block of short data: magic, unpacked bytes, packed bytes."""
LZFSE = b"bvx2"
"""Usual block: magic, unpacked bytes, and three fields of 64 bits."""
LZFSE_HEADER = struct.Struct("<4sIQQQ")
PAYLOAD_MASK = 0xFFFFF
"""Lengths of payloads have 20 bits."""


def measure_unpacked(data: bytes) -> int:
    """Add up the unpacked sizes of all blocks, in bytes; raise DamagedError for other data."""
    size = start = 0
    while data[start : start + 4] != END:
        magic = data[start : start + 4]
        if magic == RAW:
            (unpacked,) = struct.unpack_from("<I", data, start + 4)
            start += 8 + unpacked
        elif magic == LZVN:
            unpacked, packed = struct.unpack_from("<II", data, start + 4)
            start += 12 + packed
        elif magic == LZFSE:
            _, unpacked, first, second, third = LZFSE_HEADER.unpack_from(data, start)
            # Offsets and widths of the fields are those of `lzfse_compressed_block_header_v2`:
            # literals are the second 20 bits of the first field, matches the third 20 bits of the
            # second one.
            literals = (first >> 20) & PAYLOAD_MASK
            matches = (second >> 40) & PAYLOAD_MASK
            header_bytes = third & 0xFFFFFFFF
            start += max(header_bytes, LZFSE_HEADER.size) + literals + matches
        else:
            raise DamagedError("it is no LZFSE stream, or ends too early")
        size += unpacked
    return size
