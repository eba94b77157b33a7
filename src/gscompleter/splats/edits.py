"""What commands did to a splat, in their order: `edits.json` beside the file.

Every command that changes a splat adds an edit to those that the file had before. So the next
command knows what a person took out, and `strip` takes edits off again, one by one.

An edit keeps rows in their order, leaves some out, and appends others. The rows that it left out
are in a file of their own, the `originals`, with their places in the scene before (`layout`). What
a person took out, cut where it reached out of the place that was chosen, is in `taken_out`.
"""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from gscompleter import __version__
from gscompleter.parts import PartKind
from gscompleter.splats.formats import detect_splat_format, read_provenance
from gscompleter.splats.ply import LABEL_COLUMN, read_labels, read_scene, save_ply
from gscompleter.splats.provenance import RunRecord
from gscompleter.splats.table import SPLAT_FORMATS
from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.reading import hash_file
from gscompleter.system.files.result_format import RESULT_MARK
from gscompleter.system.files.result_names import (
    COMPLETED_FILE,
    EDITS_FILE,
    EDITS_FOLDER,
    REFINED_POSES_FILE,
    REMOVED_FILE,
)
from gscompleter.system.files.typed_json import read_typed_json
from gscompleter.types import Gaussians

EDITS = (EDITS_FILE, f"{EDITS_FOLDER}/*.ply", REFINED_POSES_FILE)
"""Globs of the files that are written, with the poses that the splat was made with."""
EDITS_ADVICE = "take all files of its folder again, or move it away to do without the record"
"""End of each sentence about a damaged record."""
# Names of the files of edits.
_FILE_PATTERN = re.compile(r"removed\.ply|edits/\d{1,5}_(originals|taken_out)\.ply")

RowKind = Literal["recolored", PartKind]
"""Origin of rows: given and recoloured since, or that of an addition."""


@dataclass(frozen=True)
class AppendedRows:
    """Rows of one kind, one after the other."""

    kind: RowKind
    count: int


@dataclass(frozen=True)
class Edit:
    """What one command did to a splat."""

    command: str
    """complete, update, remove, repair, live or clean."""
    rows: int
    """Gaussians of the splat before it."""
    added: int
    """Rows that it appended: Gaussians that are new, and recoloured ones in place of theirs."""
    version: str = __version__
    appended: tuple[AppendedRows, ...] = ()
    """These rows by their kind, in their order; none if an earlier version did not tell."""
    records: int = 0
    """Comments on who made the file that it added (`provenance`)."""
    had_labels: str | None = None
    """Type of the property `generated` in the .ply before it; None if there was none."""
    given: str | None = None
    """SHA-256 of the file before it; None if there was none."""
    originals: str | None = None
    """File of the rows that it left out, beside this record; None if it left out none."""
    taken_out: str | None = None
    """File of what a person took out or marked as wrong; None if nobody did."""
    labels: tuple[int, int] | None = None
    """First and last value of `generated` of what it invented; None for nothing."""
    seed: int | None = None
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Place, cameras, masks and photographs, as options of the command."""
    can_be_undone: bool = True
    """False if its rows are not known: another program changed the splat after it, a format sorted
    its rows, or rows that it changed stand where they stood."""

    @property
    def files(self) -> tuple[str, ...]:
        """Files beside the record that belong to it."""
        return tuple(name for name in (self.originals, self.taken_out) if name is not None)


@dataclass(frozen=True)
class EditsFile:
    """The content of `edits.json`."""

    sha256: str
    """SHA-256 of the splat as it was written."""
    edits: tuple[Edit, ...]
    file: str = COMPLETED_FILE
    """Name of the splat. In the folder of results lie others, such as the scene before."""


@dataclass(frozen=True)
class Edits:
    """The edits of a splat."""

    folder: Path
    """Folder of `edits.json`, in which the files of the edits are."""
    edits: tuple[Edit, ...] = ()
    is_unchanged: bool = True
    """False if the splat is another one than that which the last edit wrote."""

    def __bool__(self) -> bool:
        """Return True if there are any."""
        return bool(self.edits)

    def find(self, name: str) -> Path:
        """Find a file of an edit, or raise InputError."""
        path = self.folder / name
        if not path.is_file():
            raise InputError(
                f"{quote_value(path)} is missing, which {EDITS_FILE} names; {EDITS_ADVICE}."
            )
        return path


@dataclass(frozen=True)
class EditDraft:
    """A command, before its edit is recorded."""

    command: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    seed: int | None = None


def read_edits(splat: Path) -> Edits:
    """Read the edits of a splat; none without a record beside it that is about this splat.

    Raises InputError for a record that is damaged or names files that are not those of edits.
    """
    path = splat.with_name(EDITS_FILE)
    if not path.is_file() or not splat.is_file():
        return Edits(splat.parent)
    content = read_typed_json(EditsFile, path, EDITS_ADVICE)
    # Names of a file that may come from elsewhere lead to nothing outside of its folder.
    for edit in content.edits:
        for name in edit.files:
            if not _FILE_PATTERN.fullmatch(name):
                raise InputError(f"{quote_value(path)} names {quote_value(name)}; {EDITS_ADVICE}.")
    is_unchanged = content.sha256 == hash_file(splat)
    if not is_unchanged and splat.name != content.file:
        return Edits(splat.parent)
    return Edits(splat.parent, content.edits, is_unchanged)


def assume_edit(splat: Path) -> Edits:
    """Assume the edit of a completed .ply without a record, as earlier versions wrote them.

    What has a label was appended; what it replaced is in `removed.ply`.
    """
    if detect_splat_format(splat) != "ply":
        return Edits(splat.parent)
    scene = read_scene(splat)
    if LABEL_COLUMN not in (scene.rows.dtype.names or ()):
        return Edits(splat.parent)
    is_added = read_labels(scene.rows) > 0
    added = int(is_added.sum())
    if not added or not is_added[-added:].all():
        return Edits(splat.parent)
    removed = splat.with_name(REMOVED_FILE)
    originals = REMOVED_FILE if removed.is_file() else None
    rows = len(is_added) - added + (len(read_scene(removed).rows) if originals else 0)
    records = len(read_provenance(splat).runs)
    edit = Edit("complete", rows, added, version="", records=records, originals=originals)
    return Edits(splat.parent, (edit,))


def record_edit(
    folder: Path,
    draft: EditDraft,
    rows: int,
    appended: Sequence[AppendedRows],
    given: Path | None,
    earlier: Edits,
    run: RunRecord | None,
    taken_out: Gaussians | None = None,
    can_be_undone: bool = True,
) -> None:
    """Record what a command did, after it wrote `completed.ply` and perhaps `removed.ply`.

    Args:
        folder: Folder of its results.
        draft: The command.
        rows: Gaussians before it.
        appended: Rows that it appended, in their order.
        given: File that it was given; None if it reconstructed the scene.
        earlier: Edits of that file.
        run: What it said in the file about who made it; None if it said nothing.
        taken_out: What a person took out, if the command tells.
        can_be_undone: False if rows that it changed stand where they stood.
    """
    if given is not None and not earlier:
        earlier = assume_edit(given)
    path = None
    if taken_out is not None and len(taken_out):
        path = f"{EDITS_FOLDER}/{len(earlier.edits) + 1}_taken_out.ply"
        (folder / EDITS_FOLDER).mkdir(exist_ok=True)
        save_ply(folder / path, taken_out.to("cpu"))
    edit = Edit(
        draft.command,
        rows,
        sum(part.count for part in appended),
        appended=tuple(appended),
        records=int(run is not None),
        had_labels=None if given is None else find_label_type(given),
        given=hash_given(given) if run is None else run.given,
        originals=REMOVED_FILE if (folder / REMOVED_FILE).is_file() else None,
        taken_out=path,
        labels=None if run is None else run.labels,
        seed=draft.seed,
        settings=dict(draft.settings),
        can_be_undone=can_be_undone,
    )
    write_edits(folder, folder / COMPLETED_FILE, earlier, edit)
    # The poses of the photographs that a splat was made with stay beside it.
    poses = None if given is None else given.parent / REFINED_POSES_FILE
    if poses is not None and poses.is_file():
        shutil.copyfile(poses, folder / REFINED_POSES_FILE)


def hash_given(path: Path | None) -> str | None:
    """Compute the SHA-256 of the given splat; None without one, and for the folder of a .sog."""
    return hash_file(path) if path is not None and path.is_file() else None


def find_label_type(path: Path) -> str | None:
    """Find the type of the labels in a .ply; None without labels, or for another format."""
    if detect_splat_format(path) != "ply":
        return None
    dtype = read_scene(path).rows.dtype
    if LABEL_COLUMN not in (dtype.names or ()):
        return None
    return "float" if dtype[LABEL_COLUMN].kind == "f" else "uchar"


def write_edits(folder: Path, splat: Path, earlier: Edits, edit: Edit) -> None:
    """Write the record of a splat that was just written to `folder`, with its `earlier` edits.

    The originals of the last edit that has any are `removed.ply`, as those of a single one.
    """
    edits = []
    for number, known in enumerate(earlier.edits, start=1):
        # Rows have no place any more in a splat that another program changed. What a person took
        # out still stays out.
        if not earlier.is_unchanged:
            known = replace(known, originals=None, can_be_undone=False)
        originals = copy_file(earlier, known.originals, folder, f"{number}_originals")
        taken_out = copy_file(earlier, known.taken_out, folder, f"{number}_taken_out")
        edits.append(replace(known, originals=originals, taken_out=taken_out))
    edits.append(edit)
    # Whoever knows nothing of edits looks for the originals of the last one there.
    for index, known in reversed(list(enumerate(edits))):
        if known.originals is not None:
            (folder / known.originals).rename(folder / REMOVED_FILE)
            edits[index] = replace(known, originals=REMOVED_FILE)
            break

    content = asdict(EditsFile(hash_file(splat), tuple(edits), splat.name))
    text = json.dumps({**RESULT_MARK, **content}, indent=2, default=str)
    (folder / EDITS_FILE).write_bytes(text.encode() + b"\n")
    remove_empty(folder / EDITS_FOLDER)


def rename_edited(folder: Path, splat: Path) -> None:
    """Let the record in a folder be that of a splat in another format.

    In a format that sorts Gaussians, the rows of its edits have no place any more.
    """
    path = folder / EDITS_FILE
    content = json.loads(path.read_bytes())
    content.update(sha256=hash_file(splat), file=splat.name)
    if SPLAT_FORMATS[detect_splat_format(splat)].is_sorted:
        for edit in content["edits"]:
            edit["can_be_undone"] = False
    text = json.dumps(content, indent=2)
    path.write_bytes(text.encode() + b"\n")


def copy_file(earlier: Edits, name: str | None, folder: Path, stem: str) -> str | None:
    """Copy a file of an earlier edit, and return its new name; None without one."""
    if name is None:
        return None
    copied = f"{EDITS_FOLDER}/{stem}.ply"
    (folder / EDITS_FOLDER).mkdir(exist_ok=True)
    shutil.copyfile(earlier.find(name), folder / copied)
    return copied


def remove_empty(folder: Path) -> None:
    """Remove a folder if nothing is in it."""
    if folder.is_dir() and not any(folder.iterdir()):
        folder.rmdir()
