"""Claims of jobs: no two commands run the same jobs of a folder at once."""

from __future__ import annotations

import json
import math
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from gscompleter.system.errors import InputError, quote_value
from gscompleter.system.files.unfinished import (
    LEASE_SECONDS,
    give_signs,
    list_unfinished,
    make_unfinished_name,
)
from gscompleter.system.files.writing import convert_write_errors

CLAIM = "jobs in this folder"
"""Name for the unfinished entries of all claims in a folder."""


@contextmanager
def claim_share(out: Path, share: tuple[int, int]) -> Iterator[None]:
    """Claim the jobs i, i + n, … of an existing folder during the block, with `share` (i, n).

    Raise InputError if another run, on this machine or elsewhere, claims one of them.
    """
    claim = out / make_unfinished_name(CLAIM)
    try:
        # Written before the others are listed: of two runs that begin at the same moment at least
        # one sees the other. Both may, and then both are refused.
        with convert_write_errors(out):
            claim.write_text(json.dumps(share), "ascii")
        for entry in list_unfinished(out, CLAIM):
            # Asked last, as it may have to look at the clock of the disk.
            if entry.path != claim and overlaps(share, entry.path) and entry.is_running():
                raise InputError(
                    f"Another run (process {entry.pid}) is doing jobs of this one in "
                    f"{quote_value(out)}; wait for its end, or give each run its own shard; if it "
                    f"was killed, try again in {LEASE_SECONDS / 60:.0f} minutes.",
                    "shard",
                )
        with give_signs(claim):
            yield
    finally:
        # An error of the disk must not hide what happened, nor fail a run whose jobs are done.
        with suppress(OSError):
            claim.unlink()


def overlaps(share: tuple[int, int], claim: Path) -> bool:
    """Return True if a share and that of a claim have a job in common.

    A claim that is still being written, or that cannot be read, counts as one of all jobs.
    """
    try:
        number, count = map(int, json.loads(claim.read_bytes()))
    except FileNotFoundError:  # its run has ended since
        return False
    except (OSError, ValueError, TypeError):
        return True
    # Some job is i modulo n and j modulo m if and only if gcd(n, m) divides i - j (the Chinese
    # remainder theorem).
    return (number - share[0]) % math.gcd(count, share[1]) == 0
