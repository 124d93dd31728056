"""How long each member's next step is, and the account of why."""

from __future__ import annotations

import torch
from torch import Tensor

from torchsph.pairs.vectors import square_length

from ..state.particles import Particles
from ..state.record import LIMITS, Record
from .coefficients import Coefficients
from .terms import step_limits


class StepControl:
    """Adaptive steps of all members: acoustic, viscous and force limits with a floor, named in the record.

    Args:
        record: account of the run.
        floor: fraction of the acoustic limit at rest below which no step is cut, or None.
    """

    def __init__(self, record: Record, floor: float | None) -> None:
        self._record, self._floor = record, floor
        self._last_limit = torch.zeros(record.members, dtype=torch.float64, device=record.failed.device)

    @torch.no_grad()  # a step's length is piecewise constant in the state: an interval is divided evenly
    def step(
        self,
        particles: Particles,
        acceleration: Tensor,
        coefficients: Coefficients,
        left: Tensor,
        longest: float,
        factor: Tensor | None = None,
    ) -> Tensor:
        """Each member's step: the smallest limit, evened out over what is left of the interval.

        Args:
            particles: before the step.
            acceleration: (N, D), internal, of the last step.
            coefficients: in use.
            left: (members,) float64, internal time to the end of the interval; 0 for members that wait.
            longest: limit by frames, internal time.
            factor: (members,) that the limits are multiplied by, or None.

        Returns:
            (members,) float64, internal time.
        """
        c, record = coefficients, self._record
        speed = particles.per_member(square_length(particles.velocity), "amax").sqrt()
        force = particles.per_member(square_length(acceleration), "amax").sqrt()
        viscosity = 0.0 if c.viscosity is None else c.viscosity
        # of an incompressible fluid no signal but the flow itself limits the step
        sound = 0.0 if c.sound_speed is None else c.sound_speed
        limits = step_limits(speed, force, c.smoothing_length, sound, viscosity, c.courant).double()
        active = left > 0
        frame = torch.full_like(limits[:1], longest)
        smallest, which = torch.cat([self._floored(limits, c, active), frame]).min(0)
        # a member that is not finite breaks in this step; its time must not be lost, for the clock counts all members'
        smallest = torch.where(smallest.isnan(), frame[0], smallest)
        smallest = smallest if factor is None else factor * smallest
        record.reductions += active & (smallest < 0.99 * self._last_limit)
        self._last_limit = torch.where(active, smallest, self._last_limit)
        steps = torch.ceil(left / smallest - 1e-9).clamp_min(1.0)
        even = torch.where(active, left / steps, torch.zeros_like(left))
        which = torch.where(steps > 1, which, len(LIMITS) - 1)
        record.limited_by.scatter_add_(1, which[:, None], active[:, None].to(torch.int64))
        record.steps += active
        if c.sound_speed is not None:
            mach = torch.where(active, (speed / c.sound_speed).double(), torch.zeros_like(left))
            record.largest_mach = torch.maximum(record.largest_mach, mach)
        return even

    def _floored(self, limits: Tensor, c: Coefficients, active: Tensor) -> Tensor:
        """The limits (3, members), none below the scheme's floor; the record counts where that changed the step."""
        if self._floor is None:
            return limits
        floor = self._floor * c.courant * c.smoothing_length / c.sound
        # the viscous limit is known beforehand and no accident: it stays
        raised = (limits[[0, 2]] < floor).any(0) & (limits[1] > floor)
        self._record.floored += active & raised
        floor = torch.as_tensor(floor, dtype=limits.dtype, device=limits.device)
        return torch.stack([limits[0].maximum(floor), limits[1], limits[2].maximum(floor)])
