"""Checks that masks mean what their reader takes them for, before anything is computed with them.

Programs do not agree what white means: COLMAP's masks are black where a photograph is ignored,
those of segmentation programs are white on the thing that was clicked. Only their size tells them
apart: what is ignored, removed or repaired is seldom more than half of what a camera sees.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from statistics import median

import numpy as np
from jaxtyping import Bool

from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.masks import hides_white, read_ignored
from gscompleter.data.photographs import Photographs
from gscompleter.numerics.sampling import sample_evenly
from gscompleter.system.errors import InputError, join_names
from gscompleter.system.files.image import read_mask

MAX_TAKEN = 0.5
"""Largest share, of its image or of the splat, that a mask takes away without being asked about."""
MAX_READ = 16
"""Most masks that are read for a check, at even steps of all."""
MAX_NAMED_MASKS = 2
"""Masks or folders that a sentence names."""
MAX_MASK_NAME_LENGTH = 50


def are_probably_inverted(shares: Sequence[float]) -> bool:
    """Decide whether masks are probably the other way round: most take away more than half.

    Args:
        shares: What each mask takes away, as a share of its image or of the splat.
    """
    large = [share for share in shares if share > MAX_TAKEN]
    return 2 * len(large) > len(shares)


def read_masks_as_asked(photographs: Photographs, reading: MaskReading) -> Photographs:
    """Check the masks of photographs, and return the photographs with masks as `reading` says.

    What an alpha channel hides is certain: it is neither checked nor inverted.
    """
    check_hiding_masks(photographs.list_masks(), reading, len(photographs))
    return photographs.invert_masks() if reading.ignores_white else photographs


def refuse_nothing_to_invert(masks: Sequence[Path], reading: MaskReading) -> None:
    """Refuse to invert the masks of photographs where none is used."""
    if reading.is_inverted and not masks:
        raise InputError(
            "No mask is used for the photographs that could be read the other way round (an alpha "
            "channel always hides what is transparent); leave it out.",
            "invert-masks",
        )


def check_hiding_masks(masks: Sequence[Path], reading: MaskReading, num_photographs: int) -> None:
    """Refuse masks that hide all of all photographs, or more than half of most of theirs.

    A mask that hides a whole photograph leaves it out, which tells nothing of the others.
    """
    if reading.may_be_large or not masks:
        return
    # All of them are read only where each mask of the sample hides its whole photograph.
    shares = measure_hidden(sample_evenly(masks, MAX_READ), reading) or measure_hidden(
        masks, reading
    )
    if not shares and len(masks) < num_photographs:
        return  # photographs without a mask are left
    places = name_masks(path.parent for path in masks)
    # The names of some masks may turn them.
    are_white = {hides_white(path, reading.ignores_white) for path in masks}
    color = " or ".join("white" if is_white else "black" for is_white in sorted(are_white))
    if not shares:
        raise InputError(
            f"The masks of the photographs ({places}) are {color} everywhere, and what is {color} "
            f"is ignored, so that nothing would be left; {name_ways_out(reading, hides=True)}"
        )
    if are_probably_inverted(shares):
        raise InputError(
            f"Masks hide {format_share(shares)} of the photographs ({places}), where what is "
            f"{color} is ignored; {name_ways_out(reading, hides=True)}"
        )


def check_selecting_masks(masks: Sequence[Path], reading: MaskReading, images: str) -> None:
    """Refuse masks of what goes that select nothing, or more than half of most of their images.

    A mask that selects nothing is of an image that does not show the thing. `images` are what the
    masks are of, for errors.
    """
    # All of them are read only where no mask of the sample selects anything.
    shares = measure_selected(sample_evenly(masks, MAX_READ), reading) or measure_selected(
        masks, reading
    )
    taken = "black" if reading.is_inverted else "white"
    left = "white" if reading.is_inverted else "black"
    if not shares:
        raise InputError(
            f"{name_masks(masks)} {'is' if len(masks) == 1 else 'are'} {left} everywhere, and what "
            f"masks show {taken} goes; paint {taken} what is to go.",
            "mask",
        )
    if not reading.may_be_large and are_probably_inverted(shares):
        raise InputError(
            f"Masks ({name_masks(masks)}) select {format_share(shares)} of {images}, where what is "
            f"{taken} goes; {name_ways_out(reading)}"
        )


def check_selected_share(share: float, reading: MaskReading) -> None:
    """Refuse masks that select more than half of the Gaussians of a splat."""
    if not reading.may_be_large and are_probably_inverted([share]):
        taken = "black" if reading.is_inverted else "white"
        raise InputError(
            f"The masks select {format_share([share])} of the Gaussians of the splat, where what "
            f"is {taken} goes; {name_ways_out(reading)}"
        )


def measure_hidden(masks: Iterable[Path], reading: MaskReading) -> list[float]:
    """Measure the shares that masks hide of their photographs; without those that hide all."""
    shares = [float(read_ignored(path, reading.ignores_white).mean()) for path in masks]
    return [share for share in shares if share < 1.0]


def measure_selected(masks: Iterable[Path], reading: MaskReading) -> list[float]:
    """Measure the shares that masks select of their images; without those that select nothing."""
    shares = [float(read_selected(path, reading).mean()) for path in masks]
    return [share for share in shares if share > 0.0]


def read_selected(
    stored: Path | bytes, reading: MaskReading, name: str = ""
) -> Bool[np.ndarray, "h w"]:
    """Read the pixels of a mask that say what goes: white ones, or black ones if inverted.

    `name` stands for the mask in errors if `stored` are bytes.
    """
    black = read_mask(stored, name)
    return black if reading.is_inverted else ~black


def name_ways_out(reading: MaskReading, hides: bool = False) -> str:
    """Name the options that turn masks, or take them as they are.

    `hides` is True for masks of what is ignored in photographs, which can be left out, too.
    """
    turn = "leave --invert-masks out" if reading.is_inverted else "add --invert-masks"
    if not reading.is_turned_by_option:
        turn = "save them in the other colours"
    rest = ", or --no-masks to use all pixels" if hides else ""
    return f"if it is the other way round, {turn}; if it is meant so, add --large-masks{rest}."


def name_masks(paths: Iterable[Path]) -> str:
    """Name the first of the masks, or of their folders, each once."""
    return join_names(list(dict.fromkeys(paths)), MAX_NAMED_MASKS, MAX_MASK_NAME_LENGTH)


def format_share(shares: Sequence[float]) -> str:
    """Format the median of shares as a percentage.

    It is above `MAX_TAKEN` wherever most shares are, which a mean need not be.
    """
    return f"{100 * median(shares):.0f} %"
