"""Posed photographs, independent of their format.

A format (one module each, listed in `formats.py`) reads cameras and locates images. This module
reads images on demand, leaves out what masks hide, removes lens distortion, and resizes image and
intrinsics together.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Shaped, UInt8
from PIL import Image
from torch import Tensor

from gscompleter.data.cameras import compute_fov, compute_undistortion_map, find_pose_defect, remap
from gscompleter.data.file_names import list_stems
from gscompleter.data.frame import Frame
from gscompleter.data.ignored_regions import IgnoredRegions
from gscompleter.data.local_origin import choose_local_origin, is_near
from gscompleter.data.masks import (
    describe_unnamed_masks,
    fill_hidden,
    find_masked,
    find_masks_in,
    lies_in,
    make_no_mask_error,
)
from gscompleter.data.moving_boxes import mask_moving
from gscompleter.numerics.geometry import compute_sparse_depth
from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.image import composite_over_black, convert_to_image
from gscompleter.system.files.names import fold_name, make_colmap_name
from gscompleter.types import MAX_IMAGE_SIDE, Camera, View


@dataclass(frozen=True)
class AuthorsCrop:
    """Central crop as the data loaders of pixelSplat, MVSplat, DepthSplat and VolSplat make it.

    Unlike an exact crop it keeps the principal point as a fraction of the image. That is half a
    pixel off where an odd number of rows or columns goes (455 to 256 columns), and more where the
    principal point is not central. Their networks were trained on such cameras.
    """

    height: int
    width: int
    is_resized: bool
    """True to resize the image to cover the crop first, False to cut the crop out as it is."""


Resolution = tuple[int, int] | int | AuthorsCrop | None
"""Target size of images.

Height and width in pixels: resize to cover, then crop the centre. One number: shrink to at most
this longer side. None: keep the size.
"""

MAX_FOV = 100.0
"""Largest field of view that benchmarks keep, in degrees."""
MAX_TRANSLATION = 1e3
"""Largest camera coordinate that benchmarks keep, in scene units from the origin."""

MAX_NAMED_PATHS = 2
"""Most folders of masks, or photographs, that a sentence names."""
MAX_MAP_COORDINATE = 100.0
"""Largest vehicle coordinate without a local origin, in metres."""


@dataclass(frozen=True, eq=False)
class Photographs:
    """A named sequence of photographs with known cameras, numbered from 0."""

    name: str
    title: str
    """Name in error messages."""
    frames: tuple[Frame, ...]
    origin: Float[np.ndarray, "3"]
    """Origin of the cameras' coordinates, in those of the files (float64)."""
    near: float | None = None
    far: float | None = None
    """Range of the scene's z-depths, in scene units."""
    notes: tuple[str, ...] = ()
    """Sentences about choices made while opening."""
    unused: tuple[str, ...] = ()
    """Phrases on depth, poses and photographs that lie there and are not used."""
    format: str | None = None
    """Name of the format in `formats.py`; None for photographs that came in none of them."""
    sparse: Callable[[], Float[np.ndarray, "n 3"]] | None = None
    """Reads sparse points on the scene's surfaces, in the frame of the files."""
    front: str | None = None
    """Name of the front camera of a vehicle with several cameras."""
    has_moving_boxes_ignored: bool = False
    """True if boxes of moving objects are ignored like masks."""
    uses_masks: bool = True
    """True to ignore what masks and alpha channels hide. Else photographs with alpha are composited
    over black."""
    regions: IgnoredRegions | None = None
    """What is ignored in every photograph, besides masks; None for nothing."""

    def __len__(self) -> int:
        return len(self.frames)

    def camera(self, frame: int | str, resolution: Resolution = None) -> Camera:
        """Return the camera of a frame, even without its photograph if the file gives the size.

        `frame` is its number, or the name of its photograph.
        """
        chosen = self.frame(self.find_frame(frame))
        return self._build_camera(chosen, chosen.size(), resolution)

    def views(self, frames: Sequence[int | str], resolution: Resolution = None) -> list[View]:
        """Load undistorted photographs with cameras, known depth and the detected vehicle.

        `frames` are their numbers or their names.
        """
        return [self._load_view(self.find_frame(word), resolution) for word in frames]

    @property
    def posed(self) -> list[int]:
        """Numbers of the frames whose camera is known; the others keep their numbers unused."""
        return [number for number, frame in enumerate(self.frames) if frame.has_camera]

    @property
    def present(self) -> list[int]:
        """Numbers of the frames whose camera is known and whose photograph exists."""
        return [number for number in self.posed if self.frame(number).has_photograph()]

    @property
    def files(self) -> list[Path | None]:
        """File of each photograph by frame; None if it has none of its own."""
        return [None if frame.file is None else frame.file.path for frame in self.frames]

    def load_predicted_depth(self, view: View) -> Float[Tensor, "h w"] | None:
        """Load the predicted depth beside a photograph at the size of its view; None without one.

        It is z-depth in scene units as far as its file tells, 0 where unknown or ignored.
        """
        if view.frame is None or not 0 <= view.frame < len(self):
            return None
        frame = self.frame(view.frame)
        if frame.predicted_depth is None:
            return None
        shape = view.camera.height, view.camera.width
        depth = undistort_and_resize(frame, frame.predicted_depth(), frame.size(), shape)
        return torch.from_numpy(depth).where(view.valid_mask.cpu(), 0.0)

    def list_masks(self) -> list[Path]:
        """List the mask images that hide something, without alpha channels."""
        return [f.mask for f in self.frames if f.mask is not None] if self.uses_masks else []

    def take_masks_of(self, folder: Path) -> Photographs:
        """Return a copy with the masks of a folder in place of its own; alpha stays as it is.

        A note names images of the folder that are masks of no photograph here. Raises InputError if
        none is one, or if one may be of several photographs.
        """
        names = [frame.name for frame in self.frames]
        files = self.files
        masks = find_masks_in(folder, names, files)
        if not any(masks):
            raise make_no_mask_error(folder, names)
        notes = (*self.notes, *describe_unnamed_masks(folder, masks, files))
        pairs = zip(self.frames, masks, strict=True)
        frames = [replace(frame, mask=mask, has_inverted_mask=False) for frame, mask in pairs]
        return replace(self, frames=tuple(frames), notes=notes)

    def invert_masks(self) -> Photographs:
        """Return a copy whose mask images are read the other way round; alpha stays as it is."""
        frames = [replace(f, has_inverted_mask=not f.has_inverted_mask) for f in self.frames]
        return replace(self, frames=tuple(frames))

    def describe_masks(self, frames: Sequence[int]) -> str | None:
        """Describe the masks and alpha channels of photographs, without pixels; None for none."""
        if not self.uses_masks:
            return None
        chosen = [self.frame(number) for number in frames]
        named = [frame.mask for frame in chosen if frame.mask is not None]
        num_transparent = sum(_has_alpha_channel(frame) for frame in chosen)
        kinds = []
        if named:
            places = list(dict.fromkeys(path.parent for path in named))
            kinds.append(
                f"masks of {_name_count(len(named))} ({join_names(places, MAX_NAMED_PATHS)})"
            )
        if num_transparent:
            kinds.append(f"the alpha channel of {_name_count(num_transparent)}")
        return " and ".join(kinds) if kinds else None

    def ignore_moving(self) -> Photographs:
        """Return a copy in which boxes of moving objects are ignored like masks."""
        return replace(self, has_moving_boxes_ignored=True)

    def ignore_regions(self, regions: IgnoredRegions | None) -> Photographs:
        """Return a copy in which regions of every photograph are ignored like masks."""
        return replace(self, regions=regions)

    def leave_out_masks(self) -> Photographs:
        """Return a copy in which masks and alpha channels hide nothing."""
        return replace(self, uses_masks=False)

    def leave_out_masks_in(self, folder: Path) -> Photographs:
        """Return a copy without the masks in a folder, which mean something else."""
        frames = []
        for frame in self.frames:
            if frame.mask is not None and lies_in(frame.mask, folder):
                frame = replace(frame, mask=None)
            frames.append(frame)
        return replace(self, frames=tuple(frames))

    def is_hidden(self, frame: int) -> bool:
        """Check whether a mask or the alpha channel hides all of a photograph."""
        chosen = self.frame(frame)
        if not self.uses_masks or (chosen.mask is None and not _has_alpha_channel(chosen)):
            return False
        hidden = self._load_pixels(chosen)[1]
        return hidden is not None and bool(hidden.all())

    def at_origin(self, origin: Float[np.ndarray, "3"]) -> Photographs:
        """Return the photographs relative to the origin of a splat in their map, if they are there.

        Photographs in coordinates of their own stay as they are.
        """
        poses = [frame.c2w for frame in self.frames if frame.has_finite_pose]
        if not poses:
            return self
        middle = np.median([pose[:3, 3] for pose in poses], axis=0)
        return replace(self, origin=origin) if is_near(middle, origin) else self

    def points(self) -> Float[Tensor, "n 3"] | None:
        """Load points on the scene's surfaces relative to `origin`; None if unknown."""
        if self.sparse is None:
            return None
        return torch.from_numpy(self.sparse() - self.origin).float()

    def keep_ego_vehicle(self) -> Photographs:
        """Return a copy that keeps the vehicle that carries the camera in the scene."""
        return replace(self, frames=tuple(replace(f, vehicle=None) for f in self.frames))

    @property
    def has_boxes(self) -> bool:
        """True if some frame has boxes of moving objects."""
        return any(frame.boxes is not None for frame in self.frames)

    def find_skip_reason(self, max_translation: float | None = MAX_TRANSLATION) -> str | None:
        """Explain why benchmarks skip the photographs; None if they are kept.

        `max_translation` is the largest camera coordinate from the origin, in scene units; None
        for any.
        """
        for number, frame in enumerate(self.frames):
            reason = _explain_skip(frame, self.origin, max_translation)
            if reason is not None:
                return f"frame {number}: {reason}"
        return None

    def frame(self, number: int) -> Frame:
        """Return the frame of that number."""
        is_whole = isinstance(number, Integral) and not isinstance(number, bool)
        if not is_whole or not 0 <= number < len(self):
            raise InputError(
                f"There is no frame {quote_value(number)} in {self.title}, whose frames are "
                f"numbered 0 to {len(self) - 1}; choose one of these."
            )
        return self.frames[number]

    def find_frame(self, word: int | str) -> int:
        """Find a frame by its number, or by the name or the path of its photograph.

        A name may lack its ending and its folders, and its case does not matter if no other
        photograph has it.
        """
        if not isinstance(word, str):
            self.frame(word)
            return int(word)
        numbers = self.match_names(word)
        names = [self.frame(number).file_name for number in numbers]
        if len(numbers) > 1:
            raise InputError(
                f"{len(numbers)} photographs of {self.title} are called {quote_value(word)}: "
                f"{join_names(names, MAX_NAMED_PATHS)}; name the path of one of them."
            )
        if not numbers:
            example = self.frame(0).file_name
            raise InputError(
                f"There is no photograph '{quote_value(word)}' in {self.title}; name one of its "
                f"{len(self)} photographs, such as {quote_value(example)}, or its number from 0 "
                f"to {len(self) - 1}."
            )
        return numbers[0]

    def match_names(self, word: str) -> list[int]:
        """List the frames whose photograph a word names, those that it names exactly if any.

        Where cameras were searched for, frames have the names of the copies for COLMAP, and a word
        may be the name of the file itself.
        """
        return self._match_spelling(word) or self._match_spelling(make_colmap_name(word))

    def _match_spelling(self, word: str) -> list[int]:
        path_of_word = fold_name(word.replace("\\", "/"))
        wanted = PurePosixPath(path_of_word).parts
        wanted_stem = PurePosixPath(os.path.splitext(path_of_word)[0]).parts
        exact = []
        similar = []
        for number, frame in enumerate(self.frames):
            path = frame.name.replace("\\", "/")
            if word in (frame.name, frame.file_name, PurePosixPath(path).name):
                exact.append(number)
            # The word may lack folders, and so may the name: either may be the end of the other.
            full = [fold_name(path), fold_name(frame.file_name)]
            names = [(name, wanted) for name in full]
            names += [(stem, wanted) for name in full for stem in list_stems(name)]
            # A file of cameras may name photographs without the endings of their files.
            names += [(name, wanted_stem) for name in full if not os.path.splitext(name)[1]]
            if any(_ends_alike(PurePosixPath(name).parts, given) for name, given in names):
                similar.append(number)
        return exact or similar

    def _build_camera(self, frame: Frame, size: tuple[int, int], resolution: Resolution) -> Camera:
        _, pinhole = frame.compute_pinholes(*size)
        framing = compute_framing(*size, resolution)
        final = pinhole.resize(*framing.scaled_size).crop(*framing.corner, *framing.size)
        # The authors' loaders keep the principal point as a fraction of the image.
        if isinstance(resolution, AuthorsCrop):
            cx = pinhole.cx / pinhole.width * final.width
            cy = pinhole.cy / pinhole.height * final.height
            final = replace(final, cx=cx, cy=cy)
        c2w = frame.c2w.copy()
        c2w[:3, 3] -= self.origin  # before rounding to float32
        pose = torch.from_numpy(c2w).float()
        return Camera(pose, final.K, final.width, final.height, self.near, self.far)

    def _load_view(self, number: int, resolution: Resolution) -> View:
        frame = self.frame(number)
        colors, hidden = self._load_colors(frame)
        size = colors.shape[1], colors.shape[0]
        camera = self._build_camera(frame, size, resolution)
        image = convert_to_image(undistort_and_resize(frame, colors, size, resolution))
        depth = self._load_depth(frame, camera, size, resolution)

        # What files mark as ignored: masks and alpha, and boxes of moving objects.
        masks = []
        if hidden is not None:
            masks.append(torch.from_numpy(resize_mask(frame, hidden, size, resolution)))
        if self.has_moving_boxes_ignored and frame.boxes is not None:
            moving = mask_moving(frame.boxes(), camera, self.origin)
            masks.append(torch.from_numpy(moving))
        if masks:
            ignored = torch.stack(masks).any(dim=0)
            if ignored.all():
                raise InputError(
                    f"All of frame {number} of {self.name} ({quote_value(frame.name)}) is masked; "
                    "choose another frame."
                )
            depth = None if depth is None else depth.masked_fill(ignored, 0.0)

        # The detected vehicle joins the mask of the view alone. Depth under it was measured, so it
        # tells the unit of the depths (`compare_given_depth`), and which points beside the vehicle
        # a laser sees past it (`drop_unsure`). What gives or scores depth asks the mask as well.
        vehicle = None if frame.vehicle is None else frame.vehicle()
        if vehicle is not None:
            small = undistort_and_resize(frame, vehicle.astype(np.uint8), size, resolution)
            masks.append(torch.from_numpy(small > 0))
        mask = torch.stack(masks).any(dim=0) if masks else None
        return View(image, camera, number, depth, mask)

    def _load_colors(
        self, frame: Frame
    ) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None]:
        """Load the upright photograph, and the pixels that masks hide or None.

        Hidden pixels have the colours of their surroundings, so that no later step can take over
        what they show.
        """
        colors, hidden = self._load_pixels(frame)
        return (colors if hidden is None else fill_hidden(colors, hidden)), hidden

    def _load_pixels(
        self, frame: Frame
    ) -> tuple[UInt8[np.ndarray, "h w 3"], Bool[np.ndarray, "h w"] | None]:
        """Load the upright photograph as it is, and the pixels that masks hide or None."""
        colors, alpha, orientation = frame.load_pixels()
        size = colors.shape[1], colors.shape[0]
        hidden = None
        if self.uses_masks:
            hidden = find_masked(frame, alpha, size, orientation)
        elif alpha is not None:
            colors = composite_over_black(colors, alpha)
        if self.regions is not None:
            ignored = self.regions.draw(*size)
            hidden = ignored if hidden is None else hidden | ignored
        return colors, hidden

    def _load_depth(
        self, frame: Frame, camera: Camera, size: tuple[int, int], resolution: Resolution
    ) -> Float[Tensor, "h w"] | None:
        if frame.depth is not None:
            return torch.from_numpy(undistort_and_resize(frame, frame.depth(), size, resolution))
        if frame.laser_points is not None:
            points = torch.from_numpy(frame.laser_points() - self.origin).float()
            return compute_sparse_depth(points, camera)
        return None


def build_photographs(
    name: str, title: str, frames: Sequence[Frame], front: str | None = None
) -> Photographs:
    """Build photographs, with a local origin if the cameras are far from zero."""
    valid = [frame.c2w for frame in frames if find_pose_defect(frame.c2w) is None]
    return Photographs(name, title, tuple(frames), choose_local_origin(valid), front=front)


def build_drive(
    name: str, title: str, frames: Sequence[Frame], front: str | None = None
) -> Photographs:
    """Build the photographs of a vehicle, with the first camera as origin if far from zero.

    `choose_local_origin` compares coordinates with the spread of the cameras, which a long drive
    makes far larger than the baselines that float32 has to resolve.
    """
    built = build_photographs(name, title, frames, front)
    valid = (frame.c2w[:3, 3] for frame in frames if find_pose_defect(frame.c2w) is None)
    first = next(valid, np.zeros(3))
    is_far = np.abs(first).max() > MAX_MAP_COORDINATE
    return replace(built, origin=first.copy() if is_far else np.zeros(3))


def undistort_and_resize(
    frame: Frame,
    pixels: Shaped[np.ndarray, "h w *c"],
    size: tuple[int, int],
    resolution: Resolution,
) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Undistort and resize the photograph of a frame, or a map [h, w] of depth or mask values.

    Maps are resized to `size` (width, height) first. Colours (uint8, [h, w, 3]) are interpolated,
    values of maps never, since a mean of two depths is no surface.
    """
    is_color = pixels.ndim == 3
    if not is_color:
        pixels = resize(pixels, size, Image.Resampling.NEAREST)
    if frame.intrinsics.distortion:
        pinhole, new = frame.compute_pinholes(*size)
        source = compute_undistortion_map(pinhole, frame.intrinsics.distortion, new)
        pixels = remap(pixels, source, cv2.INTER_CUBIC if is_color else cv2.INTER_NEAREST)
    # Colours need a window function to shrink without aliasing; values of a map must not be mixed.
    filtering = Image.Resampling.LANCZOS if is_color else Image.Resampling.NEAREST
    framing = compute_framing(*size, resolution)
    left, top = framing.corner
    width, height = framing.size
    resized = resize(pixels, framing.scaled_size, filtering)
    return np.ascontiguousarray(resized[top : top + height, left : left + width])


def resize_mask(
    frame: Frame, ignored: Bool[np.ndarray, "h w"], size: tuple[int, int], resolution: Resolution
) -> Bool[np.ndarray, "h2 w2"]:
    """Undistort and resize a mask of the photograph's `size`: ignored where half of a pixel is."""
    # In shares from here on, so that no step rounds a mask before the last one.
    share = ignored.astype(np.float32)
    if frame.intrinsics.distortion:
        pinhole, new = frame.compute_pinholes(*size)
        source = compute_undistortion_map(pinhole, frame.intrinsics.distortion, new)
        share = remap(share, source, cv2.INTER_LINEAR)
    framing = compute_framing(*size, resolution)
    left, top = framing.corner
    width, height = framing.size
    resized = resize(share, framing.scaled_size, Image.Resampling.BOX)
    return resized[top : top + height, left : left + width] >= 0.5


def _ends_alike(one: Sequence[str], other: Sequence[str]) -> bool:
    """Check whether the shorter of two paths is the end of the other; an empty one is of none."""
    shorter = min(len(one), len(other))
    return shorter > 0 and one[-shorter:] == other[-shorter:]


def _name_count(count: int) -> str:
    return "1 photograph" if count == 1 else f"{count} photographs"


def _has_alpha_channel(frame: Frame) -> bool:
    return frame.file is not None and frame.file.has_alpha


def _explain_skip(
    frame: Frame, origin: Float[np.ndarray, "3"], max_translation: float | None
) -> str | None:
    # The size in the camera file needs no image to be opened.
    size = frame.intrinsics.size or frame.size()
    defect = frame.find_defect(*size)
    if defect is not None:
        return defect
    fov = compute_fov(frame.compute_pinholes(*size)[1])
    if fov > MAX_FOV:
        return f"its opening angle of {fov:.1f}° is above {MAX_FOV:g}°"
    farthest = float(np.abs(frame.c2w[:3, 3] - origin).max())
    if max_translation is None or farthest <= max_translation:
        return None
    return f"its translation of {farthest:g} is above {max_translation:g}"


@dataclass(frozen=True)
class Framing:
    """Resize to `scaled_size`, then crop `size` at `corner` (all x, y)."""

    scaled_size: tuple[int, int]
    corner: tuple[int, int]
    size: tuple[int, int]


def compute_framing(width: int, height: int, resolution: Resolution) -> Framing:
    """Compute the framing of a width × height image for a resolution."""
    check_resolution(resolution)
    # Shrink to a longer side, without a crop. Whole numbers of NumPy are no `int`.
    if not isinstance(resolution, (AuthorsCrop, tuple, list)):
        scale = 1.0 if resolution is None else min(1.0, resolution / max(width, height))
        size = max(round(width * scale), 1), max(round(height * scale), 1)
        return Framing(size, (0, 0), size)

    # Otherwise the size is exact: scale until the image covers it, and crop the rest.
    if isinstance(resolution, AuthorsCrop):
        new_height = resolution.height
        new_width = resolution.width
    else:
        new_height, new_width = resolution
    if isinstance(resolution, AuthorsCrop) and not resolution.is_resized:
        scaled = width, height
        if width < new_width or height < new_height:
            raise InputError(
                f"An image of {width} × {height} pixels is smaller than its crop of {new_width} × "
                f"{new_height}; choose a smaller resolution."
            )
    else:
        scale = max(new_height / height, new_width / width)
        scaled = max(round(width * scale), new_width), max(round(height * scale), new_height)
    if max(scaled) > MAX_IMAGE_SIDE:
        raise InputError(
            f"An image of {width} × {height} pixels that covers {new_width} × {new_height} has a "
            f"side above {MAX_IMAGE_SIDE}; choose a smaller resolution, or crop the image."
        )
    # Symmetric, with the odd pixel at the right and the lower side.
    corner = (scaled[0] - new_width) // 2, (scaled[1] - new_height) // 2
    return Framing(scaled, corner, (new_width, new_height))


def resize(
    image: Shaped[np.ndarray, "h w *c"], size: tuple[int, int], filtering: Image.Resampling
) -> Shaped[np.ndarray, "h2 w2 *c"]:
    """Resize an image to `size` (width, height)."""
    if image.shape[1::-1] == size:
        return image
    return np.array(Image.fromarray(image).resize(size, filtering))


def _is_side(value: object) -> bool:
    is_whole = isinstance(value, Integral) and not isinstance(value, bool)
    return is_whole and 1 <= value <= MAX_IMAGE_SIDE  # type: ignore[operator]


def check_resolution(resolution: Resolution) -> None:
    """Raise an InputError if a side is not within 1 to `MAX_IMAGE_SIDE`."""
    if resolution is None:
        return
    if isinstance(resolution, AuthorsCrop):
        resolution = (resolution.height, resolution.width)
    sides: Sequence[object] = (resolution,)
    if isinstance(resolution, (tuple, list)) and len(resolution) == 2:
        sides = resolution
    if not all(_is_side(side) for side in sides):
        named = " × ".join(quote_value(side) for side in sides)
        raise InputError(
            f"The resolution {named} is impossible; height and "
            f"width have to be positive, and at most {MAX_IMAGE_SIDE}."
        )
