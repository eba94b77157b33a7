"""Failures of the machine, such as a lack of memory, as sentences for the user."""

from __future__ import annotations

import errno
from dataclasses import dataclass

from gscompleter.apps.command_line.exit_codes import ERROR, WRONG_INPUT
from gscompleter.system.errors import quote_value
from gscompleter.system.files.writing import FULL_DISK_ERRORS

NAME_ERRORS = {errno.ENAMETOOLONG, errno.ELOOP}
"""Numbers of errors of a path that names nothing on any disk."""
ACCESS_ERRORS = {errno.EACCES, errno.EPERM, errno.EROFS}
"""Numbers of errors of a path that this user may not read or write."""
MEMORY_WORDS = (
    "can't start new thread",
    "can't allocate memory",
    "cannot allocate memory",
    "out of memory",
    "unable to allocate",
    "failed to allocate",
    "failed to map segment",
    "insufficient memory",
)
"""Words of the messages by which libraries say that memory ran out, in small letters.

Threads need memory, too: of a limit of the address space (`ulimit -v`) each takes its stack.
"""


@dataclass(frozen=True)
class Failure:
    """A failure that the user can understand."""

    sentence: str
    code: int


def explain_failure(error: BaseException) -> Failure | None:
    """Explain an error of the machine or of a path; None for any other, which is a defect."""
    # Libraries wrap the error of the system in their own, so the causes are searched, too. A chain
    # of causes may lead back to its beginning.
    seen: list[BaseException] = []
    cause: BaseException | None = error
    while cause is not None and cause not in seen:
        sentence, code = _explain_failure(cause)
        if sentence:
            return Failure(sentence, code)
        seen.append(cause)
        cause = cause.__cause__ or cause.__context__
    return None


def _explain_failure(error: BaseException) -> tuple[str, int]:
    """Return the sentence and exit code for an error alone; an empty sentence for a defect."""
    # torch has its own error for the memory of a GPU; torch is not imported to name it.
    if type(error).__name__ == "OutOfMemoryError":
        return (
            "The memory of the GPU ran out; choose a smaller --resolution, fewer photographs or "
            "--generator-offload (diffusion models), or run a part on the CPU: --renderer-device "
            "cpu, --network-device cpu.",
            ERROR,
        )
    # torch and numba raise RuntimeError for a lack of memory, so their words are read, too.
    number = getattr(error, "errno", None)
    is_memory = isinstance(error, MemoryError) or number == errno.ENOMEM
    if is_memory or any(words in str(error).lower() for words in MEMORY_WORDS):
        return (
            "The memory ran out; choose a smaller --resolution, fewer --threads or fewer "
            "photographs, or raise the limit (ulimit -v).",
            ERROR,
        )

    # Without a file name an error of the system names nothing that the user could correct.
    if not isinstance(error, OSError) or error.filename is None:
        return "", ERROR
    name = quote_value(str(error.filename), 120)
    reason = error.strerror
    if number in NAME_ERRORS:
        return f"{name} is no path: {reason}; correct it.", WRONG_INPUT
    if number in ACCESS_ERRORS:
        return (
            f"{name} cannot be used: {reason}; change its permissions or name another.",
            WRONG_INPUT,
        )
    if number in FULL_DISK_ERRORS:
        return f"{name} cannot be written: {reason}; free some space.", ERROR
    return "", ERROR
