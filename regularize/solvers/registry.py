"""The linear solvers by name: what the option ``solver`` of the smoother may say."""

from .direct import Direct
from .interface import LinearSolver
from .krylov import Krylov, lsqr
from .lsmr import lsmr
from .pcg import NeighbourGradients

AUTO = "auto"  # direct, or LSMR where the factor would not fit

SOLVERS: dict[str, LinearSolver] = {
    "direct": Direct(),
    "direct32": Direct(single=True),
    "lsqr": Krylov(lsqr),
    "lsmr": Krylov(lsmr),
    "pcg": NeighbourGradients(),
}
