"""The command `demo`: complete the stereo pair that scikit-image contains."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from gscompleter.apps.commands.shared_options import RunOptions, WritingOptions
from gscompleter.apps.requests.completion import ResultsRequest
from gscompleter.apps.requests.models import ModelRequest
from gscompleter.system.process import import_without_collection


@dataclass(frozen=True, kw_only=True)
class DemoOptions(RunOptions, WritingOptions):
    """Complete the stereo pair that scikit-image contains, and show before and after.

    Example: gscompleter demo --out demo
    """

    out: Path = Path("demo")
    """Write results here. A folder, for the scene, its completion and before_after.png."""


def run_demo(options: DemoOptions) -> int:
    """Write the scene, complete it for both targets, and return the exit code."""
    # Imported here, so that help pages do not wait for torch.
    with import_without_collection():
        from gscompleter.apps.completing.demo import complete_demo
        from gscompleter.render.device import choose_devices
    devices = choose_devices(options.device)
    models = ModelRequest(
        device=devices.renderer, network_device=devices.networks, seed=options.seed
    )
    results = ResultsRequest(out=options.out, overwrite=options.overwrite, answer=options.answer)
    return complete_demo(models, results)
