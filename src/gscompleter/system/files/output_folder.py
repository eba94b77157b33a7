"""Output folders: written completely or left as they were, and replaced file by file.

`summary.json` of an output folder lists under `files` what its run wrote. `--overwrite` replaces
these files and no others: whatever else lies in the folder stays, and a file in the way of a result
is refused.

A folder may come from elsewhere, in an archive or a repository. So its names lead to nothing
outside of it, links in it are not followed, and what a killed run seems to have left is finished
only as far as that run could have done it.

A session of `live` writes its steps before it saves anything: `strokes.json`, beside which its
masks are. These files count as listed, too.
"""

from __future__ import annotations

import errno
import json
import os
import random
import re
import shutil
import stat
import time
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from gscompleter.system.errors import InputError, join_names, quote_value
from gscompleter.system.files.early_results import describe_early
from gscompleter.system.files.names import is_hidden_name
from gscompleter.system.files.renaming import rename
from gscompleter.system.files.result_format import RESULT_MARK, is_marked, refuse_later
from gscompleter.system.files.result_names import STROKES_FILE, SUMMARY_FILE
from gscompleter.system.files.unfinished import (
    REPLACED_SUFFIX,
    UNFINISHED_PREFIX,
    Unfinished,
    give_signs,
    is_unfinished,
    list_unfinished,
    make_unfinished_name,
    remove_left_behind,
)
from gscompleter.system.files.writing import convert_write_errors, keep_permissions
from gscompleter.system.interrupts import defer_interrupts

FILES = "files"
"""Entry of `summary.json`: the files of the run."""
COMMAND_KEY = "command"
"""Entry of `summary.json`: the command that wrote them."""
WRITING_COMMANDS = frozenset({"bench", "clean", "complete", "demo", "poses"})
"""Commands that write an output folder. One of them is named by the summaries of versions before
formats had numbers, which do not name the program."""
FOUND_POSES_FOLDER = "colmap"
"""Folder of the cameras that a completion found for its photographs; it has its own summary."""

STROKES_FOLDER = "images"
STROKE_MASK = re.compile(r"stroke\d{1,6}\.png")
"""Name of a mask of a session, in `STROKES_FOLDER`."""

MAX_SUMMARY_BYTES = 10**9
MAX_FOREIGN_NAME_LENGTH = 60
MAX_FOREIGN_FILES = 5
"""Most foreign files that a sentence names."""
ATTEMPTS = 4
"""Attempts of two runs that reserve a folder at the same moment."""
MAX_WAIT_SECONDS = 0.2
"""Longest time between two attempts."""

_DISK_ERRORS = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS}


@dataclass
class OutputFolder:
    """An output folder that no other run may write to meanwhile."""

    path: Path
    """The folder, as the user names it."""
    command: str
    draft: Path
    """Folder for results that are not complete."""
    others: Sequence[str]
    """Files and folders in it that no run of ours wrote. They stay."""

    @contextmanager
    def write(self) -> Iterator[Path]:
        """Open a folder whose content replaces that of an earlier run at the end.

        A new output folder is made by one rename. In an existing one the files of the earlier run
        make way for the new ones, the summary leaves first and arrives last. After any exception
        everything is as it was.
        """
        target = Path(os.path.realpath(self.path))
        try:
            with convert_write_errors(self.path, _DISK_ERRORS):
                self.draft.mkdir(parents=True, exist_ok=True)
                yield self.draft
            state = f"{quote_value(self.path)} is complete"
            with convert_write_errors(self.path), defer_interrupts(state):
                _list_in_summary(self.draft, self.command)
                _publish(self.draft, target)
        except InputError as error:
            # The temporary name means nothing to the user.
            whole = str(error.args[0]).replace(str(self.draft), str(self.path))
            raise type(error)(whole, error.argument) from error
        finally:
            # What was not published must not get among the results of a later call.
            shutil.rmtree(self.draft, ignore_errors=True)

    def describe_others(self) -> list[str]:
        """Write the line on what stays in the folder; none if there is nothing else."""
        if not self.others:
            return []
        names = join_names(self.others, MAX_FOREIGN_FILES)
        return [f"Kept: {names} in {quote_value(self.path)}, which no run wrote."]


@contextmanager
def reserve_output(
    path: Path | str,
    overwrite: bool = False,
    command: str = "",
    patterns: Sequence[str] = (),
    takes_over: bool = False,
) -> Iterator[OutputFolder]:
    """Reserve a folder for the results of this process, by trying to write to it.

    Raise an InputError if it is not empty and `overwrite` is not set, if another run is writing it,
    or if it has files that match `patterns` (globs of the results) and that no earlier run wrote.
    `takes_over` is for a caller that knows that no other run is left.
    """
    given = Path(path)
    target = Path(os.path.realpath(path))
    with ExitStack() as stack:
        draft = stack.enter_context(_reserve(given, target, overwrite, takes_over))
        # Killed runs first: what they completed counts as an earlier result.
        is_finished = _finish_interrupted(given, target)
        remove_left_behind(target)
        remove_left_behind(target.parent, target.name)
        if is_finished:
            _check_free(given, target, overwrite)
        refuse_later_results(target)
        with convert_write_errors(given):
            listed = read_listing(target)
            _refuse_unlisted(given, target, [*patterns, *_match(target, patterns)], listed)
            others = list(_list_others(target, listed))
        stack.enter_context(give_signs(draft))
        yield OutputFolder(given, command, draft, others)


@contextmanager
def open_output_folder(
    path: Path | str, overwrite: bool = False, command: str = ""
) -> Iterator[Path]:
    """Reserve a folder, and open the one that becomes its content at the end."""
    with reserve_output(path, overwrite, command) as output, output.write() as folder:
        yield folder


def check_output(path: Path | str, overwrite: bool = False) -> None:
    """Raise an InputError if results cannot be written to this folder, by trying."""
    with reserve_output(path, overwrite):
        pass


def read_listing(folder: Path) -> frozenset[str]:
    """Read which files a run of ours wrote to a folder, as relative paths; empty if none did.

    Names that lead out of the folder are left out, also through links.
    """
    content = _read_own_summary(folder)
    names = None if content is None else content.get(FILES)
    if not isinstance(names, list) or SUMMARY_FILE not in names:
        names = []
    inside = [name for name in names if isinstance(name, str) and _is_inside(name)]
    listed = frozenset(name for name in inside if _find_obstacle(folder, name) is None)
    return listed | list_session(folder)


def holds_session(folder: Path) -> bool:
    """Return True if a session of `live` wrote its steps to a folder."""
    return is_marked(_read_content(folder / STROKES_FILE))


def list_session(folder: Path) -> frozenset[str]:
    """List the files in which a session keeps its steps, as relative paths; empty without one."""
    if not holds_session(folder):
        return frozenset()
    masks = list[str]()
    with suppress(OSError):
        masks = [
            name for name in os.listdir(folder / STROKES_FOLDER) if STROKE_MASK.fullmatch(name)
        ]
    names = (STROKES_FILE, *(f"{STROKES_FOLDER}/{name}" for name in masks))
    return frozenset(name for name in names if _find_obstacle(folder, name) is None)


def holds_results(folder: Path) -> bool:
    """Return True if a run of ours wrote the folder."""
    return bool(read_listing(folder))


def read_command(folder: Path) -> str | None:
    """Read which command wrote an output folder; None if it is unknown."""
    content = _read_own_summary(folder)
    if content is None or not holds_results(folder):
        return None
    command = content.get(COMMAND_KEY)
    return command if isinstance(command, str) else None


def refuse_foreign_file(folder: Path, name: str) -> None:
    """Refuse to write a result again where a link has its name, or a file that no run wrote."""
    listed = read_listing(folder)
    is_link = os.path.islink(folder / name)
    _refuse_unlisted(folder, folder, [name], listed - {name} if is_link else listed)


def refuse_later_results(folder: Path) -> None:
    """Raise InputError if a later version wrote the results in a folder."""
    refuse_later(_read_own_summary(folder), quote_value(folder / SUMMARY_FILE))


def refuse_link(folder: Path) -> None:
    """Refuse an inner folder of results that is a link: what it names may lie anywhere."""
    if os.path.islink(folder):
        raise InputError(
            f"{quote_value(folder)} is a link, and results are written to real folders; remove it, "
            "or name another output folder.",
            "out",
        )


def _read_summary(folder: Path) -> dict[str, Any]:
    """Read the summary of a folder; empty if there is none."""
    return _read_content(folder / SUMMARY_FILE)


def _read_content(path: Path) -> dict[str, Any]:
    """Read a JSON file of a folder; empty if there is none, or if it is a link."""
    try:
        if not stat.S_ISREG(path.lstat().st_mode) or path.stat().st_size > MAX_SUMMARY_BYTES:
            return {}
        content = json.loads(path.read_bytes())
    except (OSError, ValueError, RecursionError):
        return {}
    return content if isinstance(content, dict) else {}


def _read_own_summary(folder: Path) -> dict[str, Any] | None:
    """Read the summary of a folder; None if there is none, or if another program wrote it.

    That of an early version, which listed no files, gets the entries of later ones.
    """
    content = _read_summary(folder)
    command = content.get(COMMAND_KEY)
    if is_marked(content) or (isinstance(command, str) and command in WRITING_COMMANDS):
        return content
    early = describe_early(folder, content)
    return None if early is None else {**content, COMMAND_KEY: early.command, FILES: early.files}


@contextmanager
def _reserve(given: Path, target: Path, overwrite: bool, takes_over: bool) -> Iterator[Path]:
    """Create the draft of a folder, in it or beside it, with missing parents.

    Of two runs that begin at the same moment both see each other and give way; each tries again
    after another time.
    """
    home = target if os.path.isdir(target) else target.parent
    # Parents that this run makes are removed again if nothing comes of it.
    missing = [folder for folder in (home, *home.parents) if not os.path.exists(folder)]
    draft = home / make_unfinished_name(target.name)
    try:
        for attempt in range(1, ATTEMPTS + 1):
            with convert_write_errors(given):
                _check_free(given, target, overwrite)
                draft.mkdir(parents=True)
            rival = None if takes_over else _find_rival(draft, target)
            if rival is None:
                break
            draft.rmdir()
            if attempt == ATTEMPTS:
                raise InputError(rival.describe_folder(given), "out")
            time.sleep(random.uniform(0, MAX_WAIT_SECONDS))
        yield draft
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        for folder in missing:
            with suppress(OSError):
                folder.rmdir()


def _find_rival(draft: Path, target: Path) -> Unfinished | None:
    """Find the draft of another run that writes the same folder."""
    places = [*list_unfinished(target.parent, target.name), *list_unfinished(target, target.name)]
    for entry in places:
        if entry.path != draft and not entry.is_own() and entry.is_running():
            return entry
    return None


def _check_free(given: Path, target: Path, overwrite: bool) -> None:
    """Raise an error if `target` is a file or contains something that must not be overwritten."""
    names = list[str]()
    with suppress(FileNotFoundError):
        names = sorted(name for name in os.listdir(target) if not is_unfinished(name))
    if names == [FOUND_POSES_FOLDER] and os.path.isfile(target / FOUND_POSES_FOLDER / SUMMARY_FILE):
        return  # only the cameras that an earlier run found
    if names and not overwrite:
        # What `ls` does not show is named.
        is_hidden = all(is_hidden_name(name) for name in names)
        held = f" (it holds {join_names(names, MAX_FOREIGN_FILES)})" if is_hidden else ""
        raise InputError(
            f"The output folder {quote_value(given)} is not empty{held}; name another one, or "
            "overwrite the results in it.",
            "overwrite",
        )


def _match(folder: Path, patterns: Iterable[str]) -> Iterator[str]:
    """List the entries of a folder that match globs, as relative paths, but no folders."""
    for pattern in patterns:
        for path in sorted(folder.glob(pattern)):
            if os.path.islink(path) or not os.path.isdir(path):
                yield path.relative_to(folder).as_posix()


def _refuse_unlisted(
    given: Path, target: Path, names: Iterable[str], listed: frozenset[str]
) -> None:
    """Refuse to replace what no earlier run wrote, and what is no regular file."""
    for name in names:
        obstacle = _find_obstacle(target, name)
        if obstacle is None and name not in listed and os.path.lexists(target / name):
            obstacle = name
        if obstacle is not None:
            raise InputError(
                f"{quote_value(given / obstacle)} is in the way of a result, and only files that "
                f"an earlier run wrote (listed in {SUMMARY_FILE}) are replaced; move it, or name "
                "another folder.",
                "out",
            )


def _find_obstacle(folder: Path, name: str) -> str | None:
    """Find what keeps a file from being written to `folder / name`; None if nothing does.

    It is anything but a folder in the place of one, also a link to a folder elsewhere, or anything
    but a file in the place of the file.
    """
    # From the outermost parent on; below one that does not exist, nothing is in the way.
    parts = PurePosixPath(name).parts
    for depth in range(1, len(parts)):
        inner = "/".join(parts[:depth])
        try:
            mode = os.lstat(folder / inner).st_mode
        except OSError:
            return None
        if not stat.S_ISDIR(mode):
            return inner
    try:
        mode = os.lstat(folder / name).st_mode
    except OSError:
        return None
    # A link is replaced itself, and what it names is kept.
    return None if stat.S_ISREG(mode) or stat.S_ISLNK(mode) else name


def _is_inside(name: str) -> bool:
    """Return True if a relative path leads to a file within its folder, and not to a hidden one."""
    path = PurePosixPath(name)
    return (
        name == str(path)
        and not path.is_absolute()
        and ".." not in path.parts
        and "\\" not in name
        and "\0" not in name
        and path.parts != ()
        and not any(part.startswith(UNFINISHED_PREFIX) for part in path.parts)
    )


def _list_others(folder: Path, listed: frozenset[str]) -> Iterator[str]:
    """List what no run wrote to a folder, and to those of its folders that have results.

    Folders that are results of their own, such as the cameras of a completion, are left out.
    """
    homes = {"", *(str(PurePosixPath(name).parent) for name in listed if "/" in name)}
    own = {*listed, *homes, *(str(p) for home in homes for p in PurePosixPath(home).parents)}
    for home in sorted(homes):
        with suppress(OSError):
            for name in sorted(os.listdir(folder / home)):
                relative = f"{home}/{name}" if home else name
                is_known = relative in own or is_unfinished(name)
                if not is_known and not holds_results(folder / relative):
                    yield relative


def _list_files_below(folder: Path) -> list[str]:
    """List the files below a folder as relative paths."""
    return sorted(
        Path(home, name).relative_to(folder).as_posix()
        for home, _, names in os.walk(folder)
        for name in names
    )


def _list_in_summary(draft: Path, command: str) -> None:
    """Add the mark and the names of all files to the summary of a draft, or make one of them."""
    path = draft / SUMMARY_FILE
    content = json.loads(path.read_bytes()) if path.is_file() else {}
    origin = {COMMAND_KEY: command} if command else {}
    files = sorted({SUMMARY_FILE, *_list_files_below(draft)})
    whole = json.dumps({**RESULT_MARK, **origin, **content, FILES: files}, indent=2)
    path.write_bytes(whole.encode() + b"\n")


def _publish(draft: Path, target: Path) -> None:
    """Give everything its final name, or nothing; replaced files are lost."""
    if not os.path.lexists(target):
        rename(draft, target)
        return
    replaced = target / f"{draft.name}{REPLACED_SUFFIX}"
    listed = read_listing(target)
    new = _list_files_below(draft)
    _refuse_unlisted(target, target, new, listed)
    for name in listed.intersection(new):
        keep_permissions(target / name, draft / name)
    # Renames of old files, then of new ones: a run that is killed in between leaves both folders,
    # from which the next one finishes (`_finish_interrupted`).
    created = _make_folders(draft, target)
    replaced.mkdir()
    try:
        _rename_all([*_list_old_moves(target, replaced, listed), *_list_new_moves(draft, target)])
    except OSError:
        # A file that could not be put back exists only in `replaced`, which then is not empty.
        _remove_empty_folders(replaced)
        for folder in reversed(created):
            with suppress(OSError):
                folder.rmdir()
        raise
    _remove_replaced(target, replaced, listed)


def _make_folders(draft: Path, target: Path) -> list[Path]:
    """Make the folders of a draft in its target; return those that were not there."""
    created = []
    for home, folders, _ in os.walk(draft):
        for name in folders:
            folder = target / Path(home, name).relative_to(draft)
            if not os.path.isdir(folder):
                folder.mkdir()
                created.append(folder)
    return created


def _list_old_moves(target: Path, replaced: Path, listed: Iterable[str]) -> list[tuple[Path, Path]]:
    """List the moves of what an earlier run wrote, the summary first."""
    there = [name for name in listed if os.path.lexists(target / name)]
    ordered = sorted(there, key=lambda name: (name != SUMMARY_FILE, name))
    for name in ordered:
        (replaced / name).parent.mkdir(parents=True, exist_ok=True)
    return [(target / name, replaced / name) for name in ordered]


def _list_new_moves(draft: Path, target: Path) -> list[tuple[Path, Path]]:
    """List the moves of the new files, the summary last."""
    ordered = sorted(_list_files_below(draft), key=lambda name: (name == SUMMARY_FILE, name))
    return [(draft / name, target / name) for name in ordered]


def _rename_all(moves: list[tuple[Path, Path]]) -> None:
    """Do all renames, or none of them."""
    for number, move in enumerate(moves):
        try:
            rename(*move)
        except OSError:
            # In the reverse order, so that the summary, which left first, comes back last.
            for source, destination in reversed(moves[:number]):
                rename(destination, source)
            raise


def _remove_replaced(target: Path, replaced: Path, listed: Iterable[str]) -> None:
    """Remove the replaced files, and the folders of the earlier run that are empty now."""
    shutil.rmtree(replaced, ignore_errors=True)
    parents = {parent for name in listed for parent in PurePosixPath(name).parents}
    # The innermost folders first, so that outer ones are empty when it is their turn.
    for parent in sorted(parents, key=lambda parent: -len(parent.parts)):
        if parent.parts:
            with suppress(OSError):
                (target / parent).rmdir()


def _remove_empty_folders(folder: Path) -> None:
    """Remove a folder and those in it as far as they are empty."""
    for home, _, _ in os.walk(folder, topdown=False):
        with suppress(OSError):
            os.rmdir(home)


def _finish_interrupted(given: Path, target: Path) -> bool:
    """Finish the renames of a run that was killed between them; return True if there was one.

    All of its new files were complete by then. What they replace lies in a folder beside its draft.
    Raise InputError, and change nothing, if that is no state in which such a run ends.
    """
    is_changed = False
    for entry in list_unfinished(target, target.name):
        if not entry.path.name.endswith(REPLACED_SUFFIX) or entry.is_running():
            continue
        name = entry.path.name.removesuffix(REPLACED_SUFFIX)
        drafts = [folder / name for folder in (target, target.parent)]
        draft = next((path for path in drafts if os.path.lexists(path / SUMMARY_FILE)), None)
        if draft is not None:
            with convert_write_errors(given):
                _refuse_impossible(given, target, draft, entry.path)
                _finish_moves(draft, target, entry.path)
            is_changed = True
        elif not os.path.lexists(target / SUMMARY_FILE) and _list_files_below(entry.path):
            # A disk failed, and its run could not put these files back.
            raise InputError(
                f"{quote_value(entry.path)} holds results that a run could not put back; move them "
                "to where they were, or delete that folder.",
                "out",
            )
    return is_changed


def _finish_moves(draft: Path, target: Path, replaced: Path) -> None:
    """Do the renames that are left: those of earlier files, unless done, and those of new ones."""
    listed = _list_replaced(target, replaced)
    left = _list_left(draft, target, replaced)
    _make_folders(draft, target)
    for source, destination in _list_old_moves(target, replaced, left):
        rename(source, destination)
    for source, destination in _list_new_moves(draft, target):
        rename(source, destination)
    _remove_replaced(target, replaced, listed)
    # The renames count as a sign of its owner.
    shutil.rmtree(draft, ignore_errors=True)


def _list_replaced(target: Path, replaced: Path) -> frozenset[str]:
    """List what a killed run was to replace."""
    # The old summary leaves first.
    if not os.path.lexists(replaced / SUMMARY_FILE):
        return read_listing(target)
    # That of an early version lists nothing: what is still in its place is told by its name.
    early = describe_early(target, _read_summary(replaced))
    # Steps after the last save are in no summary; `strokes.json` leaves after their masks.
    session = list_session(target)
    return read_listing(replaced).union(session, [] if early is None else early.files)


def _list_left(draft: Path, target: Path, replaced: Path) -> frozenset[str]:
    """List what a killed run was to replace, and what is still in its place."""
    # New files that left the draft have their final name already, and must not be moved away.
    published = read_listing(draft).difference(_list_files_below(draft))
    waiting = _list_replaced(target, replaced) - published
    # What was replaced by then is a file below real folders.
    moved = {
        name
        for name in waiting
        if _find_obstacle(replaced, name) is None and os.path.lexists(replaced / name)
    }
    return frozenset(name for name in waiting - moved if _find_obstacle(target, name) is None)


def _refuse_impossible(given: Path, target: Path, draft: Path, replaced: Path) -> None:
    """Raise InputError for what no killed run leaves, and for what it would have refused itself."""
    for folder in (draft, replaced):
        _refuse_foreign(folder)
    _refuse_links(draft)
    refuse_later_results(draft)
    new = _list_files_below(draft)
    written = read_listing(draft)
    left = _list_left(draft, target, replaced)
    unlisted = [draft / name for name in new if name not in written]
    blocked = [replaced / name for name in left if _find_obstacle(replaced, name) is not None]
    if unlisted or blocked:
        raise InputError(
            f"{quote_value([*unlisted, *blocked][0])} is nothing that a killed run leaves; delete "
            "it, or name another output folder than "
            f"{quote_value(given, MAX_FOREIGN_NAME_LENGTH)}.",
            "out",
        )
    _refuse_unlisted(given, target, new, left)


def _refuse_foreign(folder: Path) -> None:
    """Refuse what is no folder of this user."""
    status = os.lstat(folder)
    is_own = not hasattr(os, "geteuid") or status.st_uid == os.geteuid()
    if not stat.S_ISDIR(status.st_mode) or not is_own:
        raise InputError(
            f"{quote_value(folder)} is no folder that a run of yours left; delete it, or name "
            "another output folder.",
            "out",
        )


def _refuse_links(folder: Path) -> None:
    """Refuse a folder in which there is anything but real folders and files."""
    for home, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(home, name)
            mode = os.lstat(path).st_mode
            if not stat.S_ISDIR(mode) and not stat.S_ISREG(mode):
                raise InputError(
                    f"{quote_value(path)} is a link or no file, which no run leaves; delete it, or "
                    "name another output folder.",
                    "out",
                )
