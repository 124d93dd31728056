"""Which rivals there are, what was tried for their settings, and what was found best on the tuning ventricle."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import product
from typing import Any

import numpy as np

from ..provenance import ROOT
from .methods import denoiser, gaussian, ivfm, leray, pinn, siren, smoothn, temporal


@dataclass(frozen=True)
class Rival:
    """A method.

    Attributes:
        fit: of a recording and settings, returns (T, 3, *shape), m/s.
        source: whose idea it is.
        tried: values of each setting that `--tune` tries, all combinations.
        fixed: settings that are not tuned.
        learns: whether it learns from other flows when it is first called; the seconds of that do not count.
    """

    fit: Callable[..., np.ndarray]
    source: str
    tried: dict[str, tuple[Any, ...]] = field(default_factory=dict)
    fixed: dict[str, Any] = field(default_factory=dict)
    learns: bool = False

    def combinations(self) -> list[dict[str, Any]]:
        """All settings that are tried."""
        return [dict(zip(self.tried, values, strict=True)) for values in product(*self.tried.values())]


RIVALS: dict[str, Rival] = {
    "gaussian": Rival(gaussian.fit, "common practice", {"fwhm": (1e-3, 2e-3, 3e-3, 4e-3, 5e-3), "power": (1.0, 2.0)}),
    "smoothn": Rival(smoothn.fit, "Garcia 2010; PyMUST", {"strength": (None, 4.0), "power": (1.0, 2.0)}),
    "leray": Rival(leray.fit, "Helmholtz-Leray projection", {"fwhm": (1e-3, 2e-3, 3e-3, 4e-3), "power": (1.0, 2.0)}),
    "ivfm": Rival(
        ivfm.fit,
        "constrained least squares, after Vixege et al. 2021",
        {"smoothness": (0.25, 0.5, 1.0, 2.0), "divergence": (10.0,), "wall": (3.0,), "power": (1.0,)},
    ),
    "gaussian over time": Rival(
        temporal.fit,
        "common practice",
        {"width": (5e-3, 1e-2), "fwhm": (2e-3, 3e-3, 4e-3), "power": (1.0,)},
        {"on": gaussian.fit},
    ),
    "leray over time": Rival(
        temporal.fit,
        "Helmholtz-Leray projection and a Gaussian over time",
        {"width": (5e-3, 1e-2), "fwhm": (2e-3, 3e-3, 4e-3), "power": (1.0,)},
        {"on": leray.fit},
    ),
    "ivfm over time": Rival(
        temporal.fit,
        "constrained least squares and a Gaussian over time",
        {"width": (5e-3, 1e-2), "smoothness": (1.0, 2.0), "divergence": (10.0,), "wall": (3.0,)},
        {"on": ivfm.fit},
    ),
    "denoiser": Rival(
        denoiser.fit,
        "convolutions trained on simulated flows",
        {"flows": (4,), "steps": (300,)},
        {"kept": ROOT / "examples" / "rivals" / "results" / "kept"},
        learns=True,
    ),
    "siren": Rival(
        siren.fit,
        "neural field as a curl, after DAF-FlowNet (arXiv 2604.00205)",
        # of frequencies 2, 4, 8, 12 and walls 1, 0.1, on eight frames of the tuning ventricle
        {"frequency": (8.0,), "wall": (0.1,)},
    ),
    "pinn": Rival(
        pinn.fit,
        "physics-informed network, after Ling et al. 2024",
        # of frequencies 3, 5, 8, walls 1, 0.1 and masses 0.1, 0.01, likewise
        {"frequency": (8.0,), "wall": (0.1,), "mass": (0.01,)},
    ),
}
