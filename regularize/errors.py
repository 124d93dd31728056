"""What this package raises beside the built-in exceptions."""


class InvalidInput(ValueError):
    """An argument breaks a documented rule; the message names it, the rule and the cure."""


class NotConverged(RuntimeError):
    """An iterative solver stopped before the true relative gradient reached the tolerance.

    ``solution`` holds what was reached, with its gradient, iterations and reason.
    """

    def __init__(self, message: str, solution: object = None) -> None:
        super().__init__(message)
        self.solution = solution
