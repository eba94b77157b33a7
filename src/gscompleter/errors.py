"""What the user is told when the input is wrong."""


class InputError(ValueError):
    """The input is wrong, and the user can mend it.

    Its message is one sentence: what was given, what is needed, what to do. The command
    line prints it without a traceback and exits with code 2.
    """
