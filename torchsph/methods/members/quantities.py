"""What is read out of every member of every frame, computed as the frames come."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

import geometry
from torchsph.haemodynamics.domain import PROBE, DomainFrame, FlowDomain
from torchsph.haemodynamics.pressure import region_mean
from torchsph.haemodynamics.quantities import Catalogue, catalogue
from torchsph.haemodynamics.uncertainty import Summary, summary, unresolved

from .frames import MemberFrame

__all__ = ["MemberCurves", "MemberQuantities", "quantified", "with_pressure"]

Array = NDArray[np.float64]

_NODES_AT_ONCE = 1e6
"""Members are taken in groups of about so many numbers: some 300 MB with all that is derived from them."""


@dataclass(frozen=True)
class MemberCurves:
    """Quantities of an analysis and its members over time.

    Attributes:
        time: `(T,)`, s.
        kind: which quantities they are.
        estimate: of the analysis, by their names, `(T,)`.
        members: of every member, `(N, T)`.
        coarser: of the analysis as the measurement's kernel would show it once more, `(T,)`; None where none is known.
        pressure: `(T, *shape)`, Pa, the simulator's own where there is one, else that of the velocities; its mean at
            the inlet is 0. None in a plane that blood passes through, whose velocities do not give it.
        pressure_sigma: `(T, *shape)`, Pa, standard deviation over the members, and what the kernel takes once more;
            None like it.
    """

    time: Array
    kind: Catalogue
    estimate: dict[str, Array]
    members: dict[str, Array]
    coarser: dict[str, Array] | None
    pressure: NDArray[np.float32] | None
    pressure_sigma: NDArray[np.float32] | None

    def bands(self) -> dict[str, Summary]:
        """Mean, deviation and band of every curve."""
        return _bands(self.estimate, self.members, self.coarser)

    def beat(self) -> dict[str, Array]:
        """Numbers of the beat of the analysis."""
        return self.kind.beat(self.time, self.estimate)

    def beat_bands(self) -> dict[str, Summary]:
        """Mean, deviation and band of the numbers of the beat."""
        coarser = None if self.coarser is None else self.kind.beat(self.time, self.coarser)
        return _bands(self.beat(), self.kind.beat(self.time, self.members), coarser)


class MemberQuantities:
    """Takes frames one at a time and keeps their numbers, and the pressure's field and deviation.

    Args:
        recording: whose masks, walls, valves and fluid they are.
        strict: raise what goes wrong with a frame; else warn of it and read nothing more (``fault``): a frame without
            blood, or walls without an opening, must not cost a run that was not made for its quantities.

    Attributes:
        fault: what went wrong, or None.
    """

    fault: str | None

    def __init__(self, recording: geometry.Recording, *, strict: bool = True) -> None:
        self.strict, self.fault = strict, None
        self.domain = FlowDomain.from_recording(recording)
        self.kind = catalogue(recording.dimension, recording.cut)
        self._sampler = geometry.WallSampler(self.domain.motion, min(self.domain.grid.spacing))
        self._curves: list[Array] = []
        self._coarser: list[Array] = []  # (0 or 1, quantities) each
        self._pressure: list[NDArray[np.float32]] = []
        self._sigma: list[NDArray[np.float32]] = []

    def take(self, frame: MemberFrame) -> None:
        """Compute the quantities of one frame; a frame that comes again takes the place of its first."""
        if self.fault is not None:
            return
        try:
            self._read(frame)
        except (ValueError, RuntimeError) as fault:
            if self.strict:
                raise
            self.fault = str(fault)
            text = f"no quantities are read out: at {self.domain.time[frame.frame]:g} s {fault}"
            warnings.warn(text, RuntimeWarning, stacklevel=2)

    def _read(self, frame: MemberFrame) -> None:
        for kept in (self._curves, self._coarser, self._pressure, self._sigma):
            del kept[frame.frame :]
        if len(self._curves) != frame.frame:
            raise ValueError(f"frame {frame.frame} comes after {len(self._curves)} frames: they must come in order")
        of_frame = self.kind.frame(self.domain, frame.frame, self._sampler)
        velocity, rate = stacked(frame)
        group = max(1, int(_NODES_AT_ONCE / self.domain.grid.size))
        parts = [
            of_frame.of(np.nan_to_num(velocity[k : k + group], posinf=0.0, neginf=0.0), rate[k : k + group])
            for k in range(0, len(velocity), group)
        ]
        curves = np.concatenate([np.stack([p.curves[name] for name in self.kind.units], axis=-1) for p in parts])
        count = 1 + len(frame.members)
        self._curves.append(curves[:count])
        self._coarser.append(curves[count:])
        fields = [p.pressure for p in parts if p.pressure is not None]
        if not fields:
            return
        pressures = np.concatenate([field.astype(np.float32) for field in fields])
        pressures = np.stack([self._gauged(one, of_frame) for one in pressures])
        own = pressures[0]
        if frame.pressure is not None:
            simulated = self._gauged(np.where(np.isfinite(frame.pressure), frame.pressure, own), of_frame)
            own = np.where(np.isfinite(frame.pressure), simulated, own)
        self._pressure.append(own.astype(np.float32))
        spread, lost = pressures[1:count].std(0, ddof=1), (pressures[count:] - pressures[:1]).sum(0)
        self._sigma.append(np.hypot(spread, lost).astype(np.float32))

    def found(self) -> MemberCurves:
        """All that has been found of all frames."""
        if len(self._curves) != len(self.domain.time):
            raise ValueError(f"{len(self._curves)} of {len(self.domain.time)} frames have come: the run did not end")
        curves = np.stack(self._curves)  # (T, 1 + N, quantities)
        names, lost = list(self.kind.units), np.concatenate(self._coarser)
        estimate = {name: curves[:, 0, k] for k, name in enumerate(names)}
        members = {name: curves[:, 1:, k].T for k, name in enumerate(names)}
        coarser = {name: lost[:, k] for k, name in enumerate(names)} if len(lost) == len(curves) else None
        pressure, sigma = (np.stack(fields) if fields else None for fields in (self._pressure, self._sigma))
        return MemberCurves(self.domain.time, self.kind, estimate, members, coarser, pressure, sigma)

    def state(self) -> dict[str, Any]:
        """What a checkpoint has to hold."""
        kept: dict[str, list[Any]] = {name: getattr(self, f"_{name}") for name in self._KEPT}
        tensors = {name: [torch.from_numpy(np.array(each)) for each in values] for name, values in kept.items()}
        return {**tensors, "fault": self.fault}

    def restore(self, state: dict[str, Any]) -> None:
        """Go on from what ``state`` gave."""
        self.fault = state["fault"]
        for name in self._KEPT:
            setattr(self, f"_{name}", [np.asarray(each) for each in state[name]])

    _KEPT = ("curves", "coarser", "pressure", "sigma")

    def _gauged(self, pressure: NDArray[np.floating], of_frame: DomainFrame) -> NDArray[np.float32]:
        """A pressure `(*shape)`, Pa, less its mean around the inlet; 0 outside the mask."""
        if not np.isfinite(of_frame.base).all():
            return np.where(of_frame.mask, pressure, 0.0).astype(np.float32)
        probe = PROBE * min(self.domain.grid.spacing)
        upper = of_frame.base - probe * of_frame.axis
        at_base = region_mean(pressure, of_frame.mask, self.domain.grid, upper, probe)
        return np.where(of_frame.mask, pressure - at_base, 0.0).astype(np.float32)


def stacked(frame: MemberFrame) -> tuple[NDArray[np.floating], NDArray[np.floating]]:
    """Velocities and rates of the estimate, the members and, where it is there, the coarser estimate."""
    velocity = [frame.field[None], frame.members]
    rate = [frame.rate[None], frame.member_rates]
    if frame.coarser is not None and frame.coarser_rate is not None:
        velocity, rate = [*velocity, frame.coarser[None]], [*rate, frame.coarser_rate[None]]
    return np.concatenate(velocity), np.concatenate(rate)


def _bands(
    estimate: Mapping[str, ArrayLike], members: Mapping[str, ArrayLike], coarser: Mapping[str, ArrayLike] | None
) -> dict[str, Summary]:
    """A band for each quantity, as wide as members lie apart and as what they all lack is large."""
    return {
        name: summary(values, unresolved(estimate[name], values, None if coarser is None else coarser[name]))
        for name, values in members.items()
    }


def with_pressure(recording: geometry.Recording, curves: MemberCurves | None) -> geometry.Recording:
    """A recording with the pressure and its deviation that have been read out of it; without any, as it is."""
    if curves is None or curves.pressure is None:
        return recording
    return replace(recording, pressure=curves.pressure, pressure_sigma=curves.pressure_sigma)


def quantified(recording: geometry.Recording, frames: Iterable[MemberFrame]) -> MemberCurves:
    """The curves of an analysis from all of its frames, taken one at a time."""
    quantities = MemberQuantities(recording)
    for frame in frames:
        quantities.take(frame)
    return quantities.found()
