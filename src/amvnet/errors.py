"""The one exception that means: what the user gave cannot be used."""


class InputError(ValueError):
    """Input that cannot be used.

    The message is one line that says what was expected, what was found and what to do. The
    command line prints it to stderr and exits with code 2; from Python it is a `ValueError`.
    """
