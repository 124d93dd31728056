"""The numbers of a scheme that may differ between members and change between steps, and their internal form."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor

from geometry.arguments import shown

from ..schemes.parts import GammaRamp
from ..schemes.scheme import Scheme
from ..state.units import Units

# parameters that a scheme cannot do without; the others are switched off by None
_NEEDED = ("sound_speed", "gamma", "smoothing_ratio", "courant", "valve_strength")


@dataclass(frozen=True)
class Parameters:
    """Numbers of a run; each is a float for all members, or a tensor (members,) with one for each.

    Attributes:
        sound_speed: m/s; None in an incompressible scheme.
        gamma: exponent of the Tait equation; None in an incompressible scheme.
        smoothing_ratio: h over the particle spacing.
        courant: fraction of the limits of the time step.
        background_pressure: as in ``WeaklyCompressible``.
        artificial_viscosity: as in ``WeaklyCompressible``.
        density_diffusion: as in ``WeaklyCompressible``.
        shifting: as in ``WeaklyCompressible``.
        bulk_damping: as in ``WeaklyCompressible``.
        xsph: epsilon of the scheme's XSPH.
        viscosity: dynamic, Pa s.
        valve_strength: factor on what drives the flow through open valves: on the strength Q of pressure sources
            (Grønli 2017, eq. 3.4), on fluxes that valves are given, and on differences between the pressures that
            they are given. The flux of other valves follows from the walls' motion, which leaves nothing to be set.
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
    def of(cls, scheme: Scheme, viscosity: float) -> Parameters:
        """What a scheme says, for a fluid of dynamic ``viscosity`` (Pa s)."""
        others = ("xsph", "viscosity", "valve_strength")
        given: dict[str, Any] = {f.name: getattr(scheme, f.name, None) for f in fields(cls) if f.name not in others}
        return cls(
            **given,
            xsph=None if scheme.xsph is None else scheme.xsph.epsilon,
            viscosity=viscosity if scheme.laminar_viscosity else None,
        )

    def changed(self, like: Tensor, members: int, **values: float | Sequence[float] | Tensor | None) -> Parameters:
        """A copy with some values replaced.

        Args:
            like: whose type and device rows of one value a member get.
            members: number of members.
            **values: by name, each a number, a row (members,), or None to switch a term off.

        Raises:
            ValueError: an unknown name, a number that cannot be, or rows of another length than ``members``.
            TypeError: no number at all.
        """
        known = [f.name for f in fields(self)]
        for name in values:
            if name not in known:
                raise ValueError(f"unknown parameter '{name}'; known: {', '.join(known)}")
        checked = {name: _checked(name, value, like, members) for name, value in values.items()}
        return Parameters(**{**vars(self), **checked})


def _checked(
    name: str, value: float | Sequence[float] | Tensor | None, like: Tensor, members: int
) -> float | Tensor | None:
    if value is None:
        if name in _NEEDED:
            raise ValueError(f"parameter '{name}' cannot be switched off")
        return None
    try:
        row = torch.as_tensor(value, dtype=like.dtype, device=like.device)
    except (TypeError, ValueError, RuntimeError, OverflowError) as fault:
        raise TypeError(f"parameter '{name}' must be a number, or one for each member, got {shown(value)}") from fault
    if row.ndim and row.shape != (members,):
        raise ValueError(f"parameter '{name}' needs one value, or {members} for the members, got {tuple(row.shape)}")
    fine = row > 0 if name in _NEEDED else row >= 0
    if not bool((fine & torch.isfinite(row)).all()):
        wanted = "positive" if name in _NEEDED else "not negative"
        raise ValueError(f"parameter '{name}' must be {wanted} and finite, got {row.tolist()}")
    if row.requires_grad:
        return row.expand(members)
    return row if isinstance(value, Sequence) or row.ndim else float(value)


@dataclass(frozen=True)
class Coefficients:
    """Parameters in internal units: floats, or tensors (members,); a term that is None is not computed.

    Attributes:
        sound_speed: None in an incompressible scheme; see ``sound``.
        gamma: None in an incompressible scheme; see ``exponent``.
        smoothing_length: h.
        courant: fraction of the limits of the time step.
        background: pressure p0 / rho0 in units of the squared sound speed.
        artificial: alpha c of the artificial viscosity.
        diffusion: delta of the density's diffusion.
        shifting: strength A of the shifting.
        bulk_damping: coefficient b of the pressure that damps sound.
        xsph: epsilon.
        viscosity: kinematic.
    """

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

    @property
    def sound(self) -> float | Tensor:
        """The speed of sound, internal, of a scheme that has one."""
        if self.sound_speed is None:
            raise ValueError("an incompressible scheme has no speed of sound")
        return self.sound_speed

    @property
    def exponent(self) -> float | Tensor:
        """Gamma of the equation of state, of a scheme that has one."""
        if self.gamma is None:
            raise ValueError("an incompressible scheme has no equation of state, and so no gamma")
        return self.gamma

    @classmethod
    def of(cls, parameters: Parameters, units: Units, density: float) -> Coefficients:
        """Parameters in internal units.

        Args:
            parameters: of the run.
            units: of length and speed.
            density: of the fluid at rest, kg/m^3.
        """
        p = parameters
        viscosity = _acting(p.viscosity)
        if viscosity is not None:
            viscosity = viscosity / density / units.kinematic_viscosity
        sound = None if p.sound_speed is None else p.sound_speed / units.speed
        artificial = _acting(p.artificial_viscosity)
        if artificial is not None and sound is not None:
            artificial = artificial * sound
        return cls(
            sound_speed=sound,
            gamma=p.gamma,
            smoothing_length=p.smoothing_ratio,
            courant=p.courant,
            background=_acting(p.background_pressure),
            artificial=artificial,
            diffusion=p.density_diffusion,
            shifting=p.shifting,
            bulk_damping=p.bulk_damping,
            xsph=p.xsph,
            viscosity=viscosity,
        )

    def ramped(self, ramp: GammaRamp, elapsed: Tensor) -> Coefficients:
        """With gamma as it is some time after an imposition.

        Args:
            ramp: how gamma grows.
            elapsed: (members,), since the imposition, in the unit of the ramp's duration.
        """
        progress = (elapsed / ramp.duration).clamp(0.0, 1.0)
        final = torch.as_tensor(self.exponent, dtype=progress.dtype, device=progress.device)
        gamma = ramp.start + progress * (final - ramp.start)
        if ramp.keep == "sound_speed":
            return replace(self, gamma=gamma)
        softer = torch.sqrt(gamma / final)
        artificial = None if self.artificial is None else self.artificial * softer
        return replace(self, gamma=gamma, sound_speed=self.sound * softer, artificial=artificial)


def _acting(value: float | Tensor | None) -> float | Tensor | None:
    """None for a coefficient that is zero for every member, which then costs nothing."""
    if value is None or (not isinstance(value, Tensor) and value == 0):
        return None
    return value
