"""Ensemble filters that know nothing of the model: tensors of members in, tensors of members out.

An ensemble is `(*batch, N, n)`; `predicted (*batch, N, m)` is the observation operator applied to it. Every
filter here is a `Filter`: `analyse(ensemble, predicted, observations, ...) -> Analysis`.

    seen = Observations(value, variance, position=nodes)              # NaN: missing; m = 3 * len(nodes)
    letkf = LETKF(localisation=Localisation(0.01), inflation=RTPS(0.5), gross_error=4.0)
    for time in times:
        ensemble = model(ensemble)                                    # any model that moves (N, n)
        analysis = letkf.analyse(ensemble, operator(ensemble), seen, state_positions=grid)
        record.add(time, analysis, seen)                              # what to believe, and warnings in words
        ensemble = analysis.ensemble

Conventions: inflation factors multiply standard deviations; a localisation radius is where influence ENDS; a
component-major field of vectors gives the position of each node once; random numbers come from an explicit
`torch.Generator`; the algebra of the ensemble is float64 whatever the precision of the state.
"""

from .diagnostics.figure import filter_figure
from .diagnostics.record import FilterRecord
from .diagnostics.scores import (
    InnovationStatistics,
    chi2_band,
    crps,
    desroziers,
    effective_size,
    nees,
    rank_histogram,
    spread_skill,
)
from .distributed import Distributed, gather_members, member_slice
from .error_correlation import gaussian_correlation, redundancy, thin
from .errors import AssimilationError
from .filters.base import Analysis, EnsembleFilter, Filter, GlobalTransform, Transform, check_ensemble
from .filters.enkf import StochasticEnKF
from .filters.etkf import ETKF
from .filters.fixed_lag import FixedLagSmoother
from .filters.hybrid import HybridGain
from .filters.inflation import RTPP, RTPS, Adaptive, Inflation, Multiplicative
from .filters.letkf import LETKF, LocalTransform
from .filters.localisation import Localisation, gaspari_cohn
from .filters.reduced_unscented import ReducedUnscented
from .filters.rotation import random_rotation
from .filters.sigma import SigmaPoints, Simplex, Symmetric, draw_ensemble, draw_points
from .filters.subspace import ErrorSubspace, update_weights, zero_sum_basis
from .filters.unscented import UnscentedFilter, UnscentedUpdate
from .observations import Observations, Reason, Screened, concatenate, count_reasons, screen
from .tuning.error_scale import ErrorScale
from .tuning.failures import Repaired, Replacement, replace_failed
from .tuning.learned_gain import LearnedGain
from .tuning.parameters import Augmentation, Parameter
from .tuning.spread_match import SpreadMatch

__all__ = [
    "ETKF",
    "LETKF",
    "RTPP",
    "RTPS",
    "Adaptive",
    "Analysis",
    "AssimilationError",
    "Augmentation",
    "Distributed",
    "EnsembleFilter",
    "ErrorScale",
    "ErrorSubspace",
    "Filter",
    "FilterRecord",
    "FixedLagSmoother",
    "GlobalTransform",
    "HybridGain",
    "Inflation",
    "InnovationStatistics",
    "LearnedGain",
    "LocalTransform",
    "Localisation",
    "Multiplicative",
    "Observations",
    "Parameter",
    "Reason",
    "ReducedUnscented",
    "Repaired",
    "Replacement",
    "Screened",
    "SigmaPoints",
    "Simplex",
    "SpreadMatch",
    "StochasticEnKF",
    "Symmetric",
    "Transform",
    "UnscentedFilter",
    "UnscentedUpdate",
    "check_ensemble",
    "chi2_band",
    "concatenate",
    "count_reasons",
    "crps",
    "desroziers",
    "draw_ensemble",
    "draw_points",
    "effective_size",
    "filter_figure",
    "gaspari_cohn",
    "gather_members",
    "gaussian_correlation",
    "member_slice",
    "nees",
    "random_rotation",
    "rank_histogram",
    "redundancy",
    "replace_failed",
    "screen",
    "spread_skill",
    "thin",
    "update_weights",
    "zero_sum_basis",
]
