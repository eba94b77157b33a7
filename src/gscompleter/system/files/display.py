"""Values that print as one line, and in a notebook as that line with their pictures."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from html import escape

from PIL import Image
from torch import Tensor

from gscompleter.system.files.image import SHOWN_JPEG_QUALITY, convert_to_pixels, encode_jpeg

MAX_NOTEBOOK_SIDE = 480
"""Longer side of a picture in a notebook, in pixels."""
FIGURE = "display:inline-block;margin:2px 6px 2px 0;font:12px sans-serif"


class Displayed:
    """A value with tensors, of which neither `print` nor a notebook writes out the numbers."""

    def summarize(self) -> str:
        """Describe the value in a few words, for people."""
        raise NotImplementedError

    def list_pictures(self) -> Mapping[str, Tensor]:
        """List pictures of the value by their captions: colours [h, w, 3] or grey [h, w]."""
        return {}

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.summarize()})"

    def _repr_html_(self) -> str:
        """Return what a notebook shows: the line, and the pictures below it."""
        figures = [embed_picture(image, text) for text, image in self.list_pictures().items()]
        return f"<div><code>{escape(repr(self))}</code></div>" + "".join(figures)


def embed_picture(image: Tensor, caption: str) -> str:
    """Write a picture [h, w, 3] or [h, w] in [0, 1] as HTML that loads nothing."""
    picture = Image.fromarray(convert_to_pixels(image)).convert("RGB")
    # The picture is scaled down in place, and never enlarged.
    picture.thumbnail((MAX_NOTEBOOK_SIDE, MAX_NOTEBOOK_SIDE))
    content = base64.b64encode(encode_jpeg(picture, SHOWN_JPEG_QUALITY)).decode()
    text = escape(caption)
    return (
        f'<figure style="{FIGURE}"><img alt="{text}" width="{picture.width}" '
        f'height="{picture.height}" src="data:image/jpeg;base64,{content}">'
        f"<figcaption>{text}</figcaption></figure>"
    )
