"""One assembled fit: checked samples, rows, what was chosen automatically, and the field of a solution."""

from dataclasses import dataclass, replace
from math import prod

import torch

from regularize.rows.operators import DirectionRows, System, VectorRows
from regularize.solvers.direct import solve_direct
from regularize.solvers.factor import Factor
from regularize.solvers.interface import CholeskyFactor, Solution
from regularize.solvers.prepared import PreparedSystem
from regularize.statistics.correlated import CorrelatedErrors
from regularize.statistics.likelihood import Choice
from regularize.statistics.posterior import Posterior

from .field import SplineField
from .samples import FitData


@dataclass(frozen=True)
class Problem:
    """The first block of ``system`` holds the samples of ``data``."""

    data: FitData
    system: System
    choice: Choice | None

    @property
    def samples(self) -> VectorRows | DirectionRows:
        """The rows of the samples."""
        block = self.system.blocks[0]
        if not isinstance(block, VectorRows | DirectionRows):
            raise TypeError(f"the first rows of a problem must be those of the samples, not {type(block).__name__}")
        return block

    def field(self, solution: Solution, factor: CholeskyFactor | None = None, own_factor: bool = True) -> SplineField:
        """The field of a solution; the factor of ``system`` itself also gives its uncertainty."""
        knots, data = self.system.knots, self.data
        coefficients = solution.x.to(data.dtype).view(knots.nodes, -1).T.reshape(-1, *knots.shape)
        covered = torch.zeros(prod(knots.cells), dtype=torch.bool, device=coefficients.device)
        covered[self.system.cells()] = True
        posterior = None
        if factor is not None and own_factor:
            posterior = self.posterior(solution, factor)
        return SplineField(knots, coefficients, covered, solution, data.left_out, self.choice, posterior, factor)

    def posterior(self, solution: Solution, factor: CholeskyFactor) -> Posterior:
        """The posterior, with what the samples' errors are found to have in common."""
        return Posterior(factor, self.precision(solution), self.system.components, self.shared(solution, factor))

    def shared(self, solution: Solution, factor: CholeskyFactor) -> torch.Tensor | None:
        """(C,) factors on the posterior's deviations for errors that samples share; None where they are not looked for:

        along beams, over time and on a GPU.
        """
        data, system, fit = self.data, self.system, self.samples
        if not isinstance(fit, VectorRows) or data.over_time or not isinstance(factor, Factor):
            return None
        fitted = fit.with_unit_weight().matvec(solution.x.view(system.knots.nodes, -1)).view_as(data.velocity)
        errors = CorrelatedErrors(system, factor.ordering, factor, data.weight, self.precision(solution))
        return errors.inflation(data.velocity - fitted)

    def precision(self, solution: Solution) -> float:
        """Turns the cost into minus twice a log-posterior: the weight of all samples over their variance.

        Without an automatic choice the variance is the fit's own mean squared residual.
        """
        fit = self.samples
        scale = self.data.weight.double().square().sum()
        scale = scale / (fit.weight.double().square().sum() / self.system.components)
        if self.choice is not None:
            return float(scale * (self.choice.deviation**-2).mean())
        residual = fit.target.double() - fit.matvec(solution.x.view(self.system.knots.nodes, -1))
        variance = residual.square().sum() / fit.weight.double().square().sum()
        return float(scale / variance.clamp(min=1e-300))

    def solve_all(self, velocities: list[torch.Tensor], tolerance: float, strict: bool) -> list[SplineField]:
        """Fields of several sample sets (n, C) at the same points and weights: one factorisation."""
        prepared = PreparedSystem(self.system)
        factor, fields, members = prepared.factor(), [], []
        for velocity in velocities:
            samples = self.samples
            if not isinstance(samples, VectorRows):
                raise TypeError("several sample sets at once need full vectors")
            fit = samples.with_target(velocity)
            knots, components, damping = self.system.knots, self.system.components, self.system.damping
            system = System(knots, components, [fit, *self.system.blocks[1:]], damping)
            members.append(prepared.with_targets(system))
        # one pass over the factor for all of them: each alone would fetch the whole of it from memory
        starts = factor.solve(torch.stack([member.gradient() for member in members], dim=-1)).unbind(-1)
        for member, start in zip(members, starts, strict=True):
            solution, _ = solve_direct(member, factor=factor, start=start, tolerance=tolerance, strict=strict)
            fields.append(replace(self, system=member.system).field(solution))
        return fields
