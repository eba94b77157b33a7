"""Photographs and cameras that a command line names: the context and the targets."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

from gscompleter.apps.inputs.task import Target
from gscompleter.apps.requests.scene import FRAME_NUMBER
from gscompleter.data.camera_files import is_in_splat_frame
from gscompleter.data.file_names import PHOTOGRAPH_ENDINGS
from gscompleter.data.panorama import has_panoramas
from gscompleter.data.photographs import Photographs, Resolution
from gscompleter.data.scene import load_cameras
from gscompleter.data.sfm.poses import list_photograph_files
from gscompleter.data.video import is_video
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.names import fold_name, make_colmap_name

PhotographNames = Sequence[int | str]
"""Photographs by number, from 0, or by name."""


def find_context(photographs: Photographs, context: PhotographNames | None) -> tuple[int, ...]:
    """Find the frames of `--context`; empty if it is not given."""
    frames = tuple(find_frame(photographs, word, "context") for word in context or ())
    # Equal words were refused before, but a name and a number can mean one photograph.
    if len(set(frames)) < len(frames):
        twice = next(frame for frame in frames if frames.count(frame) > 1)
        name = quote_value(photographs.frame(twice).file_name)
        raise InputError(f"--context names photograph {twice} ({name}) twice; name different ones.")
    return frames


def find_frame(photographs: Photographs, word: int | str, option: str) -> int:
    """Find the frame of a word of an option: a number, or the name of a photograph."""
    number = int(word) if FRAME_NUMBER.fullmatch(str(word)) else word
    try:
        return photographs.find_frame(number)
    except InputError as error:
        # Of a name that several photographs have, the sentence lists these.
        is_unknown = isinstance(number, str) and not photographs.match_names(number)
        if option == "target" and is_unknown:
            example = quote_value(photographs.frame(0).file_name)
            raise InputError(
                f"'{quote_value(word)}' is no target: name a photograph or its number from 0 "
                f"to {len(photographs) - 1}, such as {example}, or an existing "
                "file of cameras, such as a transforms.json.",
                option,
            ) from error
        raise InputError(str(error), option) from error


def refuse_missing_photographs(folder: Path, words: PhotographNames, num_video_frames: int) -> None:
    """Refuse photographs that `folder` does not have, before the search for their cameras.

    Of a video, `num_video_frames` serve as photographs at most, and they have no names yet. Each
    panorama is split into several photographs, so that any number is possible. Words without an
    ending, which may be files of cameras, are not judged.
    """
    named = [word for word in map(str, words) if names_photograph(word)]
    names = [word for word in named if not FRAME_NUMBER.fullmatch(word)]
    frames = [int(word) for word in named if word not in names]
    if is_video(folder):
        count = num_video_frames
    else:
        files = list_photograph_files(folder)
        count = len(files)
        # Telling panoramas apart opens each photograph, so it is done only if a word needs it.
        if named and has_panoramas([folder / name for name in files]):
            return
        # Folders and endings of the names are compared once cameras are known. Then photographs
        # have the names of their copies for COLMAP, which are understood as well.
        stems = {fold_stem(name) for name in files}
        stems |= {fold_stem(make_colmap_name(name)) for name in files}
        for word in names:
            if fold_stem(word) not in stems:
                raise InputError(
                    f"There is no photograph '{quote_value(word)}' among the {count} of "
                    f"{quote_value(folder)}; name one of them, such as "
                    f"'{quote_value(Path(files[0]).name)}', or its number from 0 to {count - 1}."
                )

    for frame in frames:
        if not 0 <= frame < count:
            raise InputError(
                f"There is no frame {frame} among the {count} photographs of "
                f"{quote_value(folder)}; name frames from 0 to {count - 1}."
            )


def check_target_files(words: Sequence[str], resolution: Resolution) -> None:
    """Refuse targets that are neither photographs nor files of cameras, and files that are damaged.

    It is called before cameras of photographs are searched for, when names are not yet compared.
    """
    for word in words:
        if names_photograph(word):
            continue
        if not os.path.exists(word):
            raise InputError(
                f"'{quote_value(word)}' is no target: name a photograph with its ending, "
                "or its number, or an existing file of cameras, such as a transforms.json.",
                "target",
            )
        load_cameras(word, resolution)


def read_targets(
    photographs: Photographs, words: Sequence[str], resolution: Resolution, has_splat: bool
) -> list[Target]:
    """Read the target cameras in the order of the command line.

    `has_splat` is True if an input splat is completed, whose frame files of cameras may be in.
    """
    targets: list[Target] = []
    for word in words:
        # Numbers and photographs are those of the scene, whatever the working folder holds.
        if os.path.exists(word) and not names_photograph(word):
            cameras = load_cameras(word, resolution, origin=photographs.origin.tolist())
            is_of_splat = has_splat and is_in_splat_frame(Path(word))
            targets += [Target(camera, is_in_splat_frame=is_of_splat) for camera in cameras]
        else:
            frame = find_frame(photographs, word, "target")
            targets.append(Target(photographs.camera(frame, resolution), frame))
    return targets


def fold_stem(name: str) -> str:
    """Fold the name of a photograph without its folders, of any system, and without its ending."""
    return fold_name(PurePosixPath(name.replace("\\", "/")).stem)


def names_photograph(word: str) -> bool:
    """Return True if a word is the number or the file of a photograph, not a file of cameras.

    A name without its ending may be either.
    """
    is_number = FRAME_NUMBER.fullmatch(word) is not None
    return is_number or word.lower().endswith(PHOTOGRAPH_ENDINGS)


def add_photograph(target: Target, photographs: Photographs, resolution: Resolution) -> Target:
    """Add its photograph to a target, if there is one."""
    if target.frame is None or not photographs.frame(target.frame).has_photograph():
        return target
    (view,) = photographs.views([target.frame], resolution)
    return replace(target, photograph=view.image, ignore_mask=view.ignore_mask)
