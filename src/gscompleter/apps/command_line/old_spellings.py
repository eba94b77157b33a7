"""Commands and options that have another name by now, refused with the sentence that names it."""

from __future__ import annotations

from collections.abc import Sequence

from gscompleter.system.errors import InputError

OLD_COMMANDS = {
    "bench": "`python benchmarks/measure_completions.py` in a checkout measures completions",
}
"""Successor of each command that is gone, by its name."""

UPDATE = "`gscompleter update` adds what photographs show and a splat lacks, and invents nothing"

OLD_SPELLINGS = {
    ("complete", "from-photographs-only"): UPDATE,
    ("remove", "from-photographs-only"): UPDATE,
    ("repair", "camera"): "the cameras of masks are named by --target",
}
"""Replacement of each option, by the command and the name of the option without dashes.

Such an option is not read under its old name as well: one name with two spellings would be two
rows of the table of options, and scripts would never be changed.
"""


def refuse_old_spellings(words: Sequence[str]) -> None:
    """Refuse a command that is none any more, or its option by the name that it had."""
    if words and words[0] in OLD_COMMANDS:
        raise InputError(f"There is no command {words[0]} any more; {OLD_COMMANDS[words[0]]}.")
    for word in words[1:]:
        # As in `--camera=FILE`, and with the underscore of the rows of a batch.
        name = word.partition("=")[0].removeprefix("--").replace("_", "-")
        new = OLD_SPELLINGS.get((words[0], name)) if word.startswith("--") else None
        if new is not None:
            raise InputError(f"{words[0]} has no option --{name} any more; {new}.")
