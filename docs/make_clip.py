"""Make docs/flight.webp, the clip of the README: a flight through the demo before and after.

python docs/make_clip.py

It shows nothing but renders of the Middlebury motorcycle pair, which scikit-image contains and
redistributes.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

from PIL import Image

import gscompleter as gsc
from gscompleter.apps.report.film import choose_stops, plan_camera_path, render_frames
from gscompleter.render.loading import load_renderer

RESOLUTION = (250, 370)
FRAMES_A_LEG = 18
FRAME_MS = 70
QUALITY = 62
MAX_BYTES = 2_000_000


def main() -> None:
    """Complete the motorcycle for both targets of the demo, and film the flight between them."""
    with tempfile.TemporaryDirectory() as folder:
        scene = gsc.write_demo_scene(Path(folder) / "scene")
        views = gsc.load_views(scene, resolution=RESOLUTION)
        targets = gsc.load_cameras(scene / "targets.json", resolution=RESOLUTION)
    completion = gsc.GSCompleter()(views, targets)
    cameras = plan_camera_path(
        choose_stops(completion), [view.camera for view in views], FRAMES_A_LEG
    )
    frames = [
        Image.fromarray(frame) for frame in render_frames(completion, cameras, load_renderer("cpu"))
    ]
    path = Path(__file__).with_name("flight.webp")
    frames[0].save(
        path,
        save_all=True,
        append_images=frames[1:],
        duration=FRAME_MS,
        loop=0,
        quality=QUALITY,
        method=6,
    )
    size = path.stat().st_size
    if size > MAX_BYTES:
        raise SystemExit(f"{path} has {size:,} bytes, more than {MAX_BYTES:,}; lower QUALITY.")
    print(f"{path}: {len(frames)} frames, {size:,} bytes")


if __name__ == "__main__":
    main()
