"""What is odd about a recording, told on stderr or refused."""

from __future__ import annotations

import sys

import geometry


def tell_findings(recording: geometry.Recording, source: str, *, strict: bool = False) -> None:
    """Print one line for each finding; with `strict` raise RecordingError for the first."""
    for finding in geometry.findings(recording):
        if strict:
            raise geometry.RecordingError(source, finding.dataset, f"{finding.rule_and_cure} (refused by --strict)")
        print(f"warning: {finding}", file=sys.stderr)
