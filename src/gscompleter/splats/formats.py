"""The table of splat formats: read by the first bytes of a file, written by its extension.

The labels of generated Gaussians are a column of a .ply, and in .sog, .glb and OpenUSD an array of
their own; other formats have a file beside them.
"""

from __future__ import annotations

import contextlib
import json
import lzma
import struct
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import UInt8
from PIL import Image
from torch import Tensor

from gscompleter.numerics.value_checks import check_gaussians
from gscompleter.splats.compressed_ply import (
    list_compressed_names,
    read_compressed_ply,
    write_compressed_ply,
)
from gscompleter.splats.foreign import (
    refuse_folder,
    refuse_foreign,
    refuse_packed_folder,
    resolve_splat,
)
from gscompleter.splats.glb import list_glb_names, read_glb, read_glb_remarks, write_glb
from gscompleter.splats.ksplat import read_ksplat
from gscompleter.splats.morton import sort_along_morton
from gscompleter.splats.origin import measure_distance
from gscompleter.splats.packing import ZIP_MAGIC, BandError, UnsupportedError
from gscompleter.splats.ply import (
    copy_ply,
    decode_gaussians,
    describe_values,
    load_ply,
    make_band_error,
    make_memory_error,
    read_scene,
    require_finite,
    save_ply,
)
from gscompleter.splats.properties import describe_further, refuse_other_kinds
from gscompleter.splats.provenance import (
    KEY,
    NOTHING_KNOWN,
    Provenance,
    parse_comments,
    parse_provenance,
)
from gscompleter.splats.sog import META, list_sog_names, read_sog, read_sog_remarks, write_sog
from gscompleter.splats.splat import read_splat_rows, write_splat
from gscompleter.splats.spz import list_spz_names, read_spz, write_spz
from gscompleter.splats.usd import read_usd, read_usd_remarks, write_usd
from gscompleter.system.damage import describe_damage
from gscompleter.system.errors import InputError, quote_value, refuse_pointer, require_path
from gscompleter.system.files.output_file import check_free, reserve_file
from gscompleter.system.files.ply import read_header
from gscompleter.system.files.reading import hash_file, open_file, read_json
from gscompleter.system.files.writing import replace_file
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import Gaussians, Origin

OPACITY_TOLERANCE = 1e-3
"""Distance from [0, 1] up to which an opacity is clamped instead of refused."""
DECODING_ERRORS = (
    *(ArithmeticError, EOFError, LookupError, MemoryError, OSError, RecursionError, ValueError),
    *(NotImplementedError, struct.error, zipfile.BadZipFile, zlib.error, lzma.LZMAError),
    Image.DecompressionBombError,
)
"""Errors that decoders raise on damaged bytes."""
JSON_ERRORS = (AttributeError, TypeError)
"""Errors by JSON whose values are of another type."""
MAX_DEFECT = 120
"""Most characters of the description of a defect."""
HEAD_BYTES = 8192
"""Bytes read to detect a format; the header of a compressed .ply fits."""


@dataclass(frozen=True)
class SplatFormat:
    """Functions that detect, read and write one file format."""

    extensions: tuple[str, ...]
    starts: tuple[bytes, ...]
    """First bytes of a file, white space aside; none if only the extension tells the format."""
    read: Callable[[Path], Gaussians]
    write: Callable[..., None] | None = None
    """Takes path and Gaussians; those of `RECORDING` also who made the file."""
    contains: bytes = b""
    """Text near the start of a file that tells it from others with the same first bytes."""
    read_remarks: Callable[[Path], object] | None = None
    """Reads the record of who made the file, as values of JSON; None if it lies beside it."""
    list_names: Callable[[Path], list[str]] | None = None
    """Lists properties that are not read, named as in a .ply; None if it can hold no others."""


SPLAT_FORMATS = {
    "compressed-ply": SplatFormat(
        (".compressed.ply",),
        (b"ply",),
        read_compressed_ply,
        write_compressed_ply,
        contains=b"packed_position",
        list_names=list_compressed_names,
    ),
    "ply": SplatFormat((".ply",), (b"ply",), load_ply, save_ply),
    "spz": SplatFormat(
        (".spz",), (b"NGSP", b"\x1f\x8b"), read_spz, write_spz, list_names=list_spz_names
    ),
    "usdz": SplatFormat(
        (".usdz",), (ZIP_MAGIC,), read_usd, write_usd, b".usd", read_remarks=read_usd_remarks
    ),
    "usd": SplatFormat(
        (".usdc", ".usda", ".usd"),
        (b"PXR-USDC", b"#usda"),
        read_usd,
        write_usd,
        read_remarks=read_usd_remarks,
    ),
    "sog": SplatFormat(
        (".sog",),
        (ZIP_MAGIC,),
        read_sog,
        write_sog,
        read_remarks=read_sog_remarks,
        list_names=list_sog_names,
    ),
    "sog-folder": SplatFormat(
        (META,), (b"{",), read_sog, read_remarks=read_sog_remarks, list_names=list_sog_names
    ),
    "glb": SplatFormat(
        (".glb",),
        (b"glTF",),
        read_glb,
        write_glb,
        read_remarks=read_glb_remarks,
        list_names=list_glb_names,
    ),
    "splat": SplatFormat((".splat",), (), read_splat_rows, write_splat),
    "ksplat": SplatFormat((".ksplat",), (), read_ksplat),
}
"""Formats by name; the first that fits the start of a file is taken."""
SORTED = (write_compressed_ply, write_sog)
"""Writers of formats whose Gaussians lie along a Morton curve."""
UNMARKED = (write_splat, write_glb, write_usd)
"""Writers of formats that cannot mark Gaussians as antialiased."""
LABELLING = (write_sog, write_glb, write_usd)
"""Writers of formats that hold the labels of generated Gaussians, besides .ply."""
PLACING = (write_glb, write_usd)
"""Writers of formats that hold the origin of Gaussians in float64, besides .ply."""
RECORDING = (write_compressed_ply, *LABELLING)
"""Writers of formats that hold the record of who made the file, besides .ply."""


@run_in_plain_torch
def load_splat(
    path: Path | str,
    drop_nonfinite: bool = False,
    ignore_properties: bool = False,
    leaves_out_band_4: bool = False,
) -> Gaussians:
    """Load the Gaussians of a file in any format of `FORMATS`, in the axes of a 3DGS .ply.

    Of a trainer's model folder, the newest iteration is loaded. Labels of generated Gaussians are
    in the file, or in `NAME.generated.json` beside it. `drop_nonfinite` drops
    Gaussians with NaN, infinity or a zero quaternion instead of refusing the file, and
    `ignore_properties` goes on with one whose further properties change what is seen.
    `leaves_out_band_4` reads harmonics of degree 4 without the fourth band.
    """
    path = resolve_splat(require_path(path))
    if detect_splat_format(path) == "ply" and not leaves_out_band_4:
        return load_ply(path, drop_nonfinite, ignore_properties)
    gaussians = decode_splat(path, leaves_out_band_4)
    if not ignore_properties:
        refuse_other_kinds(list_names(path), path)
    return require_finite(gaussians, path, drop_nonfinite)


def list_names(path: Path) -> Sequence[str]:
    """List the properties of a file that `decode_splat` reads, at least those it does not use."""
    name = detect_splat_format(path)
    if name == "ply":
        # Harmonics of a higher degree are refused, or left out, by those who read them.
        return read_scene(path, leaves_out_band_4=True).rows.dtype.names or ()
    listed = SPLAT_FORMATS[name].list_names
    return () if listed is None else listed(path)


def decode_splat(path: Path, leaves_out_band_4: bool = False) -> Gaussians:
    """Decode all Gaussians of a file with their labels, those included that are not finite."""
    name = detect_splat_format(path)
    if name == "ply":
        return decode_gaussians(read_scene(path, leaves_out_band_4))
    read = SPLAT_FORMATS[name].read
    if name == "spz":
        read = partial(read_spz, leaves_out_band_4=leaves_out_band_4)
    has_json = name in ("sog", "sog-folder", "glb", "usd", "usdz")
    errors = DECODING_ERRORS + JSON_ERRORS if has_json else DECODING_ERRORS
    try:
        with np.errstate(over="ignore", invalid="ignore"):  # infinite values are refused below
            gaussians = read(path)
    except InputError:
        raise
    except BandError as error:
        raise make_band_error(path) from error
    except UnsupportedError as error:
        raise InputError(f"{quote_value(path)} {error}; export it as .ply.") from error
    except MemoryError as error:
        raise make_memory_error(path) from error
    except errors as error:
        raise InputError(
            f"{quote_value(path)} cannot be read: {quote_value(describe_damage(error), MAX_DEFECT)}"
            "; fetch the file again, or export it as .ply."
        ) from error
    # Labels lie in the file, or beside it as an earlier version wrote them for all formats.
    if not gaussians.generated.any():
        gaussians = replace(gaussians, generated=load_labels(path, len(gaussians)))
    return validate_ranges(gaussians, path)


def find_origin(path: Path) -> Origin | None:
    """Find the origin of the Gaussians of a file; None if its coordinates lie near zero."""
    path = resolve_splat(path)
    name = detect_splat_format(path)
    if name == "ply":
        return read_scene(path).origin
    return decode_splat(path).origin if name in ("glb", "usd", "usdz") else None


def load_splat_at(path: Path, origin: Origin | None, drop_nonfinite: bool = False) -> Gaussians:
    """Load the Gaussians of a file relative to the origin of another one.

    Their positions are equal to those of the same Gaussians there. Further properties do not count.
    """
    path = resolve_splat(path)
    if origin is not None and detect_splat_format(path) == "ply":
        scene = read_scene(path)
        if scene.origin is not None:
            gaussians = decode_gaussians(replace(scene, origin=origin))
            return require_finite(gaussians, path, drop_nonfinite)
    return load_splat(path, drop_nonfinite, ignore_properties=True).move_origin(origin)


def describe_oddities(path: Path) -> list[str]:
    """Describe in sentences what a file has that plain 3DGS does not, and how it is read."""
    path = resolve_splat(path)
    further = describe_further(list_names(path))
    lines = [] if further is None else [further]
    if detect_splat_format(path) == "ply":
        # As in `list_names`.
        lines = [*describe_values(read_scene(path, leaves_out_band_4=True)), *lines]
    return lines


def validate_ranges(gaussians: Gaussians, path: Path) -> Gaussians:
    """Refuse negative scales and invalid opacities, and clamp opacities off by rounding."""
    opacities = gaussians.opacities
    bad = (gaussians.scales < 0).any(1) | ((opacities - 0.5).abs() > 0.5 + OPACITY_TOLERANCE)
    bad &= opacities.isfinite()  # others are refused as non-finite
    if bad.any():
        raise InputError(
            f"{quote_value(path)} has {int(bad.sum()):,} of {len(bad):,} Gaussians with a negative "
            "scale or an opacity outside of [0, 1]; export it again."
        )
    return replace(gaussians, opacities=opacities.clamp(0, 1))


@run_in_plain_torch
def save_splat(path: Path | str, gaussians: Gaussians, made_by: Provenance = NOTHING_KNOWN) -> None:
    """Write Gaussians in the format given by the extension of `path`.

    A .ply stores everything, and other formats round. Where a format has no place for the labels
    of generated Gaussians or for `made_by`, they go to `NAME.generated.json` beside the file.
    """
    path = require_path(path)
    write = get_writer(path)
    check_gaussians(gaussians, "The scene to write")
    if len(gaussians) == 0:
        raise InputError(f"There is no Gaussian to write to {quote_value(path)}.")
    if write is save_ply:
        save_ply(path, gaussians, made_by=made_by)
        return
    gaussians = gaussians.detach().to("cpu")
    if write in SORTED:
        gaussians = sort_along_morton(gaussians)
    if write not in PLACING:
        gaussians = gaussians.move_origin(None)
    if write in RECORDING:
        write(path, gaussians, made_by)
        made_by = NOTHING_KNOWN
    else:
        write(path, gaussians)
    # Labels beside a file that holds its own would be those of an earlier one.
    labels = gaussians.generated
    save_labels(path, torch.zeros_like(labels) if write in LABELLING else labels, made_by)


def convert_splat(
    source: Path,
    out: Path,
    drop_nonfinite: bool = False,
    keep_labels: bool = True,
    ignore_properties: bool = False,
) -> tuple[int, int, str | None]:
    """Convert a file of Gaussians to the format given by the extension of `out`.

    Returns the numbers of Gaussians and of generated ones, and a sentence on what the format cannot
    say or None. From .ply to .ply, some Gaussians are in memory at a time.
    """
    source = resolve_splat(source)
    made_by = read_provenance(source) if keep_labels else NOTHING_KNOWN
    if get_writer(out) is save_ply and detect_splat_format(source) == "ply":
        counts = copy_ply(source, out, drop_nonfinite, keep_labels, made_by, ignore_properties)
        return (*counts, None)
    gaussians = load_splat(source, drop_nonfinite, ignore_properties)
    num_generated = int((gaussians.generated > 0).sum())
    if not keep_labels:
        gaussians = drop_labels(gaussians)
    save_splat(out, gaussians, made_by)
    note = " ".join(describe_losses(out, gaussians))
    return len(gaussians), num_generated, note or None


def drop_labels(gaussians: Gaussians) -> Gaussians:
    """Take all Gaussians for observed: a writer then leaves the labels out altogether."""
    return replace(gaussians, generated=torch.zeros_like(gaussians.generated))


def describe_losses(path: Path, gaussians: Gaussians) -> list[str]:
    """Describe in sentences what a file that was written does not hold of its Gaussians."""
    losses = [describe_mode_loss(path, gaussians), describe_rounding(path, gaussians)]
    return [loss for loss in losses if loss is not None]


def describe_mode_loss(path: Path, gaussians: Gaussians) -> str | None:
    """Describe that the format of `path` cannot mark antialiased Gaussians, or return None."""
    if get_writer(path) not in UNMARKED or not gaussians.is_antialiased:
        return None
    return (
        f"A {path.suffix} file cannot mark Gaussians as antialiased: viewers will render them as "
        "classic ones, which makes small ones too opaque."
    )


def describe_rounding(path: Path, gaussians: Gaussians) -> str | None:
    """Describe how far a file that was written holds Gaussians from their places.

    None if they have no origin, which tells that their coordinates are large, or if it holds that.
    """
    write = get_writer(path)
    if gaussians.origin is None or write is save_ply or write in PLACING:
        return None
    written = gaussians.detach().to("cpu")
    written = sort_along_morton(written) if write in SORTED else written
    distance = measure_distance(written, decode_splat(path))
    name = _match_extension(path)
    ending = path.suffix if name is None else SPLAT_FORMATS[name].extensions[0]
    return (
        f"A {ending} file cannot hold coordinates this large: the largest rounding of a "
        f"position is {distance:.3g}; a .ply, .glb or .usdz holds them."
    )


def detect_splat_format(path: Path) -> str:
    """Detect the format of a file or folder, by name."""
    if path.is_dir():
        if (path / META).is_file():
            refuse_packed_folder(path)
            return "sog-folder"
        refuse_folder(path)
    with open_file(path) as file:
        head = file.read(HEAD_BYTES)
    refuse_pointer(path)
    if not head:
        raise InputError(f"{quote_value(path)} is empty; a file of Gaussians is needed.")
    refuse_foreign(path, head)
    # Content decides before the name, since files are renamed.
    for name, format_ in SPLAT_FORMATS.items():
        if head.lstrip().startswith(format_.starts) and format_.contains in head:
            return name
    named = _match_extension(path)
    if named is None or SPLAT_FORMATS[named].starts:
        raise InputError(
            f"{quote_value(path)} holds no Gaussians in a format that is known; name a .ply, "
            ".spz, .splat, .ksplat or .glb (docs/formats.md has them all)."
        )
    return named


def read_provenance(path: Path) -> Provenance:
    """Read who made a splat, from the file or from beside it; no runs if nobody says so.

    Raise InputError if the record is damaged.
    """
    path = resolve_splat(path)
    name = detect_splat_format(path)
    if name in ("ply", "compressed-ply"):
        with open_file(path) as file:
            return parse_comments(read_header(file, path)[0], quote_value(path))
    read_remarks = SPLAT_FORMATS[name].read_remarks
    beside = get_labels_path(path)
    try:
        if read_remarks is not None:
            table = read_remarks(path)
        elif beside.is_file():
            table = read_json(beside, "remove it to go on without labels").get(KEY)
        else:
            table = None
    except (*DECODING_ERRORS, *JSON_ERRORS) as error:
        raise InputError(
            f"{quote_value(path)} cannot be read: {quote_value(describe_damage(error), MAX_DEFECT)}"
            "; fetch the file again."
        ) from error
    return parse_provenance(table, quote_value(path))


def get_writer(path: Path) -> Callable[..., None]:
    """Get the function that writes the format for the extension of `path`."""
    name = _match_extension(path)
    write = None if name is None else SPLAT_FORMATS[name].write
    if write is None:
        raise InputError(
            f"{quote_value(path)} cannot be written in the format of its extension; end it in "
            f"{', '.join(f.extensions[0] for f in SPLAT_FORMATS.values() if f.write)}."
        )
    return write


def describe_other_name(path: Path) -> str | None:
    """Describe that a file is named for another format than it has, or return None."""
    found = detect_splat_format(path)
    named = _match_extension(path)
    if path.is_dir() or named is None or named == found:
        return None
    ending = next(e for e in SPLAT_FORMATS[named].extensions if path.name.lower().endswith(e))
    plain = "a plain .ply" if found == "ply" else f"a {SPLAT_FORMATS[found].extensions[0]}"
    return f"It is named {ending}, and holds {plain}."


def has_splat_extension(path: Path) -> bool:
    """Check whether a name ends as that of a splat does."""
    return _match_extension(path) is not None


def _match_extension(path: Path) -> str | None:
    for name, format_ in SPLAT_FORMATS.items():
        if path.name.lower().endswith(format_.extensions):
            return name
    return None


def get_labels_path(path: Path) -> Path:
    """Get the path of the labels file for a splat file."""
    return path.with_name(f"{path.name}.generated.json")


@contextlib.contextmanager
def reserve_splat(path: Path, overwrite: bool) -> Iterator[None]:
    """Reserve the file of a splat as `reserve_file` does, with the one of its labels.

    Raise an InputError for a name without a format, too.
    """
    write = get_writer(path)
    with reserve_file(path, overwrite):
        # Labels beside the file are replaced with it, and removed if nothing was generated.
        if write is not save_ply:
            check_free(get_labels_path(path), overwrite)
        yield


def save_labels(
    path: Path, generated: UInt8[Tensor, "n"], made_by: Provenance = NOTHING_KNOWN
) -> None:
    """Write the labels of the file at `path` beside it, with who made it unless the file says so.

    They are removed if nothing was generated.
    """
    place = get_labels_path(path)
    # What a link names lies elsewhere, and stays.
    if not (generated > 0).any() or place.is_symlink():
        with contextlib.suppress(FileNotFoundError):
            place.unlink()
    if not (generated > 0).any():
        return
    # Run lengths, as labels come in long runs; the digest ties them to this very file.
    runs = [[label, len(list(run))] for label, run in groupby(generated.tolist())]
    with replace_file(place) as file:
        table: dict[str, Any] = {"sha256": hash_file(path), "generated": runs}
        if made_by.runs:
            table[KEY] = made_by.to_json()
        file.write(json.dumps(table).encode())


def load_labels(path: Path, count: int) -> UInt8[Tensor, "n"]:
    """Load the labels of the `count` Gaussians in the file at `path`; zeros if there are none."""
    place = get_labels_path(path)
    if not path.is_file() or not place.exists():
        return torch.zeros(count, dtype=torch.uint8)
    table = read_json(place, "remove it to go on without labels")
    try:
        runs = np.array(table["generated"], dtype=np.int64).reshape(-1, 2)
        in_range = bool(((runs >= 0) & (runs <= [255, count])).all())
        fits = in_range and runs[:, 1].sum() == count and table["sha256"] == hash_file(path)
    except (KeyError, TypeError, ValueError, OverflowError):
        fits = False
    if not fits:
        raise InputError(
            f"{place} does not hold the labels of {path.name}; remove it to go on without them."
        )
    return torch.from_numpy(np.repeat(runs[:, 0].astype(np.uint8), runs[:, 1]))
