"""The same input gives the same bytes, for all compiled loops."""

import os
import subprocess
import sys
from importlib import import_module
from pkgutil import iter_modules

import numba
import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

from gscompleter.numerics import kernels
from gscompleter.numerics.kernels import splat_rows
from paths import SUPPORT

COMPLETE = """
import hashlib, sys
sys.path.insert(0, sys.argv[1])
from gscompleter import GSCompleter
from scenes import Room, camera_at, view_of
for size in (32, 48, 64, 96):
    views = [view_of(Room(), camera_at(x, size=size)) for x in (-0.3, 0.1)]
    scene = GSCompleter()(views, camera_at(0.7, yaw=12, size=size)).scene
    assert int(scene.generated.sum()) > 0
    for values in (scene.means, scene.opacities, scene.sh):
        print(hashlib.sha256(values.numpy().tobytes()).hexdigest())
"""


def test_no_kernel_may_reorder_its_sums():
    found = [
        (f"{module.name}.{name}", value)
        for module in iter_modules(kernels.__path__)
        for name, value in vars(import_module(f"{kernels.__name__}.{module.name}")).items()
        if isinstance(value, CPUDispatcher)
    ]
    assert len(found) > 30
    for name, kernel in found:
        liberties = kernel.targetoptions.get("fastmath", set())
        assert liberties in (False, set(), {"contract"}), name


@pytest.mark.slow
def test_kernels_of_others_find_blas_all_the_same():
    squared = numba.njit(lambda matrix: np.dot(matrix, matrix))
    assert (squared(2 * np.eye(2)) == 4 * np.eye(2)).all()


@pytest.mark.slow
def test_a_process_that_compiles_and_one_that_finds_it_done_give_the_same_bytes(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", COMPLETE, str(SUPPORT)]
    outputs = []
    for _ in range(2):
        life = subprocess.run(command, env=environment, capture_output=True, text=True, check=True)
        outputs.append(life.stdout)
    assert list(tmp_path.rglob("*.nbc"))
    assert len(outputs[0].split()) == 12
    assert outputs[0] == outputs[1]


def test_no_words_of_errors_are_compiled_with_a_row_that_is_copied():
    """A row assigned to a row has a message on unequal lengths; it took two thirds of the time."""
    copy_row = splat_rows.copy_row
    order = np.array([1, 0])
    values = np.arange(6, dtype=np.float32).reshape(2, 3)

    @numba.njit
    def kernel(order, values, copied):
        for row in range(len(order)):
            copy_row(values, order[row], copied, row)

    copied = np.empty_like(values)
    with numba.core.event.install_recorder("numba:compile") as found:
        kernel(order, values, copied)
    modules = {event.data["dispatcher"].py_func.__module__ for _, event in found.buffer}
    assert __name__ in modules
    assert not any("unicode" in module for module in modules)
    np.testing.assert_array_equal(copied, [[3, 4, 5], [0, 1, 2]])
