"""Ensemble filters that know nothing of the model: tensors of members in, tensors of members out.

An ensemble is `(*batch, N, n)`; `predicted (*batch, N, m)` is the observation operator applied to it. Every
filter here is a `Filter`: `analyse(ensemble, predicted, observations, ...) -> Analysis`.
"""

from .enkf import StochasticEnKF
from .errors import AssimilationError
from .etkf import ETKF
from .filters import Analysis, EnsembleFilter, Filter, GlobalTransform, Transform, check_ensemble
from .inflation import RTPP, RTPS, Adaptive, Inflation, Multiplicative
from .letkf import LETKF, LocalTransform
from .localisation import Localisation, gaspari_cohn
from .observations import Observations, Reason, Screened, concatenate, count_reasons, screen
from .rotation import random_rotation
from .subspace import ErrorSubspace, update_weights, zero_sum_basis

__all__ = [
    "ETKF",
    "LETKF",
    "RTPP",
    "RTPS",
    "Adaptive",
    "Analysis",
    "AssimilationError",
    "EnsembleFilter",
    "ErrorSubspace",
    "Filter",
    "GlobalTransform",
    "Inflation",
    "LocalTransform",
    "Localisation",
    "Multiplicative",
    "Observations",
    "Reason",
    "Screened",
    "StochasticEnKF",
    "Transform",
    "check_ensemble",
    "concatenate",
    "count_reasons",
    "gaspari_cohn",
    "random_rotation",
    "screen",
    "update_weights",
    "zero_sum_basis",
]
