"""B-spline regularisation of velocity samples: arrays in, a callable field out.

Knows numpy, scipy and torch only; walls come in as arrays (:class:`WallRows`).
"""

from .block import BlockFactor
from .bspline import basis
from .direct import Factor, PreparedSystem, solve_direct
from .errors import InvalidInput, NotConverged
from .field import SplineField
from .knots import Knots
from .krylov import Solution, lsqr
from .likelihood import Choice
from .lsmr import lsmr
from .operators import CellRows, DirectionRows, DivergenceRows, System, VectorRows
from .pcg import pcg
from .posterior import Posterior
from .sequence import WindowedField, blur_in_time, fit_windows
from .smoother import Smoother
from .sparse import sparse_matrix, sparse_operators
from .walls import WallRows

__all__ = [
    "BlockFactor",
    "CellRows",
    "Choice",
    "DirectionRows",
    "DivergenceRows",
    "Factor",
    "InvalidInput",
    "Knots",
    "NotConverged",
    "Posterior",
    "PreparedSystem",
    "Smoother",
    "Solution",
    "SplineField",
    "System",
    "VectorRows",
    "WallRows",
    "WindowedField",
    "basis",
    "blur_in_time",
    "fit_windows",
    "lsmr",
    "lsqr",
    "pcg",
    "solve_direct",
    "sparse_matrix",
    "sparse_operators",
]
