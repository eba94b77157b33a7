"""Requests to complete, repair and update one scene, and to remove something from it.

`complete`, `remove` and `repair` fill holes at targets; what `remove` and `repair` take out before
is theirs alone. `update` adds what photographs show, and has no targets.

Requests hold what was decided, and check nothing: `apps/commands` refuses options that exclude each
other, and what is opened is checked where it is opened.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from gscompleter.apps.requests.answer import AnswerRequest
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.apps.requests.scene import AloneRequest, PhotographsRequest
from gscompleter.apps.requests.splat import Selection, SplatRequest
from gscompleter.config import CompleterConfig
from gscompleter.data.mask_reading import MaskReading

DEFAULT_NUM_TARGETS = 4
"""Most cameras that are searched for as targets, unless a number is given."""


@dataclass(frozen=True, kw_only=True)
class WorkRequest:
    """A splat to work on, the models that do it, and their settings."""

    splat: SplatRequest | None = None
    """The splat to complete; None to reconstruct the scene from its photographs."""
    geometry: Path | None = None
    """Mesh or points whose depth is used where photographs show none; None for none."""
    models: ModelRequest = ModelRequest()
    config: CompleterConfig = CompleterConfig()
    """Settings. For a splat without photographs they are completed when its Gaussians are read,
    which tell what a hole of it is, and whether images are padded."""


@dataclass(frozen=True)
class TargetRequest:
    """Cameras at which holes are filled."""

    named: tuple[str, ...] = ()
    """Files of cameras, and numbers (from 0) and names of photographs, in order."""
    max_found: int = DEFAULT_NUM_TARGETS
    """Most cameras to search for if none is named."""
    images: Path | None = None
    """Folder of images that were painted for them; the generator is then `painted`."""


@dataclass(frozen=True, kw_only=True)
class ResultsRequest:
    """The folder of the results, and what is written there beside the usual."""

    out: Path
    overwrite: bool = False
    """True to replace what an earlier run wrote there."""
    suffix: Literal[".ply", ".spz", ".sog"] | None = None
    """Format in which results are kept small; None to write all files as .ply."""
    has_video: bool = False
    """True to write a video, a flight through the holes."""
    answer: AnswerRequest = AnswerRequest()


@dataclass(frozen=True, kw_only=True)
class CompletionRequest:
    """Fill holes at targets."""

    # The name of the command, for the record of edits; so in the classes below.
    command: ClassVar[str] = "complete"
    source: PhotographsRequest | AloneRequest
    work: WorkRequest
    targets: TargetRequest = TargetRequest()
    results: ResultsRequest


@dataclass(frozen=True)
class RepairRequest:
    """Take what masks mark at the targets, or a selection, out of a splat, and fill its place.

    The place is a hole whatever stands behind it. Either `masks` or `selection` is given.
    """

    command: ClassVar[str] = "repair"
    completion: CompletionRequest
    masks: tuple[Path, ...] = ()
    """An image for each target camera, in their order; none with a selection."""
    reading: MaskReading = MaskReading()
    """How these masks are read."""
    selection: Selection | None = None
    """What goes if there are no masks; None with masks."""


@dataclass(frozen=True)
class RemovalRequest:
    """Take a selection out of a splat, and fill the holes that this opens."""

    command: ClassVar[str] = "remove"
    completion: CompletionRequest
    selection: Selection


FillingRequest = CompletionRequest | RepairRequest | RemovalRequest
"""A request that fills holes at targets, whatever it takes out before."""


@dataclass(frozen=True, kw_only=True)
class UpdateRequest:
    """Add to a splat what its photographs show and it lacks; nothing is invented."""

    command: ClassVar[str] = "update"
    source: PhotographsRequest
    work: WorkRequest
    photos: Path | None = None
    """Folder of new photographs to place among those of the scene; None for none."""
    hold_out: int = 0
    """Number of photographs that are kept back to compare the splat with."""
    results: ResultsRequest


@dataclass(frozen=True)
class ExportRequest:
    """Write the holes of a completion for whoever paints them, in place of completing it.

    The folder of its results gets no more than cameras that had to be found.
    """

    filling: FillingRequest
    folder: Path
    has_path: bool = False
    """True to write a video along the targets, too."""
    names_number: bool = False
    """True if `--auto` was given, which the command with the painted images does not take: the
    sentence on how to go on then says so."""


@dataclass(frozen=True)
class PlanRequest:
    """Write the targets of a completion and what they see, and complete nothing."""

    filling: FillingRequest


Request = FillingRequest | UpdateRequest | ExportRequest | PlanRequest
"""All that `apps/completing` can be asked for."""


def get_completion(request: FillingRequest) -> CompletionRequest:
    """Return the request itself, or that of the completion which follows what it takes out."""
    return request if isinstance(request, CompletionRequest) else request.completion
