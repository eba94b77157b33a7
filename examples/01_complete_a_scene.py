"""Complete a scene and step through what happened.

    python examples/01_complete_a_scene.py SCENE 0 4 8

SCENE is a folder with a nerfstudio transforms.json; the numbers are two context frames and the
target frame.
"""

import sys
from pathlib import Path

import gscompleter as gsc
from gscompleter.system.files.image import write_image


def main() -> None:
    scene, first, second, target = sys.argv[1], *map(int, sys.argv[2:5])
    views = gsc.load_views(scene, frames=[first, second], resolution=256)
    camera = gsc.load_camera(scene, frame=target, resolution=256)

    completion = gsc.GSCompleter()(views, camera)
    (result,) = completion.targets
    print(f"{100 * result.hole_fraction:.1f} % of the target's pixels were a hole.")
    print(f"The anchor is context view {result.anchor}; its affine: {result.affine}.")
    print(f"{len(completion.added):,} Gaussians joined {len(completion.context):,}.")
    for stage, seconds in completion.seconds.items():
        print(f"{stage:>10}: {seconds:.2f} s")

    gsc.save_ply("completed.ply", completion.scene)
    write_image(Path("before.png"), result.before.image)
    write_image(Path("after.png"), result.after.image)


if __name__ == "__main__":
    main()
