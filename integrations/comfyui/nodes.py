"""Nodes that show a splat at a camera, find holes, take what was painted, and repair.

They make the requests that the commands make, and what follows is that of the commands: masks,
earlier edits, frames, cameras that are found. ComfyUI passes an IMAGE as [b, h, w, 3] and a MASK as
[b, h, w], floats in [0, 1], and runs nodes in PyTorch's inference mode, which all nodes leave
because registration needs gradients.
"""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import Any, ClassVar

import torch
from torch import Tensor

import gscompleter as gsc
from gscompleter.apps.commands.complete import CompleteOptions, decide_holes
from gscompleter.apps.commands.repair import RepairOptions, decide_repair
from gscompleter.apps.completing.complete import complete_folder, prepare
from gscompleter.apps.completing.maker import describe_maker
from gscompleter.apps.completing.preparation import Prepared
from gscompleter.apps.report.hole_pictures import draw_hole
from gscompleter.apps.report.scenes import write_scenes
from gscompleter.generators.painted import Painted, fit_painting
from gscompleter.planning.planner import ViewPlanner
from gscompleter.splats.edits import EditDraft
from gscompleter.system.console import make_console
from gscompleter.system.files.image import read_image, write_image
from gscompleter.system.files.output_folder import open_output_folder
from gscompleter.system.files.result_names import COMPLETED_FILE, SUMMARY_FILE

HANDLE = "GSCOMPLETER_HOLES"
"""Type of the link between the nodes that find holes and that register a painting."""
PAINTER = "ComfyUI"
"""Name of the painter unless the user names another."""
NAME = "The painted image"
"""Name of the image in sentences."""
NOTHING_ADDED = "Nothing of the painting was added."
FULL_ALREADY = (
    "The scene is opaque wherever the mask is white, only not confirmed by photographs, and what "
    "was painted there fits it no better; mark what is wrong, with Repair."
)
GEOMETRY = {"default": "", "tooltip": "Scan or mesh that gives depth in holes"}
OUT = {"default": "output/gscompleter", "tooltip": "Folder for a new folder per result"}
SIDE = {"default": 512, "min": 64, "max": 4096, "step": 8}


@dataclass(frozen=True)
class Holes:
    """A scene at a target camera, between the two nodes."""

    ready: Prepared
    state: gsc.Completion
    number: int
    """Number of the target among those of `ready`."""

    @property
    def target(self) -> gsc.Camera:
        """The camera, in the frame of the state."""
        return self.ready.task.targets[self.number].camera


@contextmanager
def leave_inference() -> Iterator[None]:
    """Compute with gradients, although ComfyUI runs nodes without."""
    with torch.inference_mode(False), torch.enable_grad():
        yield


def convert_depth(depth: Tensor) -> Tensor:
    """Convert z-depth [h, w] to a picture [h, w, 3]: near is white, far and holes are black."""
    inverse = torch.where(depth > 0, 1 / depth.clamp_min(1e-12), 0.0)
    return (inverse / inverse.max().clamp_min(1e-12))[..., None].expand(-1, -1, 3)


def parse_frames(text: str) -> tuple[int | str, ...]:
    """Parse numbers or names of photographs between blanks or commas."""
    words = text.replace(",", " ").split()
    return tuple(int(word) if word.isdecimal() else word for word in words)


def choose_path(text: str) -> Path | None:
    """Return the path that a text names; None for an empty one."""
    return Path(text.strip()) if text.strip() else None


def make_place(out: str) -> Path:
    """Return the first numbered folder that is not there yet."""
    return next(place for n in count(1) if not (place := Path(out) / f"{n:05}").exists())


class ReadsFiles:
    """A node that runs again once a file that its inputs name was written anew."""

    @classmethod
    def IS_CHANGED(cls, out: str = "", **inputs: object) -> str:
        """Describe the files of the inputs; ComfyUI keeps results while it stays the same.

        Results in `out` are no inputs.
        """
        named = [Path(value.strip()) for value in inputs.values() if isinstance(value, str)]
        files = [
            file
            for path in named
            if path.name and path.exists()
            for file in (sorted(path.rglob("*")) if path.is_dir() else [path])
        ]
        stamps = [(str(file), file.stat().st_mtime_ns, file.stat().st_size) for file in files]
        return str(stamps)


class ShowSplat(ReadsFiles):
    """Render a splat at a camera, to be painted on."""

    RETURN_TYPES: ClassVar = ("IMAGE",)
    RETURN_NAMES: ClassVar = ("image",)
    FUNCTION = "show"
    CATEGORY = "3d/gscompleter"

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """List the inputs with their widgets."""
        return {
            "required": {
                "splat": ("STRING", {"default": "", "tooltip": "File of the splat"}),
                "target": ("STRING", {"default": "", "tooltip": "File of cameras"}),
                "height": ("INT", SIDE),
                "width": ("INT", SIDE),
            },
            "optional": {
                "camera": ("INT", {"default": 0, "min": 0, "tooltip": "Number in that file"}),
            },
        }

    def show(
        self, splat: str, target: str, height: int, width: int, camera: int = 0
    ) -> tuple[Tensor]:
        """Return the image [1, h, w, 3]."""
        with leave_inference():
            scene = gsc.load_splat(splat.strip())
            origin = (0.0, 0.0, 0.0) if scene.origin is None else scene.origin
            cameras = gsc.load_cameras(target.strip(), (height, width), origin=origin)
            chosen = choose_camera(cameras, camera, target)
            return (gsc.load_renderer("cpu").render(scene, chosen).image.clamp(0, 1)[None],)


def choose_camera(cameras: list[gsc.Camera], number: int, target: str) -> gsc.Camera:
    """Choose one of the cameras of a target."""
    if number >= len(cameras):
        raise gsc.InputError(f"{target} has {len(cameras)} cameras; choose one.", "camera")
    return cameras[number]


class FindHoles(ReadsFiles):
    """Render a scene at a target camera, and mark what is empty or not confirmed."""

    RETURN_TYPES: ClassVar = ("IMAGE", "MASK", HANDLE, "IMAGE", "IMAGE", "IMAGE")
    RETURN_NAMES: ClassVar = ("image", "mask", "holes", "warped", "reference", "depth")
    FUNCTION = "find"
    CATEGORY = "3d/gscompleter"

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """List the inputs with their widgets."""
        photographs = "Folder of photographs and poses; empty for a splat alone"
        targets = "Photograph, or file of cameras; empty: searched for"
        return {
            "required": {
                "scene": ("STRING", {"default": "", "tooltip": photographs}),
                "context": ("STRING", {"default": "", "tooltip": "Photographs; empty: chosen"}),
                "target": ("STRING", {"default": "", "tooltip": targets}),
                "height": ("INT", SIDE),
                "width": ("INT", SIDE),
            },
            "optional": {
                "splat": ("STRING", {"default": "", "tooltip": "Splat to complete"}),
                "camera": ("INT", {"default": 0, "min": 0, "tooltip": "Number of the target"}),
                "geometry": ("STRING", GEOMETRY),
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
        geometry: str = "",
        invert_masks: bool = False,
        large_masks: bool = False,
    ) -> tuple[Tensor, Tensor, Holes, Tensor, Tensor, Tensor]:
        """Return image [1, h, w, 3], mask [1, h, w], the state, and three further images."""
        with leave_inference(), tempfile.TemporaryDirectory() as scratch:
            word = target.strip()
            options = CompleteOptions(
                folder=choose_path(scene),
                scene=choose_path(splat),
                geometry=choose_path(geometry),
                context=parse_frames(context) or None,
                target=(word,) if word else (),
                auto=None if word else camera + 1,
                resolution=(height, width),
                invert_masks=invert_masks,
                large_masks=large_masks,
                out=Path(scratch) / "out",
            )
            holes = open_holes(options, camera)
            completer = holes.ready.completer
            shown = draw_hole(completer.observe(holes.state, holes.target))
            return (
                shown.image.clamp(0, 1)[None],
                shown.mask[None].float(),
                holes,
                shown.warped[None],
                shown.reference.image[None],
                convert_depth(shown.depth)[None],
            )


def open_holes(options: CompleteOptions, number: int) -> Holes:
    """Open a scene as `complete` does, and search for targets if none is named."""
    ready = prepare(decide_holes(options, has_marks=False), make_console(stderr=True, quiet=True))
    # A painting has no padding.
    completer = replace(ready.completer, generator=Painted((), PAINTER))
    ready = replace(ready, explorer=ViewPlanner(completer))
    begun = ready.begin()
    if not ready.task.targets:
        choices = ready.explorer.plan(begun, list(ready.cameras.values()), ready.max_targets)
        ready = ready.with_choices(choices)
        if not ready.task.targets:
            raise gsc.InputError("No camera was found that sees a hole; name one.", "target")
    named = options.target[0] if options.target else "The scene"
    choose_camera(ready.task.target_cameras, number, named)
    return Holes(ready, begun, number)


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
        return {
            "required": {
                "holes": (HANDLE,),
                "image": ("IMAGE", {"tooltip": "The painted image"}),
                "out": ("STRING", OUT),
            },
            "optional": {
                "painter": ("STRING", {"default": PAINTER, "tooltip": "Name for the summary"}),
            },
        }

    def register(self, holes: Holes, image: Tensor, out: str, painter: str = PAINTER) -> tuple[str]:
        """Return the path of completed.ply.

        `image` is [b, h, w, 3], or has alpha as the fourth channel, and the first one counts.
        """
        with leave_inference():
            first = image[0].detach().cpu().float().clone()
            opaque = first[..., 3] >= 0.5 if first.shape[-1] == 4 else torch.ones(first.shape[:2])
            painting = fit_painting(first[..., :3], opaque.bool(), holes.target, NAME)
            ready = holes.ready
            completer = replace(ready.completer, generator=Painted((painting,), painter))
            completion = completer.advance(holes.state, holes.target)
            result = completion.targets[-1]
            if not len(result.added) and not result.num_recolored:
                reasons = [*filter(None, (result.refusal, *result.notes))]
                raise gsc.InputError(" ".join([NOTHING_ADDED, *(reasons or [FULL_ALREADY])]))
            models = replace(ready.work.models, generator="painted")
            run = describe_maker(models, ready.task, completion)
            place = make_place(out)
            with open_output_folder(place) as folder:
                write_scenes(
                    folder, completion, ready.task.splat_file, run, EditDraft(ready.command)
                )
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
            return (str(place / COMPLETED_FILE),)


class Repair(ReadsFiles):
    """Take what a mask marks out of a splat, and fill its place."""

    RETURN_TYPES: ClassVar = ("STRING", "IMAGE")
    RETURN_NAMES: ClassVar = ("path", "after")
    FUNCTION = "repair"
    CATEGORY = "3d/gscompleter"
    OUTPUT_NODE = True

    @classmethod
    def INPUT_TYPES(cls) -> dict[str, Any]:
        """List the inputs with their widgets."""
        photographs = "Folder of its photographs; empty for a splat alone"
        return {
            "required": {
                "splat": ("STRING", {"default": "", "tooltip": "File of the splat"}),
                "target": ("STRING", {"default": "", "tooltip": "File with one camera"}),
                "mask": ("MASK", {"tooltip": "What is wrong, painted on the image of Show splat"}),
                "out": ("STRING", OUT),
            },
            "optional": {
                "scene": ("STRING", {"default": "", "tooltip": photographs}),
                "geometry": ("STRING", GEOMETRY),
                "invert_masks": ("BOOLEAN", {"default": False, "tooltip": "Black is wrong"}),
                "large_masks": ("BOOLEAN", {"default": False, "tooltip": "It is that much"}),
            },
        }

    def repair(
        self,
        splat: str,
        target: str,
        mask: Tensor,
        out: str,
        scene: str = "",
        geometry: str = "",
        invert_masks: bool = False,
        large_masks: bool = False,
    ) -> tuple[str, Tensor]:
        """Return the path of completed.ply, and what the target sees then, [1, h, w, 3].

        `mask` is [b, h, w], and the first one counts. Its size is that of the work.
        """
        with leave_inference(), tempfile.TemporaryDirectory() as scratch:
            marked = mask[0].detach().cpu().float()
            path = Path(scratch) / "mask.png"
            write_image(path, (marked > 0.5).float()[..., None].expand(-1, -1, 3))
            place = make_place(out)
            height, width = marked.shape
            options = RepairOptions(
                folder=choose_path(scene),
                scene=choose_path(splat),
                geometry=choose_path(geometry),
                target=(target.strip(),),
                mask=(path,),
                resolution=(height, width),
                invert_masks=invert_masks,
                large_masks=large_masks,
                out=place,
                quiet=True,
            )
            complete_folder(decide_repair(options))
            after = read_image(place / "images" / "target1_after.png")
            return (str(place / COMPLETED_FILE), after[None])


NODE_CLASS_MAPPINGS = {
    "GSCompleterShowSplat": ShowSplat,
    "GSCompleterFindHoles": FindHoles,
    "GSCompleterRegisterPainting": RegisterPainting,
    "GSCompleterRepair": Repair,
}
NODE_DISPLAY_NAME_MAPPINGS = {
    "GSCompleterShowSplat": "Show splat (gscompleter)",
    "GSCompleterFindHoles": "Find holes (gscompleter)",
    "GSCompleterRegisterPainting": "Register painting (gscompleter)",
    "GSCompleterRepair": "Repair (gscompleter)",
}
