"""The exception for input that cannot be used."""


class SimulationError(ValueError):
    """Streets that cannot be simulated: what was expected, what was found and what to do."""
