"""The command `complete`: fill what the photographs of a scene do not show."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Interval

from gscompleter.apps.commands.shared_decisions import (
    Adapt,
    check_context,
    check_generator,
    check_splat_named,
    decide_filling,
    decide_results,
)
from gscompleter.apps.commands.shared_options import CompletingOptions, list_inputs
from gscompleter.apps.requests.completion import (
    DEFAULT_NUM_TARGETS,
    CompletionRequest,
    ExportRequest,
    FillingRequest,
    PlanRequest,
    RepairRequest,
    Request,
    TargetRequest,
)
from gscompleter.apps.requests.scene import Names
from gscompleter.config import CompleterConfig
from gscompleter.config.generators import GeneratorOptions, PaintedOptions
from gscompleter.data.mask_reading import MaskReading
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.overlap import do_overlap, refuse_overlap
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class CompleteOptions(CompletingOptions):
    """Fill the parts of a scene that its photographs do not show, and write the result.

    Example: gscompleter complete photographs --out result
    """

    target: tuple[str, ...] = ()
    """Target cameras: file names or numbers of photographs, or a file of cameras (transforms.json,
    cameras.json, nerfstudio's camera_path.json, COLMAP's images.txt, SuperSplat poses).
    If not given, cameras that see holes are searched for and written to targets.json."""
    mask: tuple[Path, ...] = ()
    """Masks of what goes, white there. An image for each target camera, in their order. What is
    marked is removed, counts as a hole whatever stands behind it, and is filled; `strip` puts it
    back."""
    auto: Annotated[int, Interval(ge=1, le=254)] | None = None
    """Most cameras to search for if no target is given; 4 if no number follows."""
    dry_run: bool = False
    """Only show what would be done. The plan is printed, its cameras are written to targets.json,
    which `--target` reads, and what they see to images."""
    export_holes: Path | None = None
    """Only write to this folder what another program needs to paint the holes of the targets. The
    same command with `--images` completes the scene."""
    path: bool = False
    """With `--export-holes`, also write a video along the targets and its mask."""
    images: Path | None = None
    """Folder of painted images or of a repaired video, named as `--export-holes` did, in place of a
    generator. Without `--target`, its holes.json has the targets."""
    painter: str | None = None
    """Name of their painter, for the report."""
    out: Path
    """Write results here. A folder, for completed.ply, the report (report.html), images and
    summary.json."""
    save_as: Literal[".ply", ".spz", ".sog"] | None = None
    """Keep results small: write the completed scene in this format, with its labels, and
    context.ply only if it differs from the input splat. `.spz` and `.sog` round, so that `strip`
    does not give back the same bytes."""
    video: bool = False
    """Also write video.mp4: a flight through the holes, before beside after."""

    def check_overlap(self) -> None:
        """Refuse an output that is, holds or lies in an input or the other output."""
        super().check_overlap()
        folder = self.export_holes
        if folder is None:
            return
        refuse_overlap(folder, list_inputs(self), "export-holes", may_continue=False)
        if do_overlap(folder, self.out):
            raise InputError(
                f"{quote_value(folder)} and OUT have to lie apart from each other, since what is "
                "painted is an input of the completion; name another folder.",
                "export-holes",
            )


def decide_completion(options: CompleteOptions) -> Request:
    """Decide what is done; with masks, what they mark goes first."""
    marks = options.mask
    if not marks:
        return choose_ending(options, decide_holes(options, has_marks=False))
    check_splat_named(options, "marked")
    if not options.target:
        raise InputError(
            "A mask is painted on the image of a target; name the camera of each with --target.",
            "mask",
        )
    completion = decide_holes(options, has_marks=True, adapt=CompleterConfig.for_marks)
    reading = MaskReading(options.invert_masks, options.large_masks)
    return choose_ending(options, RepairRequest(completion, marks, reading))


def decide_holes(
    options: CompleteOptions, has_marks: bool, adapt: Adapt = lambda config: config
) -> CompletionRequest:
    """Decide which holes are filled, and by what: a generator, or images that were painted.

    `has_marks` and `adapt` are those of `decide_filling`.
    """
    check_context(options.context)
    if options.target and options.auto is not None:
        raise InputError(
            "--target and --auto are both given; use one of them, and complete the result again "
            "with the other.",
            "auto",
        )
    check_ending(options)
    if options.images is None:
        check_generator(options.synthesis.generator)
        cameras = NamedCameras(options.target, options.context)
        synthesis = options.synthesis
    else:
        check_painted(options)
        cameras = name_painted_cameras(options, options.images)
        synthesis = PaintedOptions(generator_painter=options.painter)
    max_found = DEFAULT_NUM_TARGETS if options.auto is None else options.auto
    results = replace(decide_results(options), suffix=options.save_as, has_video=options.video)
    return decide_filling(
        options,
        TargetRequest(cameras.targets, max_found, options.images),
        results,
        context=cameras.context,
        synthesis=synthesis,
        has_marks=has_marks,
        adapt=adapt,
    )


@dataclass(frozen=True)
class NamedCameras:
    """Targets and context as they are named.

    Without targets these are searched for, and without a context it is chosen.
    """

    targets: tuple[str, ...]
    context: Names | None


def name_painted_cameras(options: CompleteOptions, folder: Path) -> NamedCameras:
    """Name the targets and the context of painted images, after reading these.

    Where none are named, those of `holes.json` are taken: of another context Ψ makes another scene,
    with other holes.
    """
    from gscompleter.apps.inputs.holes_file import HOLES_FILE, has_holes, read_holes
    from gscompleter.apps.inputs.paintings import check_paintings

    check_paintings(folder, len(options.target))
    if not has_holes(folder):
        return NamedCameras(options.target, options.context)
    targets = options.target or (str(folder / HOLES_FILE),)
    context = options.context
    if context is None:
        # None is listed where renders take the place of photographs, at cameras that are found.
        context = read_holes(folder).context or None
    return NamedCameras(targets, context)


def check_ending(options: CompleteOptions) -> None:
    """Refuse options for exported holes that exclude others, and a painter of nothing."""
    is_export = options.export_holes is not None
    if options.path and not is_export:
        raise InputError(
            "--path is a video of what --export-holes writes; name its folder.", "export-holes"
        )
    if options.images is None and options.painter is not None:
        raise InputError("--painter names who painted --images; name their folder.", "images")
    if options.images is not None and is_export:
        raise InputError(
            "--export-holes and --images are both given; export the holes, paint them, and run the "
            "command again with the images alone.",
            "images",
        )
    if is_export and (options.dry_run or options.video or options.save_as):
        raise InputError(
            "--export-holes completes nothing; leave --dry-run, --video and --save-as out.",
            "export-holes",
        )
    # The command with the painted images, which is the same otherwise, takes none either.
    if is_export and options.synthesis != GeneratorOptions():
        raise InputError(
            "--export-holes generates nothing; leave --generator and its options out.", "generator"
        )


def check_painted(options: CompleteOptions) -> None:
    """Refuse options that have no effect on images that were painted elsewhere."""
    if options.synthesis not in (GeneratorOptions(), GeneratorOptions("painted")):
        raise InputError(
            "--images takes the place of a generator; leave --generator and its options out.",
            "generator",
        )
    if options.auto is not None:
        raise InputError(
            "--images needs the targets that the images were painted for; leave --auto out.",
            "images",
        )


def choose_ending(options: CompleteOptions, filling: FillingRequest) -> Request:
    """Choose what is done with the holes: they are filled, exported, or only planned."""
    if options.export_holes is not None:
        return ExportRequest(
            filling, options.export_holes, options.path, names_number=options.auto is not None
        )
    return PlanRequest(filling) if options.dry_run else filling


def run_complete(options: CompleteOptions) -> int:
    """Complete the scene, and print a summary. Exit code 1 if the scene did not reconstruct."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.completing.complete import run_request
    return run_request(decide_completion(options))
