"""What steps the particles of a run: chosen by the type of its scheme."""

from __future__ import annotations

from copy import copy

from torch import Tensor

from ..schemes.projection import Projection
from ..schemes.scheme import Scheme
from ..schemes.weakly_compressible import WeaklyCompressible
from ..state.neighbour_list import PairSearch
from ..state.particles import Particles
from ..state.record import Record
from .coefficients import Coefficients
from .projection import ProjectionStepper
from .protocols import Stepped, Stepper, Surroundings
from .time_schemes import TIME_SCHEMES
from .weakly_compressible import WeaklyCompressibleSums


class WeaklyCompressibleStepper(WeaklyCompressibleSums):
    """Steps particles with the weakly compressible scheme, in the order that its options name."""

    def apart(self, coefficients: Coefficients, record: Record) -> WeaklyCompressibleStepper:
        """See ``Stepper.apart``."""
        other = copy(self)
        other.pair_search = self.pair_search.apart()
        other.use(coefficients)
        return other

    def step(self, particles: Particles, step: Tensor, number: Tensor, around: Surroundings) -> Stepped:
        """Advance every member by a step of its own (``Stepper.step``)."""
        return TIME_SCHEMES[self.scheme.order](self, particles, step, number, around)


def make_stepper(
    scheme: Scheme,
    coefficients: Coefficients,
    search: PairSearch,
    dimension: int,
    record: Record,
    *,
    buffered: bool,
) -> Stepper:
    """What steps particles with a scheme.

    Args:
        scheme: options.
        coefficients: of the run, internal units.
        search: neighbour list of the run.
        dimension: 2 or 3.
        record: account of the run, which projections write to.
        buffered: whether there can be particles of reservoirs.

    Raises:
        TypeError: the scheme is of no known type.
    """
    if isinstance(scheme, Projection):
        return ProjectionStepper(scheme, coefficients, search, dimension, record)
    if not isinstance(scheme, WeaklyCompressible):
        raise TypeError(f"no stepper is known for a scheme of type {type(scheme).__name__}")
    return WeaklyCompressibleStepper(scheme, coefficients, search, dimension, buffered=buffered)
