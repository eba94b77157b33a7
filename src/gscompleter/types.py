"""Values that the stages exchange, and their conventions.

OpenCV axes (x right, y down, z forward). `c2w` is camera-to-world. Intrinsics are in pixels; the
centre of the top-left pixel is (0.5, 0.5). Images are [h, w, 3] in [0, 1]. `depth` is z-depth in
scene units, `distance` is Euclidean along a unit ray. Quaternions are wxyz, scales linear,
opacities in [0, 1], spherical harmonics [n, k, 3] in the 3DGS basis. All values are immutable.

Constructors raise InputError for other types, shapes and devices, and `Camera` for impossible
numbers. The numbers in large tensors are checked where they enter (`value_checks`).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, Int64, Shaped, UInt8
from torch import Tensor

from gscompleter.config.settings import COVERED
from gscompleter.system.errors import InputError
from gscompleter.system.files.display import Displayed
from gscompleter.system.files.mapping import join_rows, select_rows
from gscompleter.system.tensor_checks import (
    BOOLS,
    BYTE_DTYPES,
    FLOATS,
    INTEGERS,
    Form,
    check_tensors,
    describe,
    is_number,
    is_whole_number,
)

# Bounds of a camera. Files hold float64 and the pipeline uses float32, in which 1e300 is infinity
# and 1e-300 is zero. Every real camera keeps these bounds, and squares and quotients of numbers
# within them are finite.
MAX_IMAGE_SIDE = 16_384
"""Largest width or height of an image, in pixels."""
MAX_COORDINATE = 1e9
"""Largest coordinate of a camera centre, in scene units."""
FOCAL_RANGE = (1e-3, 1e6)
"""Range of focal lengths, in image widths (or heights)."""
MAX_CENTER = 100.0
"""Largest distance of the principal point from the corner, in image widths (or heights)."""

BLUR = 0.3
"""Variance by which 3DGS widens projected Gaussians, in square pixels: a low-pass of a pixel."""
SH_C0 = 0.28209479177387814
"""Constant spherical harmonic: colour = 0.5 + SH_C0 * sh[:, 0]."""

MAX_RIGID_ERROR = 1e-3
"""Largest entry of RᵀR - I that counts as rounding error of a rotation R."""

MAX_ROUNDED_SKEW = 1e-6
"""Largest entry of K, relative to the focal length, that counts as rounding error of 0."""
NUM_SH = (1, 4, 9, 16)
"""Spherical harmonics per channel, by degree."""

Origin = tuple[float, float, float]
"""Place in the coordinates of a file, in float64."""

M = TypeVar("M", bound="TensorDataclass")
AnyView = TypeVar("AnyView", bound="View")


@dataclass(frozen=True)
class TensorDataclass:
    """A value whose tensors all lie on one device."""

    def to(self: M, device: torch.device | str) -> M:
        """Return a copy on `device`, or the value itself if it is there."""
        parts = self._list_parts()
        moved = {name: part.to(device) for name, part in parts.items()}
        is_there = all(part is parts[name] for name, part in moved.items())
        return self if is_there else replace(self, **moved)

    def detach(self: M) -> M:
        """Return the value without the history of its gradients; itself if there is none."""
        parts = self._list_parts()
        if not any(isinstance(part, Tensor) and part.requires_grad for part in parts.values()):
            return self
        return replace(self, **{name: part.detach() for name, part in parts.items()})

    def _list_parts(self) -> dict[str, Any]:
        """List the fields that hold tensors, by name."""
        # Not by `vars`, in which cached properties lie beside the fields.
        values = {part.name: getattr(self, part.name) for part in fields(self)}
        return {
            name: value
            for name, value in values.items()
            if isinstance(value, (Tensor, TensorDataclass))
        }


@dataclass(frozen=True, repr=False)
class Camera(Displayed, TensorDataclass):
    """A pinhole camera with OpenCV axes: x right, y down, z forward."""

    c2w: Float[Tensor, "4 4"]
    """Camera-to-world transform; the last column is the camera centre."""
    K: Float[Tensor, "3 3"]
    """Intrinsics in pixels; the centre of the top-left pixel is (0.5, 0.5)."""
    width: int
    height: int
    near: float | None = None
    """Smallest z-depth of the scene, in scene units, or None if unknown."""
    far: float | None = None
    """Largest z-depth of the scene, in scene units, or None if unknown."""
    padding: tuple[int, int] = (0, 0)
    """Pixels that were added to an image on the left and right each, and above and below each.
    Renderers distort Gaussians beside the image as they do without padding (`render.padding`), so
    that both images show the same where both are."""
    blur: float = BLUR
    """Variance by which projected Gaussians are widened, in square pixels. It belongs to the pixels
    that a scene was made for: a smaller image of it has less (`geometry.sample_image`)."""

    owner: ClassVar[str] = "a camera"
    forms: ClassVar[dict[str, Form]] = {"c2w": (FLOATS, (4, 4)), "K": (FLOATS, (3, 3))}

    def __post_init__(self) -> None:
        """Raise InputError for an impossible camera; numbers on a GPU are not read."""
        check_tensors(self, self.owner, self.forms)
        defect = (
            _find_size_defect(self.width, self.height)
            or _find_padding_defect(self.padding, self.width, self.height)
            or _find_planes_defect(self.near, self.far)
            or _find_blur_defect(self.blur)
            or _find_pose_defect(self.c2w)
            or _find_intrinsics_defect(self.K, self.width, self.height)
        )
        if defect is not None:
            raise InputError(f"There is no such camera: {defect}.")
        for name, convert in (
            ("width", int),
            ("height", int),
            ("near", float),
            ("far", float),
            ("blur", float),
        ):
            number = getattr(self, name)
            if number is not None and type(number) is not convert:
                _set_field(self, name, convert(number))
        if any(type(pixels) is not int for pixels in self.padding):
            _set_field(self, "padding", tuple(int(pixels) for pixels in self.padding))

    def summarize(self) -> str:
        """Describe size, focal length, place and depth range."""
        place = ", ".join(f"{x:.4g}" for x in self.center.tolist())
        parts = [f"{self.width} x {self.height} pixels", f"focal length {self.K[0, 0]:.4g}"]
        parts.append(f"centre ({place})")
        if self.near is not None and self.far is not None:
            parts.append(f"depths {self.near:.4g} to {self.far:.4g}")
        return ", ".join(parts)

    @property
    def center(self) -> Float[Tensor, "3"]:
        """Camera centre in world coordinates."""
        return self.c2w[:3, 3]

    @property
    def forward(self) -> Float[Tensor, "3"]:
        """Unit viewing direction (the z axis) in world coordinates."""
        return self.c2w[:3, 2]

    @cached_property
    def viewmat(self) -> Float[Tensor, "4 4"]:
        """World-to-camera transform; only the rasterizers need it.

        `inv_ex` does not look for singular matrices, for which the host would wait for a GPU.
        """
        return torch.linalg.inv_ex(self.c2w.double()).inverse.to(self.c2w.dtype)

    @property
    def on_cpu(self) -> Camera:
        """The camera on the CPU: its numbers are copied from a GPU once."""
        return self if self.c2w.device.type == "cpu" else self._copy_on_cpu

    @cached_property
    def _copy_on_cpu(self) -> Camera:
        return self.to("cpu")

    @property
    def near_plane(self) -> float:
        """z-depth of the near clipping plane: `near` / 100 (for any scene unit), else 0.01."""
        return 0.01 * self.near if self.near is not None else 0.01

    def z_rays(self) -> Float[Tensor, "h w 3"]:
        """Return world-axis rays with unit z in the camera: points are `center + depth * z_ray`."""
        x = torch.arange(self.width, device=self.K.device, dtype=self.K.dtype) + 0.5
        y = torch.arange(self.height, device=self.K.device, dtype=self.K.dtype) + 0.5
        pixels = torch.stack(torch.meshgrid(x, y, indexing="xy"), dim=-1)
        pixels = torch.nn.functional.pad(pixels, (0, 1), value=1.0)
        return pixels @ torch.linalg.inv_ex(self.K).inverse.T @ self.c2w[:3, :3].T


def _set_field(value: TensorDataclass, name: str, number: object) -> None:
    """Set a field of a frozen value to a number of Python; JSON cannot hold one of NumPy."""
    object.__setattr__(value, name, number)


def _find_size_defect(width: object, height: object) -> str | None:
    """Return a sentence part about an impossible size of the image, or None."""
    for name, side in (("width", width), ("height", height)):
        if not is_whole_number(side):
            return f"its {name} is {describe(side)}, and a whole number of pixels is needed"
        if not 1 <= side <= MAX_IMAGE_SIDE:  # type: ignore[operator]
            return f"its {name} is {side} pixels, and 1 to {MAX_IMAGE_SIDE} are possible"
    return None


def _find_padding_defect(padding: object, width: int, height: int) -> str | None:
    """Return a sentence part about padding that leaves no image within it, or None."""
    if not (
        isinstance(padding, tuple)
        and len(padding) == 2
        and all(is_whole_number(pixels) and pixels >= 0 for pixels in padding)
    ):
        return f"its padding is {describe(padding)}, and two numbers of pixels from 0 are needed"
    if 2 * padding[0] >= width or 2 * padding[1] >= height:
        return (
            f"its padding of {padding[0]} and {padding[1]} pixels on each side leaves nothing of "
            f"its image of {width} x {height} pixels"
        )
    return None


def _find_planes_defect(near: float | None, far: float | None) -> str | None:
    """Return a sentence part about impossible depth planes, or None."""
    for name, plane in (("near", near), ("far", far)):
        if plane is not None and not is_number(plane):
            return f"its {name} plane is {describe(plane)}, and a number is needed"
        if plane is not None and not 0 < plane < math.inf:
            return f"its {name} plane is at {plane:g}, and a positive z-depth is needed"
    if near is not None and far is not None and near >= far:
        return f"its near plane at {near:g} is not before its far plane at {far:g}"
    return None


def _find_blur_defect(blur: float) -> str | None:
    """Return a sentence part about an impossible blur, or None."""
    if not is_number(blur):
        return f"its blur is {describe(blur)}, and a number is needed"
    if not 0 < blur < math.inf:
        return f"its blur is {blur:g} square pixels, and a positive variance is needed"
    return None


def _find_pose_defect(c2w: Float[Tensor, "4 4"]) -> str | None:
    """Return a sentence part about an impossible pose, or None."""
    if c2w.requires_grad:
        return "its pose requires a gradient, which nothing computes; detach it"
    if c2w.device.type != "cpu":
        return None
    pose = c2w.double().numpy()  # for one matrix ten times as fast as torch
    if not np.isfinite(pose).all():
        return "its pose holds NaN or infinity"
    if np.abs(pose[:3, 3]).max() > MAX_COORDINATE:
        return f"its centre is more than {MAX_COORDINATE:g} scene units from the origin"

    # RᵀR = I for a rotation. The last row is part of the product, as it has to be 0 0 0 1 as well.
    rotation_error = np.abs(pose[:, :3].T @ pose[:, :3] - np.eye(3)).max()
    last_row_error = np.abs(pose[3] - np.eye(4)[3]).max()
    if not max(rotation_error, last_row_error) <= MAX_RIGID_ERROR:
        return "its pose is no rotation and translation but scaled, sheared or projective"
    # The determinant is 1 or -1 now; -1 is a reflection.
    if np.linalg.det(pose) < 0:
        return "its pose is left-handed; mirror one of its axes"
    return None


def _find_intrinsics_defect(K: Float[Tensor, "3 3"], width: int, height: int) -> str | None:
    """Return a sentence part about impossible intrinsics, or None."""
    if K.requires_grad:
        return "its K requires a gradient, which nothing computes; detach it"
    if K.device.type != "cpu":
        return None
    (fx, skew, cx), (below, fy, cy), last_row = K.tolist()
    # The sum is finite only if all of them are.
    if not (fx > 0 and fy > 0 and math.isfinite(fx + fy + cx + cy)):
        return f"its focal lengths are {fx:g} and {fy:g}, its centre is ({cx:g}, {cy:g})"
    # Renderers read the focal lengths and the centre only; rays take the inverse of the whole K.
    largest_skew = MAX_ROUNDED_SKEW * min(fx, fy)
    # Not by `max`, which loses a NaN in its second place.
    has_right_angles = abs(skew) <= largest_skew and abs(below) <= largest_skew
    if last_row != [0, 0, 1] or not has_right_angles:
        return "its K has a skew or another last row than 0 0 1; pixels must be right-angled"
    low, high = FOCAL_RANGE
    if not (low <= fx / width <= high and low <= fy / height <= high):
        return f"its focal lengths of {fx:g} and {fy:g} pixels fit no lens"
    if max(abs(cx) / width, abs(cy) / height) > MAX_CENTER:
        return f"its centre ({cx:g}, {cy:g}) is far outside of its image"
    return None


@dataclass(frozen=True)
class PaddedCamera:
    """A target camera and the same camera with padding on every side."""

    target: Camera
    padded: Camera
    """The padded camera; its rays through the pixels of `target` are those of `target`."""
    left: int
    """Padding on the left and on the right each, in pixels."""
    top: int
    """Padding above and below each, in pixels."""

    @property
    def is_padded(self) -> bool:
        """True if there is padding on any side."""
        return self.left > 0 or self.top > 0

    def crop(self, image: Shaped[Tensor, "wide_h wide_w *c"]) -> Shaped[Tensor, "h w *c"]:
        """Cut the padding off an image [h, w, ...] of the padded camera."""
        return image[self._inside]

    def paste(
        self, image: Shaped[Tensor, "h w *c"], wide: Shaped[Tensor, "wide_h wide_w *c"]
    ) -> Shaped[Tensor, "wide_h wide_w *c"]:
        """Put an image [h, w, ...] of the target in its place in one of the padded camera."""
        both = wide.clone()
        both[self._inside] = image
        return both

    @property
    def _inside(self) -> tuple[slice, slice]:
        """Rows and columns of the target in an image of the padded camera."""
        rows = slice(self.top, self.top + self.target.height)
        return rows, slice(self.left, self.left + self.target.width)


@dataclass(frozen=True, repr=False)
class View(Displayed, TensorDataclass):
    """A photograph (or a synthesized image) and its camera."""

    image: Float[Tensor, "h w 3"]
    camera: Camera
    frame: int | None = None
    """Frame number in the scene folder, or None if the view is not one of its frames."""
    depth: Float[Tensor, "h w"] | None = None
    """Measured z-depth in scene units, 0 if unknown. Only the evaluation reads it."""
    ignore_mask: Bool[Tensor, "h w"] | None = None
    """True where the image must not be used (user mask), or None if all of it may be used."""
    dynamic_mask: Bool[Tensor, "h w"] | None = None
    """True where something moved between photographs; completion copies nothing from there."""
    given_depth: Float[Tensor, "h w"] | None = None
    """z-depth in scene units that constrains the reconstruction, 0 if unknown; scores nothing."""

    owner: ClassVar[str] = "a view"
    forms: ClassVar[dict[str, Form]] = {
        "image": (FLOATS, ("h", "w", 3)),
        "depth": (FLOATS, ("h", "w")),
        "ignore_mask": (BOOLS, ("h", "w")),
        "dynamic_mask": (BOOLS, ("h", "w")),
        "given_depth": (FLOATS, ("h", "w")),
    }

    def __post_init__(self) -> None:
        """Raise InputError if a part has another form than the image of the camera."""
        check_tensors(self, self.owner, self.forms)
        if not isinstance(self.camera, Camera):
            raise InputError(
                f"The camera of a view has to be a Camera, and is {describe(self.camera)}."
            )
        if self.frame is not None and not is_whole_number(self.frame):
            raise InputError(
                f"The frame of a view is {describe(self.frame)}; give the number of a frame or "
                "None."
            )
        if self.frame is not None and type(self.frame) is not int:
            _set_field(self, "frame", int(self.frame))
        size = (self.camera.height, self.camera.width)
        for name in self.forms:
            pixels = getattr(self, name)
            if pixels is not None and tuple(pixels.shape[:2]) != size:
                raise InputError(
                    f"The {name.replace('_', ' ')} of a view has the shape {list(pixels.shape)}, "
                    f"and its camera has {size[0]} × {size[1]} pixels (height × width); resize one "
                    "of them."
                )
        if self.image.requires_grad:
            raise InputError(
                "The image of a view requires a gradient, which nothing computes; detach it."
            )
        if self.image.device != self.camera.K.device:
            raise InputError(
                f"The image of a view is on {self.image.device}, and its camera on "
                f"{self.camera.K.device}; move one of them."
            )
        # A score over depths that the reconstruction was given would be no measurement.
        if (
            self.given_depth is not None
            and self.depth is not None
            and ((self.given_depth > 0) & (self.depth > 0)).any()
        ):
            raise InputError("A depth both constrains and scores a view; leave one of them out.")

    def summarize(self) -> str:
        """Describe the frame, the size, and the depths and masks that there are."""
        parts = [] if self.frame is None else [f"frame {self.frame}"]
        parts.append(f"{self.camera.width} x {self.camera.height} pixels")
        maps = [name for name in self.forms if name != "image" and getattr(self, name) is not None]
        parts += [f"with {name.replace('_', ' ')}" for name in maps]
        return ", ".join(parts)

    def list_pictures(self) -> dict[str, Tensor]:
        """List the image."""
        caption = "image" if self.frame is None else f"frame {self.frame}"
        return {caption: self.image}

    @property
    def known_depths(self) -> Float[Tensor, "n"]:
        """Given depths of the pixels that have one."""
        if self.given_depth is None:
            return self.image.new_zeros(0)
        return self.given_depth[self.given_depth > 0]

    @property
    def valid_mask(self) -> Bool[Tensor, "h w"]:
        """True where the image may be used."""
        everywhere = torch.ones_like(self.image[..., 0], dtype=torch.bool)
        return everywhere if self.ignore_mask is None else ~self.ignore_mask

    @property
    def static_mask(self) -> Bool[Tensor, "h w"]:
        """True where completion may copy from the image: valid and not dynamic."""
        valid = self.valid_mask
        return valid if self.dynamic_mask is None else valid & ~self.dynamic_mask

    def fill_ignored(self, image: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
        """Replace ignored pixels of a render by those of the photograph."""
        if self.ignore_mask is None:
            return image
        return torch.where(self.ignore_mask[..., None], self.image, image)

    def paint_ignored(self: AnyView, image: Float[Tensor, "h w 3"]) -> AnyView:
        """Replace ignored pixels of the photograph by those of a render."""
        if self.ignore_mask is None:
            return self
        return replace(self, image=torch.where(self.ignore_mask[..., None], image, self.image))

    def normalize_exposure(self, gain: Float[Tensor, "3"]) -> View:
        """Divide the image by an exposure gain per channel."""
        return replace(self, image=(self.image / gain).clamp(0, 1))


@dataclass(frozen=True, repr=False)
class Gaussians(Displayed, TensorDataclass):
    """A set of n 3D Gaussians in world coordinates, with their provenance."""

    means: Float[Tensor, "n 3"]
    quats: Float[Tensor, "n 4"]
    """Rotations as wxyz quaternions of any nonzero length."""
    scales: Float[Tensor, "n 3"]
    """Standard deviations along the rotated axes, in scene units (linear)."""
    opacities: Float[Tensor, "n"]
    sh: Float[Tensor, "n k 3"]
    """Spherical harmonics; k is 1, 4, 9 or 16 for degree 0 to 3."""
    generated: UInt8[Tensor, "n"]
    """0 for observed Gaussians, else the label of their origin (`parts.PartOrigin`): 1 to 254 for
    the target that they were invented for, 255 for what is new and was not invented."""
    encoded: Float[Tensor, "n 4"] | None = None
    """Log-scales and logit opacities as read from a file, or None.
    The writer uses them while they still match, since float32 exp and log are not exact
    inverses."""
    is_antialiased: bool = False
    """True for Mip-Splatting: opacities are multiplied by `sqrt(det S / det(S + 0.3 I))`.
    S is the covariance in the image, in px²."""
    origin: Origin | None = None
    """Place of zero in the coordinates of the file, in scene units, if these are too large for
    float32 as those of maps; writers add it again. None for zero."""

    owner: ClassVar[str] = "Gaussians"
    forms: ClassVar[dict[str, Form]] = {
        "means": (FLOATS, ("n", 3)),
        "quats": (FLOATS, ("n", 4)),
        "scales": (FLOATS, ("n", 3)),
        "opacities": (FLOATS, ("n",)),
        "sh": (FLOATS, ("n", "k", 3)),
        "generated": (BYTE_DTYPES, ("n",)),
        "encoded": (FLOATS, ("n", 4)),
    }

    def __post_init__(self) -> None:
        """Raise InputError for other types, shapes and devices; no number is read."""
        check_tensors(self, self.owner, self.forms)
        values = {name: getattr(self, name) for name in self.forms}
        counts = {name: len(value) for name, value in values.items() if value is not None}
        if len(set(counts.values())) > 1:
            raise InputError(
                "All properties of Gaussians need as many rows, and "
                f"{', '.join(f'{name} has {count}' for name, count in counts.items())}."
            )
        if self.sh.shape[1] not in NUM_SH:
            raise InputError(
                f"Gaussians have {self.sh.shape[1]} spherical harmonics per channel; degree 0 to 3 "
                "have 1, 4, 9 or 16."
            )
        if not isinstance(self.is_antialiased, bool):
            raise InputError(
                "is_antialiased of Gaussians has to be True or False, and is "
                f"{describe(self.is_antialiased)}."
            )
        if self.origin is not None and not (
            isinstance(self.origin, tuple)
            and len(self.origin) == 3
            and all(is_number(x) and math.isfinite(x) for x in self.origin)
        ):
            raise InputError(
                f"The origin of Gaussians has to be three numbers or None, and is "
                f"{describe(self.origin)}."
            )
        if self.origin is not None and any(type(x) not in (int, float) for x in self.origin):
            _set_field(self, "origin", tuple(float(x) for x in self.origin))

    def summarize(self) -> str:
        """Describe the number, the generated ones, the extent and the degree of harmonics."""
        num_generated = int((self.generated > 0).sum())
        parts = [f"{len(self):,} Gaussians"]
        if num_generated:
            parts.append(f"{num_generated:,} of them generated")
        if len(self):
            low, high = self.means.aminmax(dim=0)
            corners = [", ".join(f"{x:.4g}" for x in corner.tolist()) for corner in (low, high)]
            parts.append(f"from ({corners[0]}) to ({corners[1]})")
        if self.origin is not None:
            parts.append(f"relative to ({', '.join(f'{x:.12g}' for x in self.origin)})")
        parts.append(f"harmonics of degree {self.sh_degree}")
        return ", ".join([*parts, "antialiased"] if self.is_antialiased else parts)

    def __len__(self) -> int:
        return self.means.shape[0]

    def __getitem__(self, index: Tensor | slice) -> Gaussians:
        """Return the Gaussians at a boolean mask [n], integer indices [m] or a slice."""
        values = self._list_parts()
        rows: dict[str, Any]
        if isinstance(index, slice):
            rows = {name: value[index] for name, value in values.items()}
            return replace(self, **rows)
        is_list = isinstance(index, Tensor) and index.dim() == 1
        if not is_list or index.dtype not in (*BOOLS, *INTEGERS):
            raise InputError(
                "Gaussians are selected by a boolean mask of shape [n], by integer indices of "
                f"shape [m] or by a slice, and not by a value {describe(index)}."
            )
        # Its rows are looked for once, and not by each property. `nonzero` takes a mask of any
        # length.
        if index.dtype == torch.bool:
            if len(index) != len(self):
                raise InputError(
                    f"A mask of {len(index):,} entries cannot select from {len(self):,} Gaussians; "
                    "give one for each."
                )
            index = index.nonzero()[:, 0]
        chosen = index.to(self.means.device)
        rows = {name: select_rows(value, chosen) for name, value in values.items()}
        return replace(self, **rows)

    def hide(self, hidden: Bool[Tensor, "n"]) -> Gaussians:
        """Make Gaussians transparent, so that renderers draw only the others.

        All but the opacities is shared: a selection of the others would copy their harmonics.
        """
        return replace(self, opacities=self.opacities.masked_fill(hidden, 0.0), encoded=None)

    def drop_colors(self) -> Gaussians:
        """Make all Gaussians grey, for steps that read no colours.

        Harmonics are most of the memory of a scene, and may have to be read from a file.
        """
        gray = self.sh.new_zeros((1, 1, 3)).expand(len(self), 1, 3)
        return replace(self, sh=gray, encoded=None)

    @property
    def sh_degree(self) -> int:
        """Degree of the spherical harmonics, 0 to 3."""
        return NUM_SH.index(self.sh.shape[1])

    def move_origin(self, origin: Origin | None) -> Gaussians:
        """Express the Gaussians relative to another origin; they stay where they are."""
        if origin == self.origin:
            return self
        # In float64, since both origins may be large, and their difference is small.
        there = torch.tensor(self.origin or (0, 0, 0), dtype=torch.float64)
        here = torch.tensor(origin or (0, 0, 0), dtype=torch.float64)
        shift = (there - here).to(self.means.device)
        means = (self.means.double() + shift).to(self.means.dtype)
        return replace(self, means=means, origin=origin)


def make_observed(
    means: Float[Tensor, "n 3"],
    quats: Float[Tensor, "n 4"],
    scales: Float[Tensor, "n 3"],
    opacities: Float[Tensor, "n"],
    sh: Float[Tensor, "n k 3"],
) -> Gaussians:
    """Make Gaussians that are labelled as observed."""
    if not isinstance(means, Tensor) or means.dim() == 0:
        raise InputError(
            "The means of Gaussians have to be a tensor of shape [n, 3], and are "
            f"{describe(means)}."
        )
    generated = torch.zeros(len(means), dtype=torch.uint8, device=means.device)
    return Gaussians(means, quats, scales, opacities, sh, generated)


def merge(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenate Gaussians; SH of lower degree are padded with zeros, which changes no colour.

    The origin is that of the first part with one. Parts without an origin are relative to it, as
    Gaussians that were made for a scene are.
    """
    if not isinstance(parts, (list, tuple)):
        raise InputError(f"What is merged has to be a list of Gaussians, and is {describe(parts)}.")
    for part in parts:
        if not isinstance(part, Gaussians):
            raise InputError(
                f"Each part that is merged has to be Gaussians, and one is {describe(part)}."
            )
    if not parts:
        raise InputError("merge needs at least one set of Gaussians, and got none.")
    if len({part.is_antialiased for part in parts}) > 1:
        raise InputError("Antialiased Gaussians cannot be merged with others; convert one of them.")

    if len(parts) == 1:
        return parts[0]
    origin = next((part.origin for part in parts if part.origin is not None), None)
    parts = [part if part.origin is None else part.move_origin(origin) for part in parts]
    k = max(part.sh.shape[1] for part in parts)
    # Padding by nothing would copy, too.
    sh = [
        part.sh
        if part.sh.shape[1] == k
        else torch.nn.functional.pad(part.sh, (0, 0, 0, k - part.sh.shape[1]))
        for part in parts
    ]
    encoded = None
    if any(part.encoded is not None for part in parts):
        # NaN is unequal to anything, so that the writer encodes these rows again.
        unknown = float("nan")
        encoded = torch.cat(
            [
                part.means.new_full((len(part), 4), unknown)
                if part.encoded is None
                else part.encoded
                for part in parts
            ]
        )
    return Gaussians(
        means=torch.cat([part.means for part in parts]),
        quats=torch.cat([part.quats for part in parts]),
        scales=torch.cat([part.scales for part in parts]),
        opacities=torch.cat([part.opacities for part in parts]),
        sh=join_rows(sh),
        generated=torch.cat([part.generated for part in parts]),
        encoded=encoded,
        is_antialiased=parts[0].is_antialiased,
        origin=origin,
    )


def sh_from_rgb(rgb: Float[Tensor, "n 3"]) -> Float[Tensor, "n 1 3"]:
    """Return degree-0 spherical harmonics of a colour in [0, 1]."""
    return ((rgb - 0.5) / SH_C0)[:, None]


@dataclass(frozen=True, repr=False)
class Render(Displayed):
    """A rendering of Gaussians over black."""

    image: Float[Tensor, "h w 3"]
    depth: Float[Tensor, "h w"]
    """z-depth in scene units, sum(w z) / sum(w) over the compositing weights w; 0 if alpha is 0."""
    alpha: Float[Tensor, "h w"]
    """Accumulated opacity, sum(w)."""

    def summarize(self) -> str:
        """Describe the size and how much of the image is covered."""
        height, width = self.alpha.shape
        covered = (self.alpha >= COVERED).float().mean().item()
        return f"{width} x {height} pixels, {covered:.1%} covered"

    def list_pictures(self) -> dict[str, Tensor]:
        """List the colours."""
        return {"render": self.image}

    def crop(self, camera: PaddedCamera) -> Render:
        """Cut the padding off a render of the padded camera."""
        return Render(camera.crop(self.image), camera.crop(self.depth), camera.crop(self.alpha))

    def depth_map(self, min_alpha: float = COVERED) -> DepthMap:
        """Return the depth, valid where alpha is at least `min_alpha`."""
        return DepthMap(self.depth, self.alpha >= min_alpha)


@dataclass(frozen=True, repr=False)
class DepthMap(Displayed, TensorDataclass):
    """z-depth per pixel, in scene units, with a validity mask."""

    depth: Float[Tensor, "h w"]
    valid: Bool[Tensor, "h w"]
    confidence: Float[Tensor, "h w"] | None = None
    """Confidence in [0, 1], or None if the model does not estimate it."""

    owner: ClassVar[str] = "a depth map"
    forms: ClassVar[dict[str, Form]] = {
        "depth": (FLOATS, ("h", "w")),
        "valid": (BOOLS, ("h", "w")),
        "confidence": (FLOATS, ("h", "w")),
    }

    def __post_init__(self) -> None:
        """Raise InputError for other types, shapes and devices; no number is read."""
        check_tensors(self, self.owner, self.forms)
        values = [getattr(self, name) for name in self.forms]
        shapes = {tuple(value.shape) for value in values if value is not None}
        if len(shapes) > 1:
            raise InputError(
                f"The parts of a depth map have to be of one size, and have the shapes "
                f"{' and '.join(str(list(shape)) for shape in sorted(shapes))}."
            )

    def summarize(self) -> str:
        """Describe the size, the valid share and the range of depths."""
        height, width = self.depth.shape
        parts = [f"{width} x {height} pixels", f"{self.valid.float().mean().item():.1%} valid"]
        if self.valid.any():
            low, high = self.depth[self.valid].aminmax()
            parts.append(f"depths {low:.4g} to {high:.4g}")
        return ", ".join(parts)

    def list_pictures(self) -> dict[str, Tensor]:
        """List inverse depth, brighter where nearer and black where it is invalid."""
        inverse = torch.where(self.valid, 1 / self.depth, torch.zeros_like(self.depth))
        return {"inverse depth": inverse / inverse.max().clamp_min(1e-12)}


ChooseMasks = Callable[[Sequence[DepthMap]], Sequence[Bool[Tensor, "_ _"]]]
"""Chooses the pixels of each view that need Gaussians, by the depths of all views."""


@dataclass(frozen=True)
class Reconstruction:
    """Output of a reconstructor Ψ, on the device of its views: Gaussians and depth maps."""

    gaussians: Gaussians
    depths: tuple[DepthMap, ...]
    view_index: Int[Tensor, "n"] | None = None
    """View that each Gaussian comes from, or None if the model is not pixel-aligned."""
    pixel_index: Int[Tensor, "n"] | None = None
    """Row-major pixel of that view, or None if the model is not pixel-aligned."""
    exposure_gains: Float[Tensor, "v 3"] | None = None
    """Exposure gain per channel of each view relative to the Gaussians, or None."""
    contradicted_depths: tuple[int, ...] = ()
    """Indices of the views whose given depth the photographs contradict; it is not used."""
    notes: tuple[str, ...] = ()
    """Sentences for the user, such as on a depth that is not used."""

    owner: ClassVar[str] = "a reconstruction"
    forms: ClassVar[dict[str, Form]] = {
        "view_index": (INTEGERS, ("n",)),
        "pixel_index": (INTEGERS, ("n",)),
        "exposure_gains": (FLOATS, ("v", 3)),
    }

    def __post_init__(self) -> None:
        """Raise InputError for other types, shapes and devices; no number is read."""
        check_tensors(self, self.owner, self.forms)
        if not isinstance(self.gaussians, Gaussians):
            raise InputError(
                f"The gaussians of a reconstruction have to be Gaussians, and are "
                f"{describe(self.gaussians)}."
            )
        is_listed = isinstance(self.depths, (tuple, list))
        if not is_listed or not all(isinstance(depth, DepthMap) for depth in self.depths):
            raise InputError(
                "The depths of a reconstruction have to be a tuple of one DepthMap per view."
            )


@dataclass(frozen=True)
class GeneratorInput:
    """Input of a generator Φ besides the target camera and its nearest view."""

    views: tuple[View, ...]
    view_renders: tuple[Render, ...]
    """Renders of the scene at the cameras of `views`, in their order."""
    target_render: Render
    """Render of the scene at the target camera."""
    max_alpha: float = COVERED
    """Pixels of the target with less alpha are holes."""
    trusted_alpha: Float[Tensor, "h w"] | None = None
    """Alpha at the target weighted by trust, or None under full trust."""

    @property
    def holes(self) -> Bool[Tensor, "h w"]:
        """Hole mask at the target; Φ fills these pixels."""
        alpha = self.target_render.alpha if self.trusted_alpha is None else self.trusted_alpha
        return alpha < self.max_alpha

    @property
    def known_colors(self) -> Float[Tensor, "h w 3"]:
        """Colours of the scene at the target without the black behind it; dark in holes."""
        alpha = self.target_render.alpha.clamp_min(self.max_alpha)
        return (self.target_render.image / alpha[..., None]).clamp(0, 1)


@dataclass(frozen=True)
class Lift:
    """The synthesized image lifted to 3D by stereo with the anchor (paper, Sec. III-D)."""

    gaussians: Gaussians
    """Gaussians of the reference image only, in world coordinates."""
    reference_depth: DepthMap
    anchor_depth: DepthMap
    pixel_index: Int[Tensor, "n"] | None
    """Row-major pixel of the reference image that each Gaussian comes from, or None if unknown."""
    notes: tuple[str, ...] = ()
    """Sentences of Ψ for the user."""


@dataclass(frozen=True)
class Registration:
    """Gaussians of the reference image, registered with the context."""

    gaussians: Gaussians
    pixel_index: Int[Tensor, "n"] | None
    """Row-major pixel of the reference image that each Gaussian comes from, or None if unknown."""
    losses: tuple[float, ...]
    """Value of Eq. 11 at each iteration."""


@dataclass(frozen=True)
class DepthPairs:
    """A sample of the z-depths that an affine was fitted to, in scene units."""

    fit_view: Literal["anchor", "target"]
    predicted: Float[Tensor, "n"]
    context: Float[Tensor, "n"]
    inlier_mask: Bool[Tensor, "n"]

    @staticmethod
    def empty() -> DepthPairs:
        """Return no pairs."""
        return DepthPairs("anchor", torch.empty(0), torch.empty(0), torch.empty(0).bool())


@dataclass(frozen=True)
class DepthAffine:
    """Correction `D_ctx = scale * D_pred + shift` on z-depth (paper, Eq. 8)."""

    scale: float = 1.0
    shift: float = 0.0
    inliers: float = 0.0
    """Fraction of the compared pixels that agree with the fit."""
    method: Literal["ransac", "median", "identity"] = "identity"
    """Estimator that was used; each is the fallback of the one before."""
    agreement: float | None = None
    """Fraction of the context visible at the target that agrees with it, or None if not checked."""
    coverage: float = 0.0
    """Fraction of the target image over which that was checked."""
    is_refitted_at_target: bool = False
    """True if the fit at the anchor was replaced by one at the target."""
    pairs: DepthPairs = field(default_factory=DepthPairs.empty, repr=False, compare=False)
    """A sample of the compared depths, for the report."""


@dataclass(frozen=True)
class ContextScene:
    """The n Gaussians of the context and the m <= n that are rendered in their place (LOD)."""

    gaussians: Gaussians
    """As Ψ made them or as the user's file holds them."""
    rendered: Gaussians
    """The m Gaussians that the stages render; `gaussians` itself for small scenes and on GPUs."""
    proxy_index: Int64[Tensor, "_n"]
    """Rendered Gaussian that stands for each Gaussian, any one for those that are gone; empty if
    `rendered is gaussians`."""
    chosen_mask: Bool[Tensor, "n"]
    """True for Gaussians that were chosen and removed."""
    revealed_mask: Bool[Tensor, "n"]
    """True for unseen Gaussians behind those, which are gone as well."""
    replaced_mask: Bool[Tensor, "n"]
    """True for Gaussians that earlier commands made and that gave way to what photographs show."""
    removed: Gaussians
    """The Gaussians that were removed, cut where they reached out of the place that was chosen; to
    save memory, without their colours by direction."""

    @staticmethod
    def whole(gaussians: Gaussians) -> ContextScene:
        """Return a context that is rendered as it is."""
        return ContextScene.build(gaussians, gaussians, gaussians.means.new_empty(0).long())

    @staticmethod
    def build(
        gaussians: Gaussians, rendered: Gaussians, index: Int64[Tensor, "_n"]
    ) -> ContextScene:
        """Return a context from which nothing was removed yet."""
        none = gaussians[:0]
        nowhere = torch.zeros_like(gaussians.generated, dtype=torch.bool)
        none = replace(none, sh=none.sh[:, :1])
        return ContextScene(gaussians, rendered, index, nowhere, nowhere, nowhere, none)

    @cached_property
    def removed_pixels(self) -> dict[Hashable, Bool[Tensor, "h w"]]:
        """Known results of `find_removed` by camera: each takes a render of the whole scene."""
        return {}

    @property
    def stand_ins(self) -> Int64[Tensor, "n"]:
        """Rendered Gaussian that stands for each Gaussian, any one for those that are gone."""
        if self.rendered is not self.gaussians:
            return self.proxy_index
        return torch.arange(len(self.gaussians), device=self.gaussians.means.device)

    @property
    def removed_mask(self) -> Bool[Tensor, "n"]:
        """True for Gaussians that went with a removal: chosen ones, and revealed ones."""
        return self.chosen_mask | self.revealed_mask

    @property
    def gone_mask(self) -> Bool[Tensor, "n"]:
        """True for Gaussians that are not in the scene any more: removed or replaced."""
        return self.removed_mask | self.replaced_mask

    def leave_out(self, gone: Bool[Tensor, "m"]) -> ContextScene:
        """Return the context without some of the rendered Gaussians; the others are renumbered.

        The masks stay as they are: the caller knows whether what went was removed or replaced.
        """
        if len(gone) == 0:  # all were left out before
            return self
        # The new number of each rendered Gaussian: its place among those that stay. Those that are
        # gone take the number of one that is left, which nobody reads.
        number = ((~gone).cumsum(0) - 1).clamp_min(0)
        return replace(self, rendered=self.rendered[~gone], proxy_index=number[self.stand_ins])

    def expand(self, values: Shaped[Tensor, "m *c"]) -> Shaped[Tensor, "n *c"]:
        """Map values of rendered Gaussians to those they stand for; 0 for those that are gone."""
        if self.rendered is self.gaussians:
            return values
        if len(values) == 0:  # nothing is left that `proxy_index` could name
            return values.new_zeros((len(self.gaussians), *values.shape[1:]))
        expanded = values[self.proxy_index]
        expanded[self.gone_mask] = 0
        return expanded


@dataclass(frozen=True)
class ErrorBudget:
    """Largest error that the render of a photograph may have after additions."""

    view: View
    """The photograph; its ignored pixels do not count."""
    metric: Literal["mse", "dssim"]
    limit: float
