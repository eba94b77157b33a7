"""Processes of Python import nothing from the working folder, which strangers may have made."""

import ast
import os
import signal
import sys
import threading
from pathlib import Path

import pytest

from gscompleter.data.sfm.poses import run_colmap
from gscompleter.system.children import hide_working_folder, run_module, run_python
from gscompleter.system.jobs.engines import check_processes, open_local
from paths import PACKAGE
from sources import list_nodes, parse_package

STRANGERS = ("json", "numpy", "runpy", "selectors", "struct", "multiprocessing", "gscompleter")
"""Modules that children import, some of them before any code of ours."""
STARTING = {"sys.executable", "subprocess.run", "subprocess.Popen", "get_context", "set_executable"}
"""Names that start processes, of Python or others."""
STARTS = {
    # A process that libraries start, in a block of `hide_working_folder`.
    "system/jobs/engines.py": {"get_context"},
    "system/children.py": {"sys.executable", "subprocess.run", "subprocess.Popen"},
    # Programs that are no Python: ffmpeg and git.
    "system/files/video.py": {"subprocess.Popen"},
    "evaluation/measured_code.py": {"subprocess.run"},
}
"""Files that start processes."""


@pytest.fixture
def strange(tmp_path, monkeypatch) -> Path:
    """Change to a working folder in which every module that is imported leaves a trace."""
    folder = tmp_path / "photographs"
    folder.mkdir()
    for name in STRANGERS:
        code = f"open({str(tmp_path / 'ran')!r}, 'a').write('{name} ')\nraise ImportError('stop')\n"
        (folder / f"{name}.py").write_text(code)
    monkeypatch.chdir(folder)
    return tmp_path / "ran"


def test_a_program_imports_what_this_process_does_and_nothing_of_the_working_folder(
    strange, tmp_path, monkeypatch
):
    (tmp_path / "script_of_user").mkdir()
    (tmp_path / "script_of_user" / "beside_the_script.py").write_text("VALUE = 7\n")
    monkeypatch.syspath_prepend(str(tmp_path / "script_of_user"))
    monkeypatch.setattr(sys, "path", ["", *sys.path])  # as in an interactive Python
    program = (
        "import json, os, sys, numpy, gscompleter, beside_the_script as own\n"
        "print(json.dumps([sys.argv[1:], sys.stdin.read(), os.getcwd(), own.VALUE]))"
    )
    done = run_python(program, ("a b", "c"), text="ä")
    assert done.returncode == 0, done.stderr
    assert ast.literal_eval(done.stdout) == [["a b", "c"], "ä", os.getcwd(), 7]
    assert not strange.exists()


def test_python_3_10_takes_the_working_folder_off_the_path_itself(strange, monkeypatch):
    """It does not know the variable, and neither does a Python that ignores it."""
    monkeypatch.setattr("gscompleter.system.children.SAFE_PATH", {})
    done = run_python("import json, numpy, selectors, sys\nprint('' in sys.path)")
    assert done.stdout == "False\n", done.stderr
    assert not strange.exists()


def test_a_module_is_run_as_the_main_one(strange, tmp_path, monkeypatch):
    (tmp_path / "a_process.py").write_text(
        "import json, sys\nif __name__ == '__main__':\n    print(json.load(sys.stdin)['n'] + 1)\n"
    )
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert run_module("a_process", '{"n": 1}').stdout == "2\n"
    (tmp_path / "stand_in.py").write_text("import json\nprint(json.dumps({'points': 1}))\n")
    assert run_colmap("stand_in", {}, tmp_path, "Finding cameras") == {"points": 1}
    assert not strange.exists()


@pytest.mark.parametrize(
    "is_known",
    [
        pytest.param(True, id="PYTHONSAFEPATH"),
        # The test before starts a plain process so.
        pytest.param(False, id="3.10", marks=pytest.mark.slow),
    ],
)
def test_workers_import_nothing_of_the_working_folder_and_work_in_it(
    is_known, strange, monkeypatch
):
    if not is_known:
        monkeypatch.setattr("gscompleter.system.children.SAFE_PATH", {})
    check_processes()
    with open_local(1) as pool:
        assert pool.start(check_is_here).result(timeout=120) is None
        assert pool.start(check_is_here).result(timeout=120) is None  # by the same process
    assert not strange.exists()


@pytest.mark.linux
def test_a_worker_that_was_killed_while_it_waited_is_replaced():
    others = set(threading.enumerate())
    with open_local(1) as pool:
        first = pool.start(os.getpid).result(timeout=120)
        managers = [
            thread
            for thread in threading.enumerate()
            if thread not in others and "ExecutorManager" in type(thread).__name__
        ]
        assert len(managers) == 1
        os.kill(first, signal.SIGKILL)
        # The thread of its executor ends once it is found dead.
        managers[0].join(60)
        assert not managers[0].is_alive()
        assert pool.start(os.getpid).result(timeout=120) != first


def check_is_here() -> None:
    """Check in a worker that its working folder is that of the parent."""
    assert Path("selectors.py").is_file()


def test_the_working_folder_and_the_environment_are_as_before(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("PYTHONSAFEPATH", raising=False)
    before = dict(os.environ)
    with pytest.raises(KeyError), hide_working_folder():
        assert Path.cwd() != tmp_path
        raise KeyError
    assert Path.cwd() == tmp_path
    assert dict(os.environ) == before


def test_every_process_of_python_is_started_in_one_place():
    last_words = {name.split(".")[-1] for name in STARTING}
    found = {}
    for path in parse_package():
        names = set()
        for node in list_nodes(path):
            if isinstance(node, ast.Attribute) and node.attr in last_words:
                names |= {node.attr, ast.unparse(node)}
            elif isinstance(node, ast.ImportFrom) and node.module in ("subprocess", "sys"):
                names |= {f"{node.module}.{alias.name}" for alias in node.names}
        if names & STARTING:
            found[path.relative_to(PACKAGE).as_posix()] = names & STARTING
    assert found == STARTS
