"""The exception for input that cannot be used."""


class SimulationError(ValueError):
    """Streets that cannot be simulated or written.

    The message is one line that says what was expected, what was found and what to do.
    """
