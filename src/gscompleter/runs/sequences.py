"""Long sequences: a clip is completed view after view, each time into the scene as it stands by
then (paper, "Analysis of Long Sequence Completion").

A step is what the method does with any case. Once it is done, the photograph of its target is
known: whatever the method, later steps may choose it for their anchor. The paper gives the true
image to the generator as well (our generator `oracle`), which leaves nothing but registration to
compare.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from gscompleter.config import AnchorConfig, HoleConfig, named_config
from gscompleter.errors import InputError
from gscompleter.metrics.image import psnr
from gscompleter.metrics.scores import Outcome, ranged_truth
from gscompleter.render import Renderer
from gscompleter.runs.methods import METHODS, SETTINGS, Parts, Start, check_methods
from gscompleter.runs.protocols import SequenceCase
from gscompleter.runs.runner import (
    VERSION,
    Again,
    RunConfig,
    Tally,
    attempt,
    begin,
    make_rows,
    save_image,
    start_at,
)
from gscompleter.runs.store import (
    Saved,
    keep_outcome,
    load_outcome,
    sequence_folder,
    slug,
)
from gscompleter.stages.anchor import AnchorChoice, lift, select_anchor
from gscompleter.stages.integration import hole_mask
from gscompleter.types import Camera, DepthMap, Gaussians, Render, View, merge

SUPPORTED = ("context", *SETTINGS, "reggs")
"""Methods that add to a scene and leave what is there, so that steps can be compared."""

MIN_PIXELS = 50
"""Fewest pixels that a depth scale is a median of."""


@dataclass(frozen=True)
class Step:
    """What a method did at one view of a sequence."""

    frame: int
    """The target."""
    anchor: int | None
    """Frame that made the stereo pair with it; None for a method that lifts nothing."""
    anchor_fallback: bool
    """True where every view was turned too far and the least-turned one was taken."""
    psnr_before: float
    """Of the scene at the target, in dB, just before the step."""
    psnr_after: float
    """The same just after it."""
    psnr_end: float | None
    """The same of the scene that the whole sequence leaves, below `psnr_after` where later steps
    spoiled it; None while the sequence goes on."""
    depth_scale: float | None
    """See `depth_scale`; None where too little was added to tell."""
    added: int
    """Gaussians of this step."""
    gaussians: int
    """Gaussians of the scene after it."""
    notes: tuple[str, ...]
    """Fallbacks that were taken, a sentence each."""
    seconds: dict[str, float]
    """Wall time by stage, and `total`."""


@dataclass(frozen=True)
class Course:
    """A sequence as far as it went."""

    scene: Gaussians
    """The context and all that was added to it."""
    views: tuple[View, ...]
    """The photographs that are known by now."""
    steps: tuple[Step, ...] = ()
    error: str | None = None
    """Why it went no further; None where nothing failed."""


def complete_in_sequence(
    start: Start,
    targets: Sequence[View],
    method: str,
    parts: Parts,
    folder: Path | None = None,
) -> Course:
    """Complete a scene for one target after the other; a step that fails is the last.

    Args:
        start: The context and its views; its own target is not looked at.
        targets: Photographs to complete the scene for, in this order. They have the near and far
            plane of the context's views.
        method: One of `SUPPORTED`.
        parts: The models. The generator `oracle` has to know all `targets`.
        folder: Where each step is saved and, where it is there already, read back.

    Raises:
        InputError: a method that works otherwise.
        OutputError: where a step cannot be saved.
    """
    check_sequence_methods([method])
    course = Course(start.context, start.views)
    for target in targets:
        following = attempt(partial(advanced, course, start, target, method, parts, folder))
        if isinstance(following, str):
            course = replace(course, error=f"Frame {target.frame}: {following}")
            break
        course = following
    return ended(course, targets, parts.renderer)


def advanced(
    course: Course, start: Start, target: View, method: str, parts: Parts, folder: Path | None
) -> Course:
    """`course` after the step at `target`."""
    number = len(course.steps) + 1
    path = None if folder is None else folder / f"step-{number:03d}.npz"
    here = start_here(course, start, target.camera, parts.renderer)
    outcome = outcome_of(method, here, number, parts, path)
    step, after = step_of(method, outcome, here, target, parts)
    if path is not None:
        save_image(path.with_suffix(".png"), after.image)
    return Course(outcome.scene, (*course.views, target), (*course.steps, step))


def start_here(course: Course, start: Start, target: Camera, renderer: Renderer) -> Start:
    """Where the next step begins: the scene as it stands is its context."""
    holes = hole_mask(renderer.render(course.scene, target), HoleConfig())
    return replace(
        start, views=course.views, target=target, context=course.scene, hole_mask=holes, seconds=0.0
    )


def outcome_of(method: str, start: Start, number: int, parts: Parts, path: Path | None) -> Outcome:
    """What is saved at `path`, else what `method` makes of the step, which is saved there."""
    saved = None if path is None else load_outcome(path, start)
    if saved is None:
        saved = Saved(numbered(METHODS[method](start, parts), number), None)
        if path is not None:
            saved = keep_outcome(path, saved, start)
    return saved.outcome


def numbered(outcome: Outcome, number: int) -> Outcome:
    """`outcome` with what it added marked as generated by target `number`."""
    assert outcome.added is not None
    added = replace(outcome.added, generated=torch.full_like(outcome.added.generated, number))
    return replace(outcome, added=added, scene=merge([outcome.context, added]))


def step_of(
    method: str, outcome: Outcome, start: Start, target: View, parts: Parts
) -> tuple[Step, Render]:
    """The scores of a step, and what its camera sees afterwards."""
    before = parts.renderer.render(outcome.context, target.camera)
    after = parts.renderer.render(outcome.scene, target.camera)
    choice = anchor_of(method, start, parts)
    anchor = None if choice is None else start.views[choice.index]
    added, scale = outcome.added, None
    assert added is not None
    if anchor is not None and len(added) > 0:
        expected = metric_depth(target, anchor, parts)
        scale = depth_scale(added, start.hole_mask, target.camera, expected, parts.renderer)
    step = Step(
        frame=number_of(target),
        anchor=None if anchor is None else number_of(anchor),
        anchor_fallback=choice is not None and choice.fallback,
        psnr_before=psnr(before.image, target.image),
        psnr_after=psnr(after.image, target.image),
        psnr_end=None,
        depth_scale=scale,
        added=len(added),
        gaussians=len(outcome.scene),
        notes=outcome.notes,
        seconds=dict(outcome.seconds),
    )
    json.dumps(asdict(step), allow_nan=False)
    return step, after


def number_of(view: View) -> int:
    """The number of a frame of a clip."""
    assert view.frame is not None
    return view.frame


def anchor_of(method: str, start: Start, parts: Parts) -> AnchorChoice | None:
    """Which of the known views `method` lifts the target with; None where it lifts nothing."""
    if method == "context":
        return None
    ours = method in SETTINGS
    config = named_config(SETTINGS[method]).anchor if ours else AnchorConfig()
    return select_anchor(start.target, start.views, config)


def metric_depth(target: View, anchor: View, parts: Parts) -> DepthMap:
    """The measured depth of `target` where the data has it, in scene units.

    Elsewhere it is what Ψ says of the two photographs, before any registration, valid where the
    model measured it.
    """
    if target.depth is not None:
        return DepthMap(target.depth, target.depth > 0)
    return lift(parts.reconstructor, target, anchor).reference_depth


def depth_scale(
    added: Gaussians,
    holes: Bool[Tensor, "h w"],
    target: Camera,
    expected: DepthMap,
    renderer: Renderer,
) -> float | None:
    """How far away what was added stands, as a multiple of how far it should: 1 is metric.

    The median of D_added / D_expected over the pixels of `holes` where both are known, with
    D_added the z-depth of `added`, drawn alone, where it covers at least half of the pixel. Only
    the holes of the scene as it was count, because a method that adds there alone and one that
    covers the whole image are to be compared. None of fewer than `MIN_PIXELS`.
    """
    alone = renderer.render(added, target).depth_map()
    both = holes & alone.valid & expected.valid
    if both.sum() < MIN_PIXELS:
        return None
    return (alone.depth / expected.depth)[both].median().item()


def scale_drift(scales: Sequence[float | None]) -> float | None:
    """How much the depth scale s varies over a sequence: max(ln s) - min(ln s), of those known.

    0.1 means that its largest is 10 % above its smallest. None where fewer than two are known.
    """
    logarithms = [math.log(scale) for scale in scales if scale is not None]
    return max(logarithms) - min(logarithms) if len(logarithms) > 1 else None


def ended(course: Course, targets: Sequence[View], renderer: Renderer) -> Course:
    """`course`, each of its steps with the PSNR that the last scene has there."""
    steps = []
    for step, target in zip(course.steps, targets, strict=False):  # the last ones may have failed
        image = renderer.render(course.scene, target.camera).image
        steps.append(replace(step, psnr_end=psnr(image, target.image)))
    return replace(course, steps=tuple(steps))


def check_sequence_methods(methods: Sequence[str]) -> None:
    """Refuse methods that cannot complete a clip view after view.

    Raises:
        InputError: where there is one, or a name of none.
    """
    check_methods(methods)
    for name in methods:
        if name not in SUPPORTED:
            raise InputError(
                f"The method {name!r} changes the scene that is there, and in a sequence each step "
                "has to add to it; choose of context, full, paper, an ablation of these, and reggs."
            )


def evaluate_sequences(
    cases: Sequence[SequenceCase],
    methods: Sequence[str],
    out: Path,
    config: RunConfig = RunConfig(),
    shard: tuple[int, int] = (0, 1),
    again: Again = "nothing",
) -> Tally:
    """Complete every sequence of the shard by every method, and write a row for each pair.

    As with `evaluate`, what is there already stays, and a sequence that fails gives a row that
    says why. Each step is saved: a sequence that was stopped goes on after its last whole step.

    Args:
        cases: The sequences of all shards.
        methods: Names out of `SUPPORTED`.
        out: Folder of results: a new one, or that of an earlier call.
        config: What decides the numbers; the same as in earlier calls.
        shard: (i, n) takes the sequences i, i + n, i + 2n, …
        again: What of an earlier call is done once more.

    Raises:
        InputError: a wrong name or shard, a folder that holds something else, a full disk.
    """
    check_sequence_methods(methods)
    begin(cases, methods, out, config, shard)
    return make_rows(
        cases[shard[0] :: shard[1]],
        methods,
        partial(sequence_path, out),
        lambda case: SequenceBench(case, out, config).row,
        again,
    )


def sequence_path(out: Path, case: SequenceCase, method: str) -> Path:
    """Where the row of a sequence and a method lies."""
    return sequence_folder(out, case.name) / f"{slug(method)}.json"


@dataclass(frozen=True)
class Ready:
    """All that the methods share."""

    start: Start
    targets: tuple[View, ...]
    """Photographs of the targets, up to the first that cannot be read."""
    parts: Parts
    error: str | None
    """Why that one cannot be read; None where all can."""


class SequenceBench:
    """One sequence: its photographs and its context are read, or computed, once."""

    def __init__(self, case: SequenceCase, out: Path, config: RunConfig) -> None:
        self.case = case
        self.folder = sequence_folder(out, case.name)
        self.config = config
        self._ready: Ready | str | None = None

    def row(self, method: str) -> dict[str, Any]:
        """The steps of a method, and why there are no more.

        Raises:
            OutputError: where a result cannot be written.
        """
        if self._ready is None:
            self._ready = attempt(self._prepare)
        if isinstance(self._ready, str):
            return self._row_of(method, self._ready)
        ready = self._ready
        course = complete_in_sequence(
            ready.start, ready.targets, method, ready.parts, self.folder / slug(method)
        )
        return self._row_of(
            method,
            course.error or ready.error,
            gaussians={"context": len(ready.start.context), "after": len(course.scene)},
            seconds={"context": ready.start.seconds},
            steps=[asdict(step) for step in course.steps],
        )

    def _prepare(self) -> Ready:
        device = self.config.device
        views = [view.to(device) for view in self.case.load(self.case.context)]
        targets, error = self._photographs()
        if error is not None and not targets:
            raise InputError(error)
        parts = self.config.parts(*targets)
        start = start_at(self.folder / "start.npz", views, targets[0], parts)
        near, far = start.target.near, start.target.far
        ranged = ranged_truth(start.views, targets[0], targets, near, far).neighbours
        return Ready(start, ranged, parts, error)

    def _photographs(self) -> tuple[list[View], str | None]:
        """Those of the targets up to the first that cannot be read, and why it cannot."""
        targets: list[View] = []
        for frame in self.case.targets:
            loaded = attempt(partial(self.case.load, (frame,)))
            if isinstance(loaded, str):
                return targets, f"Frame {frame}: {loaded}"
            targets += (replace(v, frame=frame).to(self.config.device) for v in loaded)
        return targets, None

    def _row_of(self, method: str, error: str | None = None, **content: Any) -> dict[str, Any]:
        sequence = {
            "name": self.case.name,
            "context": list(self.case.context),
            "targets": list(self.case.targets),
        }
        nothing: dict[str, Any] = {"gaussians": None, "seconds": None, "steps": []}
        return {
            "version": VERSION,
            "sequence": sequence,
            "method": method,
            "error": error,
            **nothing,
            **content,
        }
