"""Two nodes: the holes of a scene as an image with a mask, and a painted image as Gaussians.

ComfyUI passes an IMAGE as [b, h, w, 3] and a MASK as [b, h, w], floats in [0, 1], and runs nodes in
PyTorch's inference mode, which both nodes leave because registration needs gradients.
"""

from __future__ import annotations

import json
import os
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

import gscompleter as gsc
from gscompleter.apps.inputs.named_photographs import is_image
from gscompleter.apps.inputs.task import InputSplatFile
from gscompleter.apps.report.hole_pictures import draw_hole
from gscompleter.apps.report.scenes import write_scenes
from gscompleter.data.formats import open_photographs
from gscompleter.data.mask_checks import read_masks_as_asked, refuse_nothing_to_invert
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.photographs import Photographs
from gscompleter.generators.painted import Painted, fit_painting
from gscompleter.splats.edits import EditDraft
from gscompleter.system.files.image import write_image
from gscompleter.system.files.output_folder import open_output_folder
from gscompleter.system.files.writing import SUMMARY_FILE

HANDLE = "GSCOMPLETER_HOLES"
"""Type of the link between both nodes."""
MAX_CHECK_VIEWS = 40
"""Largest number of further photographs that a splat is compared with."""
PAINTER = "ComfyUI"
"""Name of the painter unless the user names another."""
NAME = "The painted image"
"""Name of the image in sentences."""


@dataclass(frozen=True)
class Holes:
    """A scene at a target camera, between the two nodes."""

    completer: gsc.GSCompleter
    state: gsc.Completion
    target: gsc.Camera
    splat: Path | None


def convert_depth(depth: Tensor) -> Tensor:
    """Convert z-depth [h, w] to a picture [h, w, 3]: near is white, far and holes are black."""
    inverse = torch.where(depth > 0, 1 / depth.clamp_min(1e-12), 0.0)
    return (inverse / inverse.max().clamp_min(1e-12))[..., None].expand(-1, -1, 3)


class FindHoles:
    """Render a scene at a target camera, and mark what is empty or not confirmed."""

    RETURN_TYPES: ClassVar = ("IMAGE", "MASK", HANDLE, "IMAGE", "IMAGE", "IMAGE")
    RETURN_NAMES: ClassVar = ("image", "mask", "holes", "warped", "reference", "depth")
    FUNCTION = "find"
    CATEGORY = "3d/gscompleter"

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """List the inputs with their widgets."""
        side = {"default": 512, "min": 64, "max": 4096, "step": 8}
        return {
            "required": {
                "scene": ("STRING", {"default": "", "tooltip": "Folder of photographs and poses"}),
                "context": ("STRING", {"default": "0 1", "tooltip": "Photographs to work with"}),
                "target": ("STRING", {"default": "2", "tooltip": "Photograph, or cameras"}),
                "height": ("INT", side),
                "width": ("INT", side),
            },
            "optional": {
                "splat": ("STRING", {"default": "", "tooltip": "Splat to complete"}),
                "camera": ("INT", {"default": 0, "min": 0, "tooltip": "Number in that file"}),
                "invert_masks": ("BOOLEAN", {"default": False, "tooltip": "White is ignored"}),
                "large_masks": ("BOOLEAN", {"default": False, "tooltip": "Masks hide that much"}),
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
        invert_masks: bool = False,
        large_masks: bool = False,
    ) -> tuple[Tensor, Tensor, Holes, Tensor, Tensor, Tensor]:
        """Return image [1, h, w, 3], mask [1, h, w], the state, and three further images."""
        with torch.inference_mode(False), torch.enable_grad():
            photographs = open_masked(scene, MaskReading(invert_masks, large_masks))
            frames = parse_frames(context)
            holes = open_holes(photographs, frames, target, (height, width), splat, camera)
            shown = draw_hole(holes.completer.observe(holes.state, holes.target))
            return (
                shown.image.clamp(0, 1)[None],
                shown.mask[None].float(),
                holes,
                shown.warped[None],
                shown.reference.image[None],
                convert_depth(shown.depth)[None],
            )


def parse_frames(text: str) -> list[int | str]:
    """Parse numbers or names of photographs between blanks or commas."""
    words = text.replace(",", " ").split()
    if not words:
        raise gsc.InputError(
            "No photographs are named; write numbers or names of files, as in 0 4.", "context"
        )
    return [parse_frame(word) for word in words]


def parse_frame(word: str) -> int | str:
    """Parse the number or the name of a photograph."""
    return int(word) if word.isdecimal() else word


def open_masked(scene: str, reading: MaskReading) -> Photographs:
    """Open photographs, and check their masks as `complete` does."""
    photographs = open_photographs(scene)
    refuse_nothing_to_invert(photographs.list_masks(), reading)
    return read_masks_as_asked(photographs, reading)


def open_holes(
    photographs: Photographs,
    words: list[int | str],
    target: str,
    size: tuple[int, int],
    splat: str,
    number: int,
) -> Holes:
    """Open a scene as `complete` does: a splat with further photographs that check it."""
    frames = [photographs.find_frame(word) for word in words]
    views = photographs.views(frames, size)
    word = target.strip()
    target_frame = None
    if not os.path.exists(word) or is_image(word):
        target_frame = photographs.find_frame(parse_frame(word))
        camera = photographs.camera(target_frame, size)
    else:
        cameras = gsc.load_cameras(target, size, origin=photographs.origin.tolist())
        if number >= len(cameras):
            raise gsc.InputError(f"{target} has {len(cameras)} cameras; choose one.", "camera")
        camera = cameras[number]
    completer = gsc.GSCompleter(generator=Painted((), PAINTER))  # no padding, as what is painted
    if not splat:
        return Holes(completer, completer.begin(views, targets=[camera]), camera, None)
    used = {*frames, target_frame}
    others = [
        frame
        for frame in photographs.posed
        if frame not in used and photographs.frame(frame).has_photograph()
    ]
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
            },
            "optional": {
                "painter": ("STRING", {"default": PAINTER, "tooltip": "Name for the summary"}),
            },
        }

    def register(self, holes: Holes, image: Tensor, out: str, painter: str = PAINTER) -> tuple[str]:
        """Return the path of completed.ply.

        `image` is [b, h, w, 3], or has alpha as the fourth channel, and the first one counts.
        """
        with torch.inference_mode(False), torch.enable_grad():
            first = image[0].detach().cpu().float().clone()
            opaque = first[..., 3] >= 0.5 if first.shape[-1] == 4 else torch.ones(first.shape[:2])
            painting = fit_painting(first[..., :3], opaque.bool(), holes.target, NAME)
            completer = replace(holes.completer, generator=Painted((painting,), painter))
            completion = completer.advance(holes.state, holes.target)
            result = completion.targets[-1]
            if not len(result.added) and not result.num_recolored:
                reasons = filter(None, (result.refusal, *result.notes))
                raise gsc.InputError(" ".join(["Nothing of the painting was added.", *reasons]))
            place = next(p for n in count(1) if not (p := Path(out) / f"{n:05}").exists())
            with open_output_folder(place) as folder:
                splat = None if holes.splat is None else InputSplatFile(holes.splat)
                write_scenes(folder, completion, splat, None, EditDraft("complete"))
                write_image(folder / "before.png", result.before.image)
                write_image(folder / "painted.png", painting.image)
                write_image(folder / "after.png", result.after.image)
                summary = {
                    "painter": painter,
                    "target_id": result.target_id,
                    "added": len(result.added),
                    "recolored": result.num_recolored,
                    "notes": list(result.notes),
                }
                (folder / SUMMARY_FILE).write_text(json.dumps(summary))
            return (str(place / "completed.ply"),)


NODE_CLASS_MAPPINGS = {
    "GSCompleterFindHoles": FindHoles,
    "GSCompleterRegisterPainting": RegisterPainting,
}
NODE_DISPLAY_NAME_MAPPINGS = {
    "GSCompleterFindHoles": "Find holes (gscompleter)",
    "GSCompleterRegisterPainting": "Register painting (gscompleter)",
}
