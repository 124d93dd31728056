"""A mesh of the domain from a threshold on the velocities, with its normals (Grønli 2017, fig. 4.3).

Beside the hull that the thesis took, whose flat parts have hardly a vertex, stands what is used here: tetrahedra of
the same points, those inside kept, smoothed, and walls sampled as densely as the spline's knots ask for.
"""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure
from mpl_toolkits.mplot3d.art3d import Poly3DCollection
from scipy.spatial import ConvexHull, cKDTree

import geometry

from ..material import Material
from ..record import Claim, Result
from ..style import plt

KNOTS = 3e-3  # m, of the default spline on a grid of 1 mm


def make(material: Material) -> Result:
    """Both meshes at the first frame: widest stretch of wall without a point, distance from the true wall."""
    truth = material.truth
    speed = np.where(truth.mask[:1, None], truth.velocity[:1], 0.0)
    body = np.asarray(truth.grid.nodes())[(np.linalg.norm(speed[0], axis=0) > 0).reshape(-1)]
    hull = ConvexHull(body)
    own = geometry.surface_from_velocity(speed[0], truth.grid, smoothing=4)
    wall = truth.wall_for("the mesh").at(0)
    index = geometry.SurfaceIndex(wall)
    away = np.abs(index.query(own.vertices).distance)
    normals_of_wall = wall.normals[index.query(own.centroids).face]
    cosine = (own.normals * normals_of_wall).sum(1)
    motion = geometry.WallMotion.at_rest(own)
    points = geometry.wall_points(motion, 0.0, KNOTS).points
    edges = [_edges(body, hull.simplices), _edges(own.vertices, own.faces)]
    gap = float(np.max(_gap(own, np.asarray(points))))
    numbers = {
        "longest_edge_of_hull": float(edges[0].max()),
        "longest_edge_of_mesh": float(edges[1].max()),
        "farthest_from_a_wall_point": gap,
        "faces": {"hull": len(hull.simplices), "mesh": len(own.faces)},
        "distance_from_true_wall": {"mean": float(away.mean()), "largest": float(away.max())},
        "median_angle_of_normals_deg": float(np.degrees(np.arccos(np.clip(np.median(cosine), -1, 1)))),
    }
    flat = Claim(
        "where the boundary is flat, coplanar points are removed and the wall is undersampled",
        bool(edges[0].max() > KNOTS),
        f"longest edge of the hull {1e3 * edges[0].max():.1f} mm; no place of the wall is farther than "
        f"{1e3 * gap:.1f} mm from a point that the spline is given",
    )
    usable = Claim(
        "the mesh and its normals can be used for the wall's rows",
        bool(away.mean() < min(truth.grid.spacing)),
        f"mean distance from the true wall {1e3 * away.mean():.2f} mm of a grid of "
        f"{1e3 * min(truth.grid.spacing):.0f} mm, median angle of the normals "
        f"{numbers['median_angle_of_normals_deg']:.0f} degrees",
    )

    def draw() -> Figure:
        return _draw(body, hull.simplices, own)

    return Result(numbers, [flat, usable], material.settings(knots_m=KNOTS), draw)


def _edges(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Lengths of all edges, m."""
    corners = vertices[faces]
    return np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).ravel()


def _gap(surface: geometry.Surface, points: np.ndarray) -> np.ndarray:
    """Distance of each face's middle from the nearest of some points, m."""
    return cKDTree(points).query(surface.centroids)[0]


def _draw(body: np.ndarray, hull: np.ndarray, own: geometry.Surface) -> Figure:
    figure = plt.figure(figsize=(8, 5), layout="constrained")
    for place, (title, vertices, faces) in enumerate(
        (("hull of the moving nodes", body, hull), ("mesh used here, every 12th normal", own.vertices, own.faces))
    ):
        axis = figure.add_subplot(1, 2, place + 1, projection="3d")
        corners = 1e3 * vertices[faces]
        axis.add_collection3d(Poly3DCollection(corners, facecolor="lightsteelblue", edgecolor="0.4", linewidth=0.2))
        if place:
            start, normal = 1e3 * own.centroids[::12], own.normals[::12]
            axis.quiver(*start.T, *normal.T, length=2.0, color="tab:red", linewidth=0.5)
        low, high = 1e3 * body.min(0), 1e3 * body.max(0)
        axis.set(xlim=(low[0], high[0]), ylim=(low[1], high[1]), zlim=(low[2], high[2]), title=title)
        axis.set_box_aspect(high - low)
        axis.set_axis_off()
        axis.view_init(20, -60)
    return figure
