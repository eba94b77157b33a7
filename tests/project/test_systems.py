"""The package assumes nothing that macOS or Windows lack; neither has run it."""

import ast
import os
import subprocess
import sys

import pytest

from paths import PACKAGE
from sources import list_nodes, parse_package

UNIX_MODULES = {"fcntl", "grp", "posix", "pty", "pwd", "resource", "syslog", "termios", "tty"}
UNIX_NAMES = {"fork", "forkpty", "getuid", "geteuid", "getpgid", "killpg", "mkfifo", "nice"}
UNIX_NAMES |= {"setsid", "statvfs", "sched_getaffinity", "sysconf", "uname", "wait4"}
UNIX_NAMES |= {"SIGALRM", "SIGHUP", "SIGKILL", "SIGPIPE", "SIGUSR1", "Signals"}
GUARDED = {
    ("system/threads.py", "sched_getaffinity"),
    ("numerics/kernels/cache.py", "getuid"),
    ("system/memory.py", "sysconf"),
    ("system/files/output_folder.py", "geteuid"),
}
"""Names that a condition or `suppress` precedes."""
ENCODED = {"read_text": 0, "write_text": 1, "TextIOWrapper": 1}
"""Positions of the encoding."""


def name_of(call: ast.Call) -> str:
    return call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")


def has_encoding(call: ast.Call) -> bool:
    """Return True if a call that reads or writes text names the encoding, or is no such call."""
    name, given = name_of(call), {keyword.arg for keyword in call.keywords}
    if name == "open":
        modes = [a.value for a in call.args if isinstance(a, ast.Constant)]
        is_builtin = isinstance(call.func, ast.Name) and len(call.args) == 1
        return not (is_builtin or {"r", "w", "a", "x"} & set(modes)) or "encoding" in given
    return name not in ENCODED or "encoding" in given or len(call.args) > ENCODED[name]


def test_no_text_is_read_or_written_in_the_encoding_of_the_system():
    calls = ((p, n) for p in parse_package() for n in list_nodes(p) if isinstance(n, ast.Call))
    assert [f"{path}:{call.lineno}" for path, call in calls if not has_encoding(call)] == []


@pytest.mark.parametrize(
    "text", ["p.read_text()", "p.write_text(x)", "open(p)", "open(p, 'w')", "p.open('r')"]
)
def test_such_calls_are_found(text):
    call = ast.parse(text, mode="eval").body
    assert isinstance(call, ast.Call)
    assert not has_encoding(call)


def test_nothing_is_used_that_only_unix_has():
    found = set()
    for file in parse_package():
        path = file.relative_to(PACKAGE)
        for node in list_nodes(file):
            if isinstance(node, ast.Import) and {a.name for a in node.names} & UNIX_MODULES:
                found.add((str(path), "import"))
            if isinstance(node, ast.ImportFrom) and node.module in UNIX_MODULES:
                found.add((str(path), str(node.module)))
            if isinstance(node, ast.Attribute) and node.attr in UNIX_NAMES:
                owner = getattr(node.value, "id", "")
                found |= {(str(path), node.attr)} if owner in ("os", "signal") else set()
    assert found == GUARDED


@pytest.mark.parametrize("encoding", ["cp1252", "ascii"])
def test_help_goes_into_a_pipe_that_is_not_utf_8(encoding):
    code = "import sys; from gscompleter.cli import run; sys.argv[1:] = ['complete', '--help-all']"
    environment = {**os.environ, "PYTHONIOENCODING": encoding, "PYTHONUTF8": "0"}
    done = subprocess.run(
        [sys.executable, "-c", f"{code}; run()"], capture_output=True, check=False, env=environment
    )
    assert done.returncode == 0, done.stderr[-500:]
    assert b"\\u03bb" in done.stdout
