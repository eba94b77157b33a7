"""What the user is told when the input is wrong."""

LONGEST_QUOTE = 100
"""Characters of the input that a sentence quotes at most."""


class InputError(ValueError):
    """The input is wrong, and the user can mend it.

    Its message is one sentence: what was given, what is needed, what to do. The command
    line prints it without a traceback and exits with code 2.
    """

    def __init__(self, message: str, argument: str | None = None) -> None:
        """The `argument` of the function, or the name of the setting, that the user can mend. The
        command line names its option of that name."""
        super().__init__(message)
        self.argument = argument


def quoted(value: object, length: int = LONGEST_QUOTE) -> str:
    """What was given as a sentence can hold it: on one line, its middle left out if it is long.

    A string stands in it without quotation marks; write `f"'{quoted(word)}'"` where it needs some.

    Args:
        value: Anything; a string as it is, other values as Python writes them.
        length: Most characters that are returned.
    """
    text = value if isinstance(value, str) else _written(value, length)
    # Twice as many characters as are wanted at either end are enough, whatever is left out.
    ends = text if len(text) <= 4 * length else text[: 2 * length] + text[-2 * length :]
    line = "".join(c if c.isprintable() else " " for c in ends)
    if len(text) <= length:
        return line
    half = (length - 1) // 2
    return f"{line[:half]}…{line[-half:]}"


def _written(value: object, length: int) -> str:
    """`repr`, which refuses integers of more than 4,300 digits."""
    if isinstance(value, int) and value.bit_length() > 4 * length:
        return f"an integer of about {value.bit_length() * 0.30103:,.0f} digits"
    try:
        return repr(value)
    except (ValueError, RecursionError):
        return f"a {type(value).__name__} that cannot be written out"
