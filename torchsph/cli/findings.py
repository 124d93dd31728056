"""What is odd about a recording, told on stderr or refused."""

from __future__ import annotations

import geometry

from .running.notes import LOGGER


def tell_findings(recording: geometry.Recording, source: str, *, strict: bool = False) -> None:
    """Print one line for each finding; with `strict` raise RecordingError for the first."""
    for finding in geometry.findings(recording):
        if strict:
            raise geometry.RecordingError(source, finding.dataset, f"{finding.rule_and_cure} (refused by --strict)")
        LOGGER.warning("%s", finding)
