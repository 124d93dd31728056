"""The command line, and nothing that a notebook needs."""

from .main import main

__all__ = ["main"]
