"""Whether the order of axes and components is the one claimed, and whether speeds have wrapped around."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import permutations, product

import numpy as np

from .finding import Finding, sampled
from .recording import Recording
from .rules import measured_nodes

FACTOR = 1.5  # by which another order must have less divergence before it is told
FRAMES = 5
LEAST_NODES = 50
WRAPPED_SHARE = 1e-3  # of the pairs of neighbours


def axis_order(recording: Recording) -> Iterator[Finding]:
    """Tell where another order of components has much less divergence than the one claimed."""
    found = best_order(recording)
    if found is None:
        return
    order, claimed, best = found
    if claimed > FACTOR * best:
        rule = f"its divergence is {claimed:.2g} of its gradient, but {best:.2g} if its components were {order}"
        yield Finding(
            "/velocity", rule, "check the order and signs of axes and components (convert --axes, --components)"
        )


def best_order(recording: Recording) -> tuple[str, float, float] | None:
    """The order and signs of components of least divergence.

    The divergence of a field whose components belong to other axes is a sum of other derivatives, so that the
    nine derivatives and their products give it for every order and sign at once.

    Returns:
        The order as `-y,x,z` (the component stored first is that of minus y), the RMS of the divergence
        relative to that of the gradient as claimed and for that order; None where too little is measured.
    """
    if recording.dimension != 3 or recording.beam is not None or recording.normal is not None:
        return None
    products = derivative_products(recording.velocity, measured_nodes(recording), recording.grid.spacing)
    if products is None:
        return None
    total = float(np.einsum("caca->", products))
    if total == 0:
        return None
    scores = {}
    for order in permutations(range(3)):
        for sign in product((1, -1), repeat=2):
            signs = (*sign, 1)
            square = sum(signs[a] * signs[b] * products[a, order[a], b, order[b]] for a in range(3) for b in range(3))
            scores[order, signs] = float(np.sqrt(max(square, 0.0) / total))
    claimed = scores[(0, 1, 2), (1, 1, 1)]
    order, signs = min(scores, key=lambda key: scores[key])
    words = ",".join(("" if sign > 0 else "-") + "xyz"[axis] for axis, sign in zip(order, signs, strict=True))
    return words, claimed, scores[order, signs]


def derivative_products(velocity: np.ndarray, measured: np.ndarray, spacing: tuple[float, ...]) -> np.ndarray | None:
    """Mean products `(3, 3, 3, 3)` of the derivatives of component c along axis a, at nodes inside.

    Args:
        velocity: (T, 3, nz, ny, nx), of which some frames are taken.
        measured: (T, nz, ny, nx), bool.
        spacing: along x, y, z.

    Returns:
        Indexed [c, a, d, b]; None where too little is measured.
    """
    count, products = 0, np.zeros((3, 3, 3, 3))
    if min(measured.shape[1:]) < 3:
        return None
    for frame in sampled(len(measured), FRAMES):
        inner = measured[frame][1:-1, 1:-1, 1:-1].copy()
        for axis in range(3):
            for step in (0, 2):
                window = [slice(1, -1)] * 3
                window[axis] = slice(step, step - 2 or None)
                inner &= measured[frame][tuple(window)]
        rows = np.empty((3, 3, int(inner.sum())))
        for axis in range(3):
            window = [slice(1, -1)] * 3
            ahead, behind = list(window), list(window)
            array_axis = 2 - axis
            ahead[array_axis], behind[array_axis] = slice(2, None), slice(0, -2)
            for component in range(3):
                field = velocity[frame, component]
                change = field[tuple(ahead)][inner].astype(np.float64) - field[tuple(behind)][inner]
                rows[component, axis] = change / (2 * spacing[axis])
        products += np.einsum("can,dbn->cadb", rows, rows)
        count += rows.shape[2]
    return products / count if count >= LEAST_NODES else None


def wrapped_speeds(recording: Recording) -> Iterator[Finding]:
    """Tell of neighbours that differ by nearly twice a common limit: aliased Doppler or phase-contrast speeds."""
    if recording.nyquist is not None:  # it is known, and taken back by whoever works with the measurement
        return
    measured = measured_nodes(recording)
    if recording.beam is None:
        parts: dict[str, int | None] = {f"component {'xyz'[c]}": c for c in range(recording.dimension)}
    else:
        parts = {"the speed along the beam": None}
    for name, component in parts.items():
        limit, jumps, pairs = 0.0, 0, 0
        fields = [(frame, _component(recording, frame, component)) for frame in sampled(recording.frames, FRAMES)]
        limit = max(float(np.abs(field[measured[frame]]).max(initial=0)) for frame, field in fields)
        near = below = 0
        for frame, field in fields:
            size = np.abs(field[measured[frame]])
            near += int((size > 0.9 * limit).sum())
            below += int(((size > 0.8 * limit) & (size <= 0.9 * limit)).sum())
            for axis in range(field.ndim):
                both = _ahead(measured[frame], axis) & _behind(measured[frame], axis)
                step = np.abs(_ahead(field, axis) - _behind(field, axis))[both]
                jumps += int((step > 1.5 * limit).sum())
                pairs += step.size
        if limit > 0 and jumps > max(10, WRAPPED_SHARE * pairs) and near > 0.5 * below:
            rule = f"{name} jumps by nearly {2 * limit:.3g} m/s between {jumps} of {pairs} neighbours, as speeds that"
            cure = "give the limit as /nyquist (convert --nyquist), unwrap them, or give them /weight 0"
            yield Finding("/velocity", f"{rule} have wrapped at +-{limit:.3g} m/s do", cure)


def _component(recording: Recording, frame: int, component: int | None) -> np.ndarray:
    if component is not None:
        return recording.velocity[frame, component].astype(np.float64)
    beam = recording.beam
    assert beam is not None
    here = beam[frame] if beam.ndim == recording.velocity.ndim else beam
    return (recording.velocity[frame].astype(np.float64) * here).sum(axis=0)


def _ahead(field: np.ndarray, axis: int) -> np.ndarray:
    return np.take(field, range(1, field.shape[axis]), axis=axis)


def _behind(field: np.ndarray, axis: int) -> np.ndarray:
    return np.take(field, range(field.shape[axis] - 1), axis=axis)
