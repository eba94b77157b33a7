"""A stand-in of `bpy`, as far as the add-on of Blender needs it to be imported and to do its maths.

Written from Blender's Python API reference (5.0). With the package `bpy`, whatever the add-on does
in Blender is tested in Blender itself.
"""

from __future__ import annotations

import types
from typing import Any


def make_module() -> Any:
    """Make the module `bpy` with base classes and properties."""
    module = types.ModuleType("bpy")
    names = ("Operator", "Panel", "Object", "Scene", "Context", "Image")
    module.types = types.SimpleNamespace(**{name: type(name, (), {}) for name in names})
    kinds = ("StringProperty", "PointerProperty")
    module.props = types.SimpleNamespace(**{kind: lambda **words: words for kind in kinds})
    return module
