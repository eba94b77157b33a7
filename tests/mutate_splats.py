"""Damages files at random and reads them: only a sentence may come of it.

`python tests/mutate_splats.py COUNT [FILE ...]` does it by hand; the tests do it 40 times for each
format.
"""

from __future__ import annotations

import random
import resource
import sys
import time
from pathlib import Path

from gscompleter import InputError, load_splat

SECONDS = 20.0
"""Longer is a hang, for files as small as these."""


def damaged(data: bytes, chance: random.Random) -> bytes:
    """The bytes with some changed, cut out, doubled or appended, most often near the beginning."""
    out = bytearray(data)
    for _ in range(chance.choice((1, 1, 2, 5, 30))):
        area = chance.choice((64, 512, len(out)))
        at = chance.randrange(max(1, min(len(out), area)))
        kind = chance.randrange(5)
        if kind == 0:
            out[at : at + 1] = bytes([chance.randrange(256)])
        elif kind == 1:
            out[at : at + 4] = chance.choice((b"\xff" * 4, bytes(4), b"\xff\xff\xff\x7f"))
        elif kind == 2:
            del out[at : at + chance.choice((1, 4, 100, len(out)))]
        elif kind == 3:
            out[at:at] = out[at : at + chance.choice((1, 4, 100))]
        else:
            out[at:at] = chance.randbytes(chance.choice((1, 4, 100)))
    return bytes(out)


def refusals(path: Path, count: int, seed: int) -> int:
    """Read `count` mutations of a file; how many were refused. Anything else raises."""
    chance, data, refused = random.Random(seed), path.read_bytes(), 0
    victim = path.with_name(f"mutated-{path.name}")
    for number in range(count):
        victim.write_bytes(damaged(data, chance))
        began = time.monotonic()
        try:
            load_splat(victim)
        except InputError as error:
            if "\n" in str(error):
                raise AssertionError(f"no sentence at mutation {number}: {error}") from error
            refused += 1
        assert time.monotonic() - began < SECONDS, number
    return refused


if __name__ == "__main__":
    for name in sys.argv[2:]:
        refused = refusals(Path(name), int(sys.argv[1]), seed=0)
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        print(f"{name}: {refused} of {sys.argv[1]} refused, {peak:.0f} MB at most")
