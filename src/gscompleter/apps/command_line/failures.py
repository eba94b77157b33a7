"""Failures of the machine, such as a lack of memory, as sentences for the user."""

from __future__ import annotations

import errno
from dataclasses import dataclass

from gscompleter.apps.command_line.exit_codes import ERROR, WRONG_INPUT
from gscompleter.system.errors import quote_value
from gscompleter.system.files.writing import FULL_DISK_ERRORS
from gscompleter.system.memory_errors import is_lack_of_memory, is_of_gpu, list_causes

NAME_ERRORS = {errno.ENAMETOOLONG, errno.ELOOP}
"""Numbers of errors of a path that names nothing on any disk."""
ACCESS_ERRORS = {errno.EACCES, errno.EPERM, errno.EROFS}
"""Numbers of errors of a path that this user may not read or write."""
DEVICE_ERRORS = {errno.EIO, errno.ESTALE, errno.ENOTCONN, errno.EHOSTDOWN, errno.ETIMEDOUT}
"""Numbers of errors of a disk that is broken, or on the network and not reached."""
OPEN_FILE_ERRORS = {errno.EMFILE, errno.ENFILE}
"""Numbers of errors of more open files than the system allows."""
GPU_MEMORY_SENTENCE = (
    "The memory of the GPU ran out; choose a smaller --resolution, fewer photographs or "
    "--generator-offload (diffusion models), or run a part on the CPU: --renderer-device cpu, "
    "--network-device cpu."
)
MEMORY_SENTENCE = (
    "The memory ran out; choose a smaller --resolution, fewer --threads or fewer photographs, or "
    "raise the limit (ulimit -v)."
)
MAX_FAILED_NAME_LENGTH = 120
"""Characters of a file name that a sentence shows."""


@dataclass(frozen=True)
class Failure:
    """A failure that the user can understand."""

    sentence: str
    code: int


def explain_failure(error: BaseException) -> Failure | None:
    """Explain an error of the machine or of a path; None for any other, which is a defect."""
    for cause in list_causes(error):
        failure = explain_lack_of_memory(cause) or explain_system_error(cause)
        if failure is not None:
            return failure
    return None


def explain_lack_of_memory(error: BaseException) -> Failure | None:
    """Explain an error, without its causes, that says that memory ran out; None for any other."""
    if not is_lack_of_memory(error):
        return None
    return Failure(GPU_MEMORY_SENTENCE if is_of_gpu(error) else MEMORY_SENTENCE, ERROR)


def explain_system_error(error: BaseException) -> Failure | None:
    """Explain an error of the system, without its causes, by its number; None for any other."""
    if not isinstance(error, OSError):
        return None
    number = error.errno
    reason = error.strerror
    # These say enough without the name of a file, which errors of a file that is open lack.
    if number in OPEN_FILE_ERRORS:
        return Failure(
            f"The limit of open files is reached: {reason}; raise it (ulimit -n).", ERROR
        )
    if number in FULL_DISK_ERRORS and error.filename is None:
        return Failure(
            f"A file or the standard output cannot be written: {reason}; free some space.", ERROR
        )

    # Without a file name any other error names nothing that the user could correct: it may be of a
    # network connection.
    if error.filename is None:
        return None
    name = quote_value(str(error.filename), MAX_FAILED_NAME_LENGTH)
    if number in NAME_ERRORS:
        return Failure(f"{name} is no path: {reason}; correct it.", WRONG_INPUT)
    if number in ACCESS_ERRORS:
        return Failure(
            f"{name} cannot be used: {reason}; change its permissions or name another.",
            WRONG_INPUT,
        )
    if number in FULL_DISK_ERRORS:
        return Failure(f"{name} cannot be written: {reason}; free some space.", ERROR)
    if number in DEVICE_ERRORS:
        return Failure(f"{name} cannot be used: {reason}; check the disk.", ERROR)
    return None
