"""Make docs/teaser.jpg, the picture of the README: the demo's second target before and after.

python docs/make_teaser.py
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from PIL import Image

import gscompleter as gsc
from gscompleter.apps.report.film import draw_corner_label
from gscompleter.data.demo_scene import write_motorcycle_scene
from gscompleter.system.files.image import convert_to_pixels

RESOLUTION = (500, 740)
GAP_PX = 8


def main() -> None:
    """Complete the motorcycle for a camera to the right of both photographs, and save the pair."""
    with tempfile.TemporaryDirectory() as folder:
        scene = Path(folder) / "scene"
        write_motorcycle_scene(scene)
        views = gsc.load_views(scene, frames=[0, 1], resolution=RESOLUTION)
        target = gsc.load_cameras(scene / "targets.json", resolution=RESOLUTION)[1]
    result = gsc.GSCompleter()(views, target).targets[0]
    images = {"two photographs": result.before, "completed": result.after}
    pictures = [
        draw_corner_label(convert_to_pixels(render.image), name) for name, render in images.items()
    ]
    gap = np.full((RESOLUTION[0], GAP_PX, 3), 255, dtype=np.uint8)
    pair = np.concatenate([pictures[0], gap, pictures[1]], axis=1)
    Image.fromarray(pair).save(Path(__file__).with_name("teaser.jpg"), quality=88)


if __name__ == "__main__":
    main()
