"""The particles of a run as a file: every n steps, in SI units, and without a trace in the run."""

from __future__ import annotations

import h5py
import numpy as np
import pytest
import torch

import geometry
from torchsph import ParticleSeries, Scene, Simulator, WeaklyCompressible, preset
from torchsph.simulator.scene import Fluid

PERIODIC = Scene(spacing=1 / 12, fluid=Fluid(1.0, 0.02), period=(1.0, 1.0), reference_speed=1.0, dimension=2)


def vortices(members=1):
    scheme = WeaklyCompressible(sound_speed=10.0, bulk_damping=None, artificial_viscosity=None)
    run = Simulator(PERIODIC, scheme, dtype=torch.float64).start(0.0, members=members, seed=0)
    x, y = (2 * np.pi * run.particles.position * PERIODIC.spacing).unbind(1)
    speed = torch.stack([-torch.cos(x) * torch.sin(y), torch.sin(x) * torch.cos(y)], 1) / run.units.speed
    run.particles = run.particles.changed(velocity=speed * (1 + run.particles.member[:, None]))
    return run


@pytest.mark.parametrize("member", [0, 1])
def test_every_third_step_of_a_member_is_written(tmp_path, member):
    run, plain = vortices(2), vortices(2)
    times = []
    run.observers.append(lambda time, length: times.append(float(time[member])) if length[member] > 0 else None)
    with ParticleSeries(tmp_path / "run.vtkhdf", run, every=3, member=member):
        run.advance(0.02)
    plain.advance(0.02)
    for name, values in run.particles.arrays().items():
        assert torch.equal(values, plain.particles.arrays()[name]), name
    assert len(run.observers) == 1 and len(times) == int(run.record.steps[member])
    wanted = [0.0, *times[2::3]] + ([] if len(times) % 3 == 0 else [0.02])
    mine = run.particles.member == member
    count = int(mine.sum())
    with h5py.File(tmp_path / "run.vtkhdf") as file:
        root = file["VTKHDF"]
        np.testing.assert_allclose(root["Steps/Values"][()], wanted, rtol=1e-9)
        assert len(root["Points"]) == count * len(wanted)
        last = root["Points"][-count:]
        np.testing.assert_allclose(last[:, :2], run.particles.position[mine] * PERIODIC.spacing)
        speed = root["PointData/velocity"][-count:, :2]
        np.testing.assert_allclose(speed, run.particles.velocity[mine] * run.units.speed)
        np.testing.assert_allclose(root["PointData/volume"][:count].sum(), 1.0)  # m^2, the whole period


def test_vtk_plays_it(tmp_path):
    pytest.importorskip("vtk", reason="the extra `formats` is not installed")
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkIOHDF import vtkHDFReader

    ball = geometry.ellipsoid((0.01, 0.01, 0.012), 0.003)
    scene = Scene(spacing=2e-3, walls=geometry.WallMotion.at_rest(ball))
    run = Simulator(scene, preset("default")).start(0.0, seed=0)
    with ParticleSeries(tmp_path / "ball.vtkhdf", run):
        run.advance(2e-3)
    reader = vtkHDFReader()
    reader.SetFileName(str(tmp_path / "ball.vtkhdf"))
    reader.UpdateInformation()
    reader.UpdateTimeStep(2e-3)
    mesh = reader.GetOutputDataObject(0)
    assert mesh.GetNumberOfVerts() == run.particles.count
    places = vtk_to_numpy(mesh.GetPoints().GetData())
    np.testing.assert_allclose(places, run.particles.position * run.units.length, rtol=1e-6)
    assert np.linalg.norm(places / [0.01, 0.01, 0.012], axis=1).max() < 1.05
    names = {mesh.GetPointData().GetArrayName(number) for number in range(mesh.GetPointData().GetNumberOfArrays())}
    assert {"velocity", "volume", "deviation", "kind", "pressure"} <= names


def test_what_cannot_be_written_is_refused_before_the_run(tmp_path):
    run = vortices()
    with pytest.raises(ValueError, match="every must be from 1 to"):
        ParticleSeries(tmp_path / "a.vtkhdf", run, every=0)
    with pytest.raises(ValueError, match="member must lie in 0 to 0"):
        ParticleSeries(tmp_path / "a.vtkhdf", run, member=1)
    with pytest.raises(FileNotFoundError, match="no directory"):
        ParticleSeries(tmp_path / "none" / "a.vtkhdf", run)
    with pytest.raises(KeyError), ParticleSeries(tmp_path / "a.vtkhdf", run):
        raise KeyError
    assert not list(tmp_path.iterdir()) and not run.observers
