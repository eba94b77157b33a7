"""A stand-in of LichtFeld Studio's Python interface, written from its documentation.

The program is in no package registry. The documentation is `docs/plugins/api-reference.md`,
`docs/plugins/getting-started.md` and the type stubs of plug-in interface 1.0 (2026; commits
0273ce2, 0af90d2 for scenes, 4197bf1 for undo). What the plug-in uses of it is here, on NumPy
arrays; whatever else it asked for would be an AttributeError.
"""

from __future__ import annotations

import enum
import types
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

FLIP = np.diag([1.0, -1.0, -1.0])


class Tensor:
    """Values with the methods of the program's tensors; `device` is kept, nothing else."""

    def __init__(self, values: np.ndarray, device: str = "cpu") -> None:
        self._values = values
        self.device = device

    @staticmethod
    def from_numpy(arr: np.ndarray, copy: bool = True) -> Tensor:
        assert arr.flags.c_contiguous
        return Tensor(arr.copy() if copy else arr)

    def cpu(self) -> Tensor:
        return Tensor(self._values, "cpu")

    def cuda(self) -> Tensor:
        return Tensor(self._values, "cuda")

    def contiguous(self) -> Tensor:
        return Tensor(np.ascontiguousarray(self._values), self.device)

    def numpy(self, copy: bool = True) -> np.ndarray:
        assert self.device == "cpu", "move a tensor to the CPU first"
        return self._values.copy() if copy else self._values

    @property
    def shape(self) -> tuple[int, ...]:
        return self._values.shape


class SplatData:
    """Gaussians of a node, as [N, ...] on the GPU."""

    def __init__(self, **raw: np.ndarray) -> None:
        self._raw = {key: np.ascontiguousarray(value, np.float32) for key, value in raw.items()}
        self.num_points = len(raw["means"])
        self._deleted: np.ndarray | None = None

    def __getattr__(self, name: str) -> Tensor:
        if name.endswith("_raw"):
            return Tensor(self._raw[name.removesuffix("_raw")], "cuda")
        raise AttributeError(name)

    def has_deleted_mask(self) -> bool:
        return self._deleted is not None

    @property
    def deleted(self) -> Tensor:
        assert self._deleted is not None
        return Tensor(self._deleted, "cuda")

    def soft_delete(self, mask: Tensor) -> Tensor:
        values = check_mask(mask, self.num_points)
        before = np.zeros(self.num_points, bool) if self._deleted is None else self._deleted
        self._deleted = before | values
        return Tensor(before, "cuda")

    def undelete(self, mask: Tensor) -> None:
        values = check_mask(mask, self.num_points)
        if self._deleted is not None:
            self._deleted = self._deleted & ~values


def check_mask(mask: Tensor, count: int) -> np.ndarray:
    values = mask.cpu().numpy()
    assert values.dtype == bool
    assert values.shape == (count,)
    return values


@dataclass
class SceneNode:
    """A node of the scene tree."""

    name: str
    data: SplatData | None
    visible: bool = True
    transform: np.ndarray = field(default_factory=lambda: np.eye(4))

    def splat_data(self) -> SplatData | None:
        return self.data

    @property
    def world_transform(self) -> tuple[tuple[float, ...], ...]:
        return tuple(map(tuple, self.transform.tolist()))


class Undo:
    """The history: steps of functions, and transactions that gather them."""

    def __init__(self) -> None:
        self._steps: list[tuple[str, list[tuple[Callable, Callable]]]] = []
        self._undone: list[tuple[str, list[tuple[Callable, Callable]]]] = []
        self._open: Transaction | None = None

    def transaction(self, name: str = "Grouped Changes") -> Transaction:
        return Transaction(self, name)

    def push(self, name: str, undo: Callable, redo: Callable) -> None:
        if self._open is not None:
            self._open.add(undo, redo)
        else:
            self._steps.append((name, [(undo, redo)]))

    def undo(self) -> bool:
        name, pairs = self._steps.pop()
        for undo, _ in reversed(pairs):
            undo()
        self._undone.append((name, pairs))
        return True

    def redo(self) -> bool:
        name, pairs = self._undone.pop()
        for _, redo in pairs:
            redo()
        self._steps.append((name, pairs))
        return True

    def undo_names(self) -> list[str]:
        return [name for name, _ in reversed(self._steps)]


class Transaction:
    """Steps that are undone together."""

    def __init__(self, history: Undo, name: str) -> None:
        self._history, self._name = history, name
        self._pairs: list[tuple[Callable, Callable]] = []

    def __enter__(self) -> Transaction:
        self._history._open = self
        return self

    def __exit__(self, kind: object, *_: object) -> bool:
        self._history._open = None
        if kind is None:
            self._history._steps.append((self._name, self._pairs))
        return False

    def add(self, undo: Callable, redo: Callable) -> None:
        self._pairs.append((undo, redo))


class Scene:
    """The scene tree, and the selection among all of its Gaussians."""

    def __init__(self, undo: Undo) -> None:
        self._undo = undo
        self.tree: list[SceneNode] = []
        self._selection: np.ndarray | None = None
        self.redraws = 0

    def get_nodes(self) -> list[SceneNode]:
        return list(self.tree)

    def get_visible_nodes(self) -> list[SceneNode]:
        return [node for node in self.tree if node.visible]

    def get_node(self, name: str) -> SceneNode | None:
        return next((node for node in self.tree if node.name == name), None)

    def add_splat(
        self,
        name: str,
        means: Tensor,
        sh0: Tensor,
        shN: Tensor,
        scaling: Tensor,
        rotation: Tensor,
        opacity: Tensor,
        sh_degree: int = 0,
        scene_scale: float = 1.0,
        parent: int = -1,
    ) -> int:
        count = means.shape[0]
        shapes = [(3,), (1, 3), ((sh_degree + 1) ** 2 - 1, 3), (3,), (4,), (1,)]
        parts = {"means": means, "sh0": sh0, "shN": shN}
        parts |= {"scaling": scaling, "rotation": rotation, "opacity": opacity}
        for (key, part), shape in zip(parts.items(), shapes, strict=True):
            assert part.shape == (count, *shape), key
        node = SceneNode(name, SplatData(**{k: p.cpu().numpy() for k, p in parts.items()}))
        self.tree.append(node)
        self._undo.push("Add Splat", lambda: self.tree.remove(node), lambda: self.tree.append(node))
        return len(self.tree)

    def set_node_transform(self, name: str, transform: np.ndarray) -> None:
        assert (transform.dtype, transform.shape) == (np.float32, (4, 4))
        node = self.get_node(name)
        assert node is not None
        before, after = node.transform, transform.astype(float)

        def put(value: np.ndarray) -> None:
            node.transform = value

        put(after)
        self._undo.push("Set Transform", lambda: put(before), lambda: put(after))

    def has_selection(self) -> bool:
        return self._selection is not None and bool(self._selection.any())

    @property
    def selection_mask(self) -> Tensor | None:
        return None if self._selection is None else Tensor(self._selection, "cuda")

    def set_selection_mask(self, mask: Tensor) -> None:
        self._selection = mask.cpu().numpy().astype(np.uint8)

    def clear_selection(self) -> None:
        self._selection = None

    def notify_changed(self) -> None:
        self.redraws += 1


@dataclass
class ViewInfo:
    """The camera of the viewport, in the visualizer's world and with axes of OpenGL."""

    rotation: Tensor
    translation: Tensor
    width: int
    height: int
    fov_y: float
    orthographic: bool = False


class Ui:
    """What a panel draws: its texts, and buttons that a test presses by their label."""

    def __init__(self, *pressed: str) -> None:
        self.pressed = set(pressed)
        self.texts: list[str] = []

    def button(self, label: str, size: tuple[float, float] = (0, 0)) -> bool:
        self.texts.append(label)
        return label in self.pressed

    def button_styled(self, label: str, style: str, size: tuple[float, float] = (0, 0)) -> bool:
        assert style in {"success", "error", "warning", "primary", "secondary"}
        return self.button(label)

    def _say(self, text: str) -> None:
        self.texts.append(text)

    heading = text_wrapped = set_tooltip = _say

    def text_colored(self, text: str, color: tuple[float, ...]) -> None:
        assert len(color) == 4
        self.texts.append(text)

    def same_line(self, offset: float = 0, spacing: float = -1) -> None:
        pass

    def input_text(self, label: str, value: str) -> tuple[bool, str]:
        return False, value

    def path_input(
        self, label: str, value: str, folder_mode: bool = True, dialog_title: str = ""
    ) -> tuple[bool, str]:
        assert folder_mode
        return False, value

    def checkbox(self, label: str, value: bool) -> tuple[bool, bool]:
        return False, value


class Log:
    """The log of the program."""

    def __init__(self) -> None:
        self.lines: list[tuple[str, str]] = []

    def info(self, message: str) -> None:
        self.lines.append(("info", message))

    def error(self, message: str) -> None:
        self.lines.append(("error", message))


@dataclass
class DatasetParams:
    """Where the photographs of the data set lie."""

    data_path: str = ""
    centralize_dataset: str = "off"

    def has_params(self) -> bool:
        return bool(self.data_path)


def make_module() -> Any:
    """Make the module `lichtfeld` of a program with an empty scene."""
    module = types.ModuleType("lichtfeld")
    module.undo = Undo()
    module.log = Log()
    module.Tensor = Tensor
    module.ViewInfo = ViewInfo
    module.scene = types.SimpleNamespace(Scene=Scene, SplatData=SplatData)
    module.ui = types.SimpleNamespace(
        Panel=type("Panel", (), {}),
        PanelSpace=enum.Enum("PanelSpace", "MAIN_PANEL_TAB FLOATING"),
        PanelHeightMode=enum.Enum("PanelHeightMode", "FILL CONTENT"),
    )
    module.classes = []
    module.register_class = module.classes.append
    module.unregister_class = module.classes.remove
    module.shown_scene = Scene(module.undo)
    module.get_scene = lambda: module.shown_scene
    module.has_scene = lambda: module.shown_scene is not None
    module.view = None
    module.get_current_view = lambda panel="main": module.view
    module.params = DatasetParams()
    module.dataset_params = lambda: module.params
    module.sources = {}
    module.get_node_source_path = lambda name: module.sources.get(name)
    return module
