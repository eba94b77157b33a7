"""Marks of a session of `live` as the page sends them."""

import io

import numpy as np
from PIL import Image


def make_mark(size: int, rows: slice, columns: slice) -> bytes:
    """Make the PNG of a square mask that is white in some rows and columns."""
    pixels = np.zeros((size, size), dtype=np.uint8)
    pixels[rows, columns] = 255
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, format="PNG")
    return file.getvalue()
