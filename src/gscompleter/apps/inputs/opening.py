"""Opening of a scene: its photographs and their cameras, found or given."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from rich.console import Console

from gscompleter.apps.inputs.describing import print_lines
from gscompleter.apps.inputs.named_photographs import refuse_missing_photographs
from gscompleter.apps.inputs.removal import check_removal_masks
from gscompleter.apps.inputs.selection import collect_usable_cameras
from gscompleter.apps.inputs.task import Opened
from gscompleter.apps.requests.scene import DEFAULT_LONG_SIDE, PosesRequest, SceneRequest
from gscompleter.data.camera_files import refuse_other_exports
from gscompleter.data.formats import find_format, open_photographs, refuse_scenes_below
from gscompleter.data.frame import FOLDERS
from gscompleter.data.limits import check_planes
from gscompleter.data.mask_checks import read_masks_as_asked, refuse_nothing_to_invert
from gscompleter.data.mask_reading import MaskReading
from gscompleter.data.masks import (
    describe_unnamed_masks,
    find_masks_in,
    lies_in,
    make_no_mask_error,
)
from gscompleter.data.photographs import Photographs, check_resolution
from gscompleter.data.sfm import NUM_VIDEO_FRAMES
from gscompleter.data.sfm.poses import find_poses, has_photographs, list_all_photographs
from gscompleter.data.unused_files import list_unused
from gscompleter.data.video import is_video
from gscompleter.splats.alignment.training_size import find_training_size
from gscompleter.splats.foreign import holds_splat_alone, is_named_splat
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.output_folder import FOUND_POSES_FOLDER, refuse_link
from gscompleter.system.files.result_names import SUMMARY_FILE

NUM_SIZE_PHOTOGRAPHS = 8
"""Number of photographs that are enough to find the size of a training by."""


def open_scene(
    request: SceneRequest,
    search: PosesRequest,
    console: Console,
    check: Callable[[], object] = lambda: None,
) -> Opened:
    """Open the photographs or video. If they have no cameras, these are found and kept.

    `search` says where they are kept. `check` is called before the search, which takes minutes, and
    raises what would end the command after it.

    Raises:
        InputError: There are no photographs, cameras or masks as asked for.
    """
    folder = request.folder
    refuse_splat_as_photographs(folder)
    refuse_frames_of_no_video(folder, search.num_frames)
    check_planes(request.near, request.far)
    check_resolution(request.resolution)
    if request.format is None and find_format(folder) is None and has_photographs(folder):
        # The search takes minutes: whatever would be refused after it is refused now.
        check_before_search(request, search, console)
        check()
        return find_cameras(request, search, console)

    photographs = open_photographs(folder, request.format, request.near, request.far)
    photographs = read_masks(photographs, request, request.masks)
    print_lines(console, *photographs.notes)
    assert photographs.format is not None
    return Opened(request, photographs, photographs.format, len(photographs))


def refuse_splat_as_photographs(folder: Path) -> None:
    """Raise InputError for a file or folder of Gaussians where photographs are wanted."""
    is_file = is_named_splat(folder)
    if is_file or (os.path.isdir(folder) and holds_splat_alone(folder)):
        kind = "file" if is_file else "folder"
        raise InputError(
            f"{quote_value(folder, 80)} is a {kind} of Gaussians, which goes to --scene; SCENE has "
            "to be the folder of its photographs, with or without cameras, or a video."
        )


def check_before_search(request: SceneRequest, search: PosesRequest, console: Console) -> None:
    """Refuse, before cameras are searched for, what would end the command after that."""
    folder = request.folder
    refuse_other_exports(folder)
    refuse_scenes_below(folder)
    print_lines(console, *describe_cameras_above(folder))
    refuse_missing_photographs(folder, search.named, search.num_frames)
    # Masks of a video's frames, which have no names before they are taken, are checked after that.
    if request.removal_masks is not None and not is_video(folder):
        names = list_all_photographs(folder)
        files = [folder / name for name in names]
        refuse_masks_among_photographs(request.removal_masks, names, files, "mask")
        check_removal_masks(request.removal_masks, names, files, request.removal_reading)
    if request.masks.folder is not None:
        print_lines(console, *check_ignoring_masks(request.masks.folder, folder))


def find_cameras(request: SceneRequest, search: PosesRequest, console: Console) -> Opened:
    """Open photographs without cameras, or a video: COLMAP finds these once.

    They are kept with copies of the photographs, which a later run reads again.
    """
    # A folder of poses with a summary was written by us, and may be continued or replaced.
    kept = search.out / FOUND_POSES_FOLDER
    refuse_link(kept)
    may_replace = search.overwrite or os.path.isfile(kept / SUMMARY_FILE)
    poses = find_poses(request.folder, kept, may_replace, search.num_frames, request.search_masks)
    print_lines(console, *poses.notes)

    photographs = open_photographs(kept, None, request.near, request.far)
    # The masks of the copies are black where something is hidden, however those of the originals
    # are read. Whether they hide too much was checked on the originals, before the search.
    photographs = read_masks(photographs, request, MaskReading(may_be_large=True))
    print_lines(console, *photographs.notes)
    # What lies beside the user's photographs, not beside the copies.
    unused = list_unused(request.folder, (), has_found_cameras=True)
    photographs = replace(photographs, unused=unused)
    # The user gave photographs, of which COLMAP may not have found all cameras. Their number is
    # reported, and not the format and number of what COLMAP wrote.
    return Opened(request, photographs, "photographs", poses.photographs)


def read_masks(
    photographs: Photographs, request: SceneRequest, reading: MaskReading
) -> Photographs:
    """Return photographs with the masks that hide parts of them, as `reading` says.

    Raises InputError if a folder that is named has no mask, or masks look the other way round.
    """
    if not request.uses_masks:
        photographs = photographs.leave_out_masks()
    # Masks of what is to be removed may lie in the scene, and are not those of what to ignore.
    if request.removal_masks is not None:
        names = [frame.name for frame in photographs.frames]
        check_removal_masks(
            request.removal_masks, names, photographs.files, request.removal_reading
        )
        photographs = photographs.leave_out_masks_in(request.removal_masks)
    if reading.folder is not None:
        photographs = photographs.take_masks_of(reading.folder)
    refuse_nothing_to_invert(photographs.list_masks(), reading)
    return read_masks_as_asked(photographs, reading)


def check_ignoring_masks(masks: Path, folder: Path) -> list[str]:
    """Refuse a folder of masks to ignore, unless it has masks of photographs in `folder`.

    Returns a line on masks that are named as no photograph, or none.
    """
    if is_video(folder):
        raise InputError(
            "The photographs of a video have no names before they are taken; run `gscompleter "
            "poses` first, and name its folder as SCENE and masks of its images.",
            "ignore",
        )
    names = list_all_photographs(folder)
    files = [folder / name for name in names]
    refuse_masks_among_photographs(masks, names, files, "ignore")
    found = find_masks_in(masks, names, files)
    if not any(found):
        raise make_no_mask_error(masks, names)
    return describe_unnamed_masks(masks, found, files)


def refuse_masks_among_photographs(
    masks: Path, names: Sequence[str], files: Sequence[Path], option: str
) -> None:
    """Refuse a folder of masks that the search for cameras would take for photographs.

    Such a folder lies among the photographs, and its masks are called as these are. The search
    takes every image for a photograph but the mask beside one (`x_mask.png` beside `x.jpg`), and no
    photograph is taken for a mask, so that no mask is found. Where one is found, the photographs in
    the folder are what they seem: the masks lie beside them.

    Args:
        masks: Folder of masks, as the user named it.
        names: The photographs without cameras, relative to their folder.
        files: Their files.
        option: Option that names the masks, for the error.

    Raises:
        InputError: The folder holds photographs and no masks, or a mask may be of several.
    """
    holds_photographs = any(lies_in(file, masks) for file in files)
    if holds_photographs and not any(find_masks_in(masks, names, files, option)):
        raise InputError(
            f"{quote_value(masks)} lies among the photographs, and would be taken for some; move "
            "it out of their folder.",
            option,
        )


def choose_working_size(opened: Opened, splat: Path, console: Console) -> Opened:
    """Choose the working size for a splat: that of its training, if smaller than the default one.

    It is for scenes whose user named no size. Where the size of the training cannot be told, the
    scene is returned as it was. A larger one is only reported: details beyond the default size cost
    much time, and no harm is done where a splat is rendered smaller than it was trained.
    """
    photographs = opened.photographs
    numbers = photographs.posed[:NUM_SIZE_PHOTOGRAPHS]
    usable = collect_usable_cameras(photographs, numbers, DEFAULT_LONG_SIDE)
    trained = find_training_size(splat, opened.request.folder, photographs, list(usable))
    if trained is None:
        return opened
    side = DEFAULT_LONG_SIDE
    sentence = f"{quote_value(splat)} was trained at {trained.long_side} px"
    sentence += f" ({quote_value(trained.source)})"
    if trained.long_side <= DEFAULT_LONG_SIDE:
        side = trained.long_side
        sentence += ", which is the working size; --resolution changes it."
    else:
        sentence += f"; the working size stays {side} px unless --resolution changes it."
    print_lines(console, sentence)
    return opened.with_resolution(side)


def describe_cameras_above(folder: Path) -> list[str]:
    """Say that the folder above one of photographs has their cameras, which are not used."""
    # Its own name has to be known, which `.` for the working folder does not tell.
    whole = Path(os.path.abspath(folder))
    if whole.name.casefold() not in FOLDERS:
        return []
    above = whole.parent
    format = find_format(above)
    # Any folder with one image has the format `photograph`, which needs no cameras.
    if format is None or format == "photograph":
        return []
    return [
        f"{quote_value(above)} has cameras of these photographs ({format}); name that folder to "
        "use them. Here they are found anew."
    ]


def refuse_frames_of_no_video(path: Path, num_frames: int) -> None:
    """Raise InputError if the user limits the frames of what is there and no video.

    The default that is typed all the same cannot be told from one that is not.
    """
    if num_frames != NUM_VIDEO_FRAMES and path.exists() and not is_video(path):
        raise InputError(
            f"--frames chooses from a video, and {quote_value(path, 80)} is none; leave it out.",
            "frames",
        )
