"""What in a file is velocity, mask, time and so on, and in which units and order: said by its user.

What can be read from a file is read from it; what is said here goes before it.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np

from geometry.arguments import checked
from geometry.recordings.units import factor

from .source import FormatError, refuse_streams

AXES = set("tcxyz")


@dataclass(frozen=True)
class FieldMap:
    """The meaning of a file's arrays; `None` and "" leave it to the file.

    Attributes:
        velocity: names of the arrays with the components, or of one array with all of them.
        mask: array that is above `mask_threshold` in the blood.
        mask_label: the value of a label image that is blood, instead of the threshold.
        weight: array of confidences from 0 to 1.
        sigma: names of arrays of standard deviations, as `velocity`, in its unit.
        time: array of times, or the times themselves.
        axes: meaning of the axes in array order, as `zyx`, `txyz` or `tczyx`; `auto` tries all orders and
            takes that of least divergence.
        components: what the stored components are, as `x,y,z` or `-y,x,z`.
        image_components: whether components run along the image's own axes instead of its coordinates' axes.
        spacing: lengths along x, y, z (one for all), or the array that holds them.
        origin: place of the first node, x, y, z.
        length_unit: a name (`mm`) or a number of m.
        time_unit: a name (`ms`) or a number of s.
        velocity_unit: a name (`cm/s`) or a number of m/s.
        interval: s between frames.
        period: s; frames without times are spread over one period.
        columns: of a text file of scattered tracks, as `id,x,y,z,u,v,w,-,t`.
        grid_spacing: m, of the grid that tracks, or the inside of a wall, are put on.
        bin: frames of tracks that make one volume; 0 = all of them.
        nyquist: m/s, at which each component wraps.
        cut: whether a plane is cut out of a flow in space.
    """

    velocity: tuple[str, ...] = ()
    mask: str = ""
    mask_threshold: float = 0.5
    mask_label: float | None = None
    weight: str = ""
    sigma: tuple[str, ...] = ()
    time: str | tuple[float, ...] = ""
    axes: str = ""
    components: str = ""
    image_components: bool = False
    spacing: str | tuple[float, ...] = ""
    origin: tuple[float, ...] = ()
    length_unit: str = ""
    time_unit: str = ""
    velocity_unit: str = ""
    interval: float | None = None
    period: float = 0.0
    columns: str = ""
    grid_spacing: float | None = None
    bin: int = 0
    nyquist: float | None = None
    cut: bool = False

    def __post_init__(self) -> None:
        if self.axes and self.axes != "auto":
            letters = set(self.axes)
            if len(letters) != len(self.axes) or not letters <= AXES or not {"x", "y"} <= letters:
                raise FormatError(
                    f"axes: must name each of t, c, x, y, z at most once, x and y always, not {self.axes!r}"
                )
        for name in ("length_unit", "time_unit", "velocity_unit"):
            if getattr(self, name):
                try:
                    factor(getattr(self, name), name.removesuffix("_unit"))
                except ValueError as fault:
                    raise FormatError(f"{name}: {fault}") from fault
        for name in ("interval", "grid_spacing", "nyquist"):
            value = getattr(self, name)
            if value is not None and not 0 < value < float("inf"):
                raise FormatError(f"{name}: must be positive, not {value}")
        if self.period < 0 or self.bin < 0:
            raise FormatError("period and bin: must not be negative")

    def inside(self, values: np.ndarray) -> np.ndarray:
        """Where the values of a mask or of labels mean blood."""
        return values == self.mask_label if self.mask_label is not None else values > self.mask_threshold

    def unit(self, quantity: str) -> float | None:
        """SI units per unit of what is stored, None where the user does not say."""
        text = getattr(self, f"{quantity}_unit")
        return factor(text, quantity) if text else None


@checked
def read_field_map(path: str | Path) -> FieldMap:
    """A field map from a TOML file whose keys are the attributes of `FieldMap`.

    Raises:
        FormatError: no TOML file, or a key or value that is not known.
    """
    path = Path(path)
    refuse_streams([path])
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as fault:
        raise FormatError(f"{path}: is no TOML file ({fault})") from fault
    known = {item.name for item in fields(FieldMap)}
    unknown = sorted(set(content) - known)
    if unknown:
        raise FormatError(f"{path}: unknown key {', '.join(unknown)}; known are {', '.join(sorted(known))}")
    for name, value in content.items():
        if isinstance(value, list):
            content[name] = tuple(value)
        elif name in ("velocity", "sigma"):
            content[name] = (value,)
        elif name == "spacing" and isinstance(value, (int, float)):
            content[name] = (float(value),)
    try:
        return FieldMap(**content)
    except (FormatError, TypeError) as fault:
        raise FormatError(f"{path}: {fault}") from fault
