"""MoGe-3 (2026): metric depth of single photographs, by its own package.

Its refinement needs a GPU of NVIDIA, and is left out elsewhere. The calls are those of its users;
tested with a stand-in of the same interface.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from gscompleter.models.packages import choose_weights, import_authors_module
from gscompleter.system.errors import InputError, quote_value
from gscompleter.types import DepthMap, View

INSTALL = "pip install git+https://github.com/microsoft/MoGe.git"
REFINE_STEPS = 3
"""Steps of the sparse refinement on a GPU, as its users take."""
REPOSITORIES = {
    "moge-3-large": "Ruicheng/moge-3-vitl",
    "moge-3-giant": "Ruicheng/moge-3-vitg",
}
"""Weights on the Hugging Face hub (MIT) by name."""


@dataclass(frozen=True)
class MoGe3:
    """Metric depth of single views."""

    model: Any
    """A `MoGeModel` of the package, on `device`."""
    device: str = "cpu"

    def __call__(self, view: View) -> DepthMap:
        """Predict z-depth in metres; raise InputError if the answer has another shape."""
        image = view.image.detach().permute(2, 0, 1).float().to(self.device)
        camera = view.camera
        fov_x = math.degrees(2 * math.atan(camera.width / (2 * camera.K[0, 0].item())))
        is_refined = self.device.startswith("cuda")
        with torch.no_grad():
            answer = self.model.infer(
                image, fov_x=fov_x, refine_steps=REFINE_STEPS if is_refined else 0
            )
        depth = answer["depth"].detach().float()
        mask = answer["mask"].detach() > 0
        size = (camera.height, camera.width)
        if tuple(depth.shape) != size or tuple(mask.shape) != size:
            raise InputError(
                f"MoGe-3 answered an image of {size[0]} x {size[1]} by depths of "
                f"{list(depth.shape)}; install the version of {INSTALL}."
            )
        # Pixels without a surface, such as the sky, are infinite.
        valid = mask & depth.isfinite() & (depth > 0)
        device = view.image.device
        filled = torch.where(valid, depth, torch.ones_like(depth))
        return DepthMap(filled.to(device), valid.to(device))


def load_moge3(name: str, weights: Path | None = None, device: str = "cpu") -> MoGe3:
    """Load a published size, or a file `model.pt`; raise InputError if it cannot be loaded."""
    place = choose_weights(weights, REPOSITORIES[name], "depth_weights", "file")
    moge = import_authors_module("moge.model.v3", f"The depth '{name}'", INSTALL, "depth")
    try:
        model = moge.MoGeModel.from_pretrained(place)
    except Exception as error:  # the hub, torch and the package have errors of their own
        raise InputError(
            f"MoGe-3 was not loaded from {quote_value(place)} ({type(error).__name__}); name its "
            "file model.pt.",
            "depth_weights",
        ) from error
    return MoGe3(model.to(device).eval(), device)
