"""Is the ensemble as wrong as it says? Scores of one cycle, with a truth or with the innovations alone.

Members come first, `(N, *shape)`, and everything is float64 inside. All scores assume nothing of the model.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ..errors import AssimilationError

# the median of chi^2 with one degree of freedom: half of all squares of standard normal numbers lie below it
CHI2_MEDIAN = 0.454936423119572


def crps(members: Tensor, truth: Tensor, *, fair: bool = False) -> Tensor:
    """Continuous ranked probability score `(*shape)`, in the unit of the variable; smaller is better.

    `E|x - y| - E|x - x'| / 2` over members x, x' and truth y (Gneiting & Raftery 2007, JASA 102, eq. 21). The
    second mean is taken over N^2 pairs, or over the N (N - 1) distinct ones if `fair`, which makes ensembles
    of different size comparable (Ferro 2014).
    """
    size = members.shape[0]
    ordered = torch.sort(members.double(), dim=0).values
    distance = (ordered - truth.double()).abs().mean(0)
    # sum over pairs |x_i - x_j| = 2 sum_i (2 i - N + 1) x_(i), i = 0 ... N - 1
    factor = 2.0 * torch.arange(size, dtype=torch.float64, device=members.device) - size + 1
    pairs = 2 * torch.tensordot(factor, ordered, dims=1)
    return distance - pairs / (2 * size * (size - 1 if fair else size))


def rank_histogram(
    members: Tensor,
    verification: Tensor,
    generator: torch.Generator,
    *,
    variance: Tensor | float = 0.0,
) -> Tensor:
    """`(N + 1,)` counts of the verification's rank among the members; flat when the ensemble is reliable.

    `verification (*shape)` is a truth, or observations whose error `variance` is then added to the members as
    noise (Hamill 2001, Mon. Wea. Rev. 129). Ties are broken at random. U-shaped: too little spread.
    """
    wide = members.double()
    noise = torch.randn(wide.shape, generator=generator, dtype=torch.float64, device=generator.device)
    sigma = torch.as_tensor(variance, dtype=torch.float64, device=wide.device).sqrt()
    wide = wide + noise.to(wide.device) * sigma
    below = (wide < verification.double()).sum(0)
    equal = (wide == verification.double()).sum(0)
    draw = torch.rand(equal.shape, generator=generator, dtype=torch.float64, device=generator.device)
    rank = below + (draw.to(wide.device) * (equal + 1)).long()
    valid = torch.isfinite(verification)
    return torch.bincount(rank[valid], minlength=members.shape[0] + 1)


def spread_skill(members: Tensor, truth: Tensor) -> tuple[float, float]:
    """RMS spread and RMS error of the mean over all numbers.

    The spread carries the factor sqrt((N + 1) / N) that makes the two equal in expectation when truth and
    members come from one distribution (Fortin et al. 2014, J. Hydrometeorol. 15, 1708).
    """
    wide, size = members.double(), members.shape[0]
    spread = (wide.var(0).mean() * (size + 1) / size).sqrt()
    error = (wide.mean(0) - truth.double()).square().mean().sqrt()
    return spread.item(), error.item()


def effective_size(members: Tensor) -> float:
    """Effective number of independent directions, `(sum l)^2 / sum l^2` over the covariance's eigenvalues l.

    Between 0 (collapsed), 1 (all members on a line) and N - 1.
    """
    flat = members.double().flatten(1)
    anomalies = flat - flat.mean(0)
    gram = anomalies @ anomalies.T
    total = gram.trace().square()
    return (total / gram.square().sum()).item() if total > 0 else 0.0


def nees(error: Tensor, covariance: Tensor) -> Tensor:
    """Normalised estimation error squared, `e' P^-1 e`, `(*batch,)`; chi^2 with n degrees of freedom."""
    scaled = torch.linalg.solve(covariance.double(), error.double().unsqueeze(-1)).squeeze(-1)
    return (error.double() * scaled).sum(-1)


def chi2_band(degrees: int, probability: float = 0.95) -> tuple[float, float]:
    """Two-sided band of a chi^2 variable over its degrees of freedom: where a mean NEES or NIS should lie.

    For the mean of R independent runs of dimension n the degrees are R n and the band is to be multiplied by
    n (Bar-Shalom, Li & Kirubarajan 2001, section 5.4).
    """
    from scipy.stats import chi2

    if degrees < 1 or not 0 < probability < 1:
        raise AssimilationError(f"chi2_band needs degrees >= 1 and 0 < probability < 1, got {degrees}")
    low, high = chi2.ppf([(1 - probability) / 2, (1 + probability) / 2], degrees)
    return float(low / degrees), float(high / degrees)


def desroziers(innovation: Tensor, residual: Tensor) -> tuple[float, float]:
    """Mean observation-error and forecast-error variance that the statistics imply.

    With d_b the innovation and d_a the analysis residual (both observation minus prediction, NaN ignored),
    `E d_a d_b = R` and `E (d_b - d_a) d_b = H P H'` if the gain is right (Desroziers et al. 2005, QJRMS 131,
    eqs. 1 and 2). Comparing R with the assumed variance says which of the two is wrong.
    """
    both = torch.isfinite(innovation) & torch.isfinite(residual)
    before, after = innovation[both].double(), residual[both].double()
    return (after * before).mean().item(), ((before - after) * before).mean().item()


@dataclass(frozen=True)
class InnovationStatistics:
    """Normalised innovations of a set of observations: about N(0, 1) where all errors are stated rightly.

    `count` used observations, worth `independent` ones; `mean`; `ratio` the RMS; `tolerance` the standard
    deviation of `ratio` if all is well.
    """

    count: int
    independent: float
    mean: float
    ratio: float
    tolerance: float

    @classmethod
    def of(cls, normalised: Tensor, redundancy: Tensor | float = 1.0) -> InnovationStatistics:
        """From normalised innovations `(m,)` (NaN ignored) and the redundancy of the observations."""
        finite = torch.isfinite(normalised)
        value = normalised[finite].double()
        share = torch.as_tensor(redundancy, dtype=torch.float64, device=value.device)
        independent = (1 / share.expand(normalised.shape)[finite]).sum().item()
        if not len(value):
            return cls(0, 0.0, float("nan"), float("nan"), float("inf"))
        ratio = value.square().mean().sqrt().item()
        # The variance of chi^2_k / k is 2 / k, that of its root near 1 is half of it over k.
        return cls(len(value), independent, value.mean().item(), ratio, (0.5 / independent) ** 0.5)

    def verdict(self, *, margin: float = 0.15) -> str | None:
        """In words what is wrong, or None. A deviation counts beyond `margin` and three tolerances."""
        allowed = max(margin, 3 * self.tolerance)
        if not self.count or abs(self.ratio - 1) <= allowed:
            return None
        if self.ratio > 1:
            return (
                f"overconfident: innovations are {self.ratio:.2g} times as large as the stated errors allow; "
                "the observations are noisier than said, or the ensemble has too little spread"
            )
        return (
            f"underconfident: innovations are only {self.ratio:.2g} of what the stated errors allow; "
            "the observations are better than said, or the ensemble has too much spread"
        )
