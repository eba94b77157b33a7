"""Write the scene of LichtFeld Studio for gscompleter, and show a result as a layer of its own.

Three frames: **data** is that of the files (cameras look along +z, y is down); **visualizer** is
what the interface speaks of (y and z turned round, cameras look along -z); and each node may be
moved in the data frame by its transform, which a file of its Gaussians does not have.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

import lichtfeld as lf

from .rows import compare_rows, widen_harmonics

FLIP = np.diag([1.0, -1.0, -1.0])
"""From the visualizer's world to the data's, and back."""
TOLERANCE = 1e-4
"""Largest deviation of the transform of a node from a rotation with one scale."""


class HealError(Exception):
    """Tell a person in one sentence what is wrong and what to do."""


@dataclass(frozen=True)
class Shown:
    """The visible Gaussians of a scene, in the frame of their nodes."""

    rows: np.ndarray
    """[n, p], as in a .ply."""
    node: np.ndarray
    """[n], numbers of `names`."""
    place: np.ndarray
    """[n], numbers of the Gaussians in their node."""
    selected: np.ndarray
    """[n], True for selected Gaussians."""
    names: tuple[str, ...]
    transform: np.ndarray
    """[4, 4], from the frame of the nodes to the data's; the same for all."""


def to_array(tensor: lf.Tensor) -> np.ndarray:
    """Return the values of a tensor, wherever it lies."""
    return np.asarray(tensor.contiguous().cpu().numpy())


def collect_rows(data: lf.scene.SplatData) -> np.ndarray:
    """Return the Gaussians of a node as rows of a .ply."""
    count = data.num_points
    # [n, k, 3] in the program, channel by channel in a .ply.
    rest = to_array(data.shN_raw).reshape(count, -1, 3).transpose(0, 2, 1).reshape(count, -1)
    parts = [data.means_raw, data.sh0_raw, None, data.opacity_raw]
    parts += [data.scaling_raw, data.rotation_raw]
    columns = [rest if part is None else to_array(part).reshape(count, -1) for part in parts]
    return np.concatenate(columns, axis=1).astype(np.float32)


def read_shown(scene: lf.scene.Scene) -> Shown:
    """Read the visible Gaussians, and which of them are selected."""
    nodes = [node for node in scene.get_visible_nodes() if node.splat_data() is not None]
    if not nodes:
        raise HealError("No splat is visible; load one, or show it in the scene tree.")
    transforms = [np.array(node.world_transform, float).reshape(4, 4) for node in nodes]
    if any(not np.allclose(transforms[0], other, atol=1e-6) for other in transforms[1:]):
        raise HealError(
            "The visible splats were moved by different transforms; bake them, or hide all but one."
        )
    counts = [node.splat_data().num_points for node in nodes]
    chosen = read_selection(scene, sum(counts))
    rows = [collect_rows(node.splat_data()) for node in nodes]
    width = max(part.shape[1] for part in rows)
    num_rest = width - 14
    rows = [widen_harmonics(part, num_rest) for part in rows]
    is_hidden = np.concatenate([read_deleted(node.splat_data()) for node in nodes])
    node = np.repeat(np.arange(len(nodes)), counts)
    place = np.concatenate([np.arange(count) for count in counts])
    seen = ~is_hidden
    return Shown(
        np.concatenate(rows)[seen],
        node[seen],
        place[seen],
        chosen[seen],
        tuple(node.name for node in nodes),
        transforms[0],
    )


def read_deleted(data: lf.scene.SplatData) -> np.ndarray:
    """Return True for Gaussians of a node that are hidden as deleted."""
    if not data.has_deleted_mask():
        return np.zeros(data.num_points, bool)
    return to_array(data.deleted).reshape(-1).astype(bool)


def read_selection(scene: lf.scene.Scene, count: int) -> np.ndarray:
    """Return True for selected Gaussians, node after node."""
    mask = scene.selection_mask if scene.has_selection() else None
    if mask is None:
        raise HealError("Nothing is selected; select what is wrong with the selection tools.")
    chosen = to_array(mask).reshape(-1) > 0
    if len(chosen) != count:
        # The mask is that of all splats, also of hidden ones, and nothing tells which is which.
        raise HealError(
            f"The selection counts {len(chosen)} Gaussians and the visible splats have {count}; "
            "show all splats, or remove hidden ones from the scene."
        )
    return chosen


def describe_camera(view: lf.ViewInfo | None, transform: np.ndarray) -> dict[str, object]:
    """Describe the camera of the viewport by the keys of a `transforms.json`.

    Its axes are those of OpenGL, as in the visualizer; its world is the frame of the nodes.
    """
    if view is None:
        raise HealError("There is no viewport to look from; open one.")
    if view.orthographic:
        raise HealError("The view is orthographic; switch to perspective.")
    pose = np.eye(4)
    pose[:3, :3] = FLIP @ to_array(view.rotation).reshape(3, 3)
    pose[:3, 3] = FLIP @ to_array(view.translation).reshape(3)
    scale = np.cbrt(np.linalg.det(transform[:3, :3]))
    turned = transform[:3, :3] / scale
    if not scale > 0 or not np.allclose(turned @ turned.T, np.eye(3), atol=TOLERANCE):
        raise HealError("The splat is stretched or mirrored by its transform; bake it.")
    local = np.linalg.inv(transform) @ pose
    local[:3, :3] *= scale
    # Its width follows from the shape of the window, so that pixels are square.
    focal = view.height / 2 / math.tan(math.radians(view.fov_y) / 2)
    return {
        "fl_x": focal,
        "fl_y": focal,
        "cx": view.width / 2,
        "cy": view.height / 2,
        "w": view.width,
        "h": view.height,
        "transform_matrix": local.tolist(),
    }


def write_camera(path: Path, camera: dict[str, object]) -> None:
    """Write a file of cameras that `--target` reads."""
    path.write_text(json.dumps({"camera_model": "PINHOLE", "frames": [camera]}, indent=1))


def add_layer(scene: lf.scene.Scene, shown: Shown, result: np.ndarray, title: str) -> str:
    """Show a result: hide what went, and add what came as a layer of its own; one step of undo.

    Returns the name of the layer.
    """
    width = max(result.shape[1], shown.rows.shape[1])
    before = widen_harmonics(shown.rows, width - 14)
    result = widen_harmonics(result, width - 14)
    went, came = compare_rows(before, result)
    masks = mask_nodes(scene, shown, went)
    name = choose_name(scene, f"{shown.names[0]} {title}")
    with lf.undo.transaction(f"gscompleter: {title}") as step:
        set_deleted(masks, True)
        step.add(lambda: set_deleted(masks, False), lambda: set_deleted(masks, True))
        if came.any():
            # The program records this step by itself, as that of the transform.
            add_splat(scene, name, result[came])
            if not np.allclose(shown.transform, np.eye(4)):
                scene.set_node_transform(name, shown.transform.astype(np.float32))
    scene.clear_selection()
    scene.notify_changed()
    return name


def mask_nodes(
    scene: lf.scene.Scene, shown: Shown, went: np.ndarray
) -> list[tuple[str, np.ndarray]]:
    """Return the names of nodes, each with a mask of its Gaussians that went."""
    masks = []
    for number, name in enumerate(shown.names):
        node = scene.get_node(name)
        data = None if node is None else node.splat_data()
        is_own = shown.node == number
        if data is None or data.num_points <= shown.place[is_own].max(initial=-1):
            raise HealError(
                f"'{name}' was changed while gscompleter ran, and the result does not fit it any "
                "more; it is kept in its folder."
            )
        mask = np.zeros(data.num_points, bool)
        mask[shown.place[is_own & went]] = True
        masks.append((name, mask))
    return masks


def set_deleted(masks: list[tuple[str, np.ndarray]], is_deleted: bool) -> None:
    """Hide Gaussians of nodes, or show them again."""
    scene = lf.get_scene()
    for name, mask in masks:
        node = None if scene is None else scene.get_node(name)
        data = None if node is None else node.splat_data()
        if data is None or len(mask) != data.num_points:
            continue  # the node was removed or baked since, and there is nothing to show again
        tensor = lf.Tensor.from_numpy(mask).cuda()
        if is_deleted:
            data.soft_delete(tensor)
        else:
            data.undelete(tensor)
    if scene is not None:
        scene.notify_changed()


def choose_name(scene: lf.scene.Scene, wanted: str) -> str:
    """Return a name that no node has yet."""
    names = (wanted if number == 1 else f"{wanted} {number}" for number in range(1, 10_000))
    return next(name for name in names if scene.get_node(name) is None)


def add_splat(scene: lf.scene.Scene, name: str, rows: np.ndarray) -> None:
    """Add rows of a .ply as a node."""
    count = len(rows)
    per_channel = (rows.shape[1] - 14) // 3
    rest = rows[:, 6 : 6 + 3 * per_channel].reshape(count, 3, per_channel).transpose(0, 2, 1)
    last = rows[:, 6 + 3 * per_channel :]
    parts = {
        "means": rows[:, :3],
        "sh0": rows[:, 3:6].reshape(count, 1, 3),
        "shN": rest,
        "scaling": last[:, 1:4],
        "rotation": last[:, 4:8],
        "opacity": last[:, :1],
    }
    tensors = {
        key: lf.Tensor.from_numpy(np.ascontiguousarray(value)).cuda()
        for key, value in parts.items()
    }
    scene.add_splat(name, **tensors, sh_degree=math.isqrt(per_channel + 1) - 1)
