"""Cameras for new photographs of a scene whose other photographs have theirs, by COLMAP.

The known cameras stay as they are, so that a splat that was trained with them stays in its frame.
Any format of scene will do, since COLMAP is given copies of its photographs without distortion. The
output folder has COLMAP's standard layout, with the new photographs alone: copies in `images` and
their cameras in `sparse/0`, in the coordinates of the scene.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.colmap import open_colmap
from gscompleter.data.frame import FOLDERS, MASKS, Frame
from gscompleter.data.mask_checks import check_hiding_masks
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.masks import GivenPhotograph, find_given
from gscompleter.data.photograph import StoredPhotograph
from gscompleter.data.photographs import Photographs, build_photographs
from gscompleter.data.sfm.poses import (
    COPIES_FOLDER,
    MAX_COPY_SIDE,
    POSES_COMMAND,
    POSES_FILES,
    identify_files,
    list_all_photographs,
    read_earlier,
    require_pycolmap,
    run_colmap,
)
from gscompleter.numerics.geometry import select_spread_cameras
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.image import convert_to_pixels
from gscompleter.system.files.names import make_colmap_name
from gscompleter.system.files.output_folder import reserve_output
from gscompleter.system.files.result_names import SUMMARY_FILE
from gscompleter.system.progress import track
from gscompleter.types import Camera, View

MAX_KNOWN = 200
"""Most photographs with known cameras that new ones are compared with; of more, those far apart."""
MIN_PLACING_MATCHES = 30
"""Features that COLMAP needs in common with the points of the scene."""
MAX_UNPLACED_PHOTOGRAPHS = 5
"""Most photographs that a sentence names."""
KNOWN_FOLDER = "known"
"""Folder of the copies with known cameras, among those that COLMAP reads."""
NEW_FOLDER = "new"
"""Folder of the copies of new photographs, among those that COLMAP reads."""
DEFAULT_HOME = "new"
"""First part of the names of new photographs whose folder has a usual name."""
PLACING_PROCESS = "gscompleter.data.sfm.placing_process"

LensKey = tuple[int, int, str]
"""Width and height of upright photographs, and the key of camera, lens and zoom from EXIF."""
PinholeNumbers = tuple[float, float, float, float]
"""Focal lengths and principal point in pixels: fx, fy, cx, cy."""


@dataclass(frozen=True)
class KnownCopy:
    """A copy of a photograph with a known camera."""

    name: str
    """File, relative to the folder that COLMAP reads."""
    width: int
    height: int
    pinhole: PinholeNumbers
    viewmat: list[list[float]]
    """World to camera, as the rows of a 3 × 4 matrix."""
    is_masked: bool
    """True if a mask for it lies in the folder of masks."""


@dataclass(frozen=True)
class NewCopy:
    """A copy of a photograph whose camera is searched for."""

    name: str
    """File, relative to the folder that COLMAP reads."""
    width: int
    height: int
    lens: str
    """Key of camera, lens and zoom from EXIF."""
    focal: float | None
    """Focal length in pixels from EXIF, or None."""
    pinhole: PinholeNumbers | None
    """Intrinsics of the undistorted copy, if a known photograph was taken by the same lens."""
    is_masked: bool
    """As for `KnownCopy`."""


@dataclass(frozen=True)
class Placed:
    """Result of the search for the cameras of new photographs."""

    total: int
    """Number of new photographs."""
    failures: dict[str, str]
    """Reason why a photograph could not be placed, by its file."""
    skipped: int = 0
    """Photographs that have cameras in the scene already."""
    reused: bool = False
    """True if the result is from an earlier run."""

    @property
    def notes(self) -> list[str]:
        """Sentences for the user."""
        count = self.total - len(self.failures)
        notes = [f"{count} of {self.total} new photographs were placed among those of the scene."]
        if self.failures:
            notes.append(self.describe_failures())
        if self.skipped:
            notes.append(f"{self.skipped} of the photographs have cameras in SCENE already.")
        return notes

    def describe_failures(self) -> str:
        """Describe in a sentence which photographs were not placed, and why."""
        listed = list(self.failures.items())[:MAX_UNPLACED_PHOTOGRAPHS]
        reasons = "; ".join(f"{quote_value(name)} ({reason})" for name, reason in listed)
        more = len(self.failures) - len(listed)
        rest = f"; and {more} more" if more else ""
        return f"Not placed, and left out: {reasons}{rest}."


def place_photographs(
    folder: Path,
    photographs: Photographs,
    out: Path,
    overwrite: bool = False,
    reading: MaskReading = MaskReading(),
) -> tuple[Photographs, Placed]:
    """Find the cameras of new photographs, and add them to those of a scene.

    The result is written to `out`, from which a later run with the same photographs takes it.
    `reading` is how masks of the new photographs are read. Raises InputError if none can be placed,
    or if these masks hide most of them.
    """
    found = list_all_photographs(folder) if os.path.isdir(folder) else []
    files = [frame.file.path for frame in photographs.frames if frame.file is not None]
    known = {path.resolve() for path in files if path is not None}
    names = [name for name in found if (folder / name).resolve() not in known]
    if not found:
        raise InputError(f"There are no photographs in {quote_value(folder)}.", "photos")
    if not names:
        raise InputError(
            f"All {len(found)} photographs in {quote_value(folder)} have cameras in SCENE already; "
            "leave it out.",
            "photos",
        )

    new = find_given(folder, names, reading)
    masks = [given.mask for given in new if given.mask is not None]
    check_hiding_masks(masks, reading, len(new))
    identity = identify_input(new, photographs)
    if reading.ignores_white:
        identity["inverted masks"] = True
    # An alpha channel is no file of its own, by which its use could be told.
    if not reading.is_used:
        identity["unused masks"] = True
    earlier = read_earlier(out, "placed", identity)
    if earlier is not None:
        placed = replace(Placed(**earlier), reused=True)
    else:
        require_pycolmap()
        with (
            reserve_output(out, overwrite, POSES_COMMAND, POSES_FILES) as output,
            output.write() as draft,
        ):
            placed = place_copies(folder, new, photographs, draft, reading)
            content = {"placed": asdict(placed), "photographs": identity}
            (draft / SUMMARY_FILE).write_bytes(json.dumps(content, indent=1).encode())
    placed = replace(placed, skipped=len(found) - len(new))
    (opened,) = open_colmap(out)
    added = [name_new(frame, folder) for frame in opened.frames]
    return replace(photographs, frames=(*photographs.frames, *added)), placed


def name_new(frame: Frame, folder: Path) -> Frame:
    """Name a new photograph by its folder, too, since phones count from IMG_0001 again and again.

    A folder of the usual names, which lines leave out, would not tell it from those of the scene.
    """
    home = folder.resolve().name
    home = DEFAULT_HOME if home.casefold() in (*FOLDERS, "") else home
    return replace(frame, name=f"{home}/{frame.name}")


def identify_input(new: Sequence[GivenPhotograph], photographs: Photographs) -> dict[str, Any]:
    """Identify new photographs as files, and the known cameras by a hash."""
    digest = hashlib.sha256()
    for frame in photographs.frames:
        digest.update(frame.name.encode(errors="surrogateescape"))
        digest.update(frame.c2w.tobytes())
    return {
        "new": identify_files(new),
        "known": digest.hexdigest(),
    }


def place_copies(
    folder: Path,
    given: Sequence[GivenPhotograph],
    photographs: Photographs,
    draft: Path,
    reading: MaskReading,
) -> Placed:
    """Write `images` and `sparse/0` of the photographs that can be placed into `draft`."""
    # In the draft, so that copies are moved within one file system.
    with tempfile.TemporaryDirectory(dir=draft) as work:
        home = Path(work)
        known, sources = write_known_copies(photographs, home)
        new = write_new_copies(given, photographs, home, reading)
        job = {
            "images": str(home / COPIES_FOLDER),
            "masks": str(home / MASKS),
            "model": str(draft / "sparse" / "0"),
            "known": [asdict(copy) for copy in known],
            "new": [asdict(copy) for copy in new],
            "origin": photographs.origin.tolist(),
        }
        result = run_colmap(PLACING_PROCESS, job, home, "Placing photographs")
        failures = {
            photograph.name: explain_unplaced(row, sources)
            for photograph, row in zip(given, result["new"], strict=True)
            if not row["is_placed"]
        }
        placed = Placed(len(given), failures)
        if len(failures) == len(given):
            raise InputError(
                f"No photograph in {quote_value(folder)} could be placed among those of SCENE. "
                + placed.describe_failures(),
                "photos",
            )
        for copy, row in zip(new, result["new"], strict=True):
            if row["is_placed"]:
                keep_copy(home, draft, copy)
    return placed


def explain_unplaced(row: Mapping[str, Any], sources: Mapping[str, str]) -> str:
    """Explain in a clause why a photograph could not be placed."""
    matches = row["matches"]
    if matches == 0:
        return "it shares no features with a photograph of SCENE"
    like = quote_value(sources[row["like"]])
    if matches < MIN_PLACING_MATCHES:
        return f"{matches} features in common with {like}, and {MIN_PLACING_MATCHES} are needed"
    return f"{matches} features in common with {like} fit no single camera"


def write_known_copies(
    photographs: Photographs, home: Path
) -> tuple[list[KnownCopy], dict[str, str]]:
    """Write undistorted copies of photographs with known cameras; return their files by copy.

    Damaged photographs are left out.

    Raises:
        InputError: All of them are damaged.
    """
    frames = choose_known(photographs)
    copies = []
    sources = {}
    damages = []
    for number in track(frames, "Reading photographs"):
        try:
            (view,) = photographs.views([number], MAX_COPY_SIDE)
        except InputError as error:
            damages.append(error)
            continue
        name = f"{KNOWN_FOLDER}/{number:05d}.png"
        is_masked = write_view(view, home, name)
        camera = view.camera
        viewmat = np.linalg.inv(camera.c2w.double().numpy())[:3]
        copies.append(
            KnownCopy(
                name=name,
                width=camera.width,
                height=camera.height,
                pinhole=get_pinhole_numbers(camera),
                viewmat=viewmat.tolist(),
                is_masked=is_masked,
            )
        )
        sources[name] = photographs.frame(number).file_name
    if damages and not copies:
        raise damages[0]
    return copies, sources


def choose_known(photographs: Photographs) -> list[int]:
    """Choose photographs to compare with: those that exist, of very many some far apart."""
    frames = [number for number in photographs.present if not photographs.is_hidden(number)]
    if len(frames) <= MAX_KNOWN:
        return frames
    cameras = {}
    for number in frames:
        # The camera of a damaged photograph has no size.
        with suppress(InputError):
            cameras[number] = photographs.camera(number, MAX_COPY_SIDE)
    if not cameras:
        return frames[:1]  # whose damage is named when it is read
    usable = list(cameras)
    chosen = select_spread_cameras(list(cameras.values()), MAX_KNOWN)
    return sorted(usable[index] for index in chosen)


def write_view(view: View, home: Path, name: str) -> bool:
    """Write the photograph of a view, and its mask; return False if it needs none."""
    save_pixels(home / COPIES_FOLDER / name, convert_to_pixels(view.image))
    if view.ignore_mask is None or not bool(view.ignore_mask.any()):
        return False
    # COLMAP's masks are black where no features are wanted, and named after the whole file.
    save_pixels(home / MASKS / f"{name}.png", convert_to_pixels(~view.ignore_mask))
    return True


def save_pixels(path: Path, pixels: np.ndarray) -> None:
    """Save a copy that COLMAP reads, as a PNG."""
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(pixels).save(path, compress_level=1)


def get_pinhole_numbers(camera: Camera) -> PinholeNumbers:
    """Return the intrinsics of a camera."""
    K = camera.K.tolist()
    return K[0][0], K[1][1], K[0][2], K[1][2]


def write_new_copies(
    given: Sequence[GivenPhotograph], photographs: Photographs, home: Path, reading: MaskReading
) -> list[NewCopy]:
    """Write copies of new photographs, undistorted if their lens is a known one."""
    lenses = collect_lenses(photographs)
    return [
        write_new_copy(photograph, lenses, home, reading)
        for photograph in track(given, "Reading new photographs")
    ]


def collect_lenses(photographs: Photographs) -> dict[LensKey, Intrinsics]:
    """Collect the intrinsics of the known photographs by size and lens."""
    lenses: dict[LensKey, Intrinsics] = {}
    for frame in photographs.frames:
        file = frame.file
        # The camera of a photograph belongs to the pixels as they are stored, unless it is turned.
        if file is not None and frame.find_turn() == 1 and file.orientation == 1:
            lenses.setdefault(get_lens_key(file), frame.intrinsics)
    return lenses


def get_lens_key(photograph: StoredPhotograph) -> LensKey:
    """Get the size of an upright photograph, and the key of its camera, lens and zoom."""
    return *photograph.upright_size, photograph.optics.lens


def write_new_copy(
    given: GivenPhotograph, lenses: Mapping[LensKey, Intrinsics], home: Path, reading: MaskReading
) -> NewCopy:
    """Write the copy of a new photograph, which is undistorted if its lens is known."""
    title = f"the photograph {quote_value(given.path)}"
    known = lenses.get(get_lens_key(given.stored))
    # Without a known lens the intrinsics are not used, but for the size that makes it upright.
    width, height = given.stored.upright_size
    guess = Intrinsics((width, height), (float(width), float(width)))
    frame = Frame(
        given.name,
        title,
        np.eye(4),
        known or guess,
        given.stored,
        mask=given.mask,
        has_inverted_mask=reading.ignores_white,
    )
    shown = build_photographs(given.name, title, [frame])
    if not reading.is_used:
        shown = shown.leave_out_masks()
    (view,) = shown.views([0], MAX_COPY_SIDE)

    # Two photographs may differ in their endings alone; then the second copy has both endings.
    plain = make_colmap_name(given.name)
    copy = f"{NEW_FOLDER}/{Path(plain).with_suffix('.png').as_posix()}"
    if (home / COPIES_FOLDER / copy).exists():
        copy = f"{NEW_FOLDER}/{plain}.png"
    if (home / COPIES_FOLDER / copy).exists():
        raise InputError(f"Two photographs would be called {quote_value(copy)}; rename one.")
    is_masked = write_view(view, home, copy)
    camera = view.camera
    lens, focal = given.stored.optics
    # From image diagonals to pixels of the copy.
    focal = None if focal is None else focal * math.hypot(camera.width, camera.height)
    pinhole = None if known is None else get_pinhole_numbers(camera)
    return NewCopy(copy, camera.width, camera.height, lens, focal, pinhole, is_masked)


def keep_copy(home: Path, draft: Path, copy: NewCopy) -> None:
    """Move the copy of a placed photograph, and its mask, to their place in `draft`."""
    name = copy.name.removeprefix(f"{NEW_FOLDER}/")
    moves = [(home / COPIES_FOLDER / copy.name, draft / COPIES_FOLDER / name)]
    if copy.is_masked:
        moves.append((home / MASKS / f"{copy.name}.png", draft / MASKS / f"{name}.png"))
    for source, target in moves:
        target.parent.mkdir(parents=True, exist_ok=True)
        os.replace(source, target)
