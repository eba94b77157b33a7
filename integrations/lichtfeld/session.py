"""One heal after the other: what is shown goes to gscompleter, and the result comes back."""

from __future__ import annotations

import shutil
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

import lichtfeld as lf

from .rows import Splat, compare_rows, look_up_labels, read_splat, widen_harmonics, write_splat
from .scene import (
    HealError,
    Shown,
    add_layer,
    describe_camera,
    read_shown,
    write_camera,
)

RECORD = "edits.json"
"""Record of what was done to a splat, beside it; it belongs to a file of this name:"""
COMPLETED = "completed.ply"
KEPT_BESIDE = ("removed.ply", "refined_poses.json")
"""Further files that a record may belong to, beside those in the folder `edits`."""


@dataclass(frozen=True)
class Request:
    """Name the command of a heal, and its settings."""

    command: str
    """`repair` or `remove`."""
    photographs: str = ""
    """Folder of the photographs of the splat; empty for none."""
    sees_from_here: bool = True
    """True to fill the place as the viewport sees it; `remove` alone finds cameras by itself."""


@dataclass(frozen=True)
class Sent:
    """Keep what was sent to gscompleter, to tell in its result what changed."""

    request: Request
    shown: Shown
    words: tuple[str, ...]
    """Words of the command line."""
    out: Path


class Session:
    """The files of a program that runs, and the results that it got so far."""

    def __init__(self, folder: Path | None = None) -> None:
        self._folder = folder
        self._results: list[Path] = []

    @property
    def folder(self) -> Path:
        """The folder of all files; a new one until the first heal."""
        if self._folder is None:
            self._folder = Path(tempfile.mkdtemp(prefix="gscompleter_"))
        return self._folder

    def send(self, request: Request) -> Sent:
        """Write what is shown and selected, and make the words of the command.

        Raises HealError if something is missing.
        """
        scene = lf.get_scene()
        if scene is None:
            raise HealError("No scene is open; load a splat.")
        shown = read_shown(scene)
        if not shown.selected.any():
            raise HealError("All that is selected is hidden; select something else.")
        folder = self.make_folder()
        splat = self.find_splat(shown, folder)
        selection = Splat(shown.rows[shown.selected], np.zeros(shown.selected.sum(), np.uint8))
        write_splat(folder / "selection.ply", selection)
        words = [request.command]
        words += [request.photographs] if request.photographs else []
        words += ["--scene", str(splat), "--select", str(folder / "selection.ply")]
        if request.sees_from_here or request.command == "repair":
            write_camera(
                folder / "camera.json", describe_camera(lf.get_current_view(), shown.transform)
            )
            words += ["--target", str(folder / "camera.json")]
        out = folder / "result"
        return Sent(request, shown, (*words, "--out", str(out)), out)

    def make_folder(self) -> Path:
        """Make a folder for one heal."""
        self.folder.mkdir(parents=True, exist_ok=True)
        number = 1 + sum(path.is_dir() for path in self.folder.iterdir())
        while (self.folder / f"{number:03}").exists():
            number += 1
        folder = self.folder / f"{number:03}"
        folder.mkdir()
        return folder

    def find_splat(self, shown: Shown, folder: Path) -> Path:
        """Return the file of what is shown: one that is known to hold it, or a new one.

        A known file has its record of edits, its labels, and its own bytes. A new one takes over
        the record and the labels of the latest known file that shares rows with it.
        """
        known = [*reversed(self._results), *find_sources(shown)]
        nearest: tuple[Path, Splat] | None = None
        for path in known:
            try:
                splat = read_splat(path)
            except (OSError, ValueError):
                continue
            splat = fit_harmonics(splat, shown.rows.shape[1])
            went, came = compare_rows(splat.rows, shown.rows)
            if not went.any() and not came.any():
                return path
            if nearest is None and not came.all():
                nearest = path, splat
        labels = np.zeros(len(shown.rows), np.uint8)
        comments: tuple[str, ...] = ()
        if nearest is not None:
            path, splat = nearest
            labels = look_up_labels(shown.rows, splat)
            comments = splat.comments
            copy_record(path, folder)
        write_splat(folder / COMPLETED, Splat(shown.rows, labels, comments))
        return folder / COMPLETED

    def receive(self, sent: Sent) -> str:
        """Show a result as a layer; returns its name."""
        scene = lf.get_scene()
        if scene is None:
            raise HealError(f"The scene was closed; the result is in {sent.out}.")
        path = sent.out / COMPLETED
        name = add_layer(scene, sent.shown, read_splat(path).rows, sent.request.command)
        self._results.append(path)
        return name


def fit_harmonics(splat: Splat, width: int) -> Splat:
    """Give a file as many harmonics as what is shown has, where it has fewer."""
    if splat.rows.shape[1] > width:
        return replace(splat, rows=splat.rows[:0], labels=splat.labels[:0])
    return replace(splat, rows=widen_harmonics(splat.rows, width - 14))


def find_sources(shown: Shown) -> list[Path]:
    """Find the files that the nodes were loaded from."""
    named = [lf.get_node_source_path(name) for name in shown.names]
    return [Path(path) for path in named if path and Path(path).is_file()]


def copy_record(splat: Path, folder: Path) -> None:
    """Copy the record of edits beside a splat, with the files that belong to it."""
    if not (splat.parent / RECORD).is_file() or splat.name != COMPLETED:
        return
    for name in (RECORD, *KEPT_BESIDE):
        if (splat.parent / name).is_file():
            shutil.copyfile(splat.parent / name, folder / name)
    if (splat.parent / "edits").is_dir():
        shutil.copytree(splat.parent / "edits", folder / "edits")


def find_photographs() -> str:
    """Return the folder of the data set that is loaded; empty for none, or if it was centred.

    Its splat is then not in the frame of the files. Older versions never centre one.
    """
    params = lf.dataset_params()
    is_centred = getattr(params, "centralize_dataset", "off") != "off"
    return params.data_path if params.has_params() and not is_centred else ""
