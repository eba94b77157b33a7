"""Records of a COLMAP model, binary or text: camera models, their parameters, and posed images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from gscompleter.data.cameras import Intrinsics, compute_rotation, invert_viewmat
from gscompleter.data.limits import MAX_COEFFICIENT, MAX_IN_PIXELS, MAX_SIDE
from gscompleter.data.undistort import Distortion, Projection
from gscompleter.errors import InputError, quote_value


class PosedImage(NamedTuple):
    """An image of a model."""

    name: str
    """Path below the folder of photographs, with forward slashes."""
    camera: int
    c2w: Float[np.ndarray, "4 4"]
    """Camera-to-world in OpenCV axes; world-to-camera where that cannot be inverted."""


def build_posed_image(name: str, camera: int, numbers: Sequence[float]) -> PosedImage:
    """Build an image from world-to-camera: a quaternion, real part first, and a translation."""
    viewmat = np.eye(4)
    viewmat[:3, :3] = compute_rotation(numbers[:4])
    viewmat[:3, 3] = numbers[4:]
    return PosedImage(name.replace("\\", "/"), camera, invert_viewmat(viewmat))


class Model(NamedTuple):
    """A camera model: its number in binary files, parameters and projection."""

    number: int
    names: str
    projection: Projection = "perspective"

    @property
    def parameters(self) -> list[str]:
        """Names of the parameters, in the order of the files."""
        return self.names.split()


MODELS = {
    "SIMPLE_PINHOLE": Model(0, "f cx cy"),
    "PINHOLE": Model(1, "fx fy cx cy"),
    "SIMPLE_RADIAL": Model(2, "f cx cy k1"),
    "RADIAL": Model(3, "f cx cy k1 k2"),
    "OPENCV": Model(4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": Model(5, "fx fy cx cy k1 k2 k3 k4", "equidistant"),
    "FULL_OPENCV": Model(6, "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    "FOV": Model(7, "fx fy cx cy omega", "field-of-view"),
    "SIMPLE_RADIAL_FISHEYE": Model(8, "f cx cy k1", "equidistant"),
    "RADIAL_FISHEYE": Model(9, "f cx cy k1 k2", "equidistant"),
    "THIN_PRISM_FISHEYE": Model(10, "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3", "equidistant"),
    "SIMPLE_DIVISION": Model(12, "f cx cy k", "division"),
    "DIVISION": Model(13, "fx fy cx cy k", "division"),
    "SIMPLE_FISHEYE": Model(14, "f cx cy", "equidistant"),
    "FISHEYE": Model(15, "fx fy cx cy", "equidistant"),
    "EUCM": Model(16, "fx fy cx cy alpha beta", "unified"),
}
"""Models by COLMAP's names; k4 to k6 of FULL_OPENCV are d1 to d3, sx1 and sy1 are s1 and s3."""

NUMBERS = {model.number: name for name, model in MODELS.items()}
_SHAPES = ("omega", "k", "alpha", "beta")
_IN_PIXELS = ("f", "fx", "fy", "cx", "cy")


def find_model(name: str | int, title: str) -> Model:
    """Return the model of a name or number."""
    known = NUMBERS.get(name) if isinstance(name, int) else name
    if known not in MODELS:
        raise InputError(
            f"The camera model {quote_value(str(name))} of {title} is not supported; undistort the "
            "photographs with `colmap image_undistorter`, which writes a PINHOLE model."
        )
    return MODELS[known]


def build_intrinsics(
    model: Model, size: tuple[int, int], numbers: Sequence[float], title: str
) -> Intrinsics:
    """Build the intrinsics and distortion of a camera, and check their range."""
    if not all(1 <= side <= MAX_SIDE for side in size):
        raise InputError(
            f"The size of {title} is {quote_value(size[0])} × {quote_value(size[1])}; sides from "
            f"1 to {MAX_SIDE} pixels are needed."
        )
    values = dict(zip(model.parameters, numbers, strict=True))
    for name, value in values.items():
        limit = MAX_IN_PIXELS if name in _IN_PIXELS else MAX_COEFFICIENT
        if not abs(value) <= limit:
            raise InputError(
                f"The parameter {name} of {title} is {value:g}; a number of at most {limit:g} is "
                "needed."
            )

    def select(*names: str) -> tuple[float, ...]:
        return tuple(values[name] for name in names if name in values)

    distortion = Distortion(
        model.projection,
        shape=select(*_SHAPES),
        radial=select("k1", "k2", "k3", "k4"),
        tangential=(values.get("p1", 0.0), values.get("p2", 0.0)),
        denominator=select("d1", "d2", "d3"),
        prism=(values.get("s1", 0.0), values.get("s3", 0.0)),
    )
    focal = values.get("fx", values.get("f")), values.get("fy", values.get("f"))
    return Intrinsics(size, focal, (values["cx"], values["cy"]), distortion=distortion)
