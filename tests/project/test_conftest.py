"""Check that every shape in an annotation is checked while the tests run, as `conftest.py` says."""

from importlib.util import find_spec
from pathlib import Path
from pkgutil import walk_packages

import pytest
import torch
from jaxtyping import TypeCheckError

import checked_calls
import cpu_times
import gscompleter
from gscompleter.evaluation.baselines.optimization import ssim_map
from gscompleter.evaluation.metrics.image import psnr
from gscompleter.numerics.geometry import quats_to_rotations
from paths import TESTS

MODULES = [
    module.name
    for module in walk_packages(gscompleter.__path__, "gscompleter.", onerror=pytest.fail)
    if not module.name.startswith("gscompleter.numerics.kernels")
    # Its modules are listed one by one; the package itself has no annotation.
    and module.name != "gscompleter.numerics"
]


def test_every_module_but_the_compiled_ones_is_loaded_by_the_hook():
    files = Path(gscompleter.__path__[0]).rglob("*.py")
    assert len(MODULES) == sum("kernels" not in path.parts for path in files) - 2
    plain = [name for name in MODULES if "jaxtyping" not in type(find_spec(name).loader).__module__]
    assert plain == []


@pytest.mark.parametrize(
    ("function", "shapes"),
    [(quats_to_rotations, [(5, 3)]), (psnr, [(4, 4)] * 2), (ssim_map, [(4, 4, 3), (4, 5, 3)])],
)
def test_a_wrong_shape_is_refused(function, shapes):
    with pytest.raises(TypeCheckError):
        function(*(torch.zeros(shape) for shape in shapes))


def test_functions_are_checked_in_their_first_calls_of_each_test():
    for _ in range(checked_calls.MOST_CHECKS):
        quats_to_rotations(torch.ones(5, 4))
    assert quats_to_rotations in checked_calls.unchecked
    # As another test begins.
    checked_calls.pytest_runtest_setup()
    with pytest.raises(TypeCheckError):
        quats_to_rotations(torch.zeros(5, 3))


def test_a_function_in_another_is_checked_in_its_first_calls_of_each_test():
    def make_inner():
        @checked_calls.leave_checked_functions(typechecker=checked_calls.check_first_calls)
        def inner(number: int) -> int:
            return number

        return inner

    for _ in range(checked_calls.MOST_CHECKS):
        with pytest.raises(TypeCheckError):
            make_inner()("1")
    assert make_inner()("1") == "1"
    # As another test begins.
    checked_calls.pytest_runtest_setup()
    with pytest.raises(TypeCheckError):
        make_inner()("1")


def test_long_tests_are_named_at_the_end(pytestconfig, capsys):
    def report(name: str, seconds: float, **keywords: int) -> pytest.TestReport:
        where = ("a.py", 1, name)
        properties = [("cpu_seconds", seconds)]
        return pytest.TestReport(
            name, where, keywords, "passed", None, "teardown", user_properties=properties
        )

    terminal = pytest.TerminalReporter(pytestconfig)
    terminal.stats = {
        "": [report("short", 4.9), report("long", 5.1), report("longer", 9.0)],
        "error": [report("slow", 60.0, slow=1)],
    }
    cpu_times.pytest_terminal_summary(terminal)
    said = capsys.readouterr().out.splitlines()
    assert "above 5 CPU seconds" in said[0]
    assert said[1:] == ["   9.0 longer", "   5.1 long"]


def test_files_that_begin_first_are_files(pytestconfig):
    plugins = pytestconfig.pluginmanager.get_plugins()
    (names,) = [plugin.LONGEST for plugin in plugins if hasattr(plugin, "LONGEST")]
    assert [name for name in names if not (TESTS / name).is_file()] == []
    assert len(set(names)) == len(names) > 0
