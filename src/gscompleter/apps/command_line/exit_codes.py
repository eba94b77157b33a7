"""Exit codes of all commands, which docs/contracts.md explains."""

DONE = 0
ERROR = 1
WRONG_INPUT = 2
SOME_FAILED = 3
INTERRUPTED = 130
"""128 + 2, the number of SIGINT, as shells have it."""


def choose_exit_code(failed: int, total: int) -> int:
    """Return the exit code of a command that had a number of cases, some of which failed."""
    if failed == 0:
        return DONE
    return ERROR if failed == total else SOME_FAILED
