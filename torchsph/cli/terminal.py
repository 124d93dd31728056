"""Text of files and names on its way to the terminal, which obeys control characters."""

from __future__ import annotations

LONGEST = 2000


def printable(text: str) -> str:
    """The text in one line: what is no letter of any script is shown as its escape, and what is very long is cut.

    A recording's description may hold escapes that clear the screen, or line ends that forge a row of a table.
    """
    shown = "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in text[: LONGEST + 1])
    return shown if len(text) <= LONGEST else f"{shown[:LONGEST]}..."
