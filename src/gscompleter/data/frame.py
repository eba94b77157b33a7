"""One camera of a scene, and the search for its photograph and mask."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path, PurePosixPath

import numpy as np
from jaxtyping import Bool, Float, UInt8

from gscompleter.data.cameras import (
    FRACTIONS,
    Intrinsics,
    Pinhole,
    find_distortion_defect,
    find_pinhole_defect,
    find_pose_defect,
    make_rigid,
    undistort_pinhole,
)
from gscompleter.data.file_names import FolderListings, list_endings
from gscompleter.data.photograph import Photograph, StoredPhotograph
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.image import QUARTER_TURNS, turn_upright
from gscompleter.types import MAX_IMAGE_SIDE

TRIED_ENDINGS = ("", ".png", ".jpg", ".jpeg")
"""Image file endings tried for names without one."""

DOWNSCALE_FACTORS = (2, 4, 8)
"""Downscaling factors of folders such as `images_4`."""
ORIGINALS = "input"
"""Folder of photographs before undistortion, as in the scripts of 3DGS."""
FOLDERS = ("images", *(f"images_{n}" for n in DOWNSCALE_FACTORS), ORIGINALS)
"""Usual folders of photographs, in search order."""
DISTORTED = "distorted"
"""Folder of the model with distortion, beside undistorted photographs (3DGS's scripts)."""
MASKS = "masks"
"""Folder of masks, in the folder of the photographs or beside it."""
MAX_MISSING_PHOTOGRAPHS = 3
"""Missing photographs that a note names."""
MAX_NAMED_OWNERS = 3
"""Most photographs, or masks without one, that a sentence names."""


@dataclass(frozen=True, eq=False)
class Frame:
    """One camera of a scene; its photograph is read on demand."""

    name: str
    """Path of the photograph as its file of cameras writes it: below a folder of photographs, or as
    of another machine until `locate_images` finds it; it may lack its ending, or be empty."""
    title: str
    """Name in error messages, such as "frame 3 of room.json"."""
    c2w: Float[np.ndarray, "4 4"]
    """Camera-to-world in OpenCV axes, float64, as stored in the file (see `find_defect`)."""
    intrinsics: Intrinsics
    image: Path | Photograph | None
    """Expected path of the photograph, or the photograph itself if it has no file of its own."""
    depth: Callable[[], Float[np.ndarray, "h w"]] | None = None
    """Reads a depth map of any size: z-depth in scene units, 0 where unknown."""
    predicted_depth: Callable[[], Float[np.ndarray, "h w"]] | None = None
    """Reads a depth map that a network predicted, in scene units as far as its file tells."""
    mask: Path | None = None
    """Mask image; its black pixels are ignored (`data/masks.py`)."""
    has_inverted_mask: bool = False
    """True if white pixels of the mask are ignored."""
    sensor: str | None = None
    """Name of the vehicle's camera, or None for a single camera."""
    laser_points: Callable[[], Float[np.ndarray, "n 3"]] | None = None
    """Reads laser points of about that time, in the frame of the poses."""
    seen_points: Callable[[], Float[np.ndarray, "n 3"]] | None = None
    """Reads the triangulated points that the photograph shows, in the frame of the poses."""
    boxes: Callable[[], Float[np.ndarray, "n 8 3"]] | None = None
    """Reads the corners of moving objects' boxes at about that time, in the frame of the poses."""
    vehicle: Callable[[], Bool[np.ndarray, "h w"] | None] | None = None
    """Detects the vehicle that carries the camera, as a mask of any size; None to keep it."""
    written: str | None = None
    """Path of the photograph in the file, if only an end of it exists here; else None."""
    lack: str | None = None
    """Why it has no camera, as in "COLMAP found no camera for it"; None if it has one."""

    @property
    def file_name(self) -> str:
        """Path of the photograph below the folder of photographs, as users know it."""
        path = PurePosixPath(self.name.replace("\\", "/"))
        # Trainers list photographs without the ending that the file has.
        if path.name and isinstance(self.image, Path) and self.image.stem == path.name:
            path = path.with_name(self.image.name)
        # "images" in front of a name is the folder of photographs, which users do not name.
        inside = len(path.parts) > 1 and path.parts[0].casefold() in FOLDERS
        return str(PurePosixPath(*path.parts[1:]) if inside else path)

    @cached_property
    def photograph(self) -> Photograph | None:
        """The photograph, or None if there is none; it is looked for once."""
        if not isinstance(self.image, Path):
            return self.image
        path = find_image(self.image)
        return None if path is None else StoredPhotograph(path)

    @property
    def file(self) -> StoredPhotograph | None:
        """The photograph if it is a file of its own, or None."""
        photograph = self.photograph
        if isinstance(photograph, StoredPhotograph) and photograph.path is not None:
            return photograph
        return None

    def has_photograph(self) -> bool:
        """Check whether the photograph exists, without opening container files."""
        return self.photograph is not None

    def size(self) -> tuple[int, int]:
        """Return width and height of the upright photograph, or else those of the camera file.

        The camera file decides for a photograph inside a container, which is opened only if that
        file gives no size. Raise InputError if there is neither a photograph nor a size.
        """
        stated = None if self.intrinsics.size == FRACTIONS else self.intrinsics.size
        # Without a file of its own, the photograph is missing or inside a container.
        if stated is not None and self.file is None:
            return stated
        if self.photograph is not None:
            width, height = self.photograph.measure()
            return (height, width) if self.find_turn() != 1 else (width, height)
        raise InputError(
            f"The size of {self.title} is not known, because it has no image and no `w` and `h`; "
            "add these, or its image."
        )

    def require_photograph(self) -> Photograph:
        """Return the photograph, or raise an InputError if there is none."""
        if self.photograph is None:
            place = "restore it" if self.image is None else f"put it at {quote_value(self.image)}"
            raise InputError(
                f"The image of {self.title} is missing; {place}, or choose another frame."
            )
        return self.photograph

    def find_turn(self) -> int:
        """Return the EXIF orientation by which stored pixels have to be turned, or 1.

        Cameras usually belong to the pixels as they are stored, whatever EXIF says. Only where the
        camera's width and height are those of the turned photograph is it turned.
        """
        if self.photograph is None:
            return 1
        if not self.intrinsics.is_transposed(*self.photograph.measure()):
            return 1
        orientation = self.photograph.read_orientation()
        return orientation if orientation in QUARTER_TURNS else 1

    def load_pixels(
        self,
    ) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"] | None, int]:
        """Read the upright photograph: its colours, its alpha or None, and how it was turned.

        The last is the EXIF orientation that was applied; 1 for the pixels as they are stored.
        """
        colors, alpha = self.require_photograph().read_pixels()
        orientation = self.find_turn()
        colors = turn_upright(colors, orientation)
        alpha = None if alpha is None else turn_upright(alpha, orientation)
        return colors, alpha, orientation

    def find_defect(self, width: int, height: int) -> str | None:
        """Describe why the camera is impossible at this photograph size; None if it is valid."""
        if self.lack is not None:
            return self.lack
        if max(width, height) > MAX_IMAGE_SIDE:
            return f"its {width} × {height} pixels have a side above {MAX_IMAGE_SIDE}"
        if not self.intrinsics.fits(width, height):
            w, h = self.intrinsics.size or (width, height)
            return (
                f"its image has {width} × {height} pixels, and its camera {w} × {h}, which is "
                "another aspect ratio"
            )
        pinhole = self.intrinsics.compute_pinhole(width, height)
        return (
            find_pose_defect(self.c2w)
            or find_pinhole_defect(pinhole)
            or find_distortion_defect(pinhole, self.intrinsics.distortion)
        )

    def compute_pinholes(self, width: int, height: int) -> tuple[Pinhole, Pinhole]:
        """Return the intrinsics at this photograph size, before and after undistortion."""
        defect = self.find_defect(width, height)
        if defect is not None:
            raise self.make_error(defect)
        pinhole = self.intrinsics.compute_pinhole(width, height)
        new = undistort_pinhole(pinhole, self.intrinsics.distortion)
        assert new is not None
        return pinhole, new

    def with_rigid_pose(self, place: str = "") -> Frame:
        """Return the frame with an exactly rigid pose; `place` in the file is for errors.

        A pose that holds NaN stays, because one such camera need not cost the others.
        """
        if not self.has_finite_pose:
            return self
        defect = find_pose_defect(self.c2w)
        if defect is not None:
            raise self.make_error(f"{defect}{place}")
        return replace(self, c2w=make_rigid(self.c2w))

    @property
    def has_finite_pose(self) -> bool:
        """True if no number of the pose is NaN or infinite."""
        return bool(np.isfinite(self.c2w).all())

    @property
    def has_camera(self) -> bool:
        """True if its camera was found, and its pose is finite."""
        return self.lack is None and self.has_finite_pose

    def make_error(self, defect: str) -> InputError:
        """Build the error for a frame with this defect."""
        advice = "correct it, or leave the frame out" if self.lack is None else "name another one"
        return InputError(f"{capitalize(self.title)} cannot be used, because {defect}; {advice}.")


def find_image(path: Path, listings: FolderListings | None = None) -> Path | None:
    """Find the image file at `path`, which may lack its ending; None if there is none.

    If folder `images` lacks it, the largest copy in `images_2`, `images_4` or `images_8` is used,
    as nerfstudio writes and DL3DV publishes them. With `listings`, the names of the file and of its
    folder on the disk may differ from `path` in case.
    """
    folders = [path.parent]
    if path.parent.name == "images":
        folders += [path.parent.with_name(f"images_{n}") for n in DOWNSCALE_FACTORS]
    candidates = (folder / (path.name + ending) for folder in folders for ending in TRIED_ENDINGS)
    # The name as written comes first, because most folders need no listing.
    exact = next((candidate for candidate in candidates if os.path.isfile(candidate)), None)
    if exact is not None or listings is None:
        return exact
    # A camera that the file calls DSC_1.jpg may have its photograph under DSC_1.JPG, or in Images.
    beside = find_file([path.parent], [path.name + ending for ending in TRIED_ENDINGS], listings)
    if beside is not None:
        return beside
    home = f"{path.parent.name}/{path.name}"
    return find_file([path.parent.parent], [home + ending for ending in TRIED_ENDINGS], listings)


def capitalize(text: str) -> str:
    """Capitalize the first letter."""
    return text[:1].upper() + text[1:]


def find_path(folder: Path, relative: str) -> Path | None:
    """Find `relative` below `folder`, ignoring case; None if it does not exist."""
    return FolderListings().find(folder, relative)


def list_image_folders(roots: Sequence[Path]) -> list[Path]:
    """List the folders that may hold the photographs: those in the roots, then the roots."""
    # Beside a model with distortion, `images` may hold undistorted photographs.
    has_lens = any(root.name.casefold() == DISTORTED for root in roots)
    order = (ORIGINALS, *FOLDERS) if has_lens else FOLDERS
    listings = FolderListings()
    folders = [listings.find(root, name) for root in roots for name in order]
    return [folder for folder in folders if folder is not None and folder.is_dir()] + [*roots]


def locate_images(frames: Sequence[Frame], roots: Sequence[Path]) -> list[Frame]:
    """Return the frames with the paths of their photographs and masks, if they exist.

    Only a mask that is named as the photograph is written is found here; `attach_masks` looks for
    the others. Raise InputError if a mask may be of several photographs.
    """
    folders = list_image_folders(roots)
    listings = FolderListings()
    located = []
    for frame in frames:
        # A name may be a path of another machine, of which the longest end that exists is meant,
        # in whichever folder; and it may lack its ending.
        ends = dict.fromkeys([frame.name, *list_endings(frame.name)])
        images = (
            find_file(folders, [end + ending for ending in TRIED_ENDINGS], listings) for end in ends
        )
        located.append(replace(frame, image=next(filter(None, images), None)))

    found_masks = [listings.find(root, MASKS) for root in roots]
    mask_folders = [folder for folder in found_masks if folder is not None]

    def find_mask_of(end: str) -> Path | None:
        names = [f"{name}.png" for name in (end, os.path.splitext(end)[0])]
        return find_file(mask_folders, names, listings)

    # Frames still have their written names: a folder of masks may keep more folders of these than
    # the photographs lie in.
    found = {n: frame.image for n, frame in enumerate(located) if isinstance(frame.image, Path)}
    written = [located[number].name for number in found]
    masks = assign_masks(written, list(found.values()), list_endings, find_mask_of)
    for number, mask in zip(found, masks, strict=True):
        located[number] = _rename_moved(replace(located[number], mask=mask), folders)
    return located


def assign_masks(
    names: Sequence[str],
    photographs: Sequence[Path | None],
    list_ends: Callable[[str], list[str]],
    find: Callable[[str], Path | None],
    option: str | None = None,
) -> list[Path | None]:
    """Assign to each photograph the mask that is named as it, or as an end of its name.

    Args:
        names: Paths of the photographs, as written.
        photographs: Their files; None for one that is not there.
        list_ends: Lists the ends of a name, the longest first.
        find: Finds the mask that is named as an end; None if there is none.
        option: Option that names the masks, for the error.

    Raises:
        InputError: A mask may be of several photographs.
    """
    # By mask: how many folders of the name it lacks, and the number of the photograph.
    claims: dict[Path, list[tuple[int, int]]] = {}
    for number, name in enumerate(names):
        for lacking, end in enumerate(list_ends(name)):
            mask = find(end)
            if mask is not None:
                claims.setdefault(mask, []).append((lacking, number))
                break

    masks: list[Path | None] = [None] * len(names)
    for mask, claimed in claims.items():
        # 1.png is of 1.jpg rather than of a/1.jpg.
        least = min(claimed)[0]
        owners = [number for lacking, number in claimed if lacking == least]
        # The frames of a file may name a photograph twice.
        if len({photographs[number] or names[number] for number in owners}) > 1:
            several = join_names([names[number] for number in owners], MAX_NAMED_OWNERS)
            raise InputError(
                f"{quote_value(mask)} may be the mask of several photographs ({several}); put "
                "masks into folders as the photographs are in.",
                option,
            )
        for number in owners:
            masks[number] = mask
    return masks


def _rename_moved(frame: Frame, folders: Sequence[Path]) -> Frame:
    """Name a frame by the photograph that was found, if its name is a path of another machine."""
    image = frame.image
    is_foreign = list_endings(frame.name) != [frame.name]
    if not is_foreign or not isinstance(image, Path):
        return frame
    # A path of this machine, which may lack the ending, leads to the photograph as it is.
    if image in [Path(frame.name + ending) for ending in TRIED_ENDINGS]:
        return frame
    home = next(folder for folder in folders if folder in image.parents)
    return replace(frame, name=image.relative_to(home).as_posix(), written=frame.name)


def find_file(
    folders: Sequence[Path], names: Sequence[str], listings: FolderListings | None = None
) -> Path | None:
    """Find the first of the files in the first of the folders; None if there is none."""
    listings = listings or FolderListings()
    found = (listings.find(folder, name) for folder in folders for name in names)
    return next((path for path in found if path is not None and os.path.isfile(path)), None)


def keep_existing(frames: Sequence[Frame], title: str) -> tuple[tuple[Frame, ...], tuple[str, ...]]:
    """Keep the frames whose photograph `locate_images` found, sorted, and note the missing ones."""
    there = sorted((frame for frame in frames if frame.image), key=lambda frame: frame.name)
    missing = sorted(frame.name for frame in frames if not frame.image)
    if not there:
        example = f" under names such as {quote_value(missing[0])}" if missing else ""
        raise InputError(
            f"None of the {len(frames)} photographs of {title} is there; put them into a folder "
            f"`{FOLDERS[0]}` beside it{example}."
        )
    if not missing:
        return tuple(there), ()
    note = (
        f"{len(missing)} of {len(frames)} photographs of {title} are missing and left out: "
        f"{join_names(missing, MAX_MISSING_PHOTOGRAPHS)}."
    )
    return tuple(there), (note,)


def describe_unposed(frames: Sequence[Frame], title: str) -> tuple[str, ...]:
    """Say which cameras have a pose of NaN or infinity; raise InputError if all of them have.

    Their photographs stay among the frames, so that the number of each is that of its file. Those
    that `lack` a camera are told where they are used.
    """
    lost = [frame.name for frame in frames if frame.lack is None and not frame.has_finite_pose]
    if len(lost) == len(frames):
        raise InputError(
            f"The poses of all {len(frames)} cameras of {title} hold NaN or infinity "
            f"({join_names(lost, MAX_MISSING_PHOTOGRAPHS)}); export the scene again."
        )
    if not lost:
        return ()
    return (
        f"{len(lost)} of {len(frames)} cameras of {title} are not used, because their poses hold "
        f"NaN or infinity: {join_names(lost, MAX_MISSING_PHOTOGRAPHS)}; "
        "the others keep their numbers.",
    )


def describe_moved(frames: Sequence[Frame], title: str) -> tuple[str, ...]:
    """Say in one sentence which photographs were found by the ends of their written paths."""
    moved = [frame for frame in frames if frame.written is not None]
    if not moved:
        return ()
    return (
        f"{len(moved)} of {len(frames)} paths in {title} are of Windows or another machine, such "
        f"as {quote_value(moved[0].written)}; the longest ends of them that exist are read, such "
        f"as {quote_value(moved[0].name)}.",
    )
