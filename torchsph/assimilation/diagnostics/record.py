"""The running account of a filter: numbers per cycle, totals, and warnings in words."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ..filters.base import Analysis
from ..observations import Observations
from .scores import InnovationStatistics, crps, effective_size, rank_histogram, spread_skill


@dataclass
class FilterRecord:
    """Feed `add` once a cycle; `summary` is ready for a JSON file. For experiments without batch dimensions.

    Attributes:
        seed: of the random ties in the rank histogram.
        cycles: one dictionary of numbers per cycle.
    """

    seed: int = 0
    cycles: list[dict] = field(default_factory=list)
    _histogram: Tensor | None = None
    _innovations: dict[str, list[tuple[Tensor, Tensor]]] = field(default_factory=dict)
    _warnings: dict[str, int] = field(default_factory=dict)

    def add(
        self,
        time: float,
        analysis: Analysis,
        observations: Observations,
        *,
        regions: Mapping[str, Tensor] | None = None,
        forecast: Tensor | None = None,
        truth: Tensor | None = None,
    ) -> None:
        """Record a cycle.

        Args:
            time: of the cycle, s.
            regions: named boolean masks `(m,)` over the observations; all of them are always recorded.
            forecast: `(N, k)` forecast members at the numbers that are verified, and
            truth: `(k,)` the truth there; with both, spread, skill, CRPS and ranks are recorded too.
        """
        used = analysis.reason == 0
        cycle = {
            "time": float(time),
            "spread_before": float(analysis.spread_before),
            "spread_after": float(analysis.spread_after),
            "signal": float(analysis.signal),
            "prior_factor": float(analysis.prior_factor),
            "effective_size": effective_size(analysis.ensemble),
            "observations": analysis.counts(),
        }
        masks = {"all": torch.ones_like(used), **(regions or {})}
        normalised = analysis.normalised_innovation()
        redundancy = torch.as_tensor(observations.redundancy, dtype=torch.float64, device=used.device)
        redundancy = redundancy.expand(normalised.shape)
        cycle["innovations"] = {
            name: self._innovation(name, normalised, redundancy, used & mask) for name, mask in masks.items()
        }
        if forecast is not None and truth is not None:
            cycle |= self._verify(forecast, truth)
        for words in analysis.warnings:
            self._warnings[words] = self._warnings.get(words, 0) + 1
        self.cycles.append(cycle)

    def state(self) -> dict:
        """What a checkpoint has to hold."""
        return {
            "cycles": list(self.cycles),
            "histogram": self._histogram,
            "warnings": dict(self._warnings),
            "innovations": {name: list(parts) for name, parts in self._innovations.items()},
        }

    def restore(self, state: dict) -> None:
        """Go on from what ``state`` gave."""
        self.cycles, self._histogram = list(state["cycles"]), state["histogram"]
        self._warnings = dict(state["warnings"])
        self._innovations = {name: list(parts) for name, parts in state["innovations"].items()}

    def statistics(self) -> dict[str, InnovationStatistics]:
        """Normalised innovations of all cycles together, per region."""
        return {
            name: InnovationStatistics.of(*(torch.cat(parts) for parts in zip(*entries, strict=True)))
            for name, entries in self._innovations.items()
        }

    def warnings(self) -> list[str]:
        """What the cycles complained of, and what their totals reveal."""
        words = [f"{text} ({count} of {len(self.cycles)} cycles)" for text, count in self._warnings.items()]
        for name, statistics in self.statistics().items():
            verdict = statistics.verdict()
            if verdict:
                words.append(f"{name}: {verdict}")
        ratio = self._spread_over_skill()
        if ratio is not None and ratio < 0.8:
            words.append(f"overconfident: the forecast's spread is only {ratio:.2f} of its error")
        return words

    def summary(self) -> dict:
        """Totals, cycles and warnings as plain Python numbers."""
        totals: dict[str, int] = {}
        for cycle in self.cycles:
            for name, count in cycle["observations"].items():
                totals[name] = totals.get(name, 0) + count
        return {
            "cycles": self.cycles,
            "observations": totals,
            "innovations": {name: _plain(part) for name, part in self.statistics().items()},
            "rank_histogram": None if self._histogram is None else self._histogram.tolist(),
            "spread_over_skill": self._spread_over_skill(),
            "warnings": self.warnings(),
        }

    def _innovation(self, name: str, normalised: Tensor, redundancy: Tensor, mask: Tensor) -> dict:
        entry = (normalised[mask].cpu(), redundancy[mask].cpu())
        self._innovations.setdefault(name, []).append(entry)
        return _plain(InnovationStatistics.of(*entry))

    def _verify(self, forecast: Tensor, truth: Tensor) -> dict:
        spread, error = spread_skill(forecast, truth)
        generator = torch.Generator().manual_seed(self.seed + len(self.cycles))
        counts = rank_histogram(forecast, truth, generator).cpu()
        self._histogram = counts if self._histogram is None else self._histogram + counts
        return {"spread": spread, "error": error, "crps": crps(forecast, truth).mean().item()}

    def _spread_over_skill(self) -> float | None:
        pairs = [(cycle["spread"] ** 2, cycle["error"] ** 2) for cycle in self.cycles if "error" in cycle]
        total = sum(error for _, error in pairs)
        return (sum(spread for spread, _ in pairs) / total) ** 0.5 if total else None


def _plain(statistics: InnovationStatistics) -> dict:
    """JSON has no NaN: statistics of nothing become null."""
    empty = not statistics.count
    return {
        "count": statistics.count,
        "mean": None if empty else statistics.mean,
        "ratio": None if empty else statistics.ratio,
        "tolerance": None if empty else statistics.tolerance,
    }
