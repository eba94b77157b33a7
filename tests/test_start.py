"""What a completion never imports."""

import subprocess
import sys

import pytest

from scenes import camera_at, photographed

COMPLETE = """
import sys
from gscompleter.cli import main
main()
print(*sys.modules)
"""


@pytest.fixture(scope="module")
def imported(tmp_path_factory) -> set[str]:
    """The modules that a quiet completion of a small room ends with."""
    folder = tmp_path_factory.mktemp("start")
    cameras = [camera_at(x, yaw=yaw, size=32) for x, yaw in ((-0.3, 0), (0.1, 0), (0.7, 12))]
    scene = photographed(folder / "room", cameras)
    words = ["complete", scene, "--context", "0", "1", "--target", "2", "--out", folder / "out"]
    command = [sys.executable, "-c", COMPLETE, *map(str, words), "--quiet"]
    return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())


@pytest.mark.parametrize(
    "module",
    [
        "matplotlib",
        "packaging.requirements",
        "rich.progress",
        "scipy.linalg",
        "scipy.ndimage",
        "scipy.optimize",
        "scipy.spatial",
        "skimage",
        "sympy",
    ],
)
def test_a_completion_does_not_wait_for(imported, module):
    assert "gscompleter.completer" in imported
    assert module not in imported
