"""A fitted vector field: callable, with exact derivatives, and masked where nothing supports it."""

from collections.abc import Sequence
from functools import reduce

import torch

from regularize.basis.knots import Knots
from regularize.errors import InvalidInput
from regularize.rows.given import dense
from regularize.solvers.interface import CholeskyFactor, Solution
from regularize.statistics.likelihood import Choice
from regularize.statistics.posterior import Posterior

FWHM = 2.3548  # of a Gaussian, in standard deviations


class SplineField:
    """v(x) = sum_j c_j B_j(x) (Grønli 2017, eq. 3.5).

    ``coefficients`` (C, *knots.shape) m/s; ``covered`` (cells,) bool says which knot cells held rows
    (samples, walls or penalties): elsewhere the field is not defined and evaluates to NaN, or to ``outside``.
    """

    def __init__(
        self,
        knots: Knots,
        coefficients: torch.Tensor,
        covered: torch.Tensor,
        solution: Solution | None = None,
        left_out: int = 0,
        choice: Choice | None = None,
        posterior: Posterior | None = None,
        factor: CholeskyFactor | None = None,
    ) -> None:
        self.knots, self.coefficients, self.covered = knots, coefficients, covered
        self.solution, self.left_out, self.choice = solution, left_out, choice
        self.posterior, self.factor = posterior, factor

    @property
    def components(self) -> int:
        """C."""
        return len(self.coefficients)

    def supported(self, points: torch.Tensor) -> torch.Tensor:
        """(n,) bool: points (n, A) in m where the field is defined."""
        points = self._checked(points)
        cell, _ = self.knots.locate(points)
        return self.knots.inside(points) & self.covered[self.knots.cell_number(cell)]

    def __call__(self, points: torch.Tensor, outside: float = float("nan")) -> torch.Tensor:
        """Velocity (n, C) in m/s at points (n, A) in m; ``outside`` where unsupported. Differentiable."""
        return self._evaluate(points, [None], outside)[0]

    def gradient(self, points: torch.Tensor, outside: float = float("nan")) -> torch.Tensor:
        """(n, C, A): derivative of component i along axis j in 1/s (m/s^2 along a time axis)."""
        orders = [[int(a == j) for a in range(self.knots.axes)] for j in range(self.knots.axes)]
        return torch.stack(self._evaluate(points, orders, outside), dim=-1)

    def divergence(self, points: torch.Tensor, outside: float = float("nan")) -> torch.Tensor:
        """(n,) in 1/s, from the analytic derivatives."""
        gradient = self.gradient(points, outside)
        return reduce(torch.add, [gradient[:, k, k] for k in range(self.components)])

    def laplacian(self, points: torch.Tensor, outside: float = float("nan")) -> torch.Tensor:
        """(n, C): sum of the second derivatives along the axes of space, in 1/(m s)."""
        orders = [[2 * int(a == j) for a in range(self.knots.axes)] for j in range(self.components)]
        return reduce(torch.add, self._evaluate(points, orders, outside))

    def std(self, points: torch.Tensor, outside: float = float("nan"), *, blur: float = 0.0) -> torch.Tensor:
        """Posterior standard deviation (n, C) in m/s at points (n, A); fit with ``uncertainty=True``.

        It is that of the random error: the samples' noise, and what the penalties leave open. Of full-vector samples
        in space, errors that neighbours share are found from the residuals and counted (see ``correlated``); of others
        all are taken for independent. What all samples have in common is beyond the data, first of all that a
        measurement averages over its resolution cell.
        ``blur``, the full width at half maximum of that cell in m, adds the square of the difference that a
        Gaussian of this width makes to the fit, s^2 / 2 times its Laplacian to leading order in its deviation s.
        It grows with the fit's own roughness, and errs on the small side where the finest scales are gone.
        """
        if self.posterior is None:
            raise InvalidInput("this field holds no posterior: fit it with uncertainty=True")
        if blur < 0:
            raise InvalidInput(f"blur is {blur}: it must be >= 0")
        points = self._checked(points)
        supported = self.supported(points)
        out = torch.full((len(points), self.components), outside).to(self.coefficients)
        variance = self.posterior.variance(points[supported])
        if blur:
            deviation = blur / FWHM
            variance = variance + (0.5 * deviation**2 * self.laplacian(points[supported]).double()).square()
        out[supported] = variance.sqrt().to(out)
        return out

    def grid(
        self,
        origin: Sequence[float],
        spacing: Sequence[float],
        shape: Sequence[int],
        outside: float = float("nan"),
    ) -> torch.Tensor:
        """Values (C, *shape) on a regular grid; origin, spacing x first, shape in array order (z, y, x)."""
        c = self.coefficients
        axes = [
            torch.arange(n, dtype=c.dtype, device=c.device) * h + o
            for n, h, o in zip(reversed(shape), spacing, origin, strict=True)
        ]
        points = torch.stack(torch.meshgrid(*reversed(axes), indexing="ij"), dim=-1).flatten(0, -2).flip(-1)
        return self(points, outside).T.reshape(self.components, *shape)

    def _checked(self, points: torch.Tensor) -> torch.Tensor:
        points = dense("points", points)
        if points.ndim != 2 or points.shape[1] != self.knots.axes:
            raise InvalidInput(f"points have shape {tuple(points.shape)}: expected (n, {self.knots.axes})")
        if not bool(torch.isfinite(points).all()):
            raise InvalidInput("points must be finite: leave out those that are not")
        return points.to(self.coefficients)

    def _evaluate(self, points: torch.Tensor, orders: list, outside: float) -> list[torch.Tensor]:
        if not isinstance(outside, int | float) or (isinstance(outside, int) and abs(outside) >= 2**1023):
            raise InvalidInput(f"outside is {outside!r:.60}: it must be a number, as nan or 0.0")
        points = self._checked(points)
        supported = self.supported(points)
        cell, t = self.knots.locate(points)
        near = self.coefficients.flatten(1).T[self.knots.local_nodes(cell)]
        blank = torch.full((), outside, dtype=near.dtype, device=near.device)
        values = [torch.einsum("nl,nlc->nc", self.knots.stencil(t, o), near) for o in orders]
        return [torch.where(supported[:, None], v, blank) for v in values]
