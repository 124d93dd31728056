"""A rigid branch, one way in and two ways out: the split is found in noisy data and kept in the forecast."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.integrate import simpson

import geometry
import torchsph as ts
from torchsph import Scene, Simulator, Valve
from torchsph.methods.measurement.flux_data import flux_data
from torchsph.simulator.grid_forecast import GridForecast, Transfer
from torchsph.simulator.scene import Fluid

BLOCK, STEP = 2.5e-3, 1.25e-3  # m: what the duct is made of, and grid and particles
FLUX, SPLIT = 3e-5, 0.65  # m^3/s in, and the part of it that leaves to the left
INLET, LEFT, RIGHT = 1, 2, 3
VISCOSITY = 0.04  # Pa s: boundary layers that the grid resolves
ALWAYS = ((-1.0, 1.0),)


def blocks() -> np.ndarray:
    """(nz, ny, nx) bool: a trunk of 10 mm square along z, under a bar along x."""
    solid = np.zeros((10, 4, 16), bool)
    solid[:6, :, 6:10] = True
    solid[6:] = True
    return solid


def duct() -> geometry.Surface:
    """The blocks' surface: the trunk's lower end is the inlet, the bar's ends are the outlets."""
    solid = np.pad(blocks(), 1)
    corners, labels = [], []
    for axis in range(3):
        for side in (-1, 1):
            bare = solid & ~np.roll(solid, -side, axis)
            for place in np.argwhere(bare):
                middle = place.astype(float)
                middle[axis] += 0.5 * side
                u, v = np.eye(3)[[(axis + 1) % 3, (axis + 2) % 3]] / 2
                around = [middle - u - v, middle + u - v, middle + u + v, middle - u + v]
                corners.append(around if side > 0 else around[::-1])
                at_end = {
                    (0, -1): (place[0] == 1, INLET),
                    (2, -1): (place[2] == 1, LEFT),
                    (2, 1): (place[2] == 16, RIGHT),
                }
                end, label = at_end.get((axis, side), (False, 0))
                labels.append(label if end else 0)
    points = np.array(corners).reshape(-1, 3)[:, ::-1]  # x, y, z; the mirror turns the quads round
    vertices, index = np.unique(np.round(2 * points).astype(int), axis=0, return_inverse=True)
    quads = index.reshape(-1, 4)[:, ::-1]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    return geometry.Surface(0.5 * BLOCK * vertices, faces.astype(np.int32), np.tile(np.array(labels, np.uint8), 2))


def recording_of(surface: geometry.Surface, field: np.ndarray, mask: np.ndarray, grid: geometry.Grid):
    rows = np.array([[float(label), -1.0, 1.0] for label in (INLET, LEFT, RIGHT)])
    wall = geometry.Wall(surface.vertices[None], surface.faces, surface.region)
    return geometry.Recording(
        np.zeros(1), grid, field[None].astype(np.float32), mask[None], wall, 1060.0, VISCOSITY, valve_intervals=rows
    )


@pytest.fixture(scope="module")
def truth():
    """The flow that the simulator makes from rest, with given fluxes, in 50 ms; on the grid thin layers are lost."""
    surface = duct()
    grid = geometry.Grid.covering(surface.vertices.min(0), surface.vertices.max(0), STEP)
    walls = geometry.WallMotion.at_rest(surface)
    mask = geometry.signed_distance(grid, surface) > 0.1 * STEP
    valves = (
        Valve(INLET, ALWAYS, flux=FLUX),
        Valve(LEFT, ALWAYS, flux=-SPLIT * FLUX),
        Valve(RIGHT, ALWAYS),
    )
    scene = Scene(STEP, Fluid(1060.0, VISCOSITY), walls=walls, valves=valves, dimension=3)
    run = Simulator(scene).start(0.0, seed=0)
    run.advance(0.05)
    field = run.fetch(grid, torch.from_numpy(mask)).value[0].numpy()
    return recording_of(surface, np.where(mask, field, 0.0), mask, grid)


def split_of_nodes(truth: geometry.Recording) -> float:
    """The part that leaves to the left, by Simpson's rule over sections of both arms: exact for parabolic profiles."""
    along = truth.velocity[0, 0]
    left = -simpson(simpson(along[12:21, :, 4]))
    right = simpson(simpson(along[12:21, :, 28]))
    return float(left / (left + right))


def shares(recording: geometry.Recording) -> dict[int, float]:
    """The fluxes inwards of the recording's spline over ``FLUX``."""
    frames = ts.PreparedMeasurement(recording).splines
    fitted = frames.fit(0)
    labels = (INLET, LEFT, RIGHT)
    asked = replace(recording, fluxes=tuple(geometry.OpeningFlux(label, [0.0]) for label in labels))
    data = flux_data(asked, frames.motion, 0, fitted)
    found = (data.of(fitted) - data.value).numpy() / FLUX
    return dict(zip(labels, found.tolist(), strict=False))


@pytest.mark.slow
def test_the_split_is_found_in_noisy_data_and_kept_in_the_forecast(truth):
    peak = np.linalg.norm(truth.velocity, axis=1).max()
    noise = 0.1 * peak * np.random.default_rng(0).standard_normal(truth.velocity.shape)
    noisy = replace(truth, velocity=np.where(truth.mask[:, None], truth.velocity + noise, 0).astype(np.float32))
    known, found = split_of_nodes(truth), shares(noisy)
    assert found[LEFT] / found[INLET] == pytest.approx(-known, rel=0.03)
    assert sum(found.values()) == pytest.approx(0.0, abs=1e-3)  # what comes in goes out
    smoothed = ts.smooth(noisy)
    inside = truth.mask[0]
    assert np.std((smoothed.velocity - truth.velocity)[0][:, inside]) < 0.35 * np.std(noise)
    model = ts.make_model(noisy, spacing=STEP)
    mask = torch.from_numpy(np.array(inside))
    going = GridForecast(model, truth.grid, torch.from_numpy(smoothed.velocity[0]), mask, 0.0, Transfer(fade=None))
    going.at(0.02, mask)
    split = going.run.surroundings.clock.flux_split
    flux = {model.domain.valves.openings.all[n].label: float(split.flux[0, k]) for k, n in enumerate(split.numbers)}
    assert flux[LEFT] / flux[INLET] == pytest.approx(-known, rel=0.03)
    assert sum(flux.values()) == pytest.approx(0.0, abs=1e-6 * abs(flux[INLET]))
