"""Every shape in an annotation is checked at run time while the tests run."""

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

import pytest
from jaxtyping import install_import_hook

import cpu_times
from paths import DATA, PACKAGE, TESTS

# The whole package except `numerics.kernels`, whose functions numba compiles, and the checks of
# `system.tensor_checks`: they know no shapes, and are called thousands of times in a completion.
# The name of a package stands for all modules in it, so those of two are listed one by one.
LISTED = ("numerics", "system")
CHECKED = sorted(
    ".".join(path.relative_to(PACKAGE.parent).with_suffix("").parts)
    for folder in (PACKAGE, *(PACKAGE / name for name in LISTED))
    for path in folder.iterdir()
    if (path.suffix == ".py" or (path / "__init__.py").exists())
    and path.stem not in ("__init__", "kernels", "tensor_checks", *LISTED)
)
install_import_hook(CHECKED, "beartype.beartype")


LONGEST = (
    "apps/test_viewer_browser.py",
    "apps/test_cli.py",
    "test_completer.py",
    "apps/test_live.py",
    "models/test_feed_forward.py",
    "apps/test_painters.py",
    "evaluation/test_steps.py",
    "project/test_snippets.py",
    "models/test_diffusion.py",
    "test_commands_on_a_device.py",
    "test_fake_device.py",
    "apps/test_batch.py",
    "project/test_release.py",
    "apps/test_shards.py",
    "test_devices.py",
    "apps/test_live_browser.py",
    "splats/alignment/test_estimate.py",
    "project/test_fuzz.py",
    "data/test_video.py",
    "data/test_poses.py",
    "models/test_volsplat.py",
)
"""Files that take longest, in the order in which processes of pytest-xdist begin them: one that
began a long file last would be waited for."""


def pytest_configure(config: pytest.Config) -> None:
    """Name the tests that take long at the end of a run."""
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
