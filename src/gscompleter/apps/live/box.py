"""The box on the page: whatever it contains can be removed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import viser
from jaxtyping import Bool, Float
from torch import Tensor

from gscompleter.apps.inputs.removal import find_in_boxes
from gscompleter.apps.live.session import Session
from gscompleter.editing.removal import remove_gaussians
from gscompleter.system.errors import InputError

COLOR = (255, 80, 80)
HANDLE = 0.5
"""Length of the arrows, in page units."""

Numbers = tuple[float, ...]


class PageBox:
    """A box that is dragged and rotated on the page, and sized by three numbers."""

    def __init__(self, server: viser.ViserServer, position: np.ndarray) -> None:
        """Add the controls, hidden at first; `position` is in page units."""
        scene = server.scene
        gui = server.gui
        self.controls = scene.add_transform_controls(
            "/box", scale=HANDLE, position=position, visible=False
        )
        self.shown = gui.add_checkbox("Box", initial_value=False)
        self.size = gui.add_vector3("Size of the box", (1.0, 1.0, 1.0), step=0.01)
        outline = scene.add_box("/box/outline", COLOR, self.size.value, wireframe=True)
        self.shown.on_update(lambda _: setattr(self.controls, "visible", self.shown.value))
        self.size.on_update(lambda _: setattr(outline, "dimensions", self.size.value))

    def read(self, unit: float) -> tuple[Numbers, Numbers]:
        """Return the corners, in scene units, and the rotation, as `remove` takes them."""
        if not self.shown.value:
            raise InputError("Tick “Box”, drag it over what you want to remove, and press again.")
        center = np.array(self.controls.position)
        half = np.array(self.size.value) / 2
        # The box is in page units, and `remove` in those of the scene.
        corners = np.concatenate([center - half, center + half]) / unit
        return tuple(corners.tolist()), tuple(np.array(self.controls.wxyz).tolist())


def remove_in_box(session: Session, corners: Numbers, rotation: Numbers) -> tuple[Session, int]:
    """Remove all Gaussians in a box, in the frame of the result, and count them.

    Gaussians of the context that only they hid go with them.
    """
    state = session.latest
    scenes = session.completer.scenes

    def contains(points: Float[Tensor, "n 3"]) -> Bool[Tensor, "n"]:
        return find_in_boxes(points.double(), corners, rotation)

    # Of the context and of all that was added; what is gone already cannot go again.
    inside = [contains(part.means) for part in (state.context, *state.parts[1:])]
    context = inside[0] & ~state.source.gone_mask
    if not any(mask.any() for mask in (context, *inside[1:])):
        raise InputError("The box contains nothing; drag it, or make it larger.")
    # What is removed from the context is marked, so that its hole may be filled. What was added is
    # simply taken out.
    added = [part[~mask] for part, mask in zip(state.parts[1:], inside[1:], strict=True)]
    parts = (state.rendered_context, *added)
    config = state.config.for_removal()
    begun = replace(state, parts=parts, config=config)
    changed = remove_gaussians(begun, context, contains, scenes)
    gone = changed.source.gone_mask & ~state.source.gone_mask
    count = sum(int(mask.sum()) for mask in (gone, *inside[1:]))
    return replace(session, completions=(*session.completions, changed)), count
