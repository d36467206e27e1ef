"""Define the exception for wrong input."""


class SimulationError(ValueError):
    """Wrong input to the simulator. One line says what was expected, what was found, what to do."""
