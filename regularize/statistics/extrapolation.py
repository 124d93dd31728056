"""Where an iteration that creeps towards its fixed point will end, read off its last few steps."""

import torch

DEPTH = 5  # differences of steps that are looked at
MOST = 1.0  # by so much, in each entry, may the next place differ from the plain iteration's
FLAT = 0.02  # of the largest: combinations of differences below it are left out


class Extrapolation:
    """Anderson's mixing (D. Anderson, J. ACM 12, 1965, 547; H. Walker and P. Ni, SIAM J. Numer. Anal. 49, 2011, 1715).

    Near the end the step g(z) - z is linear in z. The places seen so far are combined so that their steps cancel as far
    as they can.

    Args:
        like: an iteration like this one, of which what was learnt is taken over.
    """

    def __init__(self, like: "Extrapolation | None" = None) -> None:
        self._differences: list[tuple[torch.Tensor, torch.Tensor]] = [] if like is None else like._differences
        self._last: tuple[torch.Tensor, torch.Tensor] | None = None

    def next(self, place: torch.Tensor, mapped: torch.Tensor) -> torch.Tensor:
        """The place (n,) to look at after ``place``, which the iteration maps to ``mapped``."""
        step = mapped - place
        if self._last is not None:
            before, stepped = self._last
            self._differences = [*self._differences[1 - DEPTH :], (place - before, step - stepped)]
        self._last = place, step
        if not self._differences:
            return mapped
        places, steps = (torch.stack(each, 1) for each in zip(*self._differences, strict=True))
        size = steps.norm(dim=0).clamp(min=1e-300)
        mix = torch.linalg.lstsq(steps / size, step[:, None], rcond=FLAT, driver="gelsd").solution
        beyond = -((places + steps) / size @ mix).squeeze(1)
        return mapped + beyond.clamp(-MOST, MOST)
