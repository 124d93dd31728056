"""Local ensemble transform Kalman filter: one small analysis per place, all places in one batch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from .errors import AssimilationError
from .filters import EnsembleFilter, Transform
from .localisation import Groups, Localisation, PatchGrid
from .observations import Observations, Reason, Screened
from .subspace import update_weights, zero_sum_basis


@dataclass(frozen=True, kw_only=True)
class LETKF(EnsembleFilter):
    """Hunt, Kostelich & Szunyogh (2007), Physica D 230, with observation-error localisation.

    Attributes:
        localisation: radius and periodicity.
        patch: spacing of the local analyses as a fraction of the radius. Their weights are interpolated to
            the state's places (Yang et al. 2009, QJRMS 135, 251: without loss up to about the radius' half),
            and the taper is interpolated between the same nodes, so that each observation's outer product is
            formed once and not once per patch. None: one exact analysis per place, for small states.
    """

    localisation: Localisation
    patch: float | None = 0.25

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.patch is not None and not 0 < self.patch <= 1:
            raise AssimilationError(f"LETKF.patch must lie in (0, 1] or be None, got {self.patch}")

    def _transform(
        self,
        anomalies: Tensor,
        screened: Screened,
        observations: Observations,
        state: tuple[int, Tensor | None],
        generator: torch.Generator | None,
    ) -> tuple[Transform, Tensor, Tensor]:
        layout = self._layout(*state, observations)
        basis = zero_sum_basis(anomalies.shape[-2], device=anomalies.device)
        modes = (anomalies.mT @ basis).contiguous()  # (*batch, m, r): rows are gathered
        gram, projected, informed = layout.normal_equations(modes, screened)
        size = anomalies.shape[-2]
        prior = (size - 1) * torch.eye(size - 1, dtype=torch.float64, device=anomalies.device)
        shift, root, signal = update_weights(prior, gram, projected)
        weights = shift.unsqueeze(-1) + (size - 1) ** 0.5 * (root @ basis.mT)
        number = informed.sum(-1).clamp(min=1)
        signal = torch.where(informed, signal, 0.0).sum(-1) / number
        far = (screened.reason == Reason.USED) & ~layout.useful
        reason = torch.where(far, int(Reason.OUT_OF_REACH), screened.reason).to(torch.uint8)
        return LocalTransform.of(weights, informed, layout, basis), signal, reason

    def _layout(self, size: int, positions: Tensor | None, observations: Observations) -> _Layout:
        if positions is None or observations.position is None:
            raise AssimilationError(
                "the LETKF needs places: pass state_positions=... and Observations(position=...)"
            )
        if not len(positions) or size % len(positions):
            raise AssimilationError(f"{len(positions)} state positions do not divide a state of {size}")
        places = positions.repeat(size // len(positions), 1)
        located = torch.isfinite(places).all(-1)
        if not bool(located.any()):
            raise AssimilationError("no state variable has a finite position")
        if self.localisation.off:
            return _Layout.without_observations(located, len(observations))
        here, there = self.localisation.scaled(places[located]), self.localisation.scaled(observations.places)
        index = torch.nonzero(located).squeeze(-1)
        if self.patch is None:
            return _exact_layout(self.localisation, here, there, index, located)
        return _patch_layout(self.localisation, self.patch, here, there, index, located)


@dataclass(frozen=True)
class _Layout:
    """Which observations and state variables belong to which of P patches.

    `state` and `observed` group numbers by patch and by bin; `taper (P, bins)` joins the two, None where
    bins are the patches themselves. `useful (m,)`: observation within reach of any patch; `located (n,)`.
    """

    state: Groups
    observed: Groups
    taper: Tensor | None
    useful: Tensor
    located: Tensor

    @classmethod
    def without_observations(cls, located: Tensor, count: int) -> _Layout:
        index = torch.nonzero(located).squeeze(-1)
        one = torch.ones(len(index), dtype=torch.float64, device=located.device)
        empty = Groups(index[:1] * 0, index[:0].reshape(1, 0), one[:0].reshape(1, 0))
        useful = torch.zeros(count, dtype=torch.bool, device=located.device)
        return cls(Groups.of(index * 0, index, one), empty, None, useful, located)

    def normal_equations(self, modes: Tensor, screened: Screened) -> tuple[Tensor, Tensor, Tensor]:
        """Gram `(*batch, P, r, r)`, right side `(*batch, P, r)`, and whether `(*batch, P)` has any data."""
        grams, sides, amounts = [], [], []
        numbers = math.prod(modes.shape[:-2]) * modes.shape[-1]
        for part in self.observed.chunks(numbers):
            item, share = self.observed.item[part], self.observed.weight[part]
            weight = screened.weight[..., item] * share  # (*batch, p, K)
            local = modes[..., item, :]  # (*batch, p, K, r)
            weighted = local * weight.unsqueeze(-1)
            grams.append(weighted.mT @ local)
            sides.append((weighted * screened.innovation[..., item].unsqueeze(-1)).sum(-2))
            amounts.append(weight.sum(-1))
        gram, side, amount = torch.cat(grams, -3), torch.cat(sides, -2), torch.cat(amounts, -1)
        if self.taper is not None:
            gram = (self.taper @ gram.flatten(-2)).unflatten(-1, gram.shape[-2:])
            side = self.taper @ side
            amount = (self.taper @ amount.unsqueeze(-1)).squeeze(-1)
        return gram, side, amount > 0


def _exact_layout(
    localisation: Localisation, here: Tensor, there: Tensor, index: Tensor, located: Tensor
) -> _Layout:
    """One patch per distinct place; its observations carry the exact taper."""
    places, which = torch.unique(here, dim=0, return_inverse=True)
    one = torch.ones(len(index), dtype=torch.float64, device=here.device)
    step = max(1, 4_000_000 // max(1, len(there) * here.shape[-1]))
    pairs = [localisation.taper(part, there).to_sparse() for part in places.split(step)]
    patch = torch.cat([part.indices()[0] + step * k for k, part in enumerate(pairs)])
    item = torch.cat([part.indices()[1] for part in pairs])
    groups = _complete(Groups.of(patch, item, torch.cat([part.values() for part in pairs])), len(places))
    useful = torch.zeros(len(there), dtype=torch.bool, device=here.device)
    useful[item] = True
    return _Layout(Groups.of(which, index, one), groups, None, useful, located)


def _complete(groups: Groups, count: int) -> Groups:
    """The same groups with empty rows for the patches that have no items."""
    item = groups.item.new_zeros(count, groups.item.shape[1])
    weight = groups.weight.new_zeros(count, groups.item.shape[1])
    item[groups.patch], weight[groups.patch] = groups.item, groups.weight
    return Groups(torch.arange(count, device=item.device), item, weight)


def _patch_layout(
    localisation: Localisation, spacing: float, here: Tensor, there: Tensor, index: Tensor, located: Tensor
) -> _Layout:
    """Patches and bins on one coarse grid, each with multilinear shares, joined by the taper."""
    period = localisation.scaled_period(here.shape[-1], here.device)
    grid = PatchGrid.around(torch.cat([here, there]), spacing, period)
    state = _shared(grid, here, index)
    numbers = torch.arange(len(there), device=here.device)
    observed = _shared(grid, there, numbers)
    taper = localisation.taper(grid.nodes(state.patch), grid.nodes(observed.patch))
    useful = torch.zeros(len(there), dtype=torch.bool, device=here.device)
    touched = (taper > 0).any(0).unsqueeze(-1) & (observed.weight > 0)
    useful[observed.item[touched]] = True
    return _Layout(state, observed, taper, useful, located)


def _shared(grid: PatchGrid, points: Tensor, index: Tensor) -> Groups:
    node, weight = grid.share(points)
    return Groups.of(node.flatten(), index.repeat_interleave(node.shape[-1]), weight.flatten())


@dataclass(frozen=True)
class LocalTransform:
    """Weights `(*batch, P, r, N)` of the members at P patches, shared out to the state by `state`.

    Numbers without a place (parameters) take the average weights of the patches that have observations, the
    spatial averaging of Aksoy, Zhang & Nielsen-Gammon (2006).
    """

    weights: Tensor
    average: Tensor
    state: Groups
    located: Tensor
    basis: Tensor
    reached: Tensor | None

    @classmethod
    def of(cls, weights: Tensor, informed: Tensor, layout: _Layout, basis: Tensor) -> LocalTransform:
        number = informed.sum(-1).clamp(min=1)[..., None, None]
        average = torch.where(informed[..., None, None], weights, 0.0).sum(-3) / number
        reached = torch.zeros(*informed.shape[:-1], len(layout.located), device=weights.device)
        hit = informed.unsqueeze(-1) & (layout.state.weight > 0)
        flat = layout.state.item.flatten().expand(*informed.shape[:-1], -1)
        reached = reached.scatter_add(-1, flat, hit.flatten(-2).to(reached)) > 0
        reached = reached | (informed.any(-1, keepdim=True) & ~layout.located)
        return cls(weights, average, layout.state, layout.located, basis, reached.unsqueeze(-2))

    def apply(self, ensemble: Tensor) -> Tensor:
        """See `Transform.apply`."""
        wide = ensemble.double()
        mean = wide.mean(-2, keepdim=True)
        # The modes are taken in float64; their products, the bulk of the work, in the state's precision.
        modes = (wide.mT @ self.basis).to(ensemble.dtype)  # (*batch, n, r)
        weights = self.weights.to(ensemble.dtype)
        change = modes.new_zeros(*modes.shape[:-1], ensemble.shape[-2])
        for part in self.state.chunks(math.prod(modes.shape[:-2]) * ensemble.shape[-2]):
            item, share = self.state.item[part], self.state.weight[part].to(ensemble.dtype)
            local = modes[..., item, :] @ weights[..., part, :, :]  # (*batch, p, K, N)
            change.index_add_(-2, item.flatten(), (local * share.unsqueeze(-1)).flatten(-3, -2))
        if not bool(self.located.all()):
            free = ~self.located
            change[..., free, :] = modes[..., free, :] @ self.average.to(ensemble.dtype)
        return (mean + change.mT).to(ensemble.dtype)
