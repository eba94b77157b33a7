"""Recognise a splat by the path that the command line names, before it is opened."""

from __future__ import annotations

import os
from pathlib import Path


def names_splat(path: Path) -> bool:
    """Check whether a path is a file named as one of Gaussians, or a folder of nothing else."""
    # Without an import of torch where there is nothing to look into.
    if not os.path.exists(path):
        return False
    from gscompleter.splats.foreign import holds_splat_alone, is_named_splat

    return holds_splat_alone(path) if os.path.isdir(path) else is_named_splat(path)
