"""A few of the mutations of `fuzz.py`, which runs thousands by hand."""

import re
import subprocess
import sys

import pytest

from paths import SUPPORT


@pytest.mark.linux
def test_mutated_inputs_end_in_a_sentence_or_a_result():
    """It runs in a process of its own, whose forks inherit no threads."""
    script = SUPPORT / "fuzz.py"
    # A machine that is busy with other tests is no hang.
    words = ["--count", "40", "--seed", "1", "--workers", "2", "--limit", "120"]
    command = [sys.executable, str(script), *words]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[-3000:] + done.stderr[-3000:]
    refused = re.search(r"40 mutations, 0 findings, (\d+) refused", done.stdout)
    assert refused is not None
    assert 0 < int(refused[1]) < 40
