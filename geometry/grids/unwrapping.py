"""Speeds that are known modulo twice a limit, made continuous again: aliased Doppler and phase contrast.

The whole numbers k of turns are those of least  sum |d(v + 2 L k)|  over all pairs of neighbours, a problem without
local minima: it is solved exactly by a row of binary choices, each the minimum cut of a graph (PUMA: J. M. Bioucas-Dias
and G. Valadao, IEEE Trans. Image Process. 16 (2007) 698, sec. III). Of solutions that differ by a turn of all nodes
that are connected, the one that is slowest near the walls is taken.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import breadth_first_order, maximum_flow

from geometry.arguments import checked

_UNIT = 1e5  # of the whole-numbered capacities, per turn between neighbours
_AT_REST = 1e-3  # pull towards rest of a node near a wall, beside that of a neighbour
_ELSEWHERE = 1e-5  # of every other node
_MOST_TURNS = 64  # far more than any flow can wrap; the choices end by themselves


@checked
def unwrap(speed: np.ndarray, known: np.ndarray, limit: float, slow: np.ndarray | None = None) -> np.ndarray:
    """Speeds with the turns of the limit taken back, continuous from node to node as far as they can be.

    Args:
        speed: (*shape), m/s, in any number of axes; known up to whole multiples of twice the limit.
        known: (*shape), bool, nodes that hold a value.
        limit: m/s, of the interval from -limit to limit that was measured in.
        slow: (*shape), bool, nodes that move little, as those along walls; most of them must. None: no one knows.

    Returns:
        (*shape), float64, as ``speed`` where nothing is known.

    Raises:
        ValueError: shapes that differ, or a limit that is not positive.
    """
    for name, nodes in (("known", known), ("slow", slow)):
        if nodes is not None and nodes.shape != speed.shape:
            raise ValueError(f"unwrap: speed has the shape {speed.shape}, but {name} {nodes.shape}")
    if not (np.isfinite(limit) and limit > 0):
        raise ValueError(f"unwrap: limit must be positive and finite (m/s), got {limit}")
    found, known = np.array(speed, np.float64), np.asarray(known, bool)
    place, pairs = found[known] / (2 * limit), _pairs(known)
    turns = -np.rint(place)
    place += turns
    # where no neighbours are more than a limit apart no more turns are needed
    if len(pairs) and np.abs(np.diff(place[pairs], axis=1)).max() > 0.5:
        pull = np.full(len(place), _ELSEWHERE)
        if slow is not None:
            pull[np.asarray(slow, bool)[known]] = _AT_REST
        turns += _Field(place, pairs, pull).turns()
    found[known] += 2 * limit * turns
    return found


def _pairs(known: np.ndarray) -> np.ndarray:
    """(e, 2) numbers of neighbours among the known nodes."""
    number = np.full(known.shape, -1)
    number[known] = np.arange(np.count_nonzero(known))
    return np.concatenate(list(_along_axes(number)))


def _along_axes(number: np.ndarray) -> Iterator[np.ndarray]:
    for axis in range(number.ndim):
        lines = np.moveaxis(number, axis, 0)
        both = np.stack([lines[:-1].reshape(-1), lines[1:].reshape(-1)], axis=1)
        yield both[(both >= 0).all(axis=1)]


class _Field:
    """Speeds in turns, and what holds them together.

    Args:
        place: (n,), in turns.
        pairs: (e, 2) of neighbours.
        pull: (n,) towards rest, beside that of a neighbour.
    """

    def __init__(self, place: np.ndarray, pairs: np.ndarray, pull: np.ndarray) -> None:
        self.place, self.pairs, self.pull = place, pairs, pull

    def turns(self) -> np.ndarray:
        """(n,) whole numbers of least energy: choices of one more turn, up and down, until neither helps."""
        turns, energy, still = np.zeros(len(self.place)), self._energy(self.place), 0
        for sign in _up_and_down():
            moved = turns + sign * self._raised(self.place + turns, sign)
            less = self._energy(self.place + moved)
            still = 0 if less < energy - 1e-9 else still + 1
            if still == 0:
                turns, energy = moved, less
            elif still == 2:
                break
        return turns

    def _energy(self, place: np.ndarray) -> float:
        return float(np.abs(np.diff(place[self.pairs], axis=1)).sum() + (self.pull * np.abs(place)).sum())

    def _raised(self, place: np.ndarray, sign: int) -> np.ndarray:
        """(n,) bool: the nodes that take one more turn of this sign, so that no other choice has less energy.

        A cut that parts sink and source costs what the choice costs, up to a constant (V. Kolmogorov and R. Zabih,
        IEEE Trans. Pattern Anal. Mach. Intell. 26 (2004) 147, theorem 4.1).
        """
        own, between = self._costs(place, sign)
        count, pairs = len(place), self.pairs
        source, sink = count, count + 1
        gains, losses = np.flatnonzero(own < 0), np.flatnonzero(own > 0)
        rows = np.concatenate([pairs[:, 1], np.full(len(gains), source), losses])
        columns = np.concatenate([pairs[:, 0], gains, np.full(len(losses), sink)])
        weight = np.rint(_UNIT * np.concatenate([between, -own[gains], own[losses]])).astype(np.int32)
        graph = sparse.csr_matrix((weight, (rows, columns)), shape=(count + 2, count + 2), dtype=np.int32)
        left = graph - maximum_flow(graph, source, sink).flow
        left.data = np.maximum(left.data, 0)
        left.eliminate_zeros()
        chosen = np.zeros(count + 2, bool)
        chosen[breadth_first_order(left, source, return_predecessors=False)] = True
        return chosen[:count]

    def _costs(self, place: np.ndarray, sign: int) -> tuple[np.ndarray, np.ndarray]:
        """Of a choice b: own b of each node (n,), and between (1 - b) b' of each pair (e,), which is not negative."""
        step = np.diff(place[self.pairs], axis=1)[:, 0]
        still, second, first = np.abs(step), np.abs(step + sign), np.abs(step - sign)
        own = self.pull * (np.abs(place + sign) - np.abs(place))
        np.add.at(own, self.pairs[:, 0], first - still)
        np.add.at(own, self.pairs[:, 1], still - first)
        return own, second + first - 2 * still


def _up_and_down() -> Iterator[int]:
    for _ in range(_MOST_TURNS):
        yield 1
        yield -1
