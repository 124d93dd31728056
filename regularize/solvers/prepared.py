"""A system in solve order with its normal matrix and gradient, by the fastest code of its device."""

from copy import copy

import torch

from regularize.arguments import checked
from regularize.errors import InvalidInput
from regularize.native import gram_triton
from regularize.native import library as native
from regularize.native.checks import fits
from regularize.rows.assembly import reference_band
from regularize.rows.operators import System
from regularize.rows.ordering import Ordering, order

from .banded import to_single
from .block import BlockFactor
from .factor import Factor

SHIFT = 1e-13  # of the largest diagonal entry; a few hundred times the rounding of float64


class PreparedSystem:
    """A system in solve order with its normal matrix and gradient, compiled or in torch.

    Vectors are (active coefficients, C) in solve order. ``engine`` "native" (compiled, CPU), "triton" (GPU)
    or "reference" (torch, anywhere); None picks the fast one of the device where it is installed.
    """

    @checked
    def __init__(self, system: System, ordering: Ordering | None = None, engine: str | None = None) -> None:
        self.system = system
        self.ordering = order(system) if ordering is None else ordering
        if engine == "native" and not native.available():
            raise InvalidInput("engine is 'native' but no compiled library was built; use 'reference'")
        device = self.ordering.nodes.device
        if engine == "triton" and not gram_triton.available(device):
            raise InvalidInput(f"engine is 'triton', which cannot run on {device} here; use 'reference'")
        self.engine = engine or self._fastest(device, system)
        self._packed = native.PackedSystem(system, self.ordering) if self.engine == "native" else None

    @staticmethod
    def _fastest(device: torch.device, system: System) -> str:
        if device.type == "cpu":
            return "native" if native.available() and fits(system) else "reference"
        return "triton" if gram_triton.available(device) else "reference"

    def with_targets(self, system: System) -> "PreparedSystem":
        """The same rows in the same order with the right-hand sides of ``system``."""
        other = copy(self)
        other.system = system
        if self._packed is not None:
            other._packed = copy(self._packed)
            other._packed.system = system
        return other

    def with_weights(self, system: System) -> "PreparedSystem":
        """The same points in the same order with the weights and right-hand sides of ``system``."""
        other = copy(self)
        other.system = system
        if self._packed is not None:
            other._packed = self._packed.with_weights(system)
        return other

    def band(self) -> torch.Tensor:
        """Lower band (unknowns, width) of the normal matrix, float64."""
        if self._packed is not None:
            return self._packed.band()
        assemble = gram_triton.triton_band if self.engine == "triton" else reference_band
        return assemble(self.system, self.ordering)

    def single_factor(self) -> "Factor | BlockFactor":
        """Cholesky factor in float32, in half the time; InvalidInput where it breaks down.

        The peak of memory is that of the float64 band, in whose place it is made.
        """
        if self.ordering.nodes.device.type == "cpu":
            return Factor(to_single(self.band()), self.ordering)
        return BlockFactor(self.band().float(), self.ordering)

    def factor(self) -> "Factor | BlockFactor":
        """Cholesky factor of the normal matrix; InvalidInput where it is not positive definite.

        Penalties many orders stronger than the damping can lose it to round-off: then the diagonal is raised
        by SHIFT of its largest entry, which the refinement on the rows has to make good for.
        """
        kind = Factor if self.ordering.nodes.device.type == "cpu" else BlockFactor
        try:
            return kind(self.band(), self.ordering)
        except InvalidInput:
            if self.system.damping == 0:
                raise
            band = self.band()
            band[:, 0] += SHIFT * band[:, 0].max()
            return kind(band, self.ordering)

    def gradient(self, x: torch.Tensor | None = None) -> torch.Tensor:
        """A'(b - A x) - damping^2 x, or A'b."""
        if self._packed is not None:
            return self._packed.gradient(x)
        if x is None:
            return self._take(self.system.right_side())
        return self._take(self.system.gradient(self.expand(x).flatten()))

    def expand(self, x: torch.Tensor) -> torch.Tensor:
        """(active, C) in solve order -> (nodes, C) with zeros at untouched coefficients."""
        return self.ordering.expand(x)

    def _take(self, full: torch.Tensor) -> torch.Tensor:
        return full.view(self.system.knots.nodes, self.system.components)[self.ordering.nodes]
