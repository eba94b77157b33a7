"""Self-contained HTML pages: one file with style, script and images.

Templates escape all text. A content security policy blocks all requests and other scripts.
"""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from gscompleter import __version__
from gscompleter.apps.report.plain_words import format_change, format_number, format_percent
from gscompleter.io.image import encode_jpeg, read_image_size, read_pixels

REPORT_FILE = "report.html"
JPEG_QUALITY = 85
MAX_PAGE_PIXELS = 12_000_000
"""Largest sum of image pixels in a page (about 5 MB); more are scaled down."""


@dataclass(frozen=True)
class Picture:
    """An embedded image."""

    alt: str
    width: int
    height: int
    uri: str


@dataclass(frozen=True)
class Gallery:
    """Images of a folder, embedded at one scale."""

    folder: Path
    scale: float = 1.0

    def embed(self, name: str, alt: str) -> Picture:
        """Embed an image as a JPEG; raise an InputError if it is missing or damaged."""
        image = Image.fromarray(read_pixels(self.folder / f"{name}.png"))
        if self.scale < 1:
            width, height = (max(1, round(self.scale * side)) for side in image.size)
            image = image.resize((width, height), Image.Resampling.LANCZOS)
        content = base64.b64encode(encode_jpeg(image, JPEG_QUALITY)).decode()
        return Picture(alt, *image.size, f"data:image/jpeg;base64,{content}")

    def has(self, name: str) -> bool:
        """Return True if there is an image of this name."""
        return (self.folder / f"{name}.png").is_file()


def open_gallery(folder: Path) -> Gallery:
    """Choose a scale at which all images of `folder` fit into a page."""
    sizes = [read_image_size(path) for path in folder.glob("*.png")]
    pixels = sum(width * height for width, height in sizes)
    return Gallery(folder, min(1.0, (MAX_PAGE_PIXELS / max(pixels, 1)) ** 0.5))


def render_template(template: str, values: Mapping[str, object]) -> str:
    """Render a template with style and script."""
    environment = create_environment()
    script = environment.get_template("script.js").render()
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    shared = {"version": __version__, "script": Markup(script), "digest": digest}
    return environment.get_template(template).render(**shared, **values)


@cache
def create_environment() -> Environment:
    """Create the template environment: escapes all text, refuses unknown names."""
    environment = Environment(
        loader=PackageLoader(__package__),
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
