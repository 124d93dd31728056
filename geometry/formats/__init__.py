"""From the files of a lab to recordings, and from recordings to the files of its viewers."""

from .convert import Converted, WallOptions, convert
from .field_map import FieldMap, read_field_map
from .registry import FORMATS, Format
from .source import FormatError

__all__ = ["FORMATS", "Converted", "FieldMap", "Format", "FormatError", "WallOptions", "convert", "read_field_map"]
