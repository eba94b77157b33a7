"""Shapes in annotations are checked at run time while the tests run: see `checked_calls.py`."""

import gc
import os
import sys
from pathlib import Path

# As in the command line: threads that spin while they wait slow down a busy machine.
os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")
# The workers of pytest-xdist share the cores: more threads than cores cost a sixth of the time.
if "PYTEST_XDIST_WORKER_COUNT" in os.environ:
    threads = (os.cpu_count() or 1) // int(os.environ["PYTEST_XDIST_WORKER_COUNT"])
    os.environ.setdefault("OMP_NUM_THREADS", str(max(1, threads)))
    os.environ.setdefault("NUMBA_NUM_THREADS", str(max(1, threads)))

# Imports and collected tests stay; searches among them for garbage cost seconds in each worker.
gc.disable()

import jaxtyping
import pytest
from jaxtyping import install_import_hook

import checked_calls
import cpu_times
from paths import DATA, PACKAGE, TESTS

# The whole package except `gscompleter.numerics.kernels`, whose functions numba compiles. The name
# of a package stands for all modules in it, so those of `numerics` are listed one by one.
CHECKED = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for path in [*PACKAGE.iterdir(), *(PACKAGE / "numerics").iterdir()]
    if (path.suffix == ".py" or (path / "__init__.py").exists())
    and path.stem not in ("__init__", "numerics", "kernels")
)
install_import_hook(CHECKED, "checked_calls.check_first_calls")
jaxtyping.jaxtyped = checked_calls.leave_checked_functions


LONGEST = (
    "apps/test_cli.py",
    "apps/test_viewer_browser.py",
    "apps/test_live.py",
    "test_completer.py",
    "project/test_snippets.py",
    "models/test_feed_forward.py",
    "apps/test_doors.py",
    "apps/test_painters.py",
    "models/test_diffusion.py",
    "evaluation/test_runs.py",
    "test_commands_on_a_device.py",
    "apps/test_remove.py",
    "integrations/test_comfyui.py",
    "stages/test_add_observed.py",
)
"""Files that take longest, in the order in which processes of pytest-xdist begin them: one that
began a long file last would be waited for."""


def pytest_configure(config: pytest.Config) -> None:
    """Check the first calls of functions in each test, and name long tests at the end of a run."""
    config.pluginmanager.register(checked_calls)
    config.pluginmanager.register(cpu_times)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Put the longest files first, and skip tests of Linux elsewhere."""
    ranks = {TESTS / name: rank for rank, name in enumerate(LONGEST)}
    # The order within a file, and of all others, stays.
    items.sort(key=lambda item: ranks.get(item.path, len(ranks)))
    for item in items:
        if sys.platform != "linux" and item.get_closest_marker("linux"):
            item.add_marker(pytest.mark.skip(reason="needs Linux"))


def pytest_collection_finish() -> None:
    """Collect garbage again, but none of what was imported and collected."""
    gc.freeze()
    gc.enable()


@pytest.fixture(scope="session")
def room(tmp_path_factory) -> Path:
    """Write a synthetic room photographed from three places; frame 2 sees more than 0 and 1."""
    from scenes import camera_at, photographed

    cameras = [camera_at(x, yaw=yaw, size=64) for x, yaw in ((-0.3, 0), (0.1, 0), (0.7, 12))]
    return photographed(tmp_path_factory.mktemp("room"), cameras)


@pytest.fixture(scope="session")
def completed_room(room, tmp_path_factory) -> Path:
    """Return the output of one plain run on the room; copy it before changing it."""
    from command import run

    out = tmp_path_factory.mktemp("runs") / "out"
    frames = ("--context", 0, 1, "--target", 2, "--near", 0.5, "--far", 20)
    with pytest.MonkeyPatch.context() as monkeypatch:
        assert run(monkeypatch, "complete", room, *frames, "--out", out, "--quiet") == 0
    return out


@pytest.fixture
def shared() -> Path:
    """Return the folder of real photographs and files, or skip the test where it is absent."""
    if not DATA.is_dir():
        pytest.skip(f"needs real photographs, and there is no {DATA}; set GSCOMPLETER_DATA")
    return DATA
