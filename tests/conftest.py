"""Every shape in an annotation is a run-time check while the tests run."""

import os
from pathlib import Path

# As the command line has it: threads that spin while they wait make a busy machine crawl.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")

import pytest
from jaxtyping import install_import_hook

# All of the package but `gscompleter.kernels`, whose functions numba compiles.
PACKAGE = Path(__file__).resolve().parents[1] / "src" / "gscompleter"
CHECKED = sorted(
    path.stem
    for path in PACKAGE.iterdir()
    if (path.suffix == ".py" or (path / "__init__.py").exists())
    and path.stem not in ("__init__", "kernels")
)
install_import_hook([f"gscompleter.{name}" for name in CHECKED], "beartype.beartype")

SHARED = Path(__file__).resolve().parents[2] / "shared"


@pytest.fixture
def shared() -> Path:
    """Real photographs and files for development, where they lie beside the project."""
    if not SHARED.is_dir():
        pytest.skip(f"needs the development data, and there is no folder {SHARED}")
    return SHARED
