"""Figures of the paper: grids of images with a row for each case, as PNG and PDF for print."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from gscompleter.evaluation import store
from gscompleter.evaluation.paper import PHOTOGRAPH, TRUTH, FigureSpec, is_photograph
from gscompleter.system.errors import InputError
from gscompleter.system.files.image import read_pixels
from gscompleter.system.files.writing import replace_file

DPI = 300
IMAGE_INCHES = 1.4
"""Width of an image in print."""
MAX_ROWS = 8
"""Most cases in a figure if none are named."""
OUTLINE_COLOR = (255, 60, 60)
CROP = 1 / 3
"""Side of a crop, relative to the shorter side of the image."""


@dataclass(frozen=True)
class FigureCase:
    """A target whose images fill a row."""

    name: str
    number: int
    """Step of the target, from 1."""


def list_cases(runs: Mapping[str, Path], methods: Sequence[str]) -> list[FigureCase]:
    """List the targets that all methods have completed in all runs."""
    common: dict[FigureCase, int] = {}
    for folder in runs.values():
        for path in store.list_row_paths(folder):
            row = store.read_run_file(path)
            if row["method"] in methods and row["error"] is None:
                for number in range(1, len(row["steps"]) + 1):
                    case = FigureCase(row["task"]["name"], number)
                    common[case] = common.get(case, 0) + 1
    # A case is complete if every run has a row of every method for it.
    return [case for case, count in common.items() if count == len(runs) * len(methods)]


def select_cases(cases: Sequence[FigureCase], names: Sequence[str]) -> list[FigureCase]:
    """Select the cases of these names, or the first ones; raise InputError if there are none."""
    selected = [case for case in cases if not names or case.name in names]
    if not selected:
        known = ", ".join(f"'{case.name}'" for case in cases) or "none"
        raise InputError(f"No case for the figure was completed by all methods; there are {known}.")
    return selected if names else selected[:MAX_ROWS]


def draw_figure(
    path: Path,
    spec: FigureSpec,
    runs: Mapping[str, Path],
    names: Sequence[str] = (),
    outlines: bool = False,
    crops: bool = False,
) -> None:
    """Draw a figure from runs of `evaluate` by model, as .png and .pdf; `path` has no suffix.

    `names` chooses the cases, `outlines` marks holes, `crops` magnifies the widest hole of each.
    """
    cases = select_cases(list_cases(runs, spec.list_methods()), names)
    columns = list_columns(spec, runs)
    rows = []
    for case in cases:
        # The mask before the completion, which all methods share.
        task = store.get_task_folder(next(iter(runs.values())), case.name)
        step = store.get_step_path(task, spec.list_methods()[0], case.number)
        mask = read_pixels(step.with_name(f"holes-{case.number:03d}.png"))
        holes = mask[..., 0].copy()

        images = [read_figure_image(folder, image, case) for _, folder, image in columns]
        box = find_widest_hole(holes)
        # Holes are those at the target: a given photograph is seen from elsewhere.
        marked = [
            draw_outline(image, holes) if outlines and not name.startswith(PHOTOGRAPH) else image
            for image, (_, _, name) in zip(images, columns, strict=True)
        ]

        title = f"{case.name} ({case.number})" if case.number > 1 else case.name
        rows.append((title, marked))
        if crops:
            rows.append(("", [image[box] for image in images]))
    save_grid(path, [title for title, _, _ in columns], rows)


def list_columns(spec: FigureSpec, runs: Mapping[str, Path]) -> list[tuple[str, Path, str]]:
    """List title, run and image of the columns: methods for each model, photographs once."""
    first = next(iter(runs.values()))
    columns = []
    methods = spec.list_methods()
    for image in spec.images:
        if is_photograph(image):
            columns.append((image.replace(PHOTOGRAPH, "photograph "), first, image))
        # All methods stand where the first one is named, model by model.
        elif image == methods[0]:
            for model, folder in runs.items():
                prefix = f"{model}\n" if len(runs) > 1 else ""
                columns += [(prefix + method, folder, method) for method in methods]
    return columns


def read_figure_image(folder: Path, image: str, case: FigureCase) -> np.ndarray:
    """Read a photograph or the render of a method as uint8 [h, w, 3]."""
    task = store.get_task_folder(folder, case.name)
    if image == TRUTH:
        return read_pixels(store.get_truth_path(task, case.number))
    if image.startswith(PHOTOGRAPH):
        return read_pixels(store.get_photograph_path(task, int(image.removeprefix(PHOTOGRAPH))))
    return read_pixels(store.get_step_path(task, image, case.number).with_suffix(".png"))


def draw_outline(image: np.ndarray, holes: np.ndarray) -> np.ndarray:
    """Draw the outline of the holes."""
    contours, _ = cv2.findContours(holes, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    return cv2.drawContours(image.copy(), contours, -1, OUTLINE_COLOR, 1)


def find_widest_hole(holes: np.ndarray) -> tuple[slice, slice]:
    """Return rows and columns of a square around the middle of the widest hole."""
    side = round(CROP * min(holes.shape))
    # The pixel farthest from the rim is the middle of the widest hole.
    *_, (x, y) = cv2.minMaxLoc(cv2.distanceTransform(holes, cv2.DIST_L2, 3))
    height, width = holes.shape
    top = min(max(y - side // 2, 0), height - side)
    left = min(max(x - side // 2, 0), width - side)
    return slice(top, top + side), slice(left, left + side)


def save_grid(
    path: Path, titles: Sequence[str], rows: Sequence[tuple[str, Sequence[np.ndarray]]]
) -> None:
    """Save rows of images with their titles; equal images give equal bytes."""
    try:
        from matplotlib.figure import Figure
        from matplotlib.layout_engine import ConstrainedLayoutEngine
    except ImportError as error:
        raise InputError(
            f"Figures need matplotlib ({error}); run `pip install gscompleter[evaluation]`."
        ) from error

    heights = [images[0].shape[0] / images[0].shape[1] for _, images in rows]
    size = (IMAGE_INCHES * len(titles) + 0.3, IMAGE_INCHES * sum(heights) + 0.5)
    layout = ConstrainedLayoutEngine(w_pad=0.01, h_pad=0.01, wspace=0, hspace=0, compress=True)
    figure = Figure(figsize=size, layout=layout)

    grid: Any = figure.subplots(len(rows), len(titles), squeeze=False, height_ratios=heights)
    for line, (name, images) in zip(grid, rows, strict=True):
        for axes, image in zip(line, images, strict=True):
            axes.imshow(image, interpolation="nearest")
            axes.set(xticks=[], yticks=[])
            axes.spines[:].set_visible(False)
        line[0].set_ylabel(name, fontsize=5)
    for axes, title in zip(grid[0], titles, strict=True):
        axes.set_title(title, fontsize=7)
    # Dates and versions in the metadata would make each file differ.
    for suffix, metadata in ((".png", {"Software": None}), (".pdf", {"CreationDate": None})):
        with replace_file(path.with_name(path.name + suffix)) as file:
            figure.savefig(file, format=suffix[1:], dpi=DPI, metadata=metadata, bbox_inches="tight")
