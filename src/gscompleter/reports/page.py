"""Pages that need nothing but themselves: one HTML file with its style, script and pictures inside.

Whatever text a page shows, the template escapes. A policy in the page lets it load nothing and run
no script but its own.
"""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from gscompleter import __version__
from gscompleter.errors import InputError
from gscompleter.io.files import replacing
from gscompleter.io.image import image_size, jpeg_of, read_pixels

NAME = "report.html"
"""The file in the output folder."""
QUALITY = 85
"""Of the JPEGs in a page, of 100."""
MAX_PIXELS = 12_000_000
"""Of all pictures of a page together, about 5 MB; where there are more, all are shrunk alike."""


@dataclass(frozen=True)
class Picture:
    """A picture in a page, or the reason why there is none."""

    alt: str
    width: int = 0
    height: int = 0
    uri: str | None = None
    missing: str | None = None
    """A sentence where the file is missing or damaged."""


@dataclass(frozen=True)
class Slider:
    """Two pictures of one camera, one over the other."""

    before: Picture
    after: Picture
    label: str
    """What the slider compares."""


@dataclass(frozen=True)
class Table:
    """Rows of text under a head; the first cell of a row is its head."""

    caption: str
    head: Sequence[str]
    rows: Sequence[Sequence[str]]


@dataclass(frozen=True)
class Gallery:
    """The pictures of a folder, embedded at one scale."""

    folder: Path
    scale: float = 1.0

    def photo(self, name: str, alt: str) -> Picture:
        """A picture in true colours, as a JPEG."""
        return self._embedded(name, alt, exact=False)

    def exact(self, name: str, alt: str) -> Picture:
        """A mask, a picture of depth or a plot, as a PNG."""
        return self._embedded(name, alt, exact=True)

    def slider(self, name: str, label: str, exact: bool = False) -> Slider:
        """The pictures called `name` before and after."""
        before, after = (
            self._embedded(f"{name}_{when}.png", f"{label}, {when}", exact)
            for when in ("before", "after")
        )
        return Slider(before, after, label)

    def _embedded(self, name: str, alt: str, exact: bool) -> Picture:
        try:
            image = Image.fromarray(read_pixels(self.folder / name))
        except InputError:
            return Picture(alt, missing=f"{name} is missing or damaged.")
        image = shrunk(image, self.scale, exact)
        return Picture(alt, *image.size, uri=data_uri(image, exact))


def gallery_of(folder: Path) -> Gallery:
    """The pictures of `folder`, at a scale at which all of them fit into a page."""
    pixels = 0
    for path in sorted(folder.glob("*.png")):
        try:
            width, height = image_size(path)
        except InputError:
            continue
        pixels += width * height
    return Gallery(folder, min(1.0, (MAX_PIXELS / max(pixels, 1)) ** 0.5))


def shrunk(image: Image.Image, scale: float, exact: bool) -> Image.Image:
    """`image` at `scale`; what is exact gets no colours between others."""
    if scale == 1:
        return image
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image.resize(size, Image.Resampling.NEAREST if exact else Image.Resampling.LANCZOS)


def data_uri(image: Image.Image, exact: bool) -> str:
    """`image` as the address of itself: a PNG where it is exact, else a JPEG."""
    kind, content = ("png", png_of(image)) if exact else ("jpeg", jpeg_of(image, QUALITY))
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def png_of(image: Image.Image) -> bytes:
    """`image` as a PNG file, by a palette where it has few colours."""
    file = io.BytesIO()
    colours = image.getcolors(256)
    (image.quantize(256) if colours else image).save(file, format="PNG", compress_level=6)
    return file.getvalue()


def rendered(template: str, values: Mapping[str, object]) -> str:
    """The page that a template makes of `values`."""
    style, script = part("style.css"), part("script.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    shared = {"style": Markup(style), "script": Markup(script), "digest": digest}
    return environment().get_template(template).render(version=__version__, **shared, **values)


def write_page(folder: Path, page: str) -> None:
    """Write `report.html`.

    Raises:
        InputError: where it cannot be written.
    """
    with replacing(folder / NAME) as file:
        file.write(page.encode())


@cache
def environment() -> Environment:
    """Reads templates that escape all text, and know no value that is not given."""
    return Environment(
        loader=FunctionLoader(part),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def part(name: str) -> str:
    """A file of the folder `templates`."""
    return files(__package__).joinpath("templates").joinpath(name).read_text(encoding="utf-8")
