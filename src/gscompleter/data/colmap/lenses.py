"""COLMAP's camera models as pinhole intrinsics and distortion."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from gscompleter.data.cameras import Intrinsics
from gscompleter.data.limits import MAX_COEFFICIENT, MAX_IN_PIXELS, MAX_SIDE
from gscompleter.data.undistort import Distortion, Projection
from gscompleter.errors import InputError, quote_value


@dataclass(frozen=True)
class Model:
    """A camera model: its number in binary files, parameters and projection."""

    number: int
    parameters: tuple[str, ...]
    projection: Projection = "perspective"


def _define_model(number: int, parameters: str, projection: Projection = "perspective") -> Model:
    return Model(number, tuple(parameters.split()), projection)


MODELS = {
    "SIMPLE_PINHOLE": _define_model(0, "f cx cy"),
    "PINHOLE": _define_model(1, "fx fy cx cy"),
    "SIMPLE_RADIAL": _define_model(2, "f cx cy k1"),
    "RADIAL": _define_model(3, "f cx cy k1 k2"),
    "OPENCV": _define_model(4, "fx fy cx cy k1 k2 p1 p2"),
    "OPENCV_FISHEYE": _define_model(5, "fx fy cx cy k1 k2 k3 k4", "equidistant"),
    "FULL_OPENCV": _define_model(6, "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3"),
    "FOV": _define_model(7, "fx fy cx cy omega", "field-of-view"),
    "SIMPLE_RADIAL_FISHEYE": _define_model(8, "f cx cy k1", "equidistant"),
    "RADIAL_FISHEYE": _define_model(9, "f cx cy k1 k2", "equidistant"),
    "THIN_PRISM_FISHEYE": _define_model(10, "fx fy cx cy k1 k2 p1 p2 k3 k4 s1 s3", "equidistant"),
    "SIMPLE_DIVISION": _define_model(12, "f cx cy k", "division"),
    "DIVISION": _define_model(13, "fx fy cx cy k", "division"),
    "SIMPLE_FISHEYE": _define_model(14, "f cx cy", "equidistant"),
    "FISHEYE": _define_model(15, "fx fy cx cy", "equidistant"),
    "EUCM": _define_model(16, "fx fy cx cy alpha beta", "unified"),
}
"""Models by COLMAP's names; k4 to k6 of FULL_OPENCV are d1 to d3, sx1 and sy1 are s1 and s3."""

NUMBERS = {model.number: name for name, model in MODELS.items()}

_SHAPES = ("omega", "k", "alpha", "beta")
_CENTERS = ("f", "fx", "fy", "cx", "cy")


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
            "1 to "
            f"{MAX_SIDE} pixels are needed."
        )
    values = dict(zip(model.parameters, numbers, strict=True))
    for name, value in values.items():
        limit = MAX_IN_PIXELS if name in _CENTERS else MAX_COEFFICIENT
        if not abs(value) <= limit:
            raise InputError(
                f"The parameter {name} of {title} is {value:g}; a number of at most {limit:g} is "
                "needed."
            )
    focal = values.get("f", values.get("fx", 0.0)), values.get("f", values.get("fy", 0.0))
    center = values["cx"], values["cy"]
    return Intrinsics(size, focal, center, distortion=_build_distortion(model, values))


def _build_distortion(model: Model, values: dict[str, float]) -> Distortion:
    def select(*names: str) -> tuple[float, ...]:
        return tuple(values[name] for name in names if name in values)

    return Distortion(
        model.projection,
        shape=select(*_SHAPES),
        radial=select("k1", "k2", "k3", "k4"),
        tangential=(values.get("p1", 0.0), values.get("p2", 0.0)),
        denominator=select("d1", "d2", "d3"),
        prism=(values.get("s1", 0.0), values.get("s3", 0.0)),
    )
