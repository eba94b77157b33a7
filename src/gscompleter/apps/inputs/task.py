"""Values that are opened and read: photographs, targets, and the input of a completion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from gscompleter.apps.requests.scene import SceneRequest
from gscompleter.data.photograph_names import name_target
from gscompleter.data.photographs import Photographs
from gscompleter.data.sfm.refining import PoseRefinement
from gscompleter.editing.taken_out import TakenOut
from gscompleter.generators.painted import Painting
from gscompleter.numerics.given_geometry import GivenGeometry
from gscompleter.parts import EarlierWork
from gscompleter.splats.edits import Edits, read_edits
from gscompleter.types import Camera, Gaussians, View
from gscompleter.virtual_capture.witnesses import Witnesses


@dataclass(frozen=True)
class Target:
    """A target camera with the photograph that scores it."""

    camera: Camera
    frame: int | None = None
    """Frame number in the scene; None for a camera from elsewhere."""
    photograph: Float[Tensor, "h w 3"] | None = None
    """Photograph at the target, if there is one. Only the generator `oracle` uses it."""
    ignore_mask: Bool[Tensor, "h w"] | None = None
    """True for pixels that are not scored; None if all are."""
    derived_from: int | None = None
    """Frame number that a planned camera was derived from; None if the user gave the camera."""
    offset: str | None = None
    """Move and turn of a planned camera from that frame, in words."""
    reason: str = ""
    """Sentence why a planned camera was chosen; empty for one that the user gave."""
    is_in_splat_frame: bool = False
    """True if the camera was given in the frame of the input splat's file, and not in that of the
    photographs."""
    painting: Painting | None = None
    """Image that was painted for the target, with the camera as it was read."""

    @property
    def placed_painting(self) -> Painting | None:
        """The painted image with the camera of the target, or None."""
        return self.painting and replace(self.painting, camera=self.camera)

    @property
    def view(self) -> View | None:
        """The photograph with its camera, or None."""
        if self.photograph is None:
            return None
        return View(self.photograph, self.camera, self.frame, ignore_mask=self.ignore_mask)


@dataclass(frozen=True)
class InputSplatFile:
    """The file of the input splat."""

    path: Path
    context_mask: Bool[Tensor, "n"] | None = None
    """Mask of the Gaussians in the file that form the context; None for all."""
    file_order: Int64[Tensor, "n"] | None = None
    """Index among these of each Gaussian of the context; None for the order of the file."""
    origin: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    """Origin of the context in the coordinates of the file."""

    @cached_property
    def edits(self) -> Edits:
        """Read what earlier commands did to it, and the whole file, to know that it is the same."""
        return read_edits(self.path)


@dataclass(frozen=True)
class Opened:
    """Photographs with cameras, and their source."""

    request: SceneRequest
    photographs: Photographs
    format: str
    """Name of the format of the photographs, or of renders in their place."""
    num_photographs: int
    """Number of photographs, with those whose camera was not found."""
    held_out: tuple[int, ...] = ()
    """Frames that are kept back: they only score the result."""
    given: Photographs | None = None
    """The photographs with the poses that were given; None if these are used."""
    refinement: PoseRefinement | None = None
    """Change of the given poses, by this command or an earlier one; None if they are used."""
    renders_from: str | None = None
    """Source of the cameras of renders that take the place of photographs: `cameras` of a
    file, around the `targets` or the `place` of a removal, the `pixels` of the splat, or
    `standpoints`; None if there are photographs."""

    @property
    def has_numbered_frames(self) -> bool:
        """True if the user can name the frames: photographs, or cameras of a file."""
        return self.renders_from in (None, "cameras")

    def with_resolution(self, resolution: tuple[int, int] | int) -> Opened:
        """Return a copy with another working size."""
        return replace(self, request=replace(self.request, resolution=resolution))

    @property
    def files(self) -> dict[int | None, str]:
        """Files of the photographs by frame, below the folder of all."""
        return {number: f.file_name for number, f in enumerate(self.photographs.frames)}

    def name_target(self, target: Target) -> str:
        """Name a target for lines and tables."""
        near = target.derived_from
        file = self.files.get(target.frame if near is None else near)
        return name_target(target.frame, file, near, target.offset)


@dataclass(frozen=True)
class CompletionTask:
    """Input of a completion."""

    views: Sequence[View]
    """Photographs of the context, at least one, in the frame of the result."""
    targets: Sequence[Target]
    frame: Float[np.ndarray, "4 4"]
    """Similarity from the frame of the photographs to that of the result."""
    origin: Float[np.ndarray, "3"]
    """Local origin of the photographs in their own coordinates; zero unless those are large, and
    where an input splat is in a frame of its own near zero."""
    depths: Mapping[str, str]
    """Source of `near` and `far`: given, scene, points, splat, model or features."""
    scene: Gaussians | None = None
    """Input splat, or None to reconstruct the context."""
    splat_file: InputSplatFile | None = None
    method: str = "given"
    """How the frame of the input splat was found (`AlignmentMethod`)."""
    frame_description: str = "the frame of the photographs"
    """Words for people about the frame that was found."""
    check_views: Sequence[View] | None = None
    """Photographs that check the input splat, at low resolution; without one, those to which the
    reconstructed scene is fitted besides the context."""
    depth_notes: tuple[str, ...] = ()
    """Sentences about the unit of the given depth."""
    predicted_depths: Mapping[int, Float[Tensor, "h w"]] = field(default_factory=dict)
    """Predicted z-depth that lies beside photographs, by frame: it only supports stereo."""
    witnesses: Witnesses = Witnesses()
    """Further cameras from which a splat without photographs looks well."""
    geometry: GivenGeometry | None = None
    """Geometry from elsewhere in the frame of the result; None for none."""
    taken_out: TakenOut | None = None
    """What earlier edits took out of the input splat, which the photographs do not show any more;
    None for nothing."""
    earlier: EarlierWork = EarlierWork()
    """Gaussians of `scene` that earlier commands made."""
    is_remade: bool = False
    """True if Ψ made the input splat of photographs of the same folder, which are among `views`,
    and makes it anew."""

    @property
    def device(self) -> torch.device:
        """Device of the photographs."""
        return self.views[0].image.device

    @property
    def splat_origin(self) -> Float[np.ndarray, "3"]:
        """Origin of the scene in the coordinates of its file: what is named in them is moved by it.

        A splat near zero may be that of photographs in a map, so it is not `origin`. It is zero
        without an input splat, since a reconstructed scene is written as it is.
        """
        return np.zeros(3) if self.splat_file is None else self.splat_file.origin

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of the context and of the targets."""
        return [*(view.camera for view in self.views), *(t.camera for t in self.targets)]

    @property
    def target_cameras(self) -> list[Camera]:
        """Target cameras on the device of the photographs."""
        return [target.camera.to(self.device) for target in self.targets]

    @property
    def goals(self) -> list[Camera]:
        """Target cameras, or those of the context without targets."""
        return self.target_cameras or [view.camera for view in self.views]

    @property
    def context_frames(self) -> tuple[int, ...]:
        """Frame numbers of the context."""
        return tuple(view.frame for view in self.views if view.frame is not None)

    @property
    def used_frames(self) -> set[int | None]:
        """Frame numbers of the context, of the targets, and of what a context is fitted to."""
        fitted = () if self.scene is not None else self.check_views or ()
        frames = (*(target.frame for target in self.targets), *(view.frame for view in fitted))
        return {*self.context_frames, *frames}
