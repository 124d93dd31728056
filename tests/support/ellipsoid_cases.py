"""Recordings of the potential flow in a pulsating ellipsoid, with a leak or without."""

from __future__ import annotations

import numpy as np

import geometry
from torchsph.validation.ellipsoid import PulsatingEllipsoid

TIMES = np.array([0.03, 0.04, 0.05, 0.06])  # s: ejection; where there is a leak, part of it goes back through the inlet
STEP = 1.5e-3  # m, of the grid


def recorded(body: PulsatingEllipsoid) -> geometry.Recording:
    """The potential flow on a grid inside the moving wall."""
    motion = body.motion(1.2e-3)
    grid = geometry.Grid.covering((-0.009, -0.009, -0.011), (0.009, 0.009, 0.009), STEP)
    nodes = grid.nodes().numpy()
    fields, masks = [], []
    for time in TIMES:
        inside = geometry.grid_winding(grid, motion.vertices(time), motion.faces).reshape(-1) > 0
        field = np.zeros((grid.size, 3))
        field[inside] = body.flow(time).velocity(nodes[inside])
        fields.append(field.T.reshape(3, *grid.shape))
        masks.append(inside.reshape(grid.shape))
    stack, speeds = (np.stack([of(t) for t in TIMES]) for of in (motion.vertices, motion.velocity))
    wall = geometry.Wall(stack, motion.faces, motion.region, speeds)
    labels = sorted({int(label) for label in motion.region if label})
    always = np.array([[label, 0.0, 1.0] for label in labels])
    field = np.stack(fields).astype(np.float32)
    return geometry.Recording(TIMES, grid, field, np.stack(masks), wall, 1060.0, 4e-3, valve_intervals=always)
