"""The training frame of nerfstudio, from the `dataparser_transforms.json` of a run."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float

from gscompleter.data.json_numbers import get_array, get_number
from gscompleter.data.poses import find_pose_defect
from gscompleter.errors import InputError, quote_value
from gscompleter.io.json_file import read_json

SCALE_RANGE = (1e-9, 1e9)


def read_dataparser_transforms(path: Path) -> Float[np.ndarray, "4 4"]:
    """Read the similarity from the reconstruction's frame to that of the trained scene.

    The file holds a rigid 3×4 `transform` and a `scale` that multiplies its result.
    """
    content = read_json(path, "copy it from the folder of the nerfstudio run again")
    if not isinstance(content, dict):
        raise InputError(
            f"{quote_value(path)} is no object with `transform` and `scale`; copy it again."
        )
    rigid = np.vstack([get_array(content, "transform", (3, 4), str(path)), [0, 0, 0, 1]])
    defect = find_pose_defect(rigid)
    if defect is not None:
        raise InputError(
            f"The `transform` of {quote_value(path)} cannot be used: {defect}; copy it again."
        )
    scale = get_number(content, "scale", str(path), *SCALE_RANGE)
    return np.diag([scale, scale, scale, 1.0]) @ rigid
