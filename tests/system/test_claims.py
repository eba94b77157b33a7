"""Claims: two runs do not do the same jobs of a folder at once."""

import errno
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from gscompleter import InputError
from gscompleter.system.files.unfinished import make_unfinished_name
from gscompleter.system.jobs.claims import CLAIM, claim_share


@pytest.mark.parametrize(
    ("share", "other", "overlap"),
    [
        ((0, 1), (0, 1), True),
        ((0, 1), (3, 4), True),
        ((0, 2), (1, 2), False),
        ((1, 2), (3, 4), True),
        ((0, 2), (3, 4), False),
        ((2, 3), (3, 4), True),  # both have job 11
        ((1, 6), (2, 4), False),
    ],
)
def test_jobs_that_another_run_does_are_refused(tmp_path, share, other, overlap):
    first = set(range(share[0], 24, share[1]))
    assert bool(first & set(range(other[0], 24, other[1]))) == overlap
    with claim_share(tmp_path, share):
        if overlap:
            sentence = rf"Another run \(process {os.getpid()}\) is doing jobs of this one in"
            with pytest.raises(InputError, match=sentence), claim_share(tmp_path, other):
                pass
        else:
            with claim_share(tmp_path, other):
                pass
    assert os.listdir(tmp_path) == []
    with claim_share(tmp_path, other):
        pass


@pytest.mark.parametrize("content", [b"", b"[0, 1", b"5", b"null", b'["a", 1]', b"[0, null]"])
def test_a_claim_that_cannot_be_read_counts_for_all_jobs(tmp_path, content):
    """It may be half written."""
    entry = tmp_path / make_unfinished_name(CLAIM)
    entry.write_bytes(content)
    with pytest.raises(InputError, match="Another run"), claim_share(tmp_path, (1, 8)):
        pass
    assert os.listdir(tmp_path) == [entry.name]


def test_a_claim_of_another_user_counts_for_all_jobs(tmp_path, monkeypatch):
    entry = tmp_path / make_unfinished_name(CLAIM)
    entry.write_bytes(b"[0, 2]")

    def refuse(path):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(Path, "read_bytes", refuse)
    with pytest.raises(InputError, match="Another run"), claim_share(tmp_path, (1, 2)):
        pass


def test_a_claim_that_cannot_be_removed_hides_nothing(tmp_path, monkeypatch):
    """Of a disk that has gone meanwhile, or of a folder that is none."""
    file = tmp_path / "file"
    file.touch()
    with pytest.raises(InputError, match="Cannot write"), claim_share(file, (0, 1)):
        pass

    def refuse(path, missing_ok=False):
        raise OSError(errno.ESTALE, "Stale file handle")

    monkeypatch.setattr(Path, "unlink", refuse)
    with claim_share(tmp_path, (0, 1)):
        pass


@pytest.mark.linux
def test_the_claim_of_a_killed_run_counts_no_more(tmp_path):
    program = (
        "import os, sys; from pathlib import Path\n"
        "from gscompleter.system.jobs.claims import claim_share\n"
        "with claim_share(Path(sys.argv[1]), (0, 2)):\n"
        "    os.kill(os.getpid(), 9)\n"
    )
    killed = subprocess.run([sys.executable, "-c", program, tmp_path], check=False)
    assert killed.returncode == -9
    (left,) = tmp_path.iterdir()
    assert json.loads(left.read_text()) == [0, 2]
    with claim_share(tmp_path, (0, 1)):
        pass
