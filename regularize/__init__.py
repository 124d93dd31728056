"""B-spline regularisation of velocity samples: arrays in, a callable field out.

Knows numpy, scipy and torch only; walls come in as arrays (:class:`WallRows`).
"""

from .bspline import basis
from .direct import Factor, PreparedSystem, solve_direct
from .errors import InvalidInput, NotConverged
from .field import SplineField
from .knots import Knots
from .krylov import Solution, lsqr
from .operators import CellRows, DirectionRows, DivergenceRows, System, VectorRows
from .smoother import Smoother
from .walls import WallRows

__all__ = [
    "CellRows",
    "DirectionRows",
    "DivergenceRows",
    "Factor",
    "InvalidInput",
    "Knots",
    "NotConverged",
    "PreparedSystem",
    "Smoother",
    "Solution",
    "SplineField",
    "System",
    "VectorRows",
    "WallRows",
    "basis",
    "lsqr",
    "solve_direct",
]
