"""B-spline regularisation of velocity samples: arrays in, a callable field out.

Knows numpy, scipy and torch only; walls come in as arrays (:class:`WallRows`).
"""

from .basis.bspline import basis
from .basis.knots import Knots
from .errors import InvalidInput, NotConverged
from .options import SplineOptions
from .rows.operators import CellRows, DirectionRows, DivergenceRows, System, VectorRows
from .rows.sparse import sparse_matrix, sparse_operators
from .rows.walls import WallRows
from .smoothing.field import SplineField
from .smoothing.linear_data import LinearData, with_linear_data
from .smoothing.sequence import WindowedField, blur_in_time, fit_windows
from .smoothing.smoother import Smoother
from .solvers.block import BlockFactor
from .solvers.direct import solve_direct
from .solvers.factor import Factor
from .solvers.interface import LinearSolver, Solution
from .solvers.krylov import lsqr
from .solvers.lsmr import lsmr
from .solvers.pcg import pcg
from .solvers.prepared import PreparedSystem
from .statistics.likelihood import Choice
from .statistics.posterior import Posterior

__all__ = [
    "BlockFactor",
    "CellRows",
    "Choice",
    "DirectionRows",
    "DivergenceRows",
    "Factor",
    "InvalidInput",
    "Knots",
    "LinearData",
    "LinearSolver",
    "NotConverged",
    "Posterior",
    "PreparedSystem",
    "Smoother",
    "Solution",
    "SplineField",
    "SplineOptions",
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
    "with_linear_data",
]
