"""Noise levels, smoothness and slip chosen by restricted likelihood, without seeing any truth.

Bayesian reading of the cost: every group of rows is Gaussian with a precision theta of its own: the samples
of velocity component k (1 / sigma_k^2), the curvature (how rough the flow is), its divergence, the slip at the
wall. The restricted likelihood of all of them is maximised by the update of S. Wood and M. Fasiolo, Biometrics 73
(2017) 1071 (generalised Fellner-Schall), which needs two factorisations and a few traces per round.

Speckle noise is correlated over millimetres, and a likelihood that believes samples to be independent takes
its long waves for flow. Here the samples count only through their unpenalised fit in the span of a knot grid
somewhat coarser than the final one (as many data as coefficients, whatever the number of voxels): the noise
level is read off scales that the spline resolves, where correlated noise looks white, and the residual at
finer scales, which tells nothing about them, drops out.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import exp, log
from typing import NamedTuple

import torch

from regularize.basis.knots import Knots
from regularize.rows.operators import CellRows, DivergenceRows, RowBlock, System, VectorRows
from regularize.rows.ordering import Ordering, order
from regularize.solvers.banded import multiply, widen
from regularize.solvers.factor import Factor
from regularize.solvers.prepared import SHIFT, PreparedSystem

from .robust import inflation, robust_weight

LEAST, MOST = 1e-30, 1e30  # of a strength: its tenth power is still a number

PROBES = 8  # random sums of rows per trace: its error is about sqrt(2 / (PROBES unknowns)), near 1 %
RELAXATION = 1.6  # the plain update converges from one side at a rate near 0.6
UNLIKE = 10.0  # no component is taken for more than this many times noisier than another
MOST_PER_ROUND = 1e3  # growth of a precision, where a penalty's energy vanishes
SHRINKING = (0.3, 0.85)  # ratios of successive steps between which their sum is foretold
SETTLED = 0.03  # a round that changes no precision by more than this fraction ends the search
FLOOR = 1e-3  # slip precisions below this share of the data's no longer matter
NOISE_FLOOR = 1e-4  # of the data's root mean square: exact data would send the precision to infinity
SHARPEST = 0.01  # curvature lengths stay between this many knot spacings and its inverse
LONGEST = 10.0  # divergence lengths stay below so many sides of the box: divergence-free data want an infinite one
RATIOS = ("no_slip", "divergence")  # options whose squares are strengths relative to the samples'
RIDGE = 0.02  # curvature length, in knot spacings, that keeps the unpenalised fit defined


@dataclass(frozen=True)
class Choice:
    """What the likelihood chose. Lengths in m, velocities in m/s.

    ``noise`` (C): white-equivalent standard deviation, per component, of a sample of full weight (larger than
    the point-wise one where the noise is correlated). ``curvature``, ``no_slip``, ``divergence``: the Smoother's
    options of that name (None: none to choose). ``robust`` (n,): factors on the squared rows of the samples.
    ``rounds`` used; ``settled``: the last one changed nothing of note. ``shared`` (C,): factors on ``noise`` for long
    scales, where errors are correlated over several samples (see ``correlated``); they are in the other values.
    """

    noise: tuple[float, ...]
    curvature: float
    no_slip: float | None
    divergence: float | None
    order: int
    robust: torch.Tensor
    rounds: int
    settled: bool
    shared: tuple[float, ...] | None = None

    @property
    def start(self) -> "Start":
        """From where a search on other knots may go on."""
        return Start(self.noise, self.curvature, self.no_slip, self.divergence, self.robust)

    @property
    def deviation(self) -> torch.Tensor:
        """(C,) m/s: ``noise`` with what neighbouring samples' errors have in common."""
        return torch.tensor(self.noise, dtype=torch.float64) * torch.tensor(self.shared or 1.0, dtype=torch.float64)

    def counting(self, shared: torch.Tensor) -> "Choice":
        """The choice for samples whose errors disturb long scales ``shared`` (C,) times as much as ``noise`` says.

        They then weigh less beside the penalties, whose own strengths stay.
        """
        noise = torch.tensor(self.noise, dtype=torch.float64)
        less = float((noise**-2).mean() / ((noise * shared) ** -2).mean()) ** 0.5
        stronger = {name: value and less * value for name, value in vars(self).items() if name in RATIOS}
        curvature = self.curvature * less ** (1.0 / self.order)
        return replace(self, curvature=curvature, shared=tuple(shared.tolist()), **stronger)


def _strength(precision: float) -> float | None:
    """A penalty's strength from its precision over the samples'; None where the data have switched it off.

    A search that finds nothing for a penalty makes it weaker round by round, beyond what options and sums can hold.
    """
    strength = min(max(precision, 0.0) ** 0.5, MOST)
    return strength if strength >= LEAST else None


@dataclass(frozen=True)
class Start:
    """A first guess of a search; lengths in m, as in the Smoother's options."""

    noise: float | Sequence[float]  # m/s, of all components or of each
    curvature: float
    no_slip: float | None
    divergence: float | None
    robust: torch.Tensor | None = None  # (n,) factors on the squared rows of the samples; None: all 1


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


class Precisions(NamedTuple):
    """What the search looks for: of the samples' components (C,), curvature, slip and divergence (0: no such rows)."""

    fit: torch.Tensor
    rough: float
    slip: float
    divergence: float


class _Coupled:
    """A group of rows without targets that couple the components."""

    def __init__(self, block: DivergenceRows | CellRows, ordering: Ordering) -> None:
        self.block, self.ordering = block, ordering
        self.band = PreparedSystem(System(ordering.knots, block.components, [block], 0.0), ordering).band()

    def probes(self, generator: torch.Generator) -> torch.Tensor:
        """As :meth:`_Alike.probes`."""
        draws = []
        for _ in range(PROBES):
            signs = torch.randint(0, 2, self.block.target.shape, generator=generator).double() * 2 - 1
            draws.append(self.block.rmatvec(signs)[self.ordering.nodes])
        return torch.stack(draws, dim=-1)

    def energy(self, x: torch.Tensor) -> float:
        """Sum of the squared rows at x (active, C)."""
        flat = x.reshape(-1, 1)
        return float((flat * multiply(self.band, flat)).sum())


class _Alike:
    """A group that acts alike on every component: one scalar band serves them all."""

    def __init__(self, block: VectorRows | CellRows, ordering: Ordering) -> None:
        knots, self.block, self.ordering = ordering.knots, block, ordering
        if isinstance(block, CellRows):
            self.band = PreparedSystem(System(knots, 1, [block], 0.0), ordering).band()
            self.right, self.size = torch.zeros(()), 0.0
            return
        one = block.component(0)
        self.band = PreparedSystem(System(knots, 1, [one], 0.0), ordering).band()
        self.right = PreparedSystem(System(knots, block.components, [block], 0.0), ordering).gradient()
        self.size = float(block.target.square().sum())

    def times(self, x: torch.Tensor) -> torch.Tensor:
        """Normal matrix times x (active, ...)."""
        return multiply(self.band, x.reshape(len(x), -1)).view(x.shape)

    def probes(self, components: int, generator: torch.Generator) -> torch.Tensor:
        """(active, C, PROBES) draws u with E[u u'] = the group's normal matrix: its rows' random sums.

        tr(M^-1 G) = E[u' M^-1 u] has a small variance where M holds G; with signs on the coefficients,
        directions that M hardly knows would drown it.
        """
        width = components * PROBES
        rows = self.block.repeated(width)
        signs = torch.randint(0, 2, rows.target.shape, generator=generator).double() * 2 - 1
        summed = rows.rmatvec(signs)[self.ordering.nodes]
        return summed.view(-1, components, PROBES)

    def energy(self, x: torch.Tensor) -> float:
        """Sum of the squared row residuals at x (active, C)."""
        linear = 0.0 if isinstance(self.right, float) else float((x * self.right).sum())
        return float((x * self.times(x)).sum()) - 2.0 * linear + self.size


class LikelihoodSearch:
    """Rounds of the Fellner-Schall update on one set of groups."""

    def __init__(self, knots: Knots, groups: Groups, robust: str | None) -> None:
        self.groups, self.robust, self.components = groups, robust, groups.velocity.shape[1]
        fit = VectorRows(knots, groups.points, groups.velocity, groups.weight[:, None])
        every = [fit, *groups.fixed, *(rows for rows in (groups.slip, groups.divergence) if rows is not None)]
        self.ordering = order(System(knots, self.components, every, 0.0))
        self.fit, self.step = fit, max(knots.spacing[: self.components])  # m, time left out
        self.curvature = _Alike(groups.curvature, self.ordering)
        self.slip = None if groups.slip is None else _Alike(groups.slip, self.ordering)
        self.divergence = None if groups.divergence is None else _Coupled(groups.divergence, self.ordering)
        silent = VectorRows(knots, groups.points, groups.velocity, torch.zeros_like(groups.weight)[:, None])
        fixed = PreparedSystem(System(knots, self.components, [silent, *groups.fixed], groups.damping), self.ordering)
        self.fixed, self.fixed_right = fixed.band(), fixed.gradient()
        generator = torch.Generator().manual_seed(0)  # fixed probes: the same data give the same choice
        shape = (len(self.ordering.nodes), self.components * PROBES)
        self.signs = torch.randint(0, 2, shape, generator=generator).double() * 2 - 1
        self.rough_probes = self.curvature.probes(self.components, generator)
        if self.slip is not None:
            self.slip_probes = self.slip.probes(self.components, generator)
        if self.divergence is not None:
            self.divergence_probes = self.divergence.probes(generator)
        self._weigh(torch.ones_like(groups.weight))
        speed = float(groups.velocity.double().square().mean().sqrt())
        self.sharpest = (NOISE_FLOOR * speed) ** -2
        self.longest = LONGEST * max(h * n for h, n in zip(knots.spacing, knots.cells, strict=True))

    def run(self, start: "Start", rounds: int) -> Choice:
        """Search from a first guess, for at most so many rounds."""
        if start.robust is not None:
            self._weigh(start.robust)
        fit = torch.as_tensor(start.noise, dtype=torch.float64).expand(self.components) ** -2
        scale = self.scale(fit)
        slip = 0.0 if self.slip is None or start.no_slip is None else scale * start.no_slip**2
        free = 0.0 if self.divergence is None or start.divergence is None else scale * start.divergence**2
        found, settled, count = Precisions(fit, self.roughness(scale, start.curvature), slip, free), False, 0
        steps: list[float] = []
        while count < rounds and not settled:
            count += 1
            old, found = found, self._round(found)
            settled = self._settled(old, found)
            steps.append(log(found.rough / old.rough))
            ahead = 0.0 if settled else _still_to_come(steps)
            if ahead:
                found, steps = found._replace(rough=found.rough * exp(ahead)), []
        scale = self.scale(found.fit)
        noise_each = tuple((found.fit**-0.5).tolist())
        no_slip, divergence = (_strength(each / scale) for each in (found.slip, found.divergence))
        curvature = (found.rough / scale) ** (0.5 / self.groups.order)
        return Choice(noise_each, curvature, no_slip, divergence, self.groups.order, self.factor, count, settled)

    def _round(self, now: Precisions) -> Precisions:
        band, right = self.prior(now)
        posterior = Factor(band + widen(self.data.band, now.fit), self.ordering)
        prior = Factor(band, self.ordering)
        penalties = self._penalty_probes(now)
        # all right-hand sides at once: each alone would fetch the whole factor from memory
        known = (right + now.fit * self.data.right)[:, :, None]
        x, freed, *after = _solved(posterior, [known, self.data_probes, *penalties])
        x, before = x.squeeze(-1), _solved(prior, penalties)
        gained = [old - new for old, new in zip(before, after, strict=True)]
        new_fit, scale = self._noise(x, now.fit, freed), self.scale(now.fit)
        low, high = (self.roughness(scale, factor * self.step) for factor in (SHARPEST, 1 / SHARPEST))
        rough = now.rough * self._step(penalties.pop(0), gained.pop(0), self.curvature.energy(x))
        rough, slip, free = min(max(rough, low), high), now.slip, now.divergence
        if self.slip is not None and slip > 0:
            slip *= self._step(penalties.pop(0), gained.pop(0), self.slip.energy(x))
            slip = min(slip, scale / SHARPEST**2)
        if self.divergence is not None and free > 0:
            free *= self._step(penalties.pop(0), gained.pop(0), self.divergence.energy(x))
            free = min(free, scale * self.longest**2)
        if self.robust is not None:
            self.reweigh(x)
        return Precisions(new_fit, rough, slip, free)

    def _penalty_probes(self, now: Precisions) -> list[torch.Tensor]:
        """Random sums (active, C, PROBES) of the rows of curvature, slip and divergence that are looked for."""
        probes = [self.rough_probes]
        if self.slip is not None and now.slip > 0:
            probes.append(self.slip_probes)
        if self.divergence is not None and now.divergence > 0:
            probes.append(self.divergence_probes)
        return probes

    def prior(self, now: Precisions) -> tuple[torch.Tensor, torch.Tensor]:
        """Band and right-hand side of all penalties."""
        scale, one = self.scale(now.fit), torch.ones(self.components, dtype=torch.float64)
        prior = scale * self.fixed + widen(self.curvature.band, now.rough * one)
        right = scale * self.fixed_right
        if self.slip is not None and now.slip > 0:
            prior += widen(self.slip.band, now.slip * one)
            right = right + now.slip * self.slip.right
        if self.divergence is not None and now.divergence > 0:
            prior.add_(self.divergence.band, alpha=now.divergence)
        # stiff penalties over a breath of damping may lose definiteness to round-off
        prior[:, 0] += SHIFT * prior[:, 0].max()
        return prior, right

    def _noise(self, x: torch.Tensor, fit: torch.Tensor, solved: torch.Tensor) -> torch.Tensor:
        """(C,) new precisions of the samples: what they determine over how far the fit stays from them.

        ``solved``: the posterior's solutions for the data's probes.
        """
        # tr(A^-1 S_k): how much of component k's data the posterior leaves free
        freed = (self.data_probes * solved).sum(dim=(0, 2)) / PROBES
        off = x - self.unpenalised
        misfit = (off * self.data.times(off)).sum(dim=0)
        precision = (self.rank - fit * freed).clamp(min=1.0) / misfit.clamp(min=1e-300)
        if self.robust is not None:
            precision = precision / inflation(self.robust, self.components) ** 2
        precision = precision.clamp(max=self.sharpest)
        return precision.clamp(min=float(precision.max()) / UNLIKE**2)

    @staticmethod
    def _step(probes: torch.Tensor, gained: torch.Tensor, energy: float) -> float:
        """Factor on a penalty's precision: (tr(P^-1 G) - tr(A^-1 G)) over its energy, over-relaxed."""
        trace = float((probes * gained).sum()) / PROBES
        return min((max(trace, 1e-30) / max(energy, 1e-30)) ** RELAXATION, MOST_PER_ROUND)

    def scale(self, fit: torch.Tensor) -> float:
        """Precision of the whole data set: what turns the Smoother's cost into a log-likelihood."""
        return float(fit.mean() * (self.groups.weight.double().square() * self.factor).sum())

    def roughness(self, scale: float, curvature: float) -> float:
        """Precision of the curvature rows for a curvature length in m."""
        return scale * curvature ** (2 * self.groups.order)

    def reweigh(self, x: torch.Tensor) -> None:
        """Judge the samples anew by their distance from the fit with coefficients x (active, C)."""
        fitted = self.fit.matvec(self.ordering.expand(x)).view(-1, self.components)
        residual = self.groups.velocity - fitted / self.groups.weight[:, None]
        if self.robust is not None:
            self._weigh(robust_weight(residual, self.robust))

    def _weigh(self, factor: torch.Tensor) -> None:
        """Take robust factors (n,) into the data group and its unpenalised fit."""
        self.factor = factor
        weight = self.groups.weight * factor.sqrt()
        rows = VectorRows(self.fit.knots, self.groups.points, self.groups.velocity, weight[:, None])
        self.data = _Alike(rows, self.ordering)
        ridge = self.roughness(float(weight.double().square().sum()), RIDGE * self.step)
        ridged = Factor(self.data.band + ridge * self.curvature.band, self.ordering)
        self.unpenalised = ridged.solve(self.data.right[:, None]).squeeze(1)
        # rank = tr((S + R)^-1 S) = unknowns - tr((S + R)^-1 R) for the ridge R
        probe = self.rough_probes[:, :1]
        self.rank = len(probe) - ridge * float((probe * ridged.solve(probe)).sum()) / PROBES
        self.data_probes = ridged.spread(self.signs).view(len(probe), self.components, PROBES)

    @property
    def unknowns(self) -> int:
        """Of one of its systems."""
        return self.components * len(self.ordering.nodes)

    def _settled(self, old: Precisions, new: Precisions) -> bool:
        fit = float(((new.fit - old.fit) / old.fit).abs().max())
        rough = abs(new.rough / old.rough - 1.0)
        slip = abs(new.slip - old.slip) / (old.slip + FLOOR * self.scale(old.fit))
        free = abs(new.divergence - old.divergence) / (old.divergence + 1e-300)
        return max(fit, rough, slip, free) < SETTLED


def _still_to_come(steps: list[float]) -> float:
    """What steps that shrink by the same ratio will add up to from here on; 0 where the last two do not shrink so.

    Aitken's extrapolation; the smoothness creeps towards its end for many rounds by two thirds of the step before.
    """
    ratio = steps[-1] / steps[-2] if len(steps) > 1 and steps[-2] else 0.0
    return steps[-1] * ratio / (1.0 - ratio) if SHRINKING[0] < ratio < SHRINKING[1] else 0.0


def _solved(factor: Factor, right: list[torch.Tensor]) -> list[torch.Tensor]:
    """Solutions for several right-hand sides (active, C, k), by one pass over the factor."""
    return list(factor.solve(torch.cat(right, dim=-1)).split([each.shape[-1] for each in right], dim=-1))
