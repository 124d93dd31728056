"""Errors that neighbouring samples share: how far they reach, and how much less the samples then determine.

A tracker's error is much the same over its resolution cell: a hundred samples may hold the information of one. The
cost counts them as independent, with the noise that the resolved scales show; that hardly moves the fit but makes its
posterior too narrow on long scales. Here the errors' covariance is taken as a white part and a part that falls off as
a Gaussian of the distance. Its size, share and length are those for which errors so drawn, sent through the fit, leave
residuals like the ones that the data left (indirect inference: C. Gourieroux, A. Monfort and E. Renault, J. Appl.
Econometrics 8, 1993, S85): the fit takes the long waves of the errors for flow, so that its residuals alone show less
of them than there is. What they add to the fit's variance, M^-1 A'(C - S) A M^-1 with the samples' covariance C and
the white one S that the cost stands for, comes on top of the posterior's M^-1 (the sandwich of P. Huber, Proc. Fifth
Berkeley Symp. 1, 1967, 221).
"""

from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from scipy.sparse import coo_array
from scipy.spatial import cKDTree

from regularize.rows.operators import System, VectorRows
from regularize.rows.ordering import Ordering
from regularize.rows.sparse import value_matrix
from regularize.solvers.factor import Factor

from .waves import Lattice

CENTRES = 500  # samples whose neighbours are looked at
REACH = 6.0  # typical distances between samples over which correlation is looked for
BINS = 12
SHORTEST = 0.05  # length looked for, of the reach
FAR = 3.0  # robust standard deviations at which residuals are cut: a hop is no correlated error
FEWEST = 100  # samples
DRAWS = 8
WAVES = 64  # of which a drawn error field is made
ROUNDS = 5  # of the search for errors that leave the residuals found
STEP = 2.0  # at most by this factor does a round change the size or length of the errors


@dataclass(frozen=True)
class Correlation:
    """Of the samples' errors, per velocity component: deviation (m/s, full weight), correlated share, length (m)."""

    deviation: torch.Tensor
    share: torch.Tensor
    length: torch.Tensor


class _Pairs:
    """Pairs of samples, of which one is among CENTRES drawn at random, by distance."""

    def __init__(self, points: np.ndarray, used: np.ndarray) -> None:
        # drawn from all samples: one that is discarded more or less does not change all the others
        drawn = np.random.default_rng(0).permutation(len(points))
        self.centres = centres = (np.cumsum(used) - 1)[drawn[used[drawn]][:CENTRES]]
        points = points[used]
        tree = cKDTree(points)
        typical = float(np.median(tree.query(points[centres], k=2)[0][:, 1]))
        self.far = REACH * max(typical, 1e-12)
        near = tree.query_ball_point(points[centres], self.far, return_sorted=False)
        number = np.repeat(np.arange(len(centres)), [len(each) for each in near])
        second = np.concatenate([np.asarray(each, int) for each in near])
        other = second != centres[number]
        number, second = number[other], second[other]
        distance = np.linalg.norm(points[centres[number]] - points[second], axis=1)
        place = np.minimum(distance / self.far * BINS, BINS - 1).astype(int)
        self.count = np.bincount(place, minlength=BINS)
        self.middle = np.bincount(place, distance, BINS) / np.maximum(self.count, 1)
        # sums over the neighbours of each centre in each bin: in single precision, half of the memory to gather from
        shape = (len(centres) * BINS, len(points))
        self.sums = coo_array((np.ones(len(second), np.float32), (number * BINS + place, second)), shape=shape).tocsr()

    def correlation(self, residual: torch.Tensor) -> Correlation:
        """What residuals (n, C, draws) have in common in each component."""
        far = FAR * 1.4826 * residual.abs().median(dim=0).values.mean(-1)[:, None]
        cut = torch.maximum(torch.minimum(residual, far), -far)
        deviation = cut.square().mean((0, 2)).sqrt()
        e = (cut / deviation[:, None]).float().numpy()
        near = (self.sums @ e.reshape(len(e), -1)).reshape(len(self.centres), BINS, *e.shape[1:])
        together = np.einsum("ibcd,icd->cb", near.astype(np.float64), e[self.centres]) / e.shape[2]
        fits = [self._gaussian(each / np.maximum(self.count, 1)) for each in together]
        share, length = torch.tensor(fits, dtype=torch.float64).unbind(1)
        return Correlation(deviation, share, length)

    def _gaussian(self, correlation: np.ndarray) -> tuple[float, float]:
        """Share in [0, 1] and length of share exp(-distance^2 / (2 length^2)), by least squares."""

        def share(length: float | np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            curve = np.exp(-0.5 * (self.middle / length) ** 2)
            best = (curve * (self.count * correlation)).sum(-1) / np.maximum((self.count * curve**2).sum(-1), 1e-300)
            return best.clip(0.0, 1.0), curve

        def misfit(logarithm: float | np.ndarray) -> np.ndarray:
            part, curve = share(np.exp(logarithm))
            return np.asarray(self.count * (correlation - part[..., None] * curve) ** 2).sum(-1)

        grid = np.log(self.far) + np.linspace(np.log(SHORTEST), 0.0, 30)
        place = int(np.argmin(misfit(grid[:, None])))
        # between the grid's points, so that the answer follows the data without jumps
        bounds = grid[max(place - 1, 0)], grid[min(place + 1, len(grid) - 1)]
        length = float(np.exp(minimize_scalar(misfit, bounds=bounds, method="bounded", options={"xatol": 1e-6}).x))
        return float(share(length)[0]), length


class CorrelatedErrors:
    """The errors of the full-vector samples in the first block of ``system``, and what they do to its solution.

    ``weight`` (n,): the samples' row weights. ``precision``: as in ``Posterior``.
    """

    def __init__(
        self, system: System, ordering: Ordering, factor: Factor, weight: torch.Tensor, precision: float
    ) -> None:
        self.system, self.ordering, self.factor, self.precision = system, ordering, factor, precision
        fit = system.blocks[0]
        if not isinstance(fit, VectorRows):
            raise TypeError(f"correlated errors are those of full vectors, not of {type(fit).__name__}")
        self.fit = fit
        self.matrix = value_matrix(fit, ordering)
        self.adjoint = self.matrix.T.tocsr()
        self.weight = weight[:, None, None]
        self.points = torch.tensor(self.fit.knots.spacing) * (self.fit.cell + self.fit.t)
        self.lattice = Lattice(self.points)
        generator = torch.Generator().manual_seed(0)  # the same data give the same deviations
        shape = (system.components, WAVES, DRAWS)
        self.white = torch.randn(len(self.fit), system.components, DRAWS, generator=generator, dtype=torch.float64)
        # in single precision: the cosines of all waves are most of the work, and draws need no more
        self.waves = torch.randn(self.fit.knots.axes, *shape, generator=generator, dtype=torch.float64).float()
        self.phase = (2 * torch.pi * torch.rand(shape, generator=generator, dtype=torch.float64)).float()
        self.generator = generator

    def inflation(self, residual: torch.Tensor) -> torch.Tensor:
        """(C,) factor, at least 1, on the posterior's standard deviations, for a fit that left residual (n, C)."""
        used = self.weight[:, 0, 0] > 0
        if int(used.sum()) < FEWEST or not bool((residual[used].abs().median(dim=0).values > 0).all()):
            return torch.ones(residual.shape[1], dtype=torch.float64)
        pairs = _Pairs(self.points.numpy(), used.numpy())
        errors = seen = pairs.correlation((self.weight * residual[:, :, None])[used])
        for _ in range(ROUNDS):
            drawn, fitted = self._fitted_errors(errors)
            errors = _towards(errors, seen, pairs.correlation((self.weight * (drawn - fitted))[used]))
        return self._spread(self._fitted_errors(errors)[1])

    def _fitted_errors(self, errors: Correlation) -> tuple[torch.Tensor, torch.Tensor]:
        """Errors (n, C, DRAWS) at the samples, and what the fit makes of them there."""
        draws = errors.deviation[:, None] * self._field(errors) / self.weight.clamp(min=1e-300)
        draws = torch.where(self.weight > 0, draws, 0.0)
        return draws, self._fitted(self._pulled(self.fit.weight[:, :, None] * draws))

    def _spread(self, fitted: torch.Tensor) -> torch.Tensor:
        """Deviations with the fitted errors given, over those with the white ones that the posterior stands for."""
        white = self._fitted(self._pulled(self.white / self.precision**0.5))  # the draws in the errors: chance cancels
        posterior = self._at_samples(self.factor.samples(self.precision, DRAWS, self.generator))
        more = fitted.square().mean((0, 2)) - white.square().mean((0, 2))
        return (1.0 + more.clamp(min=0.0) / posterior.square().mean((0, 2))).sqrt()

    def _field(self, errors: Correlation) -> torch.Tensor:
        """(n, C, DRAWS) of variance 1: white, and plane waves with the spectrum of the correlated part."""
        share, smooth = errors.share[:, None], torch.empty_like(self.white)
        for k in range(self.system.components):
            smooth[:, k] = self.lattice.sum_of_waves(self.waves[:, k] / float(errors.length[k]), self.phase[k])
        return share.sqrt() * smooth * (2 / WAVES) ** 0.5 + (1 - share).sqrt() * self.white

    def _pulled(self, rows: torch.Tensor) -> torch.Tensor:
        """Right-hand sides (active, C, DRAWS) in solve order of weighted sample values (n, C, DRAWS)."""
        pulled = self.adjoint @ (self.fit.weight[:, :, None] * rows).flatten(1).numpy()
        return torch.from_numpy(pulled).view(-1, *rows.shape[1:])

    def _fitted(self, right: torch.Tensor) -> torch.Tensor:
        """Fields (n, C, DRAWS) at the samples for right-hand sides (active, C, DRAWS) in solve order."""
        return self._at_samples(self.factor.solve(right))

    def _at_samples(self, x: torch.Tensor) -> torch.Tensor:
        """Fields (n, C, DRAWS) at the samples of coefficients (active, C, DRAWS) in solve order."""
        return torch.from_numpy(self.matrix @ x.flatten(1).numpy()).view(-1, *x.shape[1:])


def _towards(errors: Correlation, seen: Correlation, left: Correlation) -> Correlation:
    """Errors whose residuals look more like the ones seen than the ones ``left`` by these."""
    size = (seen.deviation / left.deviation).clamp(1 / STEP, STEP)
    longer = (seen.length / left.length).clamp(1 / STEP, STEP)
    share = (errors.share + seen.share - left.share).clamp(0.0, 1.0)
    return Correlation(errors.deviation * size, share, errors.length * longer)
