"""A step of a run, and the step as one node of torch's graph: taken without a tape, and taken again for its adjoint.

What stays of a step are the particles before it, 100 bytes each; everything else is made anew where gradients go back
through it (checkpointing: Griewank & Walther 2000, sec. 2). The second time it writes to an account of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, fields, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torchsph.pairs.backends.differentiable import TakenTwice

from ..state.clock import Clock
from ..state.particles import Particles
from ..state.record import Record
from ..surroundings import PresentSurroundings
from ..walls.interface import WallSample
from .coefficients import Coefficients
from .protocols import Stepper

# the arrays of particles that a step reads or changes, and that can have a gradient
_ARRAYS = ("position", "velocity", "deviation", "mass", "pressure", "confidence")


class Taken(NamedTuple):
    """A step that was taken.

    Attributes:
        particles: after it, kept inside the walls.
        acceleration: (N, D), internal; without gradient, it only limits the next step.
        stepped: the particles before walls stopped any.
        wall: as they saw it, or None.
    """

    particles: Particles
    acceleration: Tensor
    stepped: Particles
    wall: WallSample | None


@dataclass(frozen=True)
class Step:
    """What a step needs to know beside the particles.

    Attributes:
        stepper: of the run.
        surroundings: walls, valves and forces, at the times of its start.
        record: account of the run.
        length: (members,), internal, in the particles' precision.
        ends: (members,), s, the times at its end.
        number: (members,) int64, of the step in the run.
    """

    stepper: Stepper
    surroundings: PresentSurroundings
    record: Record
    length: Tensor
    ends: Tensor
    number: Tensor

    def take(self, particles: Particles) -> Taken:
        """Take it; as one node of the graph where something that it depends on has a gradient."""
        if torch.is_grad_enabled() and self.stepper.pair_search.backend.differentiable:
            inputs = self._inputs(particles)
            if any(value.requires_grad for value in inputs.values()):
                return self._taken_once_more(particles, inputs)
        return self._plainly(particles)

    def _plainly(self, particles: Particles) -> Taken:
        stepped, acceleration, wall = self.stepper.step(particles, self.length, self.number, self.surroundings)
        self.surroundings.at(self.ends)
        after = self.surroundings.constrain(particles, stepped, wall, self.length, self.record)
        return Taken(after, acceleration, stepped, wall)

    def _taken_once_more(self, particles: Particles, inputs: dict[str, Tensor]) -> Taken:
        later = self._apart()
        seen: list[Taken] = []

        def forwards(values: Sequence[Tensor]) -> tuple[Tensor, ...]:
            step, start = self._with(particles, dict(zip(inputs, values, strict=True)), self)
            taken = step._plainly(start)
            self.surroundings.at(self.ends)
            seen.append(taken)
            return tuple(_arrays(taken.particles).values())

        def once_more(values: Sequence[Tensor]) -> tuple[Tensor, ...]:
            step, start = self._with(particles, dict(zip(inputs, values, strict=True)), later._apart())
            return tuple(_arrays(step._plainly(start).particles).values())

        outputs = TakenTwice.apply(forwards, once_more, *inputs.values())
        (taken,) = seen
        names = _arrays(taken.particles)
        return taken._replace(particles=taken.particles.changed(**dict(zip(names, outputs, strict=True))))

    def _inputs(self, particles: Particles) -> dict[str, Tensor]:
        """All tensors of real numbers that the step depends on, by place and name."""
        found: dict[str, float | Tensor | None] = {f"particles.{n}": value for n, value in _arrays(particles).items()}
        c = self.stepper.coefficients
        found |= {f"coefficients.{f.name}": getattr(c, f.name) for f in fields(c)}
        clock = self.surroundings.clock
        found["clock.valve_strength"] = clock.valve_strength
        if clock.flux_split is not None:
            found["split.flux"] = clock.flux_split.flux
        walls = self.surroundings.fields
        found["walls.fields"] = None if walls is None else walls.variable
        return {name: value for name, value in found.items() if isinstance(value, Tensor)}

    def _apart(self) -> Step:
        """The same step at the present times, with a search and an account of its own."""
        record = Record(self.record.members, self.record.valves, self.record.device)
        around = copy(self.surroundings)
        around.clock = copy(around.clock)
        stepper = self.stepper.apart(self.stepper.coefficients, record)
        # the account counts on in place
        return replace(self, stepper=stepper, surroundings=around, record=record, number=self.number.clone())

    @staticmethod
    def _with(particles: Particles, values: dict[str, Tensor], step: Step) -> tuple[Step, Particles]:
        """``step`` and the particles before it with other values in the places of ``_inputs``."""
        owners = ("particles", "coefficients", "clock", "split", "walls")
        groups: dict[str, dict[str, Any]] = {owner: {} for owner in owners}
        for place, value in values.items():
            owner, name = place.split(".")
            groups[owner][name] = value
        coefficients: Coefficients = replace(step.stepper.coefficients, **groups["coefficients"])
        around = copy(step.surroundings)
        around.clock = clock = copy(around.clock)
        _give(clock, groups["clock"], groups["split"])
        rows = groups["walls"].get("fields")
        if around.fields is not None and rows is not None and rows.requires_grad:
            around.fields = around.fields.with_variable(rows)
        stepper = step.stepper
        if groups["coefficients"]:
            stepper = stepper.apart(coefficients, step.record)
        return replace(step, stepper=stepper, surroundings=around), particles.changed(**groups["particles"])


def _arrays(particles: Particles) -> dict[str, Tensor]:
    return {name: getattr(particles, name) for name in _ARRAYS if getattr(particles, name) is not None}


def _give(clock: Clock, values: dict[str, Any], split: dict[str, Any]) -> None:
    """Put values into a clock."""
    for name, value in values.items():
        setattr(clock, name, value)
    if split and clock.flux_split is not None:
        clock.flux_split = replace(clock.flux_split, **split)  # type: ignore[type-var]
