"""Numbers that a fitted field should have as well, each a weighted sum of its values: a flux, a mean, a circulation.

One such number ties coefficients all over the field together, so that as a row of the fit it would fill the band of the
normal matrix. With the posterior of a fit at hand it is exact to update its mean instead: of coefficients x with
covariance S, numbers q = G x + e with deviations of e in R make x + S G' (G S G' + R)^-1 (q - G x) (e.g. C. Rasmussen
and C. Williams, Gaussian Processes for Machine Learning, 2006, eq. A.6).
"""

from dataclasses import dataclass

import torch

from regularize.arguments import checked, finite
from regularize.errors import InvalidInput

from .field import SplineField


@checked(points=finite(None, None), rows=finite(None, None), value=finite(None), sigma=finite(None))
@dataclass(frozen=True)
class LinearData:
    """K numbers, the k-th the sum over the points of group k of row . velocity.

    Attributes:
        points: (n, A), m, where the field is defined.
        rows: (n, C), m^2 for fluxes: normals times areas.
        group: (n,) int64, from 0 to K - 1.
        value: (K,), as measured.
        sigma: (K,), standard deviations.

    Raises:
        InvalidInput: shapes that disagree, groups without a number, values that are not finite or negative deviations.
    """

    points: torch.Tensor
    rows: torch.Tensor
    group: torch.Tensor
    value: torch.Tensor
    sigma: torch.Tensor

    def __post_init__(self) -> None:
        count, numbers = len(self.points), len(self.value)
        if len(self.rows) != count or self.group.shape != (count,) or self.sigma.shape != self.value.shape:
            shapes = [tuple(getattr(self, name).shape) for name in ("points", "rows", "group", "value", "sigma")]
            raise InvalidInput(f"LinearData: points, rows, group, value and sigma of {shapes} do not fit each other")
        if bool((self.sigma < 0).any()):
            raise InvalidInput(f"LinearData: sigma must be 0 or more, not {self.sigma.tolist()}")
        if self.group.dtype != torch.int64:
            raise InvalidInput(f"LinearData: group must be of torch.int64, not {self.group.dtype}")
        if count and (int(self.group.min()) < 0 or int(self.group.max()) >= numbers):
            places = f"{int(self.group.min())} to {int(self.group.max())}"
            raise InvalidInput(f"LinearData: group numbers the {numbers} values from 0 on, but runs from {places}")

    def of(self, field: SplineField) -> torch.Tensor:
        """(K,) what a field says they are."""
        each = (self.rows.double() * field(self.points, outside=0.0).double()).sum(1)
        return torch.zeros(len(self.value), dtype=torch.float64).index_add(0, self.group, each)


@checked
def with_linear_data(field: SplineField, data: LinearData) -> SplineField:
    """The field that the numbers make of a fit, each weighed by its error against the fit's own.

    What is returned keeps the fit's posterior, whose deviations are those before the numbers, and so on the large side.

    Args:
        field: of a fit with ``uncertainty=True``.
        data: the numbers.

    Raises:
        InvalidInput: the field keeps no posterior, or the rows are of other components.
    """
    if field.posterior is None or field.factor is None:
        raise InvalidInput("linear data need the posterior of the fit: fit it with uncertainty=True")
    if data.rows.shape[1] != field.components:
        raise InvalidInput(f"linear data of {data.rows.shape[1]} components for a field of {field.components}")
    ordering, posterior = field.posterior.ordering, field.posterior
    supported = field.supported(data.points)
    cell, t = field.knots.locate(data.points[supported].double())
    stencil, nodes = field.knots.stencil(t), field.knots.local_nodes(cell)
    shape = (field.knots.nodes, field.components, len(data.value))
    gather = torch.zeros(shape, dtype=torch.float64)
    each = stencil[:, :, None] * data.rows[supported].double()[:, None, :]
    group = data.group[supported][:, None].expand(nodes.shape)
    gather.permute(0, 2, 1).index_put_((nodes, group), each, accumulate=True)
    spread = posterior.inflation[:, None]
    # the covariance of what is seen: deviations inflated for errors that samples share
    right = gather[ordering.nodes] * spread
    known = field.factor.solve(right) * spread / posterior.precision
    between = torch.einsum("nck,ncl->kl", gather[ordering.nodes], known)
    missing = data.value.double() - data.of(field)
    push = torch.linalg.solve(between + torch.diag(data.sigma.double() ** 2), missing)
    moved = ordering.expand(known @ push)
    coefficients = field.coefficients + moved.T.reshape(field.coefficients.shape).to(field.coefficients)
    return SplineField(
        field.knots,
        coefficients,
        field.covered,
        field.solution,
        field.left_out,
        field.choice,
        posterior,
        field.factor,
    )
