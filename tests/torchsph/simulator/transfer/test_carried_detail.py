"""What particles cannot carry goes with the fluid, and at walls with the walls."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import geometry
from torchsph import Fluid, Scene, Simulator, Transfer, preset
from torchsph.simulator.grid_forecast import GridForecast
from torchsph.simulator.transfer.carried_detail import CarriedDetail

STEP = 1e-3
GRID = geometry.Grid((0.5e-3, 0.5e-3), (STEP, STEP), (24, 24))
EVERYWHERE = torch.ones(GRID.shape, dtype=torch.bool)
STREAM = 0.4  # m/s


def stream_with_ripple(time: float) -> torch.Tensor:
    """A stream along x that carries a shear wave of three nodes a period: exact for a fluid without viscosity."""
    x = GRID.nodes()[:, 0]
    ripple = 0.05 * torch.sin(2 * math.pi * (x - STREAM * time) / (3 * STEP))
    return torch.stack([torch.full_like(x, STREAM), ripple]).reshape(2, *GRID.shape).float()


@pytest.fixture(scope="module")
def box() -> Simulator:
    scene = Scene(fluid=Fluid(viscosity=0.0), spacing=STEP, dimension=2, period=(24 * STEP, 24 * STEP))
    return Simulator(scene, preset("default"))


def forecast_error(model: Simulator, fade: float | None, time: float = 6e-3) -> float:
    going = GridForecast(model, GRID, stream_with_ripple(0.0), EVERYWHERE, 0.0, Transfer(fade=fade))
    value, _ = going.at(time, EVERYWHERE)
    inner = slice(4, -4)  # the stream carries the box's edge, where a spline knows no period, by 2.4 nodes
    wrong = (value[0] - stream_with_ripple(time))[1, inner, inner]
    return float(wrong.square().mean().sqrt() / stream_with_ripple(time)[1, inner, inner].square().mean().sqrt())


def test_a_ripple_too_fine_for_particles_travels_with_the_stream(box):
    """In 6 ms it moves by .8 of its length: left where it was, twice of it would be wrong."""
    plain, carried = (forecast_error(box, fade) for fade in (None, 1e3))
    assert plain > 0.4
    assert carried < 0.2


def test_the_way_of_a_stream_is_its_speed_times_the_time(box):
    run = box.start(0.0)
    run.impose(GRID, stream_with_ripple(0.0), EVERYWHERE)
    with pytest.raises(RuntimeError, match="call follow"):
        run.travelled(GRID, EVERYWHERE)
    run.follow()
    run.advance(6e-3)
    way = run.travelled(GRID, EVERYWHERE)
    assert way.covered.all()
    np.testing.assert_allclose(way.value[0, 0], STREAM * 6e-3, rtol=1e-2)
    assert float(way.value[0, 1].abs().max()) < 0.05 * 6e-3


def test_particles_that_come_later_began_where_they_came_in(box):
    run = box.start(0.0)
    run.follow()
    more = replace(run.particles, origin=None)
    joined = run.particles.changed(position=run.particles.position + 1.0).joined(more)
    torch.testing.assert_close(joined.origin[run.particles.count :], more.position)
    torch.testing.assert_close(joined.origin[: run.particles.count], run.particles.position)


def moving_box(shift: float) -> geometry.WallMotion:
    low, high = 2e-3, 22e-3
    shape = geometry.polygon(np.array([(low, low), (high, low), (high, high), (low, high)]), STEP)
    vertices = np.stack([shape.vertices, shape.vertices + [shift, 0.0]])
    return geometry.WallMotion.through(np.array([0.0, 0.01]), vertices, shape.faces, shape.region)


def test_next_to_a_wall_it_moves_with_the_wall_and_in_the_core_with_the_fluid():
    """The walls move by one node, the fluid by two: each layer of the detail is found where it went."""
    nodes = GRID.nodes()
    inside = ((nodes > 2e-3) & (nodes < 22e-3)).all(1).reshape(GRID.shape)
    later = torch.roll(inside, 1, 1)
    detail = torch.sin(nodes[:, 0] / 3e-3).reshape(1, 1, *GRID.shape).repeat(1, 2, 1, 1)
    carried = CarriedDetail(GRID, detail, EVERYWHERE, moving_box(STEP), 0.0)
    way = torch.zeros((1, 2, *GRID.shape), dtype=torch.float64)
    way[:, 0] = 2 * STEP
    found = carried.at(0.01, way, later)[0, 0]
    assert (found[~later] == 0).all()
    row, first = 12, int(torch.nonzero(later[12])[0])
    torch.testing.assert_close(found[row, first], detail[0, 0, row, first - 1])
    torch.testing.assert_close(found[row, 11:14], detail[0, 0, row, 9:12], atol=1e-9, rtol=0)


def test_the_nearest_place_of_the_wall_is_the_same_however_it_is_found():
    """From the wall's faces where it is within reach, else by the surface's index."""
    walls, row = moving_box(STEP), np.arange(0, GRID.size, 7)
    carried = CarriedDetail(GRID, torch.zeros(1, 2, *GRID.shape), EVERYWHERE, walls, 0.0)
    surface = walls.surface(0.004)
    ways = [carried._travelled(surface, row, np.full(len(row), reach)) for reach in (3.0, 0.0)]
    np.testing.assert_allclose(*ways, atol=1e-15)
    assert ways[0][:, 0].min() > 0.3 * STEP


def test_where_nothing_is_known_the_nearest_detail_goes_on():
    known = EVERYWHERE.clone()
    known[:, 12:] = False
    detail = torch.full((1, 2, *GRID.shape), torch.nan, dtype=torch.float64)
    detail[..., :12] = 0.3
    way = torch.zeros_like(detail)
    found = CarriedDetail(GRID, detail, known, None, 0.0).at(0.0, way, EVERYWHERE)
    torch.testing.assert_close(found, torch.full_like(found, 0.3))
    none = CarriedDetail(GRID, detail, ~EVERYWHERE, None, 0.0).at(0.0, way, EVERYWHERE)
    assert (none == 0).all()


def test_a_member_that_failed_spoils_no_other():
    detail = torch.ones((2, 2, *GRID.shape), dtype=torch.float64)
    detail[0] = torch.nan
    way = torch.zeros_like(detail)
    way[0] = torch.nan
    found = CarriedDetail(GRID, detail, EVERYWHERE, None, 0.0).at(0.0, way, EVERYWHERE)
    torch.testing.assert_close(found[1], torch.ones_like(found[1]))
