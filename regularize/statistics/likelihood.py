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
from typing import NamedTuple

import torch

from regularize.basis.knots import Knots
from regularize.rows.operators import System, VectorRows
from regularize.rows.ordering import order
from regularize.solvers.banded import add_widened
from regularize.solvers.factor import Factor
from regularize.solvers.prepared import SHIFT, PreparedSystem

from .extrapolation import Extrapolation
from .robust import inflation, robust_weight
from .row_groups import PROBES, Alike, Coupled, Groups, Samples, random_sums

LEAST, MOST = 1e-30, 1e30  # of a strength: its tenth power is still a number

RELAXATION = 1.6  # the plain update converges from one side at a rate near 0.6
UNLIKE = 10.0  # no component is taken for more than this many times noisier than another
MOST_PER_ROUND = 1e3  # growth of a precision, where a penalty's energy vanishes
FEWEST_ROUNDS = 3  # with fewer a small step may be chance
SETTLED = 0.1  # a round that moves no precision by more than this fraction, nor is foretold to, ends the search
FLOOR = 1e-3  # slip precisions below this share of the data's no longer matter
LEAST_OF_SLIP = 0.1  # by so much may a foretold slip be less than the round's
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


class Precisions(NamedTuple):
    """What the search looks for: of the samples' components (C,), curvature, slip and divergence (0: no such rows)."""

    fit: torch.Tensor
    rough: float
    slip: float
    divergence: float

    def logarithms(self, floor: float) -> torch.Tensor:
        """(C + 3,), of slip as of its sum with ``floor``: what lies below no longer matters; 0 for absent rows."""
        rest = torch.tensor([self.rough, self.slip and self.slip + floor, self.divergence], dtype=torch.float64)
        return torch.cat([self.fit, torch.where(rest > 0, rest, 1.0)]).log()

    def at(self, logarithms: torch.Tensor, floor: float) -> "Precisions":
        """The same rows at other logarithms."""
        values = logarithms.exp()
        rough, slip, free = values[len(self.fit) :].tolist()
        slip = max(slip - floor, LEAST_OF_SLIP * self.slip)
        return Precisions(values[: len(self.fit)], rough, slip if self.slip else 0.0, free if self.divergence else 0.0)


class LikelihoodSearch:
    """Rounds of the Fellner-Schall update on one set of groups."""

    def __init__(self, knots: Knots, groups: Groups, robust: str | None) -> None:
        self.groups, self.robust, self.components = groups, robust, groups.velocity.shape[1]
        fit = VectorRows(knots, groups.points, groups.velocity, groups.weight[:, None])
        every = [fit, *groups.fixed, *(rows for rows in (groups.slip, groups.divergence) if rows is not None)]
        self.ordering = order(System(knots, self.components, every, 0.0))
        self.samples, self.step = Samples(fit, self.ordering), max(knots.spacing[: self.components])  # m, time left out
        self.curvature = Alike.of(groups.curvature, self.ordering)
        self.slip = None if groups.slip is None else Alike.of(groups.slip, self.ordering)
        self.divergence = None if groups.divergence is None else Coupled(groups.divergence, self.ordering)
        silent = VectorRows(knots, groups.points, groups.velocity, torch.zeros_like(groups.weight)[:, None])
        fixed = PreparedSystem(System(knots, self.components, [silent, *groups.fixed], groups.damping), self.ordering)
        self.fixed, self.fixed_right = fixed.band(), fixed.gradient()
        generator = torch.Generator().manual_seed(0)  # fixed probes: the same data give the same choice
        shape = (len(self.ordering.nodes), self.components * PROBES)
        self.signs = torch.randint(0, 2, shape, generator=generator).double() * 2 - 1
        self.rough_probes = random_sums(groups.curvature, self.ordering, self.components, generator)
        if groups.slip is not None:
            self.slip_probes = random_sums(groups.slip, self.ordering, self.components, generator)
        if self.divergence is not None:
            self.divergence_probes = self.divergence.probes(generator)
        self.ahead = Extrapolation()
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
        floor = FLOOR * scale
        while count < rounds and not settled:
            count += 1
            mapped = self._round(found)
            before, after = (each.logarithms(floor) for each in (found, mapped))
            ahead = self.ahead.next(before, after)
            found = mapped.at(ahead, floor)
            moved = float(torch.stack([after - before, ahead - before]).abs().max())
            settled = count >= FEWEST_ROUNDS and moved < SETTLED
        scale = self.scale(found.fit)
        noise_each = tuple((found.fit**-0.5).tolist())
        no_slip, divergence = (_strength(each / scale) for each in (found.slip, found.divergence))
        curvature = (found.rough / scale) ** (0.5 / self.groups.order)
        return Choice(noise_each, curvature, no_slip, divergence, self.groups.order, self.factor, count, settled)

    def _round(self, now: Precisions) -> Precisions:
        band, right = self.prior(now)
        both = band.clone()
        add_widened(both, [precision * self.data.band for precision in now.fit.tolist()])
        posterior = Factor(both, self.ordering)
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
        scale, alike = self.scale(now.fit), now.rough * self.curvature.band
        right = scale * self.fixed_right
        if self.slip is not None and now.slip > 0:
            alike.add_(self.slip.band, alpha=now.slip)
            right = right + now.slip * self.slip.right
        prior = scale * self.fixed
        add_widened(prior, [alike] * self.components)
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
        if self.robust is not None:
            self._weigh(robust_weight(self.groups.velocity - self.samples.at(x), self.robust))

    def _weigh(self, factor: torch.Tensor) -> None:
        """Take robust factors (n,) into the data group and its unpenalised fit."""
        self.factor, self.data = factor, self.samples.weighed(factor.double())
        weight = self.groups.weight * factor.sqrt()
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


def _solved(factor: Factor, right: list[torch.Tensor]) -> list[torch.Tensor]:
    """Solutions for several right-hand sides (active, C, k), by one pass over the factor."""
    return list(factor.solve(torch.cat(right, dim=-1)).split([each.shape[-1] for each in right], dim=-1))
