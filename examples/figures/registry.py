"""Which figures there are: name, where they stand in Grønli 2017, what makes them, and the code that they speak of."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module

from ..provenance import ANALYSES, MODEL, TRACKING
from .material import Material
from .record import Result

GEOMETRY = ("geometry",)
FORECASTS = (*MODEL, "torchsph/methods/forecast_skill.py")
OWN = ("examples/figures/material.py",)


@dataclass(frozen=True)
class Entry:
    """A figure of the list.

    Attributes:
        name: of its script and of its files.
        thesis: where it stands in Grønli 2017.
        title: what it shows.
        code: what its numbers depend on, beside its script.
        timed: whether its numbers are seconds, which no run gives twice.
    """

    name: str
    thesis: str
    title: str
    code: tuple[str, ...]
    timed: bool = False

    @property
    def make(self) -> Callable[[Material], Result]:
        """The script's own function."""
        found: Callable[[Material], Result] = import_module(f"{__package__}.thesis.{self.name}").make
        return found

    @property
    def sources(self) -> tuple[str, ...]:
        """Files and folders whose change makes the numbers stale."""
        return (f"examples/figures/thesis/{self.name}.py", *OWN, *self.code)


FIGURES = {
    entry.name: entry
    for entry in (
        Entry("phantom", "figs. 4.1 and 4.2", "the phantom in two planes", GEOMETRY),
        Entry("segmentation", "fig. 4.3", "a mesh from velocities, with normals", GEOMETRY),
        Entry("tracked", "figs. 4.4 and 4.5", "tracked velocities in two planes", TRACKING),
        Entry("wedge", "fig. 4.6", "a dam breaks on a wedge", MODEL),
        Entry("smoothing", "figs. 4.7 and 4.8", "what imposing, fetching and splines smooth", (*MODEL, "regularize")),
        Entry("panels", "figs. 4.9 and 4.10", "the same in one frame", (*MODEL, "regularize")),
        Entry("valves", "fig. 4.11", "pressures at the valves", MODEL),
        Entry("forecasts", "figs. 4.12 and 4.13", "forecasts without and with valves", FORECASTS),
        Entry("noise", "fig. 4.14", "noise suppression over the beat", ANALYSES),
        Entry("where", "fig. 4.15", "where the error sits", ANALYSES),
        Entry("sequences", "figs. 4.16 and 4.17", "processed sequences", ANALYSES),
        Entry("performance", "fig. 4.18", "iterations per second", MODEL, timed=True),
        Entry("clustering", "fig. 5.1", "clustering during filling", MODEL),
    )
}
