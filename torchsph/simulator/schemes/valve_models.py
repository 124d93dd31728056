"""What drives the flow through open valves: the options of the valve models."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Protocol

from geometry.arguments import checked


class ValveOptions(Protocol):
    """What the engine asks of the options of any valve model; ``valves.registry`` knows which model is theirs."""

    @property
    def needs_compressible(self) -> bool:
        """Whether the model needs a fluid with an equation of state."""


@checked
@dataclass(frozen=True)
class PressureSource:
    """A timed pressure source at an open valve, softened inside ``core`` (Grønli 2017, eqs. 3.3 and 3.4).

    The strength Q follows from continuity: the acceleration that changes the flux through the orifice as the volume of
    the cavity demands, spread over a half-sphere around the orifice. ``core`` is in orifice radii.
    """

    core: float = 0.5
    needs_compressible: ClassVar[bool] = True

    def __post_init__(self) -> None:
        if not self.core > 0:
            raise ValueError(f"PressureSource.core must be positive, got {self.core}")


@checked
@dataclass(frozen=True)
class Reservoir:
    """An open valve as an opening with a buffer of particles behind it whose flux follows from dV/dt.

    Attributes:
        profile: "field" (the velocity profile of the imposed field, flat where it has none) or "flat".
        relaxation: time (spacings per reference speed) in which a difference between the particles' volume and the
            cavity's is let through the open valve on top of dV/dt, or None.
        run_out: length (spacings) of free channel between an outlet and its buffer, 0 or more than 1. A scheme that
            projects needs as much as its kernel reaches: no pressure can bring a particle to the speed of a prescribed
            one beside it.
    """

    profile: str = "field"
    run_out: float = 0.0
    relaxation: float | None = 5.0
    needs_compressible: ClassVar[bool] = False

    def __post_init__(self) -> None:
        if self.profile not in ("field", "flat"):
            raise ValueError(f"Reservoir.profile must be 'field' or 'flat', got '{self.profile}'")
        if self.run_out != 0 and not self.run_out > 1:
            raise ValueError(f"Reservoir.run_out must be 0 or more than 1 spacing, got {self.run_out}")
        if self.relaxation is not None and not self.relaxation > 0:
            raise ValueError(f"Reservoir.relaxation must be positive or None, got {self.relaxation}")
