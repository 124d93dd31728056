"""Why the value at a node of an analysis is what it is."""

from __future__ import annotations

from enum import IntEnum


class Quality(IntEnum):
    """Codes of the dataset `/quality`; readers take the names from its attribute `names`, in this order."""

    OUTSIDE = 0  # the mask
    USED = 1  # it was measured there, and the measurement has entered
    NO_DATA = 2  # nothing was measured there: the model alone
    OUTLIER = 3  # what was measured there is farther from the forecast than both their errors allow
    OUT_OF_REACH = 4  # what was measured there is too far from everything that it could change
    FAILED = 5  # the forecast has no value there
    AMBIGUOUS = 6  # what was measured there has wrapped, and the forecast cannot tell how often


QUALITY_NAMES = tuple(code.name.lower().replace("_", " ") for code in Quality)
