"""How far each of several increments is to be followed, learned from what the next innovations still hold of them."""

from __future__ import annotations

import torch
from torch import Tensor

from ..errors import AssimilationError

# components start from what all of them show together, which counts as much as this share of what each shows itself
_TOGETHER = 0.5
# share of the diagonal by which increments that are nearly alike are kept apart
_RIDGE = 0.03


class LearnedGain:
    """Weights in [0, 1] of the components of several increments, found online without a model of the errors.

    An analysis adds `sum_j g_j x_j` to the forecast, x_j one component of one increment. With the best weights the next
    innovation d holds nothing more of what the increments brought, `E d H x_j = 0`: the innovations of an optimal
    filter are white (R. Mehra, IEEE Trans. Autom. Control 15 (1970) 175). Where it does, the weights were too small,
    and where it holds their negative, too large. To first order in the time between two analyses

        d = H sum_j (g*_j - g_j) x_j + what is independent of them,

    a regression for g* that is accumulated over the cycles, older ones counting less. All it assumes of the
    observation errors is that those of different cycles are independent; variances and correlations in space drop out.

    It remembers: `state` and `restore` belong in a checkpoint.
    """

    def __init__(
        self, increments: int, components: int = 1, *, start: float = 0.5, memory: float = 8.0, prior: float = 1.0
    ) -> None:
        """`start`: weights before anything is learned, worth `prior` cycles. `memory`: in cycles."""
        if increments < 1 or components < 1 or not 0 <= start <= 1 or not memory >= 1 or not prior > 0:
            raise AssimilationError(
                "LearnedGain needs increments and components >= 1, start in [0, 1], memory >= 1 and prior > 0, "
                f"got {increments}, {components}, {start}, {memory} and {prior}"
            )
        self.memory, self.prior = memory, prior
        size = increments * components
        self._pool = torch.eye(increments, dtype=torch.float64).repeat_interleave(components, 1)
        self._weight = torch.full((size,), start, dtype=torch.float64)
        self._normal = torch.zeros(size, size, dtype=torch.float64)
        self._right = torch.zeros(size, dtype=torch.float64)

    @property
    def weight(self) -> Tensor:
        """`(J,)` present weights, J = increments times components, components running fastest."""
        return self._weight.clone()

    def state(self) -> dict[str, Tensor]:
        return {"weight": self._weight.clone(), "normal": self._normal.clone(), "right": self._right.clone()}

    def restore(self, state: dict[str, Tensor]) -> None:
        self._weight, self._normal, self._right = (state[name].clone() for name in ("weight", "normal", "right"))

    def learn(self, seen: Tensor, innovation: Tensor, weight: Tensor) -> None:
        """From one cycle.

        Args:
            seen: `(J, m)` the increments of the cycle before, in the place of the observations.
            innovation: `(m,)` of this cycle, of the forecast that started from the weighted increments.
            weight: `(m,)` not negative, 1 / variance for instance; 0 for observations that are not used.
        """
        seen, innovation, weight = seen.double(), innovation.double(), weight.double()
        if seen.shape != (len(self._weight), len(innovation)) or weight.shape != innovation.shape:
            raise AssimilationError(
                f"increments {tuple(seen.shape)}, innovations {tuple(innovation.shape)} and weights "
                f"{tuple(weight.shape)} do not belong together"
            )
        used = weight > 0
        seen, innovation, weight = seen[:, used], innovation[used], weight[used]
        total = weight.sum()
        if not total > 0:
            return
        weighted = seen * (weight / total)
        normal, right = weighted @ seen.mT, weighted @ innovation
        if not bool((self._normal.diagonal() > 0).any()):
            self._normal = self.prior * torch.diag(normal.diagonal())
            self._right = self._normal @ self._weight
        kept = 1.0 - 1.0 / self.memory
        self._right = kept * self._right + right + normal @ self._weight
        self._normal = kept * self._normal + normal
        shared = self._pool.mT @ _solved(
            self._pool @ self._normal @ self._pool.mT,
            self._pool @ self._right,
            self._pool @ self._weight / self._pool.sum(1),
            _RIDGE,
        )
        self._weight = _solved(self._normal, self._right, shared.clamp(0.0, 1.0), _TOGETHER).clamp(0.0, 1.0)


def _solved(normal: Tensor, right: Tensor, guess: Tensor, share: float) -> Tensor:
    """The solution of the normal equations, drawn to `guess` with `share` of the diagonal; `guess` where it is 0."""
    ridge = share * normal.diagonal()
    known = ridge > 0
    solution = guess.clone()
    if bool(known.any()):
        square = normal[known][:, known] + torch.diag(ridge[known])
        solution[known] = torch.linalg.solve(square, right[known] + ridge[known] * guess[known])
    return solution
