"""Second chances: the last good states of a run, to which a member that fails goes back."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from .schemes.parts import Rollback
from .state.particles import Particles
from .state.record import Record


@dataclass(frozen=True)
class _State:
    """All members at one moment; ``done`` (members,) is how far each had come in its interval, internal time."""

    particles: Particles
    acceleration: Tensor
    done: Tensor
    accounts: dict[str, Tensor]


class RollbackStates:
    """States of one interval between the times at which members meet.

    Attributes:
        factor: (members,) float64, what each member's steps are multiplied by.
    """

    def __init__(self, options: Rollback, record: Record) -> None:
        self.options, self._record, self._calls = options, record, 0
        self.factor = torch.ones(record.members, dtype=torch.float64, device=record.failed.device)
        self._failed_at = torch.full_like(self.factor, -1.0)
        self._tries = [0] * record.members
        self._state: list[_State | None] = [None] * record.members

    def keep(self, particles: Particles, acceleration: Tensor, done: Tensor) -> None:
        """Keep the state, every so many calls, of the members that have got past where they failed."""
        self._calls += 1
        if (self._calls - 1) % self.options.every:
            return
        state = _State(particles, acceleration, done, self._record.kept())
        for member in torch.nonzero(done > self._failed_at).flatten().tolist():
            self._state[member], self._tries[member], self.factor[member] = state, 0, 1.0

    def restored(
        self, broken: Tensor, particles: Particles, acceleration: Tensor, done: Tensor
    ) -> tuple[Particles, Tensor, Tensor, Tensor]:
        """Put the members in ``broken`` (members,) bool back to their kept states, with steps half as long.

        Returns particles, acceleration (N, D), ``done`` (members,), and the members (members,) bool that have no try
        left.
        """
        given_up, done = torch.zeros_like(broken), done.clone()
        for member in torch.nonzero(broken).flatten().tolist():
            state = self._state[member]
            self._failed_at[member] = max(float(self._failed_at[member]), float(done[member]))
            if self._tries[member] < self.options.tries:
                self._tries[member] += 1
                self.factor[member] *= 0.5
                self._record.rollbacks[member] += 1
            else:
                given_up[member] = True
            particles, rows = particles.with_member(member, state.particles)
            acceleration = torch.cat([acceleration, state.acceleration])[rows]
            done[member] = state.done[member]
            self._record.take_back(member, state.accounts)
        return particles, acceleration, done, given_up
