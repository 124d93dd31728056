"""What complete-kernel walls add to the particles' sums: one compiled pass where there is one, else torch's formulas.

The formulas stand in ``formulas``; the compiled pass (csrc/walls.cpp) reads a particle's walls as one row and writes
each result once, which takes a fifth of the time of torch's passes over columns.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from torchsph.native.library import REALS, LibraryMissing, address, library
from torchsph.native.structures import WallArguments
from torchsph.pairs.interface import PRESSURE_FORMS
from torchsph.pairs.vectors import per_particle

from .formulas import SMALLEST_COMPLETENESS, SMALLEST_FRICTION_DISTANCE, completed, friction, wall_pressure_force
from .interface import CompleteWallSample, WallSample


def complete_rates(
    divergence: Tensor, gradient: Tensor | None, velocity: Tensor, wall: CompleteWallSample
) -> tuple[Tensor, Tensor | None]:
    """Velocity divergence (N,) and the concentration's gradient (N, D), complete at walls (``formulas.completed``)."""
    walls = _compiled(wall, divergence, gradient, velocity)
    if walls is None:
        return completed(divergence, gradient, velocity, wall)
    velocity, divergence = velocity.contiguous(), divergence.contiguous()
    gradient = None if gradient is None else gradient.contiguous()
    whole, even = torch.empty_like(divergence), None if gradient is None else torch.empty_like(gradient)
    walls.code.sph_wall_rates(
        walls.arguments(
            velocity,
            velocity=velocity.data_ptr(),
            divergence=divergence.data_ptr(),
            concentration_gradient=address(gradient),
            whole_divergence=whole.data_ptr(),
            whole_concentration_gradient=address(even),
        )
    )
    return whole, even


def complete_forces(
    acceleration: Tensor,
    velocity: Tensor,
    wall: CompleteWallSample,
    *,
    viscosity: float | Tensor | None,
    member: Tensor,
    form: str = "symmetric",
    pressure: Tensor | None = None,
    deviation: Tensor | None = None,
) -> Tensor:
    """Pair accelerations with the walls' pressure and friction, over the part of the kernel in the fluid.

    Args:
        acceleration: (N, D), by pairs.
        velocity: (N, D).
        wall: walls at the particles.
        viscosity: kinematic, one or (members,), of no-slip walls; None: free slip.
        member: (N,) int64.
        form: of the pressure force (``formulas.wall_pressure_force``).
        pressure: (N,), p / rho0; None: friction alone.
        deviation: (N,), of the density; needed with a pressure.

    Returns:
        (N, D), internal.
    """
    walls = _compiled(wall, acceleration, velocity, pressure, deviation)
    if walls is None:
        return _forces_by_torch(acceleration, velocity, wall, viscosity, member, form, pressure, deviation)
    acceleration, velocity = acceleration.contiguous(), velocity.contiguous()
    given = [None if t is None else t.contiguous() for t in (pressure, deviation)]
    nu = None if viscosity is None else torch.as_tensor(viscosity, dtype=torch.float64).reshape(-1).contiguous()
    out, member = torch.empty_like(acceleration), member.contiguous()
    walls.code.sph_wall_forces(
        walls.arguments(
            velocity,
            velocity=velocity.data_ptr(),
            form=PRESSURE_FORMS.index(form),
            pressure=address(given[0]),
            deviation=address(given[1]),
            viscosity=address(nu),
            viscosities=0 if nu is None else nu.numel(),
            member=member.data_ptr(),
            acceleration=acceleration.data_ptr(),
            whole_acceleration=out.data_ptr(),
        )
    )
    return out


def near_wall(
    before: Tensor, after: Tensor, wall: WallSample, step: Tensor, member: Tensor, stopped: Tensor, gap: float
) -> tuple[Tensor, Tensor]:
    """Particles that end a step too near to the wall.

    The distance that was seen is carried on to first order, with the wall's velocity.

    Args:
        before: (N, D), positions that the walls were seen from.
        after: (N, D), positions at the end of the step.
        wall: walls as they were seen.
        step: (members,), internal.
        member: (N,) int64.
        stopped: (N,) bool, particles that walls stop.
        gap: distance that is near enough.

    Returns:
        Rows (n,) int64 of these particles, and their distance (n,) then.
    """
    walls = _compiled(wall, before, after)
    if walls is None:
        moved = after - before - per_particle(step, member)[:, None] * wall.velocity
        distance = wall.distance + (moved * wall.normal).sum(1)
        near = torch.nonzero((distance < gap) & stopped).squeeze(1)
        return near, distance[near]
    near, distance = torch.empty_like(member), torch.empty_like(wall.distance, memory_format=torch.contiguous_format)
    before, after, member, stopped = (t.contiguous() for t in (before, after, member, stopped))
    step = step.double().contiguous()
    found = walls.code.sph_wall_near(
        walls.arguments(
            after,
            before=before.data_ptr(),
            after=after.data_ptr(),
            distance=wall.distance.data_ptr(),
            distance_stride=wall.distance.stride(0),
            step=step.data_ptr(),
            member=member.data_ptr(),
            held=stopped.data_ptr(),
            gap=gap,
            near=near.data_ptr(),
            near_distance=distance.data_ptr(),
        )
    )
    return near[:found], distance[:found]


def _forces_by_torch(
    acceleration: Tensor,
    velocity: Tensor,
    wall: CompleteWallSample,
    viscosity: float | Tensor | None,
    member: Tensor,
    form: str,
    pressure: Tensor | None,
    deviation: Tensor | None,
) -> Tensor:
    if pressure is not None and deviation is not None:
        acceleration = acceleration + wall_pressure_force(form, pressure, deviation, wall)
    if viscosity is not None:
        acceleration = acceleration + friction(per_particle(viscosity, member), velocity, wall)
    return acceleration / wall.completeness.clamp_min(SMALLEST_COMPLETENESS)[:, None]


class _Code:
    """The compiled passes of one precision."""

    def __init__(self, reals: str) -> None:
        self.sph_wall_rates = library().function("wall_rates", reals)
        self.sph_wall_forces = library().function("wall_forces", reals)
        self.sph_wall_near = library().function("wall_near", reals)


@lru_cache
def _code(dtype: torch.dtype) -> _Code | None:
    """Looked up once, for every step asks several times; None: no such precision, or nothing was compiled."""
    try:
        return _Code(REALS[dtype]) if dtype in REALS else None
    except LibraryMissing:
        return None


@dataclass(frozen=True)
class _CompiledWalls:
    """The compiled passes and the rows (N, C) of walls that they read."""

    code: _Code
    rows: Tensor

    def arguments(self, vectors: Tensor, **arrays: int | float | None) -> object:
        """Arguments of a pass over ``vectors`` (N, D), by reference."""
        count, channels = self.rows.shape
        return ctypes.byref(
            WallArguments(
                dimension=vectors.shape[1],
                threads=torch.get_num_threads(),
                count=count,
                channels=channels,
                rows=self.rows.data_ptr(),
                smallest_share=SMALLEST_COMPLETENESS,
                smallest_gap=SMALLEST_FRICTION_DISTANCE,
                **arrays,
            )
        )


def _compiled(wall: WallSample, *tensors: Tensor | None) -> _CompiledWalls | None:
    """Compiled passes for these arrays, or None: other device or type, no library, gradients wanted."""
    if not isinstance(wall, CompleteWallSample) or wall.rows is None or wall.rows.device.type != "cpu":
        return None
    given = [t for t in (wall.rows, *tensors) if t is not None]
    if any(t.dtype != wall.rows.dtype for t in given):
        return None
    if torch.is_grad_enabled() and any(t.requires_grad for t in given):
        return None
    code = _code(wall.rows.dtype)
    return None if code is None else _CompiledWalls(code, wall.rows)
