"""The .splat format: 32 bytes per Gaussian, no header, no view-dependent colour.

Position and linear scale are float32, colour and opacity one byte each. The wxyz rotation has one
byte per component, from -1 at 0 to 1 at 256.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from gscompleter.splats.packing import assemble_sh, build_gaussians
from gscompleter.splats.splat_format import FormatTexts, SplatFormat
from gscompleter.system.damage import DamagedError
from gscompleter.system.files.reading import read_bytes
from gscompleter.system.files.writing import replace_file
from gscompleter.types import SH_C0, Gaussians

ROW = np.dtype([("mean", "<f4", 3), ("scale", "<f4", 3), ("rgba", "u1", 4), ("quat", "u1", 4)])


def read_splat_rows(path: Path) -> Gaussians:
    """Read a .splat."""
    data = read_bytes(path)
    whole, rest = divmod(len(data), ROW.itemsize)
    if rest > 0:
        raise DamagedError(
            f"it ends after {whole:,} Gaussians, within the next one, which has {ROW.itemsize} "
            f"bytes and not {rest}"
        )
    rows = np.frombuffer(data, ROW)
    rgba = rows["rgba"].astype(np.float32) / 255
    quats = (rows["quat"].astype(np.float32) - 128) / 128
    return build_gaussians(rows["mean"], quats, rows["scale"], rgba[:, 3], assemble_sh(rgba[:, :3]))


def write_splat(path: Path, gaussians: Gaussians) -> None:
    """Write a .splat, without SH of degree 1 and above."""
    rows = np.empty(len(gaussians), ROW)
    rows["mean"] = gaussians.means.numpy()
    rows["scale"] = gaussians.scales.numpy()
    rgb = 0.5 + SH_C0 * gaussians.sh[:, 0].numpy()
    rgba = np.concatenate([rgb, gaussians.opacities.numpy()[:, None]], axis=1)
    rows["rgba"] = np.rint(np.clip(rgba, 0, 1) * 255)
    quats = gaussians.quats.numpy()
    unit = quats / np.linalg.norm(quats, axis=1, keepdims=True)
    rows["quat"] = np.clip(np.rint(unit * 128 + 128), 0, 255)
    with replace_file(path) as file:
        file.write(rows.view(np.uint8).data)


SPLAT = SplatFormat(
    name="splat",
    endings=(".splat",),
    texts=FormatTexts(precision="8 bits of colour, opacity and rotation; no harmonics"),
    read=read_splat_rows,
    write=write_splat,
    holds_harmonics=False,
)
