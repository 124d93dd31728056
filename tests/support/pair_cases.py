"""Particle states that the pair tests share, and the comparison of two backends."""

from __future__ import annotations

import dataclasses

import torch
from torch import Tensor

from torchsph.pairs import PairState, Support
from torchsph.pairs.smoothing_kernels import kernel


def disordered(
    per_side: int, dimension: int, dtype: torch.dtype = torch.float64, *, members: int = 1, seed: int = 0
) -> PairState:
    """A lattice of unit spacing with 40 % disorder per member, shuffled, with random states of order one."""
    generator = torch.Generator().manual_seed(seed)

    def normal(*shape: int) -> Tensor:
        return torch.randn(shape, generator=generator, dtype=torch.float64)

    lattice = torch.cartesian_prod(*[torch.arange(per_side, dtype=torch.float64)] * dimension)
    count = lattice.shape[0] * members
    noise = torch.rand((count, dimension), generator=generator, dtype=torch.float64) - 0.5
    position = lattice.repeat(members, 1) + 0.4 * noise - 0.3 * per_side
    member = torch.arange(members).repeat_interleave(lattice.shape[0])
    order = torch.randperm(count, generator=generator)
    return as_dtype(
        PairState(
            position=position[order],
            velocity=normal(count, dimension),
            mass=1.0 + 0.1 * torch.rand(count, generator=generator, dtype=torch.float64),
            deviation=0.01 * normal(count),
            pressure=normal(count),
            member=member[order],
            slope=0.01 * normal(count, dimension),
        ),
        dtype,
    )


def as_dtype(state: PairState, dtype: torch.dtype) -> PairState:
    """The state with its reals in another precision."""
    return changed(state, lambda tensor: tensor.to(dtype) if tensor.is_floating_point() else tensor)


def changed(state, change):
    """The state, or other dataclass of tensors, with ``change`` applied to every tensor."""
    values = {f.name: getattr(state, f.name) for f in dataclasses.fields(state)}
    return type(state)(**{name: None if value is None else change(value) for name, value in values.items()})


def support(name: str, dimension: int, length: float | Tensor = 1.2) -> Support:
    """A pass's support by the name of its kernel."""
    return Support(kernel(name), length, dimension)


def tolerance(dtype: torch.dtype) -> float:
    """Allowed relative difference to float64 sums: round-off of the terms times their number."""
    return 1e-12 if dtype == torch.float64 else 2e-5


def assert_close(got, wanted, dtype: torch.dtype, what: str = "") -> None:
    """Compare tensors, or dataclasses of tensors, relative to the largest wanted value."""
    if dataclasses.is_dataclass(wanted):
        for field in dataclasses.fields(wanted):
            assert_close(getattr(got, field.name), getattr(wanted, field.name), dtype, field.name)
    elif wanted is None:
        assert got is None, f"{what} was not asked for"
    else:
        assert got.shape == wanted.shape, what
        scale = wanted.abs().max().clamp_min(1e-30)
        error = float((got.double() - wanted.double()).abs().max() / scale)
        assert error <= tolerance(dtype), f"{what}: relative difference {error:.2e}"
