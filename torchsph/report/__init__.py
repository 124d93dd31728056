"""`report.html`: a run's flow in one page that needs nothing but a browser, for those who will not write Python.

Planes over time, curves with their bands, moving pathlines, what is to be thought of the measurement, and what made it.
"""

from .curves import Curve, curves_of
from .quality import Check, measurement_checks
from .write import LARGEST, write_report

__all__ = ["LARGEST", "Check", "Curve", "curves_of", "measurement_checks", "write_report"]
