"""Masks of photographs, whose black pixels are neither reconstructed nor scored.

Programs put them into a folder `masks` or beside the photographs. COLMAP calls the mask of x.jpg
x.jpg.png, nerfstudio and others x.png, Metashape x_mask.png and RealityScan x.mask.png. Those that
instant-ngp calls dynamic_mask_x.png are white where pixels are ignored. An alpha channel is a mask,
too, unless it is the same everywhere. A photograph without any mask is used as a whole.
"""

from __future__ import annotations

import os
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from itertools import product
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from jaxtyping import Bool, UInt8
from PIL import Image

from gscompleter.data.cameras import has_same_aspect
from gscompleter.data.file_names import (
    FolderListings,
    is_photograph_name,
    list_endings,
    list_stems,
)
from gscompleter.data.frame import FOLDERS, MASKS, MAX_NAMED_OWNERS, Frame, assign_masks
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.photograph import StoredPhotograph
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.image import HALF_OPAQUE, read_mask, turn_upright

MASK_FOLDERS = (MASKS, "mask")
"""Names of folders of masks, which lie in the folder of the photographs or beside it."""
MASK_ENDINGS = (".png", ".jpg", ".jpeg")
"""Image file endings of masks."""
FORMS = tuple(product(("{}_mask", "{}.mask", "{}-mask"), MASK_ENDINGS))
"""Forms of the names of masks, {} being that of the photograph without its ending; and endings."""
INVERTED = "dynamic_mask_"
"""Beginning of the names of instant-ngp's masks, in which white is ignored."""


def attach_masks(frames: Sequence[Frame]) -> tuple[Frame, ...]:
    """Attach the mask of each photograph that has one and whose format named none."""
    listings = FolderListings()
    attached = []
    for frame in frames:
        path = None if frame.mask is not None or frame.file is None else frame.file.path
        mask = None if path is None else find_mask(path, frame.name, listings)
        # A frame that stays itself need not look for its photograph again.
        attached.append(frame if mask is None else replace(frame, mask=mask))
    return tuple(attached)


@dataclass(frozen=True)
class GivenPhotograph:
    """A photograph in a folder of new ones, with its mask, which is looked for once."""

    name: str
    """Path below the folder."""
    stored: StoredPhotograph
    path: Path
    mask: Path | None
    """Its mask; None if it has none."""


def find_given(
    folder: Path, names: Sequence[str], reading: MaskReading = MaskReading()
) -> list[GivenPhotograph]:
    """Find photographs of a folder and their masks, where `reading` says that these are."""
    listings = FolderListings()
    paths = [folder / name for name in names]
    masks: list[Path | None]
    if not reading.is_used:
        masks = [None] * len(names)
    elif reading.folder is None:
        masks = [find_mask(path, name, listings) for path, name in zip(paths, names, strict=True)]
    else:
        masks = find_masks_in(reading.folder, names, paths)
    # A folder that is named for masks counts, though it be below the one that is left out.
    if reading.left_out is not None and reading.folder is None:
        masks = [None if mask and lies_in(mask, reading.left_out) else mask for mask in masks]
    return [
        GivenPhotograph(name, StoredPhotograph(path), path, mask)
        for name, path, mask in zip(names, paths, masks, strict=True)
    ]


def lies_in(file: Path, folder: Path) -> bool:
    """Check whether a file lies in a folder or below it, wherever links lead."""
    return folder.resolve() in file.resolve().parents


def find_masks_in(
    folder: Path, names: Sequence[str], photographs: Sequence[Path | None], option: str = "ignore"
) -> list[Path | None]:
    """Find the mask of each photograph in a folder of masks that the user named by an option.

    `photographs` are the files of these `names`, None for one without a file. No photograph is
    taken for a mask, nor is an image beside which its own mask lies. Raises InputError if a mask
    may be of several photographs.
    """
    listings = FolderListings()
    taken = {os.path.realpath(path) for path in photographs if path is not None}

    def find_one(ending: str) -> Path | None:
        named = list_mask_names(PurePosixPath(ending), is_beside=False)
        found = (listings.find(folder, mask) for mask in named)
        masks = (mask for mask in found if mask is not None and os.path.isfile(mask))
        return next((mask for mask in masks if not is_photograph(mask)), None)

    def is_photograph(path: Path) -> bool:
        # Of copies for COLMAP, the photographs themselves may lie here, with their masks.
        beside = list_mask_names(PurePosixPath(path.name))
        has_mask = any(listings.find(path.parent, name) is not None for name in beside)
        return has_mask or os.path.realpath(path) in taken

    return assign_masks(names, photographs, list_inner_endings, find_one, option)


def list_inner_endings(name: str) -> list[str]:
    """List the ends of a name, the longest first, that stay inside of the folder they are in."""
    # Every name is taken for one of another machine, of which no end begins at the root.
    return [end for end in list_endings(f"/{name}") if ".." not in PurePosixPath(end).parts]


def describe_unnamed_masks(
    folder: Path, masks: Collection[Path | None], photographs: Collection[Path | None]
) -> list[str]:
    """Describe images in a folder of masks that are neither `masks` in use nor `photographs`.

    Returns one sentence, or none if there are no such images.
    """
    used = {os.path.realpath(path) for path in (*masks, *photographs) if path is not None}
    # Among photographs, or in a whole scene, most images are meant as something else.
    home = os.path.realpath(folder) + os.sep
    if any(path is not None and os.path.realpath(path).startswith(home) for path in photographs):
        return []
    files = (
        Path(place, name)
        for place, _, names in os.walk(folder)
        for name in names
        if is_photograph_name(name)
    )
    unused = sorted(path for path in files if os.path.realpath(path) not in used)
    if not unused:
        return []
    count = "1 mask" if len(unused) == 1 else f"{len(unused)} masks"
    verb = "is" if len(unused) == 1 else "are"
    shown = join_names([path.relative_to(folder) for path in unused], MAX_NAMED_OWNERS)
    return [
        f"{count} in {quote_value(folder)} {verb} named as no photograph with a camera: {shown}."
    ]


def make_no_mask_error(folder: Path, names: Sequence[str], option: str = "ignore") -> InputError:
    """Make the error for a folder of masks without one of a photograph of these names."""
    example = f", such as {quote_value(PurePosixPath(names[0]).stem)}.png" if names else ""
    return InputError(
        f"{quote_value(folder)} has no mask that is named as a photograph{example}; name the "
        "folder of the masks.",
        option,
    )


def find_mask(photograph: Path, name: str, listings: FolderListings) -> Path | None:
    """Find the mask of a photograph; `name` is its path below the scene or its image folder."""
    # The folder that `name` counts from: as many levels above the photograph as it has parts.
    parts = PurePosixPath(name).parts
    is_plain = not PurePosixPath(name).is_absolute() and ".." not in parts
    is_below = is_plain and photograph.parts[-len(parts) :] == parts
    depth = len(parts) if is_below else 1
    home = photograph.parents[depth - 1]

    relatives = [PurePosixPath(*photograph.parts[-depth:])]
    roots = [home, photograph.parent]
    # A transforms.json calls it "images/x.png" and COLMAP "x.png", and its mask is masks/x.png or
    # masks/images/x.png.
    if depth > 1 and photograph.parts[-depth].casefold() in FOLDERS:
        relatives.append(PurePosixPath(*photograph.parts[1 - depth :]))
    if home.name.casefold() in FOLDERS:
        roots.append(home.parent)
        relatives.append(PurePosixPath(home.name, *photograph.parts[-depth:]))

    # In folders of masks for any of these paths, then beside the photograph.
    folders = [root / folder for root, folder in product(dict.fromkeys(roots), MASK_FOLDERS)]
    names_there = [mask for path in relatives for mask in list_mask_names(path, is_beside=False)]
    places = [(folder, mask) for folder in folders if os.path.isdir(folder) for mask in names_there]
    names_beside = list_mask_names(PurePosixPath(photograph.name))
    places += [(photograph.parent, mask) for mask in names_beside]
    found = (listings.find(folder, mask) for folder, mask in places)
    return next((path for path in found if path is not None and os.path.isfile(path)), None)


def list_mask_names(photograph: PurePosixPath, is_beside: bool = True) -> list[str]:
    """List the names that the mask of a photograph may have, in a folder of masks or beside it.

    Beside it no name is that of the photograph with another ending, which may be a photograph.
    """
    stem, *original = list_stems(str(photograph))
    named = [f"{photograph}.png", *(form.format(stem) + end for form, end in FORMS)]
    if is_beside:
        inverted = photograph.with_name(INVERTED + photograph.stem)
        return [*named, *(f"{inverted}{ending}" for ending in MASK_ENDINGS)]
    same = [f"{path}{ending}" for path in (photograph, stem) for ending in MASK_ENDINGS]
    # The mask of a copy for COLMAP may be named as the photograph was.
    of_copy = [f"{path}{ending}" for path in original for ending in MASK_ENDINGS]
    return [*same, *named, *of_copy]


def leave_out_masks(names: Collection[str]) -> list[str]:
    """Leave out the names of files that are masks of other files of the same folder."""
    masks = {mask.casefold() for name in names for mask in list_mask_names(PurePosixPath(name))}
    return [name for name in names if name.casefold() not in masks]


def hides_white(path: Path, is_inverted: bool) -> bool:
    """Return True if white pixels of a mask are ignored: by its name, or because it is inverted.

    Of a mask with such a name that is inverted, too, black pixels are ignored.
    """
    return path.name.casefold().startswith(INVERTED) != is_inverted


def read_ignored(path: Path, is_inverted: bool = False) -> Bool[np.ndarray, "h w"]:
    """Read the pixels of a mask that are ignored in its photograph, as `hides_white` tells."""
    black = read_mask(path)
    return ~black if hides_white(path, is_inverted) else black


def load_mask(
    path: Path,
    size: tuple[int, int],
    photograph: str,
    orientation: int = 1,
    is_inverted: bool = False,
) -> Bool[np.ndarray, "h w"]:
    """Read the ignored pixels of a mask at the `size` (width, height) of its upright photograph.

    A mask of another size is scaled if its aspect ratio is the same. `orientation` is how EXIF
    turned the photograph: a mask of the stored pixels is turned likewise, which its aspect ratio
    tells. Where turning does not change that, as half a turn, a mask counts as upright. Any other
    mask raises an InputError, in which `photograph` names its photograph. An inverted mask is white
    where pixels are ignored.
    """
    ignored = read_ignored(path, is_inverted)
    is_stored = not has_same_aspect((ignored.shape[1], ignored.shape[0]), size)
    if is_stored and orientation != 1:
        ignored = turn_upright(ignored, orientation)
    height, width = ignored.shape
    if not has_same_aspect((width, height), size):
        raise InputError(
            f"The mask {quote_value(path)} has {width} × {height} pixels, and {photograph} has "
            f"{size[0]} × {size[1]}, which is another aspect ratio; export the mask again in the "
            "size of the photograph."
        )
    scaled = Image.fromarray(ignored).resize(size, Image.Resampling.NEAREST)
    return np.array(scaled, dtype=bool)


def find_masked(
    frame: Frame, alpha: UInt8[np.ndarray, "h w"] | None, size: tuple[int, int], orientation: int
) -> Bool[np.ndarray, "h w"] | None:
    """Find the pixels of an upright photograph that its mask or its alpha hides; None if none.

    `alpha` is upright, `size` is (width, height), and `orientation` is that of `load_mask`.
    """
    masks = []
    if frame.mask is not None:
        masks.append(load_mask(frame.mask, size, frame.title, orientation, frame.has_inverted_mask))
    if alpha is not None:
        masks.append(alpha < HALF_OPAQUE)
    hidden = np.logical_or.reduce(masks) if masks else None
    return None if hidden is None or not hidden.any() else hidden


def fill_hidden(
    pixels: UInt8[np.ndarray, "h w 3"], hidden: Bool[np.ndarray, "h w"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Replace hidden pixels by the nearest visible ones, so that resampling mixes in none of them.

    Where all are hidden, pixels stay as they are.
    """
    if hidden.all():
        return pixels
    _, labels = cv2.distanceTransformWithLabels(
        hidden.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    # A visible pixel and the hidden ones that it is nearest to have the same label.
    rows, columns = np.nonzero(~hidden)
    number = np.zeros(labels.max() + 1, dtype=np.int64)
    number[labels[rows, columns]] = np.arange(len(rows))
    nearest = number[labels]
    filled: UInt8[np.ndarray, "h w 3"] = pixels[rows[nearest], columns[nearest]]
    return filled
