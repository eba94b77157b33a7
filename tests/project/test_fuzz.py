"""A few of the inputs of `fuzz.py` and `fuzz_python.py`; `make fuzz` runs thousands.

`FUZZ_CALLS` and `FUZZ_FILES` in the environment set the numbers of the second.
"""

import os
import re
import subprocess
import sys

import pytest

from paths import SUPPORT

pytest.importorskip("imageio_ffmpeg", reason="needs gscompleter[film]")


# The next test damages the same files, and reads them in Python.
@pytest.mark.slow
@pytest.mark.linux
def test_mutated_inputs_end_in_a_sentence_or_a_result():
    """It runs in a process of its own, whose forks inherit no threads."""
    script = SUPPORT / "fuzz.py"
    # A machine that is busy with other tests is no hang.
    words = ["--count", "12", "--seed", "1", "--workers", "2", "--limit", "120"]
    command = [sys.executable, str(script), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    refused = re.search(r"12 mutations, 0 findings, (\d+) refused", done.stdout)
    assert refused is not None
    assert 0 < int(refused[1]) < 12


@pytest.mark.linux
def test_odd_values_and_damaged_files_end_in_a_sentence_or_a_result():
    """Calls of the Python interface and its readers, in a process of its own with its limits."""
    calls, files = os.environ.get("FUZZ_CALLS", "5"), os.environ.get("FUZZ_FILES", "40")
    words = ["--calls", calls, "--files", files, "--seed", "2"]
    command = [sys.executable, str(SUPPORT / "fuzz_python.py"), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    count = int(calls) + int(files)
    refused = re.search(rf"{count} inputs, 0 findings, (\d+) refused", done.stdout)
    assert refused is not None
    assert 0 < int(refused[1]) < count
