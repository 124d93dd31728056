"""Openings of a surface that does not close: where they are, how large, which way they face, and lids with labels.

A segmented ventricle is cut at its valves, a vessel at the ends of the image: each cut leaves a rim. A wall may be torn
as well; its holes are small against the openings, or ragged.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from geometry.arguments import checked
from geometry.grids.given import numbers

from .integers import region_number
from .repair import rims
from .surface import Surface, SurfaceError

# a rim is an opening rather than a hole where it is at least this part of the largest one's area ...
_LEAST_AREA = 0.01
# ... has at least so many edges (a missing face or two leave fewer) ...
_LEAST_EDGES = 8
# ... and is this round, as 4 pi area / length^2 of its rim: a slit or a tear is not
_LEAST_ROUND = 0.25
# area of a lid over that of its rim's area vector: 1 where the rim is plane and convex, 1.1 for a saddle of 25 degrees
_LARGEST_BEND = 1.3


@dataclass(frozen=True, eq=False)
class Opening:
    """A rim of an open surface.

    Attributes:
        centre: (3,) m, mean of the rim by length.
        normal: (3,) unit vector out of the enclosed volume, across the rim's area vector.
        area: m^2, of the rim's area vector: the same for every sheet that closes it.
        length: m, of the rim.
        rim: (n,) vertices in order, in the sense of the surface's faces.
        hole: whether it is a hole of a torn wall rather than an opening: small, of few edges, or a slit.
    """

    centre: np.ndarray
    normal: np.ndarray
    area: float
    length: float
    rim: np.ndarray
    hole: bool

    @property
    def roundness(self) -> float:
        """4 pi area over the square of the rim's length: 1 for a plane circle, 0 for a slit."""
        return 4.0 * np.pi * self.area / self.length**2


@checked
def openings(surface: Surface) -> list[Opening]:
    """The rims of an open surface in space, largest first; none where it is closed.

    Raises:
        SurfaceError: faces cross or branch at a rim, or the surface is a plane one.
    """
    if surface.dimension != 3:
        raise SurfaceError("openings: a plane outline has gaps, not openings; label its edges instead")
    if surface.open_ridges == 0:
        return []
    found = rims(surface.faces)
    measured = [_measured(surface.vertices[loop]) for loop in found]
    largest = max(area for _, _, area, _ in measured)
    result = []
    for loop, (centre, vector, area, length) in zip(found, measured, strict=True):
        ragged = area < _LEAST_AREA * largest or len(loop) < _LEAST_EDGES
        ragged |= 4.0 * np.pi * area < _LEAST_ROUND * length**2
        # the faces pass the rim with the volume to their inside: a lid passes it the other way
        normal = -vector / area if area > 0 else np.zeros(3)
        result.append(Opening(centre, normal, area, length, loop, bool(ragged)))
    return sorted(result, key=lambda one: one.area, reverse=True)


def _measured(rim: np.ndarray) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Centre, area vector, area and length of a closed polygon (n, 3)."""
    following = np.roll(rim, -1, axis=0)
    edge = np.linalg.norm(following - rim, axis=1)
    centre = (0.5 * (rim + following) * edge[:, None]).sum(0) / edge.sum()
    vector = 0.5 * np.cross(rim - centre, following - centre).sum(0)
    return centre, vector, float(np.linalg.norm(vector)), float(edge.sum())


@checked
def with_lids(surface: Surface, labels: Sequence[int] | Mapping[int, Sequence[float]] | None = None) -> Surface:
    """The surface closed by a lid over each opening, labelled; holes of a torn wall are closed as wall (region 0).

    Args:
        surface: open, consistently numbered, m.
        labels: region labels of the openings from the largest to the smallest; or a point (3,), m, for each label,
            which goes to the opening whose centre is nearest; or None: 1, 2, ... by size.

    Raises:
        SurfaceError: there are more labels than openings, two points are nearest to one opening, or a lid would cross
            the wall (a rim that is not nearly plane: cut the surface there).
    """
    found = openings(surface)
    real = [one for one in found if not one.hole]
    given = _assigned(real, labels)
    vertices, faces, region = [surface.vertices], [surface.faces], [surface.region]
    total = len(surface.vertices)
    for one in found:
        label = next((label for place, label in given.items() if real[place] is one), 0)
        fan = np.column_stack([np.roll(one.rim, -1), one.rim, np.full(len(one.rim), total)])
        _check_lid(surface.vertices[one.rim], one)
        vertices.append(one.centre[None])
        faces.append(fan)
        region.append(np.full(len(fan), label, np.uint8))
        total += 1
    closed = Surface(np.concatenate(vertices), np.concatenate(faces), np.concatenate(region))
    if closed.volume < 0:
        closed = Surface(closed.vertices, closed.faces[:, ::-1], closed.region)
    return closed


def _assigned(real: list[Opening], labels: Sequence[int] | Mapping[int, Sequence[float]] | None) -> dict[int, int]:
    """Place in ``real`` -> label."""
    if labels is None:
        return {place: place + 1 for place in range(len(real))}
    if len(labels) > len(real):
        sizes = ", ".join(f"{1e4 * one.area:.3g} cm2 at {np.round(one.centre, 4).tolist()} m" for one in real)
        raise SurfaceError(f"{len(labels)} openings were labelled, but the surface has {len(real)}: {sizes or 'none'}")
    if not isinstance(labels, Mapping):
        return {place: region_number("with_lids: labels", label) for place, label in enumerate(labels)}
    result: dict[int, int] = {}
    for label, point in labels.items():
        where = numbers(f"with_lids: the point of label {label}", point)
        if len(where) != 3:
            raise SurfaceError(f"with_lids: the point of label {label} must be three numbers (m), not {point!r:.60}")
        away = [float(np.linalg.norm(one.centre - np.array(where))) for one in real]
        place = int(np.argmin(away))
        if place in result:
            raise SurfaceError(f"labels {result[place]} and {label} are nearest to the same opening: move their points")
        result[place] = region_number("with_lids: labels", label)
    return result


def _check_lid(rim: np.ndarray, opening: Opening) -> None:
    """Raise SurfaceError where a fan around the centre would leave the wall and cut through what it encloses."""
    if len(rim) < _LEAST_EDGES:
        return
    following = np.roll(rim, -1, axis=0)
    fan = float(np.linalg.norm(0.5 * np.cross(rim - opening.centre, following - opening.centre), axis=1).sum())
    if fan > _LARGEST_BEND * opening.area:
        raise SurfaceError(
            f"the rim at {np.round(opening.centre, 4).tolist()} m cannot be closed by a lid: it is bent so far that "
            "the lid would cut through the blood; cut the surface along a plane there, or mend the wall"
        )
