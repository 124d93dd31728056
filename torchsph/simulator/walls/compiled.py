"""What complete-kernel walls add to the particles' sums: one compiled pass where there is one, else torch's formulas.

The formulas stand in ``walls``; the compiled pass (csrc/walls.cpp) reads a particle's walls as one row and writes each
result once, which takes a fifth of the time of torch's passes over columns.
"""

from __future__ import annotations

import ctypes
from functools import lru_cache

import torch
from torch import Tensor

from torchsph.native.library import REALS, LibraryMissing, address, library
from torchsph.native.structures import WallArguments
from torchsph.pairs.interface import PRESSURE_FORMS, per_particle

from .forces import SMALLEST_FRICTION_DISTANCE, SMALLEST_SHARE, WallSample, completed, friction, wall_pressure_force


def complete_rates(
    divergence: Tensor, crowding: Tensor | None, velocity: Tensor, wall: WallSample | None
) -> tuple[Tensor, Tensor | None]:
    """``walls.completed``: velocity divergence (N,) and crowding gradient (N, D) complete at walls."""
    code = _compiled(wall, divergence, crowding, velocity)
    if code is None:
        return completed(divergence, crowding, velocity, wall)
    velocity, divergence = velocity.contiguous(), divergence.contiguous()
    crowding = None if crowding is None else crowding.contiguous()
    whole, even = torch.empty_like(divergence), None if crowding is None else torch.empty_like(crowding)
    code.sph_wall_rates(
        _arguments(
            wall,
            velocity,
            velocity=velocity.data_ptr(),
            divergence=divergence.data_ptr(),
            crowding=address(crowding),
            whole_divergence=whole.data_ptr(),
            whole_crowding=address(even),
        )
    )
    return whole, even


def complete_forces(
    acceleration: Tensor,
    velocity: Tensor,
    wall: WallSample,
    *,
    viscosity: float | Tensor | None,
    member: Tensor,
    form: str = "symmetric",
    pressure: Tensor | None = None,
    deviation: Tensor | None = None,
) -> Tensor:
    """Pair accelerations (N, D) with the walls' pressure and friction, over the share of the kernel in the fluid.

    Args:
        viscosity: laminar, one or (members,), of no-slip walls; None: free slip. member: (N,) int64.
        form, pressure, deviation: as in ``walls.wall_pressure_force``; pressure None: friction alone.
    """
    code = _compiled(wall, acceleration, velocity, pressure, deviation)
    if code is None:
        return _forces_by_torch(acceleration, velocity, wall, viscosity, member, form, pressure, deviation)
    acceleration, velocity = acceleration.contiguous(), velocity.contiguous()
    given = [None if t is None else t.contiguous() for t in (pressure, deviation)]
    nu = None if viscosity is None else torch.as_tensor(viscosity, dtype=torch.float64).reshape(-1).contiguous()
    out, member = torch.empty_like(acceleration), member.contiguous()
    code.sph_wall_forces(
        _arguments(
            wall,
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
    before: Tensor, after: Tensor, wall: WallSample, step: Tensor, member: Tensor, held: Tensor, gap: float
) -> tuple[Tensor, Tensor]:
    """Particles (n,) int64 that end a step nearer to the wall than ``gap``, and their distance (n,) then.

    The distance that was seen is carried on to first order, with the wall's velocity.

    Args:
        before, after: positions (N, D). step: (members,), internal. held: (N,) bool, particles that walls hold.
    """
    code = _compiled(wall, before, after)
    if code is None:
        moved = after - before - per_particle(step, member)[:, None] * wall.velocity
        distance = wall.distance + (moved * wall.normal).sum(1)
        near = torch.nonzero((distance < gap) & held).squeeze(1)
        return near, distance[near]
    near, distance = torch.empty_like(member), torch.empty_like(wall.distance, memory_format=torch.contiguous_format)
    before, after, member, held = (t.contiguous() for t in (before, after, member, held))
    step = step.double().contiguous()
    found = code.sph_wall_near(
        _arguments(
            wall,
            after,
            before=before.data_ptr(),
            after=after.data_ptr(),
            distance=wall.distance.data_ptr(),
            distance_stride=wall.distance.stride(0),
            step=step.data_ptr(),
            member=member.data_ptr(),
            held=held.data_ptr(),
            gap=gap,
            near=near.data_ptr(),
            near_distance=distance.data_ptr(),
        )
    )
    return near[:found], distance[:found]


def _forces_by_torch(
    acceleration: Tensor,
    velocity: Tensor,
    wall: WallSample,
    viscosity: float | Tensor | None,
    member: Tensor,
    form: str,
    pressure: Tensor | None,
    deviation: Tensor | None,
) -> Tensor:
    if pressure is not None:
        acceleration = acceleration + wall_pressure_force(form, pressure, deviation, wall)
    if viscosity is not None:
        acceleration = acceleration + friction(per_particle(viscosity, member), velocity, wall)
    return acceleration / wall.share.clamp_min(SMALLEST_SHARE)[:, None]


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


def _compiled(wall: WallSample | None, *tensors: Tensor | None) -> _Code | None:
    """Compiled passes for these arrays, or None: other device or type, no library, gradients wanted."""
    if wall is None or wall.rows is None or wall.rows.device.type != "cpu":
        return None
    given = [t for t in (wall.rows, *tensors) if t is not None]
    if any(t.dtype != wall.rows.dtype for t in given):
        return None
    if torch.is_grad_enabled() and any(t.requires_grad for t in given):
        return None
    return _code(wall.rows.dtype)


def _arguments(wall: WallSample, vectors: Tensor, **arrays: int | float | None) -> ctypes._CArgObject:
    count, channels = wall.rows.shape
    return ctypes.byref(
        WallArguments(
            dimension=vectors.shape[1],
            threads=torch.get_num_threads(),
            count=count,
            channels=channels,
            rows=wall.rows.data_ptr(),
            smallest_share=SMALLEST_SHARE,
            smallest_gap=SMALLEST_FRICTION_DISTANCE,
            **arrays,
        )
    )
