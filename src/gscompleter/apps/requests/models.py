"""The models of a completion, and where they run."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

from gscompleter.config.generators import PREFIX, GeneratorSettings


@dataclass(frozen=True, kw_only=True)
class ModelRequest:
    """Ψ and Φ, the depth that helps Ψ, and the devices of renderer and networks."""

    reconstructor: str = "plane-sweep"
    """Name of Ψ, or a function as `file.py:function`."""
    weights: Path | None = None
    """File of its weights; None for those that are published."""
    depth: str = "none"
    """Name of the monocular depth that helps it, or `none`."""
    depth_weights: Path | None = None
    """File of weights of that depth; None for those that are published."""
    generator: str = "warp-inpaint"
    """Name of Φ, or a function as `file.py:function`."""
    generator_settings: GeneratorSettings = GeneratorSettings()
    """Settings of Φ, of the class that it names."""
    device: Literal["cpu", "cuda"] = "cpu"
    """Device of the renderer, the photographs and the Gaussians."""
    network_device: Literal["cpu", "cuda", "mps"] = "cpu"
    """Device of the networks."""
    seed: int = 0

    def describe_generator(self) -> dict[str, Any]:
        """Describe Φ and its settings as entries of `summary.json`."""
        settings = asdict(self.generator_settings)
        return {"generator": self.generator, **{PREFIX + name: settings[name] for name in settings}}
