"""What reading, writing and checking recordings raise."""


class RecordingError(ValueError):
    """A recording, in a file or in memory, breaks a rule of the format.

    Args:
        source: the file, or what stands for it; it opens the message.
        dataset: the dataset or attribute at fault.
        rule: the rule that is broken, and the cure.
    """

    def __init__(self, source: str, dataset: str, rule: str) -> None:
        super().__init__(f"{source}: {dataset}: {rule}")
        self.source, self.dataset, self.rule = source, dataset, rule

    def __reduce__(self) -> tuple[type, tuple[str, str, str]]:
        """Errors cross processes by pickling, which would hand the whole message to `source`."""
        return type(self), (self.source, self.dataset, self.rule)
