"""Two photographs of the room, and what they show of it at a target."""

from dataclasses import replace

from gscompleter import load_renderer
from gscompleter.types import GeneratorInput, merge
from scenes import Room, camera_at, gaussians_of, view_of

SIZE = 96

TARGET = camera_at(0.7, yaw=12, size=SIZE)


def known_room(gain: float = 1.0) -> GeneratorInput:
    """Two photographs and the scene they give, as seen by them and by the target."""
    views = [view_of(Room(), camera_at(x, size=SIZE)) for x in (-0.3, 0.1)]
    views[0] = replace(views[0], image=gain * views[0].image)
    scene = merge([gaussians_of(view) for view in views])
    renderer = load_renderer("cpu")
    return GeneratorInput(
        tuple(views),
        tuple(renderer.render(scene, view.camera) for view in views),
        renderer.render(scene, TARGET),
    )
