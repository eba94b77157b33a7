"""GSCompleter: complete 3D Gaussian Splatting scenes by generating, then registering."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# For type checkers; `_HOMES` has the same names (tests/project/test_names.py).
if TYPE_CHECKING:
    from gscompleter.completer import GSCompleter as GSCompleter
    from gscompleter.config import CompleterConfig as CompleterConfig
    from gscompleter.config import load_config as load_config
    from gscompleter.data.demo_scene import write_demo_scene as write_demo_scene
    from gscompleter.data.scene import load_camera as load_camera
    from gscompleter.data.scene import load_cameras as load_cameras
    from gscompleter.data.scene import load_views as load_views
    from gscompleter.evaluation.verdict.judge import judge as judge
    from gscompleter.generators import Generator as Generator
    from gscompleter.generators import GeneratorOutput as GeneratorOutput
    from gscompleter.generators import GeneratorRequest as GeneratorRequest
    from gscompleter.generators import ImageFunction as ImageFunction
    from gscompleter.generators import load_generator as load_generator
    from gscompleter.guards import Attempt as Attempt
    from gscompleter.guards import Guard as Guard
    from gscompleter.numerics.given_geometry import GivenGeometry as GivenGeometry
    from gscompleter.planning.remove import remove as remove
    from gscompleter.reconstructors import DepthAware as DepthAware
    from gscompleter.reconstructors import Lifter as Lifter
    from gscompleter.reconstructors import PartReconstructor as PartReconstructor
    from gscompleter.reconstructors import Reconstructor as Reconstructor
    from gscompleter.reconstructors import load_reconstructor as load_reconstructor
    from gscompleter.reconstructors.depth_predictors import DepthPredictor as DepthPredictor
    from gscompleter.reconstructors.from_depth import DepthModel as DepthModel
    from gscompleter.reconstructors.from_depth import FromDepth as FromDepth
    from gscompleter.reconstructors.plane_sweep import PlaneSweep as PlaneSweep
    from gscompleter.render.cache import SceneRenderer as SceneRenderer
    from gscompleter.render.loading import load_renderer as load_renderer
    from gscompleter.render.protocols import FrozenScene as FrozenScene
    from gscompleter.render.protocols import Renderer as Renderer
    from gscompleter.splats import load_splat as load_splat
    from gscompleter.splats import save_splat as save_splat
    from gscompleter.splats.geometry_files import load_geometry as load_geometry
    from gscompleter.splats.ply import load_ply as load_ply
    from gscompleter.splats.ply import save_ply as save_ply
    from gscompleter.stages.target_view import TargetView as TargetView
    from gscompleter.state import Completion as Completion
    from gscompleter.system.errors import InputError as InputError
    from gscompleter.target_result import TargetResult as TargetResult
    from gscompleter.types import Camera as Camera
    from gscompleter.types import DepthMap as DepthMap
    from gscompleter.types import Gaussians as Gaussians
    from gscompleter.types import GeneratorInput as GeneratorInput
    from gscompleter.types import Reconstruction as Reconstruction
    from gscompleter.types import Render as Render
    from gscompleter.types import View as View
    from gscompleter.types import make_observed as make_observed
    from gscompleter.types import merge as merge
    from gscompleter.virtual_capture.render_views import render_views as render_views

# Module of each public name, imported on first use, so that `import gscompleter` and
# `gscompleter --help` do not wait for torch.
_HOMES = {
    "GSCompleter": "completer",
    "CompleterConfig": "config",
    "load_config": "config",
    "InputError": "system.errors",
    "judge": "evaluation.verdict.judge",
    "load_generator": "generators",
    "load_ply": "splats.ply",
    "save_ply": "splats.ply",
    "load_camera": "data.scene",
    "load_cameras": "data.scene",
    "load_views": "data.scene",
    "GivenGeometry": "numerics.given_geometry",
    "load_geometry": "splats.geometry_files",
    "remove": "planning.remove",
    "load_reconstructor": "reconstructors",
    "load_renderer": "render.loading",
    "load_splat": "splats",
    "save_splat": "splats",
    "Camera": "types",
    "Completion": "state",
    "Gaussians": "types",
    "Render": "types",
    "View": "types",
    "merge": "types",
    "DepthMap": "types",
    "Reconstruction": "types",
    "GeneratorInput": "types",
    "make_observed": "types",
    "Reconstructor": "reconstructors",
    "Lifter": "reconstructors",
    "PartReconstructor": "reconstructors",
    "DepthAware": "reconstructors",
    "DepthPredictor": "reconstructors.depth_predictors",
    "DepthModel": "reconstructors.from_depth",
    "FromDepth": "reconstructors.from_depth",
    "PlaneSweep": "reconstructors.plane_sweep",
    "Generator": "generators",
    "GeneratorOutput": "generators",
    "GeneratorRequest": "generators",
    "ImageFunction": "generators",
    "Renderer": "render.protocols",
    "FrozenScene": "render.protocols",
    "SceneRenderer": "render.cache",
    "Guard": "guards",
    "Attempt": "guards",
    "TargetView": "stages.target_view",
    "TargetResult": "target_result",
    "write_demo_scene": "data.demo_scene",
    "render_views": "virtual_capture.render_views",
}

__all__ = sorted(_HOMES)


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'gscompleter' has no attribute {name!r}")
    return getattr(importlib.import_module(f"gscompleter.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return [*__all__, "__version__"]
