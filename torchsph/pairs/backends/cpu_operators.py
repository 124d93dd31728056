"""The C++ kernels as torch custom operators: tensors in, new tensors out, with shapes that torch can ask for.

An operator allocates its results and hands addresses to the plain C interface of ``csrc/interface.h``;
nothing here knows what the sums mean.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from torchsph.native.library import REALS, address, library
from torchsph.native.structures import (
    InterpolationArguments,
    ListArguments,
    PassArguments,
    PoissonArguments,
    SearchArguments,
    Sizes,
)

from ..terms import OUTPUTS, outputs_of
from . import plan

CLUSTER = 8
_OPERATORS = torch.library.Library("torchsph", "FRAGMENT")


def _operator(fake: Callable[..., Any], mutates: Sequence[str] = ()) -> Callable[[Callable[..., Any]], Any]:
    """Make a function of CPU tensors a torch operator; ``fake`` gives its shapes, ``mutates`` what it writes into.

    ``torch.library.custom_op`` would do the same, but its first call imports the compiler of torch, 2 s and more.
    """

    def register(function: Callable[..., Any]) -> Any:
        name = function.__name__
        _OPERATORS.define(name + torch.library.infer_schema(function, mutates_args=mutates))
        _OPERATORS.impl(name, function, "CPU")
        torch.library.register_fake(f"torchsph::{name}", fake, lib=_OPERATORS)
        return getattr(torch.ops.torchsph, name).default

    return register


def _period(period: Sequence[float]) -> ctypes.Array:
    return (ctypes.c_double * 3)(*period, *(float("inf"),) * (3 - len(period)))


def _cluster_lists_shapes(
    position: Tensor, member: Tensor, radius: float, period: Sequence[float], entries: Tensor
) -> list[Tensor]:
    clusters = torch.library.get_ctx().new_dynamic_size()
    slot, owner = (position.new_empty(size, dtype=torch.int32) for size in (CLUSTER * clusters, clusters))
    offset, needed = (position.new_empty(size, dtype=torch.int64) for size in (clusters, 1))
    periodic = any(length != float("inf") for length in period)
    home = position.new_empty((CLUSTER * clusters if periodic else 0, position.shape[1]))
    return [slot, owner, offset, home, needed]


@_operator(_cluster_lists_shapes, mutates=("entries",))
def cluster_lists(
    position: Tensor, member: Tensor, radius: float, period: Sequence[float], entries: Tensor
) -> list[Tensor]:
    """Sort particles into clusters and write the lists of their neighbours into ``entries``, int32.

    Returns:
        slot (S,), owner (C,) int32; offset (C,) int64; home (S, D), or (0, D) where no axis is periodic;
        needed (1,) int64. Where ``needed`` exceeds the length of ``entries`` the lists are incomplete: call
        again with more room.

    Raises:
        ValueError: a position is not finite, or a member index is negative.
    """
    reals, code = REALS[position.dtype], library()
    given = _search_arguments(position, member, radius, period)
    sizes = Sizes()
    code.function("sort", reals)(ctypes.byref(given), ctypes.byref(sizes))
    if sizes.unusable:
        raise ValueError(
            f"{sizes.unusable} particle positions are not finite (or members are negative); freeze or remove "
            "them before the search"
        )
    slots, clusters = CLUSTER * sizes.clusters, sizes.clusters
    periodic = any(length != float("inf") for length in period)
    slot, owner = torch.empty(slots, dtype=torch.int32), torch.empty(clusters, dtype=torch.int32)
    offset, needed = torch.empty(clusters, dtype=torch.int64), torch.empty(1, dtype=torch.int64)
    home = position.new_empty((slots if periodic else 0, position.shape[1]))
    addresses = (t.data_ptr() for t in (slot, owner, offset, entries))
    lists = ListArguments(*addresses, home.data_ptr() if periodic else None)
    needed[0] = code.function("list", reals)(ctypes.byref(given), entries.numel(), ctypes.byref(lists))
    return [slot, owner, offset, home, needed]


def _search_arguments(position: Tensor, member: Tensor, radius: float, period: Sequence[float]) -> SearchArguments:
    return SearchArguments(
        position.shape[0],
        position.data_ptr(),
        member.data_ptr(),
        radius,
        _period(period),
        position.shape[1],
        torch.get_num_threads(),
    )


def _pair_pass_shapes(
    lists: Sequence[Tensor],
    period: Sequence[float],
    choice: Sequence[int],
    kernel: Sequence[float],
    coefficients: Tensor,
    position: Tensor,
    velocity: Tensor,
    mass: Tensor,
    deviation: Tensor,
    pressure: Tensor | None,
    slope: Tensor | None,
    field: Tensor | None,
    active: Tensor | None,
) -> list[Tensor]:
    return plan.allocate(choice[0], position)


@_operator(_pair_pass_shapes)
def pair_pass(
    lists: Sequence[Tensor],
    period: Sequence[float],
    choice: Sequence[int],
    kernel: Sequence[float],
    coefficients: Tensor,
    position: Tensor,
    velocity: Tensor,
    mass: Tensor,
    deviation: Tensor,
    pressure: Tensor | None,
    slope: Tensor | None,
    field: Tensor | None,
    active: Tensor | None,
) -> list[Tensor]:
    """One pass over the cluster lists.

    Args:
        lists: slot, owner, entries, offset, home of ``cluster_lists``. period: (D,), inf where not periodic.
        choice: terms, weight, pressure form and kernel by the numbers of ``pairs.terms`` and ``smoothing_kernels``.
        kernel: support in smoothing lengths and sigma_D. coefficients: (members, 4) float64.

    Returns:
        One tensor for each of ``outputs_of(terms)``.
    """
    terms = choice[0]
    outputs = plan.allocate(terms, position)
    given = _pass_arguments(
        lists, period, choice, kernel, coefficients, position, velocity, mass, deviation, pressure, slope, field, active
    )
    addresses = (ctypes.c_void_p * len(OUTPUTS))()
    for place, output in zip(_places(terms), outputs, strict=True):
        addresses[place] = output.data_ptr()
    given.outputs = ctypes.addressof(addresses)
    if library().function("pass", REALS[position.dtype])(ctypes.byref(given)):
        raise NotImplementedError(f"no compiled pass has exactly the terms {terms:#x}")
    return outputs


@lru_cache
def _places(terms: int) -> tuple[int, ...]:
    """Where in ``OUTPUTS`` the sums of a pass stand."""
    return tuple(OUTPUTS.index(output) for output in outputs_of(terms))


def _pass_arguments(
    lists: Sequence[Tensor],
    period: Sequence[float],
    choice: Sequence[int],
    kernel: Sequence[float],
    coefficients: Tensor,
    position: Tensor,
    velocity: Tensor | None,
    mass: Tensor,
    deviation: Tensor,
    pressure: Tensor | None = None,
    slope: Tensor | None = None,
    field: Tensor | None = None,
    active: Tensor | None = None,
) -> PassArguments:
    slot, owner, entries, offset, home = lists
    terms, weight, form, kind = choice
    return PassArguments(
        dimension=position.shape[1],
        threads=torch.get_num_threads(),
        terms=terms,
        weight=weight,
        form=form,
        kernel=kind,
        support=kernel[0],
        sigma=kernel[1],
        particles=position.shape[0],
        clusters=owner.shape[0],
        slot=slot.data_ptr(),
        owner=owner.data_ptr(),
        entries=entries.data_ptr(),
        offset=offset.data_ptr(),
        home=home.data_ptr() if home.numel() else None,
        period=_period(period),
        coefficients=coefficients.data_ptr(),
        position=position.data_ptr(),
        velocity=address(velocity),
        mass=mass.data_ptr(),
        deviation=deviation.data_ptr(),
        pressure=address(pressure),
        slope=address(slope),
        field=address(field),
        active=address(active),
    )


def poisson(
    lists: Sequence[Tensor],
    period: Sequence[float],
    kind: int,
    kernel: Sequence[float],
    coefficients: Tensor,
    position: Tensor,
    mass: Tensor,
    deviation: Tensor,
    group: Tensor,
    source: Tensor,
    start: Tensor | None,
    free: Tensor,
    active: Tensor | None,
    singular: Tensor,
    tolerance: float,
    iterations: int,
) -> list[Tensor]:
    """Conjugate gradients for the Laplacian of the cluster lists; arguments as in ``Backend.poisson``.

    Not an operator of torch: how long it runs depends on the numbers.

    Returns:
        values (N,); iterations int64, residual float64, converged bool and mismatch float64, (groups,) each.
    """
    groups = singular.shape[0]
    choice = [plan.LAPLACIAN, plan.BY_VOLUME, 0, kind]
    given = _pass_arguments(lists, period, choice, kernel, coefficients, position, None, mass, deviation, active=active)
    values, converged = torch.empty_like(source), torch.empty(groups, dtype=torch.bool)
    count = torch.empty(groups, dtype=torch.int64)
    residual, mismatch = (torch.empty(groups, dtype=torch.float64) for _ in range(2))
    arguments = PoissonArguments(
        **{"pass": given},
        source=source.data_ptr(),
        start=address(start),
        free=free.data_ptr(),
        singular=singular.data_ptr(),
        member=group.data_ptr(),
        members=groups,
        iterations=iterations,
        tolerance=tolerance,
        values=values.data_ptr(),
        count=count.data_ptr(),
        residual=residual.data_ptr(),
        mismatch=mismatch.data_ptr(),
        converged=converged.data_ptr(),
    )
    library().function("poisson", REALS[position.dtype])(ctypes.byref(arguments))
    return [values, count, residual, converged, mismatch]


def _interpolation_moments_shapes(
    position: Tensor,
    member: Tensor,
    fields: Tensor,
    query: Tensor,
    query_member: Tensor,
    radius: float,
    period: Sequence[float],
    kind: int,
    kernel: Sequence[float],
    lengths: Tensor,
    weight: Tensor | None = None,
) -> list[Tensor]:
    return _allocate_moments(fields, query)


@_operator(_interpolation_moments_shapes)
def interpolation_moments(
    position: Tensor,
    member: Tensor,
    fields: Tensor,
    query: Tensor,
    query_member: Tensor,
    radius: float,
    period: Sequence[float],
    kind: int,
    kernel: Sequence[float],
    lengths: Tensor,
    weight: Tensor | None = None,
) -> list[Tensor]:
    """Moments of particles around queries; shapes as in ``Moments``, ``lengths`` (members,) float64, ``weight`` (N,).

    Raises:
        ValueError: a position is not finite, or a member index is negative.
    """
    given = _search_arguments(position, member, radius, period)
    outputs = _allocate_moments(fields, query)
    arguments = InterpolationArguments(
        given,
        fields.data_ptr(),
        fields.shape[1],
        query.shape[0],
        query.data_ptr(),
        query_member.data_ptr(),
        kind,
        kernel[0],
        kernel[1],
        lengths.data_ptr(),
        *(output.data_ptr() for output in outputs),
        address(weight),
    )
    unusable = library().function("interpolate", REALS[position.dtype])(ctypes.byref(arguments))
    if unusable:
        raise ValueError(f"{unusable} particle or query positions are not finite, or their member does not exist")
    return outputs


def _allocate_moments(fields: Tensor, query: Tensor) -> list[Tensor]:
    (queries, dimension), columns = query.shape, fields.shape[1]
    shapes = ((), (), (dimension,), (dimension, dimension), (columns,), (dimension, columns))
    return [query.new_empty((queries, *shape)) for shape in shapes]
