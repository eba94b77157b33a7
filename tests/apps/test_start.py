"""Start and end of the command's process."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from gscompleter import __version__
from scenes import camera_at, photographed

COMPLETE = """
import sys
from gscompleter.cli import main
main()
print(*sys.modules)
"""


@pytest.fixture(scope="module")
def imported(tmp_path_factory) -> set[str]:
    """Return the modules that a quiet completion of a small room has imported."""
    folder = tmp_path_factory.mktemp("start")
    cameras = [camera_at(x, yaw=yaw, size=32) for x, yaw in ((-0.3, 0), (0.1, 0), (0.7, 12))]
    scene = photographed(folder / "room", cameras)
    words = ["complete", scene, "--context", "0", "1", "--target", "2", "--out", folder / "out"]
    command = [sys.executable, "-c", COMPLETE, *map(str, words), "--quiet"]
    return set(subprocess.run(command, capture_output=True, text=True, check=True).stdout.split())


@pytest.mark.parametrize(
    "module",
    [
        "PIL.WmfImagePlugin",
        "matplotlib",
        "packaging.requirements",
        "rich.progress",
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


PARSE = """
import sys
from contextlib import suppress
from gscompleter.cli import parse_command
with suppress(SystemExit):
    parse_command(sys.argv[1:])
print()
print(*sys.modules)
"""


ALL_COMMANDS = """
import sys
from gscompleter.cli import main
sys.argv = ["gscompleter", *sys.argv[1:]]
main()
print(*sys.modules)
"""


def list_imported(*words: object, code: str = PARSE) -> set[str]:
    """Return the modules that parsing a command line imports, or what `code` does with it."""
    command = [sys.executable, "-c", code, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return set(done.stdout.splitlines()[-1].split())


COMPUTING = {"torch", "numba", "numpy", "rich.console"}
"""Modules that take long to import, and that no help page needs."""


@pytest.mark.parametrize("words", [("complete", "--help"), ("complete", "--help-all")])
def test_help_waits_for_nothing_that_computes(words):
    modules = list_imported(*words)
    assert "gscompleter.apps.commands.complete" in modules
    assert not modules & COMPUTING


@pytest.mark.parametrize("word", ["-h", "--help", "--help-all"])
def test_the_page_of_all_commands_waits_for_no_options(word):
    modules = list_imported(word, code=ALL_COMMANDS)
    assert not modules & {"tyro", "gscompleter.apps.commands.complete", *COMPUTING}


def test_a_command_line_imports_the_options_of_its_command_alone():
    modules = list_imported("complete", "SCENE", "--out", "OUT")
    files = {name.rpartition(".")[2] for name in modules if "apps.commands." in name}
    assert files == {"complete", "shared_options", "shared_decisions"}


ENDING = """
import atexit, sys
from gscompleter.cli import run

sys.argv = ["gscompleter", *sys.argv[1:]]
run()
atexit.register(print, "done at the end")
"""


def ended(*words: str, **settings) -> subprocess.CompletedProcess[str]:
    """Run the command as it is installed, in a process of its own."""
    command = [sys.executable, "-c", ENDING, *words]
    return subprocess.run(command, text=True, stderr=subprocess.PIPE, check=False, **settings)


def test_the_command_ends_once_all_is_done_and_said():
    done = ended("--version", stdout=subprocess.PIPE)
    assert done.returncode == 0, done.stderr
    assert done.stdout.splitlines() == [__version__, "done at the end"]


# `test_cli.py` has wrong input in this process, and the test before ends a process.
@pytest.mark.slow
def test_what_is_wrong_ends_as_ever():
    done = ended("view", "nowhere", stdout=subprocess.PIPE)
    assert done.returncode == 2
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    "words", [("complete", "--help-all"), ("doctor", "--help"), ("--version",)]
)
def test_a_reader_that_ends_early_leaves_no_traceback(words):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as closed:
        done = ended(*words, stdout=closed)
    assert done.stderr == ""


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full")
def test_what_could_not_be_said_is_no_success():
    with open("/dev/full", "w") as full:
        assert ended("--version", stdout=full).returncode != 0


STOPPED_EARLY = """
import sys
from gscompleter.cli import run

class Stop:
    def find_spec(self, name, *_):
        if name == "tyro":
            raise KeyboardInterrupt

sys.meta_path.insert(0, Stop())
sys.argv = ["gscompleter", "doctor"]
run()
"""


def test_a_command_that_is_stopped_while_it_starts_says_so_in_a_sentence():
    """As by Ctrl+C within the first tenths of a second, in which its options are imported."""
    command = [sys.executable, "-c", STOPPED_EARLY]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.stderr == "gscompleter: interrupted; no unfinished result was written.\n"
    assert done.returncode == 130


CLOSED_OUTPUT = """
import subprocess, sys
from gscompleter.cli import replace_closed_outputs

replace_closed_outputs()
child = "import sys; print(sys.stdout is None, file=sys.stderr)"
subprocess.run([sys.executable, "-c", child], check=True)
"""


@pytest.mark.skipif(os.name == "nt", reason="needs a POSIX shell")
def test_what_a_command_starts_has_an_output_where_its_own_is_closed():
    command = ["sh", "-c", 'exec "$0" -c "$1" >&-', sys.executable, CLOSED_OUTPUT]
    done = subprocess.run(command, stderr=subprocess.PIPE, text=True, check=True)
    assert done.stderr == "False\n"
