"""Picture of the worst thin gaps of a case, magnified and labelled."""

from __future__ import annotations

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from gscompleter.evaluation.metrics.thin_gaps import WINDOW, WorstGap
from gscompleter.numerics.image_ops import paint_marked
from gscompleter.system.files.image import convert_to_pixels

PIXEL_ZOOM = 4
"""Pixels of the picture for each one of the window."""
LABEL_HEIGHT = 52
"""Height of two lines of text, in pixels."""
FONT_SIZE = 18
NOTHING_THIN = "No thin gaps at the target\nor near it"


def draw_gap(worst: WorstGap | None) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the worst place as it is rendered, and beside it with its gaps in magenta.

    A line above them says where it is, and how much of it are gaps. Without thin gaps there are
    only words that say so.
    """
    side = PIXEL_ZOOM * WINDOW
    height = LABEL_HEIGHT + (0 if worst is None else side)
    canvas = Image.new("RGB", (2 * side, height), "white")
    label = NOTHING_THIN if worst is None else f"Thin gaps: {worst.describe()}"
    font = ImageFont.load_default(FONT_SIZE)
    ImageDraw.Draw(canvas).text((4, LABEL_HEIGHT // 2), label, "black", font, anchor="lm")
    if worst is not None:
        # Each pixel becomes a square: smoothed, a gap of one pixel would look like a shade.
        marked = paint_marked(worst.crop, worst.gaps)
        for number, crop in enumerate((worst.crop, marked)):
            shown = Image.fromarray(convert_to_pixels(crop))
            shown = shown.resize((side, side), Image.Resampling.NEAREST)
            canvas.paste(shown, (number * side, LABEL_HEIGHT))
    return np.array(canvas)
