"""Splat files of any format of the table: read by their first bytes, written by their extension.

The labels of generated Gaussians, and who made them, are in the file, or beside it if its format
has no place for them (`labels_file.py`).
"""

from __future__ import annotations

import contextlib
import lzma
import struct
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from PIL import Image

from gscompleter.numerics.value_checks import check_gaussians
from gscompleter.splats.foreign import (
    is_packed_folder,
    refuse_folder,
    refuse_foreign,
    resolve_splat,
)
from gscompleter.splats.labels_file import (
    get_labels_path,
    load_labels,
    load_record,
    save_labels,
)
from gscompleter.splats.morton import sort_along_morton
from gscompleter.splats.origin import measure_distance
from gscompleter.splats.packing import BandError, UnsupportedError
from gscompleter.splats.ply import (
    PLY,
    decode_gaussians,
    describe_values,
    load_ply,
    make_band_error,
    make_memory_error,
    read_scene,
    require_finite,
    save_ply,
)
from gscompleter.splats.properties import describe_further_properties, refuse_other_kinds
from gscompleter.splats.provenance import NOTHING_KNOWN, Provenance, parse_provenance
from gscompleter.splats.sog import SOG_FOLDER
from gscompleter.splats.splat_format import HEAD_BYTES, SplatFormat
from gscompleter.splats.table import SPLAT_FORMATS as SPLAT_FORMATS
from gscompleter.splats.table import get_written_format, match_ending, name_endings
from gscompleter.system.damage import describe_damage
from gscompleter.system.errors import InputError, quote_value, refuse_pointer, require_path
from gscompleter.system.files.output_file import check_free, reserve_file
from gscompleter.system.files.reading import ZIP_ERRORS, open_file
from gscompleter.system.torch_modes import run_in_plain_torch
from gscompleter.types import Gaussians, Origin

OPACITY_TOLERANCE = 1e-3
"""Distance from [0, 1] up to which an opacity is clamped instead of refused."""
DECODING_ERRORS = (
    *ZIP_ERRORS,
    *(ArithmeticError, MemoryError, RecursionError, struct.error, lzma.LZMAError),
    Image.DecompressionBombError,
)
"""Errors that decoders raise on damaged bytes."""
JSON_ERRORS = (AttributeError, TypeError)
"""Errors by JSON whose values are of another type."""
MAX_DEFECT = 120
"""Most characters of the description of a defect."""


@run_in_plain_torch
def load_splat(
    path: Path | str,
    drop_nonfinite: bool = False,
    ignore_properties: bool = False,
    leaves_out_band_4: bool = False,
) -> Gaussians:
    """Load the Gaussians of a file in any format of `SPLAT_FORMATS`, in the axes of a 3DGS .ply.

    Of a trainer's model folder, the newest iteration is loaded. Labels of generated Gaussians are
    in the file, or in `NAME.generated.json` beside it. `drop_nonfinite` drops Gaussians with NaN,
    infinity or a zero quaternion instead of refusing the file, and `ignore_properties` goes on with
    one whose further properties change what is seen. `leaves_out_band_4` reads harmonics of degree
    4 without the fourth band.

    Raises:
        InputError: The file is damaged, of no known format, or refused for what these options say.
    """
    path = resolve_splat(require_path(path))
    # `load_ply` refuses harmonics of degree 4, and maps the rows of the file once.
    if detect_splat_format(path) == PLY.name and not leaves_out_band_4:
        return load_ply(path, drop_nonfinite, ignore_properties)
    gaussians = decode_splat(path, leaves_out_band_4)
    if not ignore_properties:
        refuse_other_kinds(list_property_names(path), path)
    return require_finite(gaussians, path, drop_nonfinite)


def list_property_names(path: Path) -> Sequence[str]:
    """List the properties of a file that `decode_splat` reads, at least those it does not use."""
    name = detect_splat_format(path)
    if name == PLY.name:
        # Harmonics of a higher degree are refused, or left out, by those who read them.
        return read_scene(path, leaves_out_band_4=True).rows.dtype.names or ()
    row = SPLAT_FORMATS[name]
    if row.list_names is None:
        return ()
    with translate_damage(path, row.has_json):
        return row.list_names(path)


def decode_splat(path: Path, leaves_out_band_4: bool = False) -> Gaussians:
    """Decode all Gaussians of a file with their labels, those included that are not finite."""
    row = SPLAT_FORMATS[detect_splat_format(path)]
    if row is PLY:
        return decode_gaussians(read_scene(path, leaves_out_band_4))
    read = row.read
    if row.can_leave_out_band_4:
        read = partial(read, leaves_out_band_4=leaves_out_band_4)
    # Infinite values are refused by those who load the file (`require_finite`).
    with translate_damage(path, row.has_json), np.errstate(over="ignore", invalid="ignore"):
        gaussians = read(path)
    # Labels lie in the file, or beside it as an earlier version wrote them for all formats.
    if not gaussians.generated.any():
        gaussians = replace(gaussians, generated=load_labels(path, len(gaussians)))
    return validate_ranges(gaussians, path)


@contextlib.contextmanager
def translate_damage(path: Path, has_json: bool) -> Iterator[None]:
    """Translate the errors of a decoder of the file at `path` into InputErrors.

    With `has_json`, those by values of another type are damage, too, and else defects of ours.
    """
    errors = DECODING_ERRORS + JSON_ERRORS if has_json else DECODING_ERRORS
    try:
        yield
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


def find_origin(path: Path, leaves_out_band_4: bool = False) -> Origin | None:
    """Find the origin of the Gaussians of a file; None if its coordinates lie near zero."""
    path = resolve_splat(path)
    row = SPLAT_FORMATS[detect_splat_format(path)]
    if row is PLY:
        return read_scene(path, leaves_out_band_4).origin
    return decode_splat(path, leaves_out_band_4).origin if row.holds_origin else None


def load_splat_at(path: Path, origin: Origin | None, drop_nonfinite: bool = False) -> Gaussians:
    """Load the Gaussians of a file relative to the origin of another one.

    Their positions are equal to those of the same Gaussians there. Further properties do not count.
    """
    path = resolve_splat(path)
    if origin is not None and detect_splat_format(path) == PLY.name:
        scene = read_scene(path)
        if scene.origin is not None:
            # Its coordinates in float64 less the other origin, without its own in between.
            gaussians = decode_gaussians(replace(scene, origin=origin))
            return require_finite(gaussians, path, drop_nonfinite)
    return load_splat(path, drop_nonfinite, ignore_properties=True).move_origin(origin)


def describe_oddities(path: Path) -> list[str]:
    """Describe in sentences what a file has that plain 3DGS does not, and how it is read."""
    path = resolve_splat(path)
    further = describe_further_properties(list_property_names(path))
    lines = [] if further is None else [further]
    if detect_splat_format(path) == PLY.name:
        # A fourth band of harmonics is refused, or left out, by those who read it.
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
    row = get_written_format(path)
    check_gaussians(gaussians, "The scene to write")
    if len(gaussians) == 0:
        raise InputError(f"There is no Gaussian to write to {quote_value(path)}.")
    if row is PLY:
        save_ply(path, gaussians, made_by=made_by)
        return
    gaussians = arrange(gaussians, row)
    if not row.holds_origin:
        gaussians = gaussians.move_origin(None)
    assert row.write is not None
    if row.read_record is None:
        row.write(path, gaussians)
    else:
        row.write(path, gaussians, made_by)
        made_by = NOTHING_KNOWN
    # Labels beside a file that holds its own would be those of an earlier one.
    labels = gaussians.generated
    save_labels(path, torch.zeros_like(labels) if row.holds_labels else labels, made_by)


def arrange(gaussians: Gaussians, row: SplatFormat) -> Gaussians:
    """Arrange Gaussians in the order in which a format writes them, on the CPU."""
    gaussians = gaussians.detach().to("cpu")
    return sort_along_morton(gaussians) if row.is_sorted else gaussians


def drop_labels(gaussians: Gaussians) -> Gaussians:
    """Take all Gaussians for observed: a writer then leaves the labels out altogether."""
    return replace(gaussians, generated=torch.zeros_like(gaussians.generated))


def describe_losses(path: Path, gaussians: Gaussians) -> list[str]:
    """Describe in sentences what a file that was written does not hold of its Gaussians."""
    losses = [describe_mode_loss(path, gaussians), describe_rounding(path, gaussians)]
    return [loss for loss in losses if loss is not None]


def describe_mode_loss(path: Path, gaussians: Gaussians) -> str | None:
    """Describe that the format of `path` cannot mark antialiased Gaussians, or return None."""
    if get_written_format(path).marks_antialiased or not gaussians.is_antialiased:
        return None
    return (
        f"A {path.suffix} file cannot mark Gaussians as antialiased: viewers will render them as "
        "classic ones, which makes small ones too opaque."
    )


def describe_rounding(path: Path, gaussians: Gaussians) -> str | None:
    """Describe how far a file that was written holds Gaussians from their places.

    None if they have no origin, which tells that their coordinates are large, or if it holds that.
    """
    row = get_written_format(path)
    if gaussians.origin is None or row.holds_origin:
        return None
    distance = measure_distance(arrange(gaussians, row), decode_splat(path))
    holding = name_endings(lambda other: other.write and other.holds_origin)
    return (
        f"A {row.endings[0]} file cannot hold coordinates this large: the largest rounding of a "
        f"position is {distance:.3g}; write {holding}."
    )


def detect_splat_format(path: Path) -> str:
    """Detect the format of a file or folder, by name."""
    if path.is_dir():
        if is_packed_folder(path):
            return SOG_FOLDER.name
        refuse_folder(path)
    with open_file(path) as file:
        head = file.read(HEAD_BYTES)
    refuse_pointer(path)
    if not head:
        raise InputError(f"{quote_value(path)} is empty; a file of Gaussians is needed.")
    # Content decides before the name, since files are renamed.
    for row in SPLAT_FORMATS.values():
        if row.begins(path, head):
            return row.name
    refuse_foreign(path, head)
    named = match_ending(path)
    if named is None or named.starts:
        raise InputError(
            f"{quote_value(path)} holds no Gaussians in a format that is known; name a splat, such "
            "as a .ply (docs/formats.md has all formats)."
        )
    return named.name


def read_provenance(path: Path) -> Provenance:
    """Read who made a splat, from the file or from beside it; no runs if nobody says so.

    Raise InputError if the record is damaged.
    """
    path = resolve_splat(path)
    row = SPLAT_FORMATS[detect_splat_format(path)]
    # A record is JSON in every format.
    with translate_damage(path, has_json=True):
        table = load_record(path) if row.read_record is None else row.read_record(path)
    return parse_provenance(table, quote_value(path))


def describe_other_name(path: Path) -> str | None:
    """Describe that a file is named for another format than it has, or return None."""
    found = detect_splat_format(path)
    named = match_ending(path)
    if path.is_dir() or named is None or named.name == found:
        return None
    ending = next(e for e in named.endings if path.name.lower().endswith(e))
    plain = "a plain .ply" if found == PLY.name else f"a {SPLAT_FORMATS[found].endings[0]}"
    return f"It is named {ending}, and holds {plain}."


@contextlib.contextmanager
def reserve_splat(path: Path, overwrite: bool) -> Iterator[None]:
    """Reserve the file of a splat as `reserve_file` does, with the one of its labels.

    Raise an InputError for a name without a format, too.
    """
    row = get_written_format(path)
    with reserve_file(path, overwrite):
        # Labels beside the file are replaced with it, and removed if nothing was generated.
        if row is not PLY:
            check_free(get_labels_path(path), overwrite)
        yield
