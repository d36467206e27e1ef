"""The exceptions that mean: what the user gave cannot be used, all of it or some."""


class InputError(ValueError):
    """Input that cannot be used.

    The message is one line that says what was expected, what was found and what to do. The
    command line prints it to stderr and exits with code 2; from Python it is a `ValueError`.
    """


class SomeBroken(Exception):
    """Some of many inputs could not be used, and the others are done.

    Attributes:
        faults: a line for each.
    """

    def __init__(self, line: str, faults: list[str]) -> None:
        super().__init__(line)
        self.faults = faults
