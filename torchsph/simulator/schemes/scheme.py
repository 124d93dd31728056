"""What the options of every scheme tell."""

from __future__ import annotations

from typing import Any, ClassVar

from .parts import XSPH, GammaRamp, Rollback
from .population_control import PopulationControl
from .valve_models import ValveOptions
from .wall_models import WallModel


class Scheme:
    """Base of the schemes' options, which are frozen dataclasses; what has a value here need not be said by a scheme.

    Attributes:
        compressible: whether the fluid has an equation of state, and so a speed of sound that limits the steps.
        changeable: names of the parameters that a run may change (``Simulation.change``); None: all.
        kernel: name of the smoothing kernel.
        smoothing_ratio: smoothing length h over particle spacing.
        laminar_viscosity: whether the viscosity of the scene's fluid acts.
        shifting: strength of the particle shifting, or None.
        shifting_speed: the speed in the shifting: "local" or "largest".
        shifting_surface: h times the concentration gradient above which a particle is not shifted, or None.
        wall: model of the walls.
        valve: model of the valves; they stay shut with None.
        courant: fraction of the limits of the step that is taken.
        steps_per_frame: at least so many steps between imposed frames, or None.
        population: how particles that crowd are merged and holes seeded again, or None: neither.
        max_step: s, longest step, or None.
        longest_step: the same in spacings per reference speed, or None.
        step_floor: smallest step as a fraction of the acoustic limit of the fluid at rest, or None.
        xsph: velocity smoothing, or None.
        gamma_ramp: how gamma grows after an imposition, or None.
        rollback: second chances for members that fail, or None.
    """

    __dataclass_fields__: ClassVar[dict[str, Any]]  # so that ``dataclasses.replace`` takes any scheme

    compressible: ClassVar[bool]
    changeable: ClassVar[tuple[str, ...] | None] = None
    kernel: str
    smoothing_ratio: float
    laminar_viscosity: bool
    shifting: float | None
    shifting_speed: str
    shifting_surface: float | None
    wall: WallModel
    valve: ValveOptions | None
    courant: float
    steps_per_frame: int | None
    population: PopulationControl | None
    max_step: float | None = None
    longest_step: float | None = None
    step_floor: float | None = None
    xsph: XSPH | None = None
    gamma_ramp: GammaRamp | None = None
    rollback: Rollback | None = None

    @property
    def must_fill(self) -> bool:
        """Whether the scheme knows of no free surface, so that the fluid has to fill its walls or its box."""
        return False
