"""Options of the incompressible scheme."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from geometry.arguments import checked
from torchsph.pairs.smoothing_kernels import kernel

from .population_control import PopulationControl
from .scheme import Scheme
from .valve_models import Reservoir, ValveOptions
from .wall_models import CompleteKernelWall, WallModel


@checked
@dataclass(frozen=True)
class Projection(Scheme):
    """Incompressible SPH by pressure projection (Cummins & Rudman 1999); None switches a term off.

    The step is limited by the flow's speed instead of that of sound.

    Attributes:
        kernel: name of the smoothing kernel.
        smoothing_ratio: smoothing length h over particle spacing.
        laminar_viscosity: whether the viscosity of the scene's fluid acts, explicitly (Morris et al. 1997).
        shifting: strength, as in ``WeaklyCompressible``.
        shifting_speed: as there.
        shifting_surface: as there.
        relaxation: time in which a particle's excess of number density is let out through the source of the pressure
            (after Khayyer & Gotoh 2011), in spacings per reference speed, or None: left to the shifting alone.
        surface: filling of the kernel below which a particle counts as one of a free surface and has pressure 0, or
            None: the fluid fills its walls, or its periodic box, and pressure is determined up to a constant.
        tolerance: of the residual relative to the source.
        iterations: at most, per solve.
        wall: model for scenes with walls.
        valve: model for scenes with valves; they stay shut with None.
        courant: fraction of the limits h / v, h^2 / (8 nu) and sqrt(h / |a|) / 2.
        max_step: s, or None.
        longest_step: longest step in spacings per reference speed, or None: what particles resolve in time goes with
            what they resolve in space.
        steps_per_frame: at least so many steps between imposed frames, or None.
        population: how particles that crowd are merged and holes seeded again, or None: neither.
    """

    compressible: ClassVar[bool] = False
    changeable: ClassVar[tuple[str, ...]] = ("shifting", "courant", "viscosity", "valve_strength")

    kernel: str = "wendland_c2"
    smoothing_ratio: float = 1.3
    laminar_viscosity: bool = True
    shifting: float | None = 2.0
    shifting_speed: str = "largest"
    shifting_surface: float | None = None
    relaxation: float | None = 2.0
    surface: float | None = None
    tolerance: float = 2e-2
    iterations: int = 200
    wall: WallModel = field(default_factory=CompleteKernelWall)
    valve: ValveOptions | None = field(default_factory=lambda: Reservoir(run_out=3.0))
    courant: float = 0.27
    max_step: float | None = 5e-4
    longest_step: float | None = None
    steps_per_frame: int | None = None
    population: PopulationControl | None = None

    def __post_init__(self) -> None:
        kernel(self.kernel)
        for name in ("smoothing_ratio", "courant", "tolerance"):
            if not getattr(self, name) > 0:
                raise ValueError(f"Projection.{name} must be positive, got {getattr(self, name)}")
        for name in ("shifting", "shifting_surface", "relaxation", "max_step", "longest_step"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise ValueError(f"Projection.{name} must be positive or None, got {value}")
        if self.iterations < 1 or (self.steps_per_frame is not None and self.steps_per_frame < 1):
            raise ValueError(
                f"Projection needs at least one iteration and step, got {self.iterations}, {self.steps_per_frame}"
            )
        if self.surface is not None and not 0 < self.surface < 1:
            raise ValueError(f"Projection.surface must lie in (0, 1) or be None, got {self.surface}")
        if self.shifting_speed not in ("local", "largest"):
            raise ValueError(f"Projection.shifting_speed must be 'local' or 'largest', got '{self.shifting_speed}'")
        for name, kind in (("wall", "CompleteKernelWall"), ("valve", "Reservoir or None")):
            model = getattr(self, name)
            if getattr(model, "needs_compressible", True) and not (name == "valve" and model is None):
                raise ValueError(
                    f"Projection.{name} must be a {kind}: the others act through the equation of state; got {model}"
                )

    @property
    def must_fill(self) -> bool:
        """Whether the pressure is that of a fluid without a free surface."""
        return self.surface is None
