"""From the files of a lab to recordings, and from recordings to the files of its viewers."""

from .convert import Converted, WallOptions, convert
from .displacement import MotionOptions
from .export import EXPORTS, export
from .field_map import FieldMap, read_field_map
from .labelled_arrays import from_xarray, to_xarray
from .registry import FORMATS, Format
from .source import FormatError
from .writers.sidecar import write_sidecar
from .writers.vtkhdf import PolySeries

__all__ = [
    "EXPORTS",
    "FORMATS",
    "Converted",
    "FieldMap",
    "Format",
    "FormatError",
    "MotionOptions",
    "PolySeries",
    "WallOptions",
    "convert",
    "export",
    "from_xarray",
    "read_field_map",
    "to_xarray",
    "write_sidecar",
]
