"""Two nodes: the holes of a scene as an image with a mask, and a painted image as Gaussians.

ComfyUI passes an IMAGE as [b, h, w, 3] and a MASK as [b, h, w], floats in [0, 1], and runs nodes in
PyTorch's inference mode, which both nodes leave because registration needs gradients.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor
from torch.nn.functional import interpolate

import gscompleter as gsc
from gscompleter.apps.inputs.task import InputSplatFile
from gscompleter.apps.report.completion import write_scenes
from gscompleter.data.formats import open_photographs
from gscompleter.generators import GeneratorOutput, GeneratorRequest
from gscompleter.system.files.image import write_image
from gscompleter.system.files.output_folder import open_output_folder

HANDLE = "GSCOMPLETER_HOLES"
"""Type of the link between both nodes."""
MAX_CHECK_VIEWS = 40
"""Largest number of further photographs that a splat is compared with."""
MAX_STRETCH = 0.01
"""Largest relative difference of the proportions of the painted image from those of the target."""


@dataclass(frozen=True)
class Painted:
    """Generator Φ whose image was painted elsewhere."""

    image: Tensor | None = None
    """[h, w, 3] in [0, 1]; None before it is painted."""
    supports_padding: bool = False
    max_batch_size: int = 1

    def synthesize(self, requests: Sequence[GeneratorRequest]) -> list[GeneratorOutput]:
        """Return the image for the only request."""
        assert self.image is not None
        return [GeneratorOutput(fit_image(self.image, request.target)) for request in requests]


@dataclass(frozen=True)
class Holes:
    """A scene at a target camera, between the two nodes."""

    completer: gsc.GSCompleter
    state: gsc.Completion
    target: gsc.Camera
    splat: Path | None


def fit_image(image: Tensor, camera: gsc.Camera) -> Tensor:
    """Scale an image [h, w, 3] to the size of a camera; its proportions must be the same."""
    height, width = image.shape[:2]
    if abs(width * camera.height / (height * camera.width) - 1) > MAX_STRETCH:
        raise gsc.InputError(
            f"The painted image has {width} x {height} pixels, and the target {camera.width} x "
            f"{camera.height}; scale it without cropping."
        )
    size = camera.height, camera.width
    scaled = interpolate(image.movedim(-1, 0)[None], size, mode="bilinear", antialias=True)
    return scaled[0].movedim(0, -1).clamp(0, 1)


class FindHoles:
    """Render a scene at a target camera, and mark what is empty or not confirmed."""

    RETURN_TYPES: ClassVar = ("IMAGE", "MASK", HANDLE)
    RETURN_NAMES: ClassVar = ("image", "mask", "holes")
    FUNCTION = "find"
    CATEGORY = "3d/gscompleter"

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """List the inputs with their widgets."""
        side = {"default": 512, "min": 64, "max": 4096, "step": 8}
        return {
            "required": {
                "scene": ("STRING", {"default": "", "tooltip": "Folder of photographs and poses"}),
                "context": ("STRING", {"default": "0 1", "tooltip": "Frames to work with"}),
                "target": ("STRING", {"default": "2", "tooltip": "Frame, or file of cameras"}),
                "height": ("INT", side),
                "width": ("INT", side),
            },
            "optional": {
                "splat": ("STRING", {"default": "", "tooltip": "Splat to complete"}),
                "camera": ("INT", {"default": 0, "min": 0, "tooltip": "Number in that file"}),
            },
        }

    def find(
        self,
        scene: str,
        context: str,
        target: str,
        height: int,
        width: int,
        splat: str = "",
        camera: int = 0,
    ) -> tuple[Tensor, Tensor, Holes]:
        """Return the image [1, h, w, 3], the mask [1, h, w] and the state."""
        with torch.inference_mode(False), torch.enable_grad():
            holes = open_holes(scene, parse_frames(context), target, (height, width), splat, camera)
            view = holes.completer.observe(holes.state, holes.target)
            image = view.camera.crop(view.render.image).detach().clamp(0, 1)
            return image[None], view.camera.crop(view.holes)[None].float(), holes


def parse_frames(text: str) -> list[int]:
    """Parse frame numbers between blanks or commas."""
    words = text.replace(",", " ").split()
    if not words or not all(word.isdecimal() for word in words):
        raise gsc.InputError(f"{text!r} names no frames; write numbers, as in 0 4.", "context")
    return [int(word) for word in words]


def open_holes(
    scene: str, frames: list[int], target: str, size: tuple[int, int], splat: str, number: int
) -> Holes:
    """Open a scene as `complete` does: a splat with further photographs that check it."""
    photographs = open_photographs(scene)
    views = photographs.views(frames, size)
    if target.strip().isdecimal():
        camera = photographs.camera(int(target), size)
    else:
        cameras = gsc.load_cameras(target, size, origin=photographs.origin.tolist())
        if number >= len(cameras):
            raise gsc.InputError(f"{target} has {len(cameras)} cameras; choose one.", "camera")
        camera = cameras[number]
    completer = gsc.GSCompleter(generator=Painted())
    if not splat:
        return Holes(completer, completer.begin(views, targets=[camera]), camera, None)
    used = {*frames, int(target) if target.strip().isdecimal() else -1}
    others = [frame for frame in range(len(photographs)) if frame not in used]
    checks = photographs.views(others[:: 1 + len(others) // MAX_CHECK_VIEWS], size)
    state = completer.begin(views, gsc.load_splat(splat), checks, [camera])
    return Holes(completer, state, camera, Path(splat))


class RegisterPainting:
    """Lift a painted image to Gaussians, register them, and write the completed scene."""

    RETURN_TYPES: ClassVar = ("STRING",)
    RETURN_NAMES: ClassVar = ("path",)
    FUNCTION = "register"
    CATEGORY = "3d/gscompleter"
    OUTPUT_NODE = True

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """List the inputs with their widgets."""
        out = {"default": "output/gscompleter", "tooltip": "Folder for a new folder per result"}
        return {
            "required": {
                "holes": (HANDLE,),
                "image": ("IMAGE", {"tooltip": "The painted image"}),
                "out": ("STRING", out),
            }
        }

    def register(self, holes: Holes, image: Tensor, out: str) -> tuple[str]:
        """Return the path of completed.ply; `image` is [b, h, w, 3], and the first one counts."""
        with torch.inference_mode(False), torch.enable_grad():
            painted = image[0, ..., :3].detach().cpu().float().clone()
            completer = replace(holes.completer, generator=Painted(painted))
            completion = completer.advance(holes.state, holes.target)
            result = completion.targets[-1]
            if not len(result.added) and not result.num_recolored:
                reasons = filter(None, (result.refusal, *result.notes))
                raise gsc.InputError(" ".join(["Nothing of the painting was added.", *reasons]))
            place = next(p for n in count(1) if not (p := Path(out) / f"{n:05}").exists())
            with open_output_folder(place) as folder:
                splat = None if holes.splat is None else InputSplatFile(holes.splat)
                write_scenes(folder, completion, splat)
                write_image(folder / "before.png", result.before.image)
                write_image(folder / "painted.png", fit_image(painted, holes.target))
                write_image(folder / "after.png", result.after.image)
            return (str(place / "completed.ply"),)


NODE_CLASS_MAPPINGS = {
    "GSCompleterFindHoles": FindHoles,
    "GSCompleterRegisterPainting": RegisterPainting,
}
NODE_DISPLAY_NAME_MAPPINGS = {
    "GSCompleterFindHoles": "Find holes (gscompleter)",
    "GSCompleterRegisterPainting": "Register painting (gscompleter)",
}
