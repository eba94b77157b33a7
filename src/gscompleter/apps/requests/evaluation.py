"""Requests to score methods on cases, and to write tables and figures of the paper from them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from gscompleter.apps.requests.answer import AnswerRequest
from gscompleter.apps.requests.batch import EngineRequest
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.apps.requests.scene import Size
from gscompleter.data.mask_reading import MaskReading


@dataclass(frozen=True, kw_only=True)
class CasesRequest:
    """Cases with known target photographs: those of files, or those that protocols choose."""

    paths: tuple[Path, ...]
    """Files of cases, or scenes."""
    protocol: tuple[str, ...] = ()
    """Choices of context and targets in scenes; files of cases need none."""
    preset: str | None = None
    """Data set of the paper, whose authors' code is followed at its own resolution."""
    resolution: Size | None = None
    """Working size; None for that of each case, or the default of scenes."""
    near: float | None = None
    """Smallest depth in the unit of the cameras; None for that of each case or of the data."""
    far: float | None = None
    """Largest depth, likewise."""
    uses_masks: bool = True
    masks: MaskReading = MaskReading()
    ignore_moving: bool = False
    """True to ignore boxes of moving objects."""
    one_per_scene: bool = False
    """True to take only the first case of each scene and protocol."""
    ego_mask: bool = True
    """True to ignore what stays the same while the camera moves."""
    refines_poses: bool = False
    """True to refine the poses of a scene that matches contradict."""
    limit: int | None = None
    """Most cases, over all shares; None for all."""
    apart: bool = False
    """True to use also the cases that their file keeps apart."""


@dataclass(frozen=True, kw_only=True)
class EvaluationRequest:
    """Run methods with one choice of models on cases, and score them."""

    cases: CasesRequest
    methods: tuple[str, ...]
    models: ModelRequest
    out: Path
    """Folder of the scores; those of an earlier run are kept."""
    rerun: Literal["nothing", "failures", "scores"] = "nothing"
    """Part of an earlier run that is repeated: none, failed cases, or the scores of all."""
    engine: EngineRequest = EngineRequest()
    answer: AnswerRequest = AnswerRequest()


@dataclass(frozen=True, kw_only=True)
class ComparisonRequest:
    """Compare models of one kind in one table."""

    run: EvaluationRequest
    """Its models are those of none of the runs."""
    kind: Literal["depth", "generator"]
    models: Mapping[str, ModelRequest]
    """Models of each run, by the name of what is compared."""


@dataclass(frozen=True, kw_only=True)
class ReproductionRequest:
    """Write tables and figures of the paper."""

    run: EvaluationRequest
    """Its reconstructor and methods are those of none of the runs."""
    weights: Mapping[str, Path | None]
    """File of weights by reconstructor; None for those that are published."""
    tables: tuple[str, ...] = ()
    figures: tuple[str, ...] = ()
    figure_cases: tuple[str, ...] = ()
    """Cases of the figures; none for the first ones."""
    has_outlines: bool = False
    """True to outline the holes in figures."""
    has_crops: bool = False
    """True to show the widest hole magnified."""


@dataclass(frozen=True, kw_only=True)
class IndexRequest:
    """Write the frames that a protocol selects in a data set."""

    path: Path
    protocol: str
    out: Path
    overwrite: bool = False
    answer: AnswerRequest = AnswerRequest()
