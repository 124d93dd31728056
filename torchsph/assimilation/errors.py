"""What this package raises."""


class AssimilationError(ValueError):
    """Input or state that no sound analysis can be made from; the message says what to do."""
