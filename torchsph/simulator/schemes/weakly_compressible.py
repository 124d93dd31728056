"""How a scene is stepped: the options of the weakly compressible scheme and its presets."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from geometry.arguments import checked
from torchsph.pairs.interface import CONTINUITY_FORMS, PRESSURE_FORMS
from torchsph.pairs.smoothing_kernels import kernel

from .parts import XSPH, GammaRamp, Rollback
from .population_control import PopulationControl
from .scheme import Scheme
from .valve_models import Reservoir, ValveOptions
from .wall_models import CompleteKernelWall, WallModel

ORDERS = ("thesis", "symplectic", "verlet", "predictor_corrector")


@checked
@dataclass(frozen=True)
class WeaklyCompressible(Scheme):
    """Weakly compressible SPH with an equation of state; None switches a term off.

    Attributes:
        kernel: name of the smoothing kernel.
        smoothing_ratio: smoothing length h over particle spacing.
        sound_speed: numerical speed of sound, m/s.
        gamma: exponent of the Tait equation (Grønli 2017, eq. 2.25).
        gamma_ramp: how gamma grows after an imposition, or None.
        background_pressure: p0 / rho0 in units of c^2 (0: none).
        hughes_graham: whether the Tait pressure is taken at max(rho, rho0) (Hughes & Graham 2010), which
            cannot pull.
        least_density: over that at rest, below which no particle thins out, or None. A drop in free flight that has
            come under tension spins, thins and is pulled the harder: a pair swings at sqrt(6.6 (1 - r)) c / (h r) for
            a density r, and below r = 1/2 no acoustic step resolves that. Water cavitates long before.
        continuity: "volume" or "mass" (Grønli 2017, eq. 2.19) form of the density rate.
        pressure: form of the pressure force (``MomentumTerms``).
        artificial_viscosity: alpha (Grønli 2017, eq. 2.29), or None.
        laminar_viscosity: whether the viscosity of the scene's fluid acts (Morris et al. 1997).
        density_diffusion: delta of delta-SPH, or None.
        diffusion_form: "plain" (Molteni & Colagrossi 2009) or "corrected" (Antuono et al. 2010: leaves a linear density
            alone, at two more passes a step).
        xsph: velocity smoothing, or None.
        shifting: strength of the particle shifting (Lind et al. 2012 with the speed of the particle), or None.
        bulk_damping: coefficient of a pressure -b c h div v that damps sound, or None.
        shepard_period: steps between filters of the density, or None.
        density_filter: "shepard" (Grønli 2017, eq. 2.20), or "mls", which leaves a linear density alone (Colagrossi &
            Landrini 2003, eqs. 12-14).
        wall: wall model for scenes with walls.
        valve: valve model for scenes with valves; they stay shut with None.
        shifting_speed: the speed in the shifting: "local" (the particle's own) or "largest" (of its member: also
            stagnation points are evened out, which a vortex needs and a jet in a resting chamber does not).
        shifting_surface: h times the concentration gradient above which a particle counts as one of a free surface and
            is not shifted, or None: all are.
        tensile: R of Monaghan's tensile correction (2000; 0.2 there, symmetric pressure form only), or None.
        order: "thesis" steps as Grønli 2017, algorithm 1; "symplectic" evaluates both passes at one position
            (symplectic Euler); "verlet" is the position Verlet scheme, "predictor_corrector" the symplectic
            predictor-corrector, both of second order (``stepping.time_schemes``).
        courant: fraction of the acoustic limit h / (c + v), of h^2/(8 nu) and of sqrt(h / |a|) / 2.
        constant_volume: the fluid fills a volume that never changes (a periodic box, or walls without openings that
            enclose the same volume all the time): its mean density is held, which wanders by percents otherwise.
        step_floor: no step is cut below this fraction of the acoustic limit of the fluid at rest, or None: a single
            runaway particle then cannot stall a run; the record counts the steps that the floor held up.
        rollback: second chances for members that fail, or None: they are frozen at once.
        steps_per_frame: at least so many steps between imposed frames, or None.
        population: how particles that crowd are merged and holes seeded again, or None: neither.
    """

    compressible: ClassVar[bool] = True

    kernel: str = "wendland_c2"
    smoothing_ratio: float = 1.3
    sound_speed: float = 5.0
    gamma: float = 1.0
    background_pressure: float = 0.0
    hughes_graham: bool = False
    least_density: float | None = None
    continuity: str = "volume"
    pressure: str = "switched"
    artificial_viscosity: float | None = 0.02
    laminar_viscosity: bool = True
    density_diffusion: float | None = 0.1
    diffusion_form: str = "plain"
    xsph: XSPH | None = None
    shifting: float | None = 0.5
    shifting_speed: str = "local"
    shifting_surface: float | None = None
    tensile: float | None = None
    bulk_damping: float | None = 0.3
    shepard_period: int | None = None
    density_filter: str = "shepard"
    wall: WallModel = field(default_factory=CompleteKernelWall)
    valve: ValveOptions | None = field(default_factory=Reservoir)
    order: str = "symplectic"
    courant: float = 0.35
    constant_volume: bool = False
    step_floor: float | None = 0.02
    rollback: Rollback | None = None
    steps_per_frame: int | None = None
    population: PopulationControl | None = None
    gamma_ramp: GammaRamp | None = None

    def __post_init__(self) -> None:
        kernel(self.kernel)
        for name in ("smoothing_ratio", "sound_speed", "gamma", "courant"):
            if not getattr(self, name) > 0:
                raise ValueError(f"WeaklyCompressible.{name} must be positive, got {getattr(self, name)}")
        for name in ("artificial_viscosity", "density_diffusion", "shifting", "bulk_damping", "background_pressure"):
            value = getattr(self, name)
            if value is not None and not value >= 0:
                raise ValueError(f"WeaklyCompressible.{name} must not be negative, got {value}")
        for name, known in (
            ("continuity", CONTINUITY_FORMS),
            ("pressure", PRESSURE_FORMS),
            ("order", ORDERS),
            ("shifting_speed", ("local", "largest")),
            ("diffusion_form", ("plain", "corrected")),
            ("density_filter", ("shepard", "mls")),
        ):
            if getattr(self, name) not in known:
                raise ValueError(f"WeaklyCompressible.{name} must be one of {known}, got '{getattr(self, name)}'")
        for name in ("shepard_period", "steps_per_frame"):
            value = getattr(self, name)
            if value is not None and value < 1:
                raise ValueError(f"WeaklyCompressible.{name} must be at least 1 or None, got {value}")
        if self.least_density is not None and not 0 < self.least_density < 1:
            raise ValueError(
                f"WeaklyCompressible.least_density must lie in (0, 1) or be None, got {self.least_density}"
            )
        if self.step_floor is not None and not 0 < self.step_floor < 1:
            raise ValueError(f"WeaklyCompressible.step_floor must lie in (0, 1) or be None, got {self.step_floor}")
        self._check_combinations()

    def _check_combinations(self) -> None:
        """Refuse options that would be accepted and then ignored."""
        if self.tensile is not None and not (self.tensile > 0 and self.pressure == "symmetric"):
            raise ValueError(
                "WeaklyCompressible.tensile must be positive and needs pressure='symmetric', got "
                f"{self.tensile} with '{self.pressure}'"
            )
        if self.xsph is not None and self.xsph.level == "velocity" and self.order != "thesis":
            raise ValueError(
                f"XSPH of level 'velocity' belongs to order 'thesis', got order '{self.order}'; use level 'position'"
            )
        if self.shifting_surface is not None and not (self.shifting_surface > 0 and self.shifting is not None):
            raise ValueError(
                "WeaklyCompressible.shifting_surface must be positive and needs shifting, got "
                f"{self.shifting_surface} with shifting {self.shifting}"
            )
        if self.shepard_period is not None and self.order not in ("thesis", "symplectic"):
            raise ValueError(f"the Shepard filter needs order 'thesis' or 'symplectic', got '{self.order}'")
