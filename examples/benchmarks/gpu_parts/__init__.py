"""The parts of ``gpu.py`` by their names; each is a function of a ``Bench``."""

from collections.abc import Callable

from .bench import Bench
from .fields import splines, tracker
from .flow import cycle, members
from .machine import machine, tests
from .particles import pairs, steps

PARTS: dict[str, Callable[[Bench], None]] = {
    "machine": machine,
    "tests": tests,
    "pairs": pairs,
    "steps": steps,
    "members": members,
    "cycle": cycle,
    "tracker": tracker,
    "splines": splines,
}
