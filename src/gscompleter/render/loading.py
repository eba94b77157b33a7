"""Renderers by name."""

from __future__ import annotations

from gscompleter.render.protocols import Renderer
from gscompleter.system.errors import InputError, quote_value


def load_renderer(name: str) -> Renderer:
    """Load the renderer called `name`: reference, cpu, cuda or metal."""
    if not isinstance(name, str):
        raise InputError(
            f"A renderer is named by a str, got '{quote_value(name)}'; choose reference, cpu, "
            "cuda or metal."
        )
    if name == "cpu":
        from gscompleter.render.cpu import CpuRenderer

        return CpuRenderer()
    if name == "metal":
        from gscompleter.render.metal import MetalRenderer

        return MetalRenderer()
    if name == "reference":
        from gscompleter.render.reference import ReferenceRenderer

        return ReferenceRenderer()
    if name == "cuda":
        from gscompleter.render.gsplat import CudaRenderer

        return CudaRenderer()
    raise InputError(
        f"There is no renderer '{quote_value(name)}'; choose reference, cpu, cuda or metal."
    )
