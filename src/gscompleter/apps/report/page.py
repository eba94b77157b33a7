"""Self-contained HTML pages: one file with style, script and images.

Templates escape all text. A content security policy blocks all requests and other scripts.
"""

from __future__ import annotations

import base64
import hashlib
import io
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib.resources import files
from pathlib import Path

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from gscompleter import __version__
from gscompleter.apps.report.plain_words import format_change, format_number, format_percent
from gscompleter.errors import InputError
from gscompleter.io.files import replace_file
from gscompleter.io.image import encode_jpeg, read_image_size, read_pixels

REPORT_FILE = "report.html"
JPEG_QUALITY = 85
MAX_PAGE_PIXELS = 12_000_000
"""Largest sum of image pixels in a page (about 5 MB); more are scaled down."""


@dataclass(frozen=True)
class Picture:
    """An embedded image, or the reason why it is missing."""

    alt: str
    width: int = 0
    height: int = 0
    uri: str | None = None
    missing: str | None = None


@dataclass(frozen=True)
class Slider:
    """Two images of one camera with a movable border."""

    before: Picture
    after: Picture
    label: str


@dataclass(frozen=True)
class Gallery:
    """Images of a folder, embedded at one scale."""

    folder: Path
    scale: float = 1.0

    def embed(self, name: str, alt: str, exact: bool = False) -> Picture:
        """Embed an image as a JPEG, or a mask, depth image or plot (`exact`) as a PNG."""
        try:
            image = Image.fromarray(read_pixels(self.folder / name))
        except InputError:
            return Picture(alt, missing=f"{name} is missing or damaged.")
        image = scale_image(image, self.scale, exact)
        return Picture(alt, *image.size, uri=encode_image(image, exact))

    def has(self, name: str) -> bool:
        """Return True if there is a file of this name."""
        return (self.folder / name).is_file()

    def embed_slider(self, name: str, label: str, exact: bool = False) -> Slider:
        """Embed an image before and after."""
        before, after = (
            self.embed(f"{name}_{when}.png", f"{label}, {when}", exact)
            for when in ("before", "after")
        )
        return Slider(before, after, label)


def open_gallery(folder: Path) -> Gallery:
    """Choose a scale at which all images of `folder` fit into a page."""
    pixels = 0
    for path in sorted(folder.glob("*.png")):
        try:
            width, height = read_image_size(path)
        except InputError:
            continue
        pixels += width * height
    return Gallery(folder, min(1.0, (MAX_PAGE_PIXELS / max(pixels, 1)) ** 0.5))


def scale_image(image: Image.Image, scale: float, exact: bool) -> Image.Image:
    """Scale an image, without interpolation if `exact`."""
    if scale == 1:
        return image
    size = (max(1, round(image.width * scale)), max(1, round(image.height * scale)))
    return image.resize(size, Image.Resampling.NEAREST if exact else Image.Resampling.LANCZOS)


def encode_image(image: Image.Image, exact: bool) -> str:
    """Encode an image as a data URI: a JPEG, or a PNG if `exact`, with a palette if it can."""
    if not exact:
        return encode_uri("image/jpeg", encode_jpeg(image, JPEG_QUALITY))
    file = io.BytesIO()
    image = image.quantize(256) if image.getcolors(256) else image
    image.save(file, format="PNG", compress_level=6)
    return encode_uri("image/png", file.getvalue())


def encode_uri(kind: str, content: bytes) -> str:
    """Encode the content of a file as a data URI."""
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def render_template(template: str, values: Mapping[str, object]) -> str:
    """Render a template with style and script."""
    style, script = read_template("style.css"), read_template("script.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    shared = {"style": Markup(style), "script": Markup(script), "digest": digest}
    page = create_environment().get_template(template)
    return page.render(version=__version__, **shared, **values)


def write_page(folder: Path, page: str) -> None:
    """Write `report.html`."""
    with replace_file(folder / REPORT_FILE) as file:
        file.write(page.encode())


@cache
def create_environment() -> Environment:
    """Create the template environment: escapes all text, refuses unknown names."""
    environment = Environment(
        loader=FunctionLoader(read_template),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {
        "number": format_number,
        "percent": format_percent,
        "change": format_change,
        "count": "{:,}".format,
    }
    return environment


def read_template(name: str) -> str:
    """Read a file of the folder `templates`."""
    return files(__package__).joinpath("templates").joinpath(name).read_text(encoding="utf-8")
