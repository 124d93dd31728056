"""Groups of rows whose precisions a search looks for: their normal matrices, energies and random sums."""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.sparse import csr_array

from regularize.rows.operators import CellRows, DivergenceRows, RowBlock, System, VectorRows
from regularize.rows.ordering import Ordering
from regularize.rows.sparse import value_matrix
from regularize.solvers.banded import multiply
from regularize.solvers.prepared import PreparedSystem

PROBES = 8  # random sums of rows per trace: its error is about sqrt(2 / (PROBES unknowns)), near 1 %


@dataclass(frozen=True)
class Groups:
    """Rows on the search grid. Penalties are means over the fluid or the wall, as in the Smoother's cost."""

    order: int  # of the derivatives that the curvature rows hold
    points: torch.Tensor  # (n, D) m
    velocity: torch.Tensor  # (n, C) m/s
    weight: torch.Tensor  # (n,) row weights
    curvature: CellRows  # one component
    slip: VectorRows | None  # the wall rows held in full, one weight per row
    divergence: DivergenceRows | CellRows | None  # only where its strength is to be chosen
    fixed: list[RowBlock]  # divergence and wall rows at the strength the options give
    damping: float  # row factor


class Coupled:
    """A group of rows without targets that couple the components."""

    def __init__(self, block: DivergenceRows | CellRows, ordering: Ordering) -> None:
        self.block, self.ordering = block, ordering
        self.band = PreparedSystem(System(ordering.knots, block.components, [block], 0.0), ordering).band()

    def probes(self, generator: torch.Generator) -> torch.Tensor:
        """As :meth:`Alike.probes`."""
        draws = []
        for _ in range(PROBES):
            signs = torch.randint(0, 2, self.block.target.shape, generator=generator).double() * 2 - 1
            draws.append(self.block.rmatvec(signs)[self.ordering.nodes])
        return torch.stack(draws, dim=-1)

    def energy(self, x: torch.Tensor) -> float:
        """Sum of the squared rows at x (active, C)."""
        flat = x.reshape(-1, 1)
        return float((flat * multiply(self.band, flat)).sum())


class Alike:
    """A group that acts alike on every component: one scalar band (active, width) serves them all.

    Args:
        band: of the normal matrix of one component.
        right: (active, C), right-hand sides.
        size: sum of the squared targets.
    """

    def __init__(self, band: torch.Tensor, right: torch.Tensor, size: float) -> None:
        self.band, self.right, self.size = band, right, size

    @classmethod
    def of(cls, block: VectorRows | CellRows, ordering: Ordering) -> "Alike":
        """The group of a block's rows."""
        if isinstance(block, CellRows):
            band = PreparedSystem(System(ordering.knots, 1, [block], 0.0), ordering).band()
            return cls(band, torch.zeros(()), 0.0)
        return Samples(block, ordering).weighed(torch.ones(len(block), dtype=torch.float64))

    def times(self, x: torch.Tensor) -> torch.Tensor:
        """Normal matrix times x (active, ...)."""
        return multiply(self.band, x.reshape(len(x), -1)).view(x.shape)

    def energy(self, x: torch.Tensor) -> float:
        """Sum of the squared row residuals at x (active, C)."""
        return float((x * self.times(x)).sum()) - 2.0 * float((x * self.right).sum()) + self.size


class Samples:
    """Rows of full vectors, of one weight each, that are weighed again and again."""

    def __init__(self, rows: VectorRows, ordering: Ordering) -> None:
        self._one = rows.component(0)
        self._prepared = PreparedSystem(System(rows.knots, 1, [self._one], 0.0), ordering)
        self._weight = rows.weight[:, :1].double()
        self._target = rows.target.view(rows.weight.shape).double()
        self._values = value_matrix(rows, ordering)
        self._adjoint = self._values.T.tocsr()

    def at(self, x: torch.Tensor) -> torch.Tensor:
        """(n, C) unweighted values of coefficients x (active, C)."""
        return torch.from_numpy(self._values @ x.numpy())

    def weighed(self, factor: torch.Tensor) -> Alike:
        """The group with factors (n,) on the squared rows."""
        one = self._one.with_weight(factor.sqrt()[:, None])
        band = self._prepared.with_weights(System(one.knots, 1, [one], 0.0)).band()
        target = factor[:, None] * self._target
        right = torch.from_numpy(self._adjoint @ (self._weight * target).numpy())
        return Alike(band, right, float((target * self._target).sum()))


def random_sums(
    block: VectorRows | CellRows, ordering: Ordering, components: int, generator: torch.Generator
) -> torch.Tensor:
    """(active, C, PROBES) draws u with E[u u'] = the normal matrix of rows that act alike on every component.

    tr(M^-1 G) = E[u' M^-1 u] has a small variance where M holds G; with signs on the coefficients, directions that M
    hardly knows would drown it.
    """
    width = components * PROBES
    rows = block.repeated(width)
    signs = torch.randint(0, 2, rows.target.shape, generator=generator).double() * 2 - 1
    if isinstance(rows, VectorRows):
        values = rows.weight[:, :1].double() * signs.view(len(rows), width)
        summed = torch.from_numpy(value_matrix(rows, ordering).T @ values.numpy())
    else:
        pulled = torch.einsum("rl,nrc->nlc", rows.factor.double(), signs.view(len(rows.cell), -1, width))
        summed = torch.from_numpy(_cell_sums(rows, ordering) @ pulled.flatten(0, 1).numpy())
    return summed.view(-1, components, PROBES)


def _cell_sums(block: CellRows, ordering: Ordering) -> csr_array:
    """(active, cells * L) of ones that sum what cells give to their coefficients."""
    place = torch.empty(block.knots.nodes, dtype=torch.int64)
    place[ordering.nodes] = torch.arange(len(ordering.nodes))
    entries = place[block.nodes.flatten()].numpy()
    ones, starts = np.ones(len(entries)), np.arange(len(entries) + 1)
    return csr_array((ones, entries, starts), shape=(len(entries), len(ordering.nodes))).T.tocsr()
