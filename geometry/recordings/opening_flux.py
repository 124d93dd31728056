"""A volume flux through an opening that somebody has measured, as by Doppler or phase contrast, with its error."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from geometry.arguments import checked

from .errors import RecordingError

GROUP = "/flux"
MOST_REGIONS = 255
# deviation of a flux that states none, as a part of its own RMS: that of flow rates by Doppler or phase contrast
UNSTATED = 0.1
_NAME = re.compile(r"region_([1-9][0-9]{0,2})(_sigma)?")


@checked
@dataclass(frozen=True, eq=False)
class OpeningFlux:
    """The measured flux through the openings of one region together.

    Args:
        region: label of their faces, 1 to 255.
        value: (T,), m^3/s (m^2/s in a plane), positive into the blood, relative to the openings' own motion.
        sigma: (T,), m^3/s, standard deviation; None: ``UNSTATED`` of the flux's RMS.
    """

    region: int
    value: np.ndarray
    sigma: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "value", np.asarray(self.value, np.float64))
        if self.sigma is not None:
            object.__setattr__(self, "sigma", np.asarray(self.sigma, np.float64))
        for name, values in (("value", self.value), ("sigma", self.sigma)):
            if values is not None and values.ndim != 1:
                rule = f"must hold one number a frame, but {name} has the shape {values.shape}"
                raise RecordingError("recording", self.dataset, rule)
        if not 1 <= self.region <= MOST_REGIONS:
            rule = f"names no opening: regions run from 1 to {MOST_REGIONS} (0 is the wall)"
            raise RecordingError("recording", self.dataset, rule)
        self.check("recording")

    @property
    def dataset(self) -> str:
        """Its name in a file."""
        return f"{GROUP}/region_{self.region}"

    @property
    def deviation(self) -> np.ndarray:
        """(T,), m^3/s: the standard deviation, stated or taken for usual."""
        if self.sigma is not None:
            return self.sigma
        return np.full(len(self.value), UNSTATED * float(np.sqrt(np.mean(self.value**2))))

    def arrays(self) -> dict[str, np.ndarray]:
        """Its arrays by the name of their dataset."""
        found = {self.dataset: self.value}
        return found if self.sigma is None else found | {f"{self.dataset}_sigma": self.sigma}

    def select(self, frames: np.ndarray) -> OpeningFlux:
        """The flux at some frames."""
        return replace(self, value=self.value[frames], sigma=None if self.sigma is None else self.sigma[frames])

    def check(self, source: str) -> None:
        """Raise RecordingError where a value is not finite, or a deviation negative."""
        for dataset, values in self.arrays().items():
            if not np.isfinite(values).all():
                raise RecordingError(source, dataset, "must be finite at every frame")
        if self.sigma is not None and (self.sigma < 0).any():
            rule = "is a standard deviation in m^3/s and must not be negative"
            raise RecordingError(source, f"{self.dataset}_sigma", rule)


def is_flux(dataset: str) -> bool:
    """Whether a name under ``/flux`` is that of a measured flux or its deviation."""
    found = _NAME.fullmatch(dataset.removeprefix(f"{GROUP}/"))
    return found is not None and int(found[1]) <= MOST_REGIONS


def fluxes_of(arrays: Mapping[str, np.ndarray]) -> tuple[OpeningFlux, ...]:
    """The fluxes among arrays by dataset, by region.

    Raises:
        RecordingError: a deviation without its flux.
    """
    names = {dataset for dataset in arrays if dataset.startswith(f"{GROUP}/") and is_flux(dataset)}
    for name in sorted(names):
        if name.endswith("_sigma") and name.removesuffix("_sigma") not in names:
            rule = f"is the deviation of {name.removesuffix('_sigma')}, which is missing; store both"
            raise RecordingError("recording", name, rule)
    regions = sorted(int(name.rsplit("_", 1)[1]) for name in names if not name.endswith("_sigma"))
    return tuple(
        OpeningFlux(n, arrays[f"{GROUP}/region_{n}"], arrays.get(f"{GROUP}/region_{n}_sigma")) for n in regions
    )


def check_distinct(fluxes: Sequence[OpeningFlux]) -> None:
    """Raise RecordingError where two fluxes are of one region."""
    regions = [flux.region for flux in fluxes]
    double = sorted({region for region in regions if regions.count(region) > 1})
    if double:
        raise RecordingError("recording", f"{GROUP}/region_{double[0]}", "is given twice; one flux for each region")
