"""The numbers of a scheme that may differ between members and change between steps, and their internal form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from ..scene import Fluid
from ..schemes.projection import Projection
from ..schemes.weakly_compressible import GammaRamp, WeaklyCompressible
from ..state.units import Units

# parameters that a scheme cannot do without; the others are switched off by None
_NEEDED = ("sound_speed", "gamma", "smoothing_ratio", "courant", "valve_strength")


@dataclass(frozen=True)
class Parameters:
    """Numbers of a run; each is a float for all members, or a tensor (members,) with one for each.

    Attributes:
        sound_speed: m/s. gamma: exponent of the Tait equation; both None in an incompressible scheme.
        smoothing_ratio: h over the particle spacing.
        courant, background_pressure, artificial_viscosity, density_diffusion, shifting, bulk_damping: as in
            ``WeaklyCompressible``.
        xsph: epsilon of the scheme's XSPH. viscosity: dynamic, Pa s.
        valve_strength: factor on what drives the flow through open valves: on the strength Q of pressure sources
            (thesis 3.4), and on differences between the pressures that valves are given. The flux of other valves
            follows from the walls' motion, which leaves nothing to be set.
    """

    sound_speed: float | Tensor | None
    gamma: float | Tensor | None
    smoothing_ratio: float | Tensor
    courant: float | Tensor
    background_pressure: float | Tensor | None = None
    artificial_viscosity: float | Tensor | None = None
    density_diffusion: float | Tensor | None = None
    shifting: float | Tensor | None = None
    bulk_damping: float | Tensor | None = None
    xsph: float | Tensor | None = None
    viscosity: float | Tensor | None = None
    valve_strength: float | Tensor = 1.0

    @classmethod
    def of(cls, scheme: WeaklyCompressible | Projection, fluid: Fluid) -> Parameters:
        """What a scheme and a fluid say."""
        others = ("xsph", "viscosity", "valve_strength")
        given = {f.name: getattr(scheme, f.name) for f in fields(cls) if f.name not in others}
        return cls(
            **given,
            xsph=None if scheme.xsph is None else scheme.xsph.epsilon,
            viscosity=fluid.viscosity if scheme.laminar_viscosity else None,
        )

    def changed(self, like: Tensor, members: int, **values: float | Sequence[float] | Tensor | None) -> Parameters:
        """A copy with some values replaced; rows of one value a member become tensors of the type of ``like``.

        Raises:
            ValueError: an unknown name, a number that cannot be, or rows of another length than ``members``.
        """
        known = [f.name for f in fields(self)]
        for name in values:
            if name not in known:
                raise ValueError(f"unknown parameter '{name}'; known: {', '.join(known)}")
        return replace(self, **{name: _checked(name, value, like, members) for name, value in values.items()})


def _checked(
    name: str, value: float | Sequence[float] | Tensor | None, like: Tensor, members: int
) -> float | Tensor | None:
    if value is None:
        if name in _NEEDED:
            raise ValueError(f"parameter '{name}' cannot be switched off")
        return None
    row = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    if row.ndim and row.shape != (members,):
        raise ValueError(f"parameter '{name}' needs one value, or {members} for the members, got {tuple(row.shape)}")
    fine = row > 0 if name in _NEEDED else row >= 0
    if not bool((fine & torch.isfinite(row)).all()):
        wanted = "positive" if name in _NEEDED else "not negative"
        raise ValueError(f"parameter '{name}' must be {wanted} and finite, got {row.tolist()}")
    return row if row.ndim else float(value)


@dataclass(frozen=True)
class Coefficients:
    """Parameters in internal units: floats, or tensors (members,); a term that is None is not computed."""

    sound_speed: float | Tensor | None
    gamma: float | Tensor | None
    smoothing_length: float | Tensor
    courant: float | Tensor
    background: float | Tensor | None
    artificial: float | Tensor | None
    diffusion: float | Tensor | None
    shifting: float | Tensor | None
    bulk_damping: float | Tensor | None
    xsph: float | Tensor | None
    viscosity: float | Tensor | None

    @classmethod
    def of(cls, parameters: Parameters, units: Units, density: float) -> Coefficients:
        """``parameters`` in units of length and speed, for a fluid of ``density`` (kg/m^3)."""
        p = parameters
        viscosity = _acting(p.viscosity)
        if viscosity is not None:
            viscosity = viscosity / density / units.kinematic_viscosity
        sound = None if p.sound_speed is None else p.sound_speed / units.speed
        artificial = _acting(p.artificial_viscosity)
        return cls(
            sound_speed=sound,
            gamma=p.gamma,
            smoothing_length=p.smoothing_ratio,
            courant=p.courant,
            background=_acting(p.background_pressure),
            artificial=None if artificial is None else artificial * sound,
            diffusion=p.density_diffusion,
            shifting=p.shifting,
            bulk_damping=p.bulk_damping,
            xsph=p.xsph,
            viscosity=viscosity,
        )

    def ramped(self, ramp: GammaRamp, elapsed: Tensor) -> Coefficients:
        """With gamma as it is ``elapsed`` (members,) after the imposition, in the unit of the ramp's duration."""
        share = (elapsed / ramp.duration).clamp(0.0, 1.0)
        final = torch.as_tensor(self.gamma, dtype=share.dtype, device=share.device)
        gamma = ramp.start + share * (final - ramp.start)
        if ramp.keep == "sound_speed":
            return replace(self, gamma=gamma)
        softer = torch.sqrt(gamma / final)
        artificial = None if self.artificial is None else self.artificial * softer
        return replace(self, gamma=gamma, sound_speed=self.sound_speed * softer, artificial=artificial)


def _acting(value: float | Tensor | None) -> float | Tensor | None:
    """None for a coefficient that is zero for every member, which then costs nothing."""
    if value is None or (not isinstance(value, Tensor) and value == 0):
        return None
    return value
