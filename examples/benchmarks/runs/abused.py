"""Sound calls of everything that the three packages export, small enough to be made a thousand times (`abuses.py`)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

import geometry
import regularize as reg
import torchsph as ts
from torchsph.simulator.seeding import Seeding

Call = tuple[Callable[..., object], dict[str, Any]]
NODES = 5


def calls(folder: Path) -> dict[str, Call]:
    """Every call by its name: what is called, and the arguments that are put wrong one after the other."""
    measured = recording()
    return simulations(measured) | splines() | options() | motions(measured) | shapes(folder) | methods(measured)


def recording() -> geometry.Recording:
    """A ball of blood that grows through an opening at its top."""
    body = geometry.ellipsoid((6e-3, 6e-3, 6e-3), 2.5e-3)
    body = replace(body, region=(body.centroids[:, 2] > 4e-3).astype(np.uint8))
    grid = geometry.Grid.covering((-5e-3,) * 3, (5e-3,) * 3, 1e-2 / (NODES - 1))
    points = grid.nodes().numpy()
    mask = (geometry.winding_number(body.vertices, body.faces, points) > 0.5).reshape(grid.shape)
    times = 0.01 * np.arange(3)
    flow = np.stack([(0.05 * np.cos(200 * points + t)).T.reshape(3, *grid.shape) * mask for t in times])
    wall = geometry.Wall(
        np.stack([body.vertices * (1 + 0.5 * t) for t in times]),
        body.faces,
        body.region,
        np.stack([0.5 * body.vertices] * 3),
    )
    intervals = np.array([[1, -1.0, 1.0]])
    return geometry.Recording(times, grid, flow, mask, wall, 1060.0, 0.004, valve_intervals=intervals)


def shapes(folder: Path) -> dict[str, Call]:
    """Grids and surfaces."""
    body = geometry.ellipsoid((5e-3, 5e-3, 7e-3), 2.5e-3)
    grid = geometry.Grid((-6e-3, -6e-3, -8e-3), (2e-3,) * 3, (9, 7, 7))
    field, points = torch.rand(3, *grid.shape), 2e-3 * torch.rand(20, 3, dtype=torch.float64)
    cap = body.centroids[:, 2] > 5e-3
    cut = geometry.Surface(body.vertices, body.faces[~cap])
    inside = geometry.signed_distance(grid, body) > 0
    geometry.write_surface(folder / "body.stl", body)
    geometry.write_recording(folder / "m.h5", recording())
    square = np.array([[0.0, 0.0], [0.01, 0.0], [0.01, 0.01], [0.0, 0.01]])
    axes = (5e-3, 5e-3, 7e-3)
    return {
        "Grid": (geometry.Grid, {"origin": (0.0,) * 3, "spacing": (1e-3,) * 3, "shape": (4, 5, 6)}),
        "Grid.covering": (geometry.Grid.covering, {"lower": (0.0,) * 3, "upper": (1e-2,) * 3, "spacing": 1e-3}),
        "Grid.sample": (grid.sample, {"field": field, "points": points, "outside": "clamp"}),
        "Grid.spread": (grid.spread, {"values": torch.rand(3, 20, dtype=torch.float64), "points": points}),
        "Grid.contains": (grid.contains, {"points": points, "margin": 0.0}),
        "Grid.refined": (grid.refined, {"spacing": 1e-3}),
        "Grid.padded": (grid.padded, {"nodes": 2}),
        "Surface": (geometry.Surface, {"vertices": body.vertices, "faces": body.faces, "region": body.region}),
        "box": (geometry.box, {"lower": (0.0,) * 3, "upper": (1e-2,) * 3, "spacing": 5e-3}),
        "ellipse": (geometry.ellipse, {"semi_axes": axes[:2], "spacing": 2e-3, "centre": (0.0, 0.0)}),
        "ellipsoid": (geometry.ellipsoid, {"semi_axes": axes, "spacing": 3e-3, "centre": (0.0,) * 3}),
        "polygon": (geometry.polygon, {"corners": square, "spacing": 2e-3}),
        "tube": (geometry.tube, {"radius": 5e-3, "length": 1e-2, "spacing": 3e-3}),
        "revolved": (
            geometry.revolved,
            {"profile": np.array([[0.0, -4e-3], [4e-3, 0.0], [0.0, 4e-3]]), "spacing": 4e-3, "region": 0},
        ),
        "labelled": (
            geometry.labelled,
            {"surface": body, "region": 1, "centre": np.array([0.0, 0.0, 7e-3]), "radius": 3e-3},
        ),
        "openings": (geometry.openings, {"surface": cut}),
        "with_lids": (geometry.with_lids, {"surface": cut, "labels": (1,)}),
        "refined": (geometry.refined, {"surface": body, "spacing": 2e-3}),
        "repaired": (geometry.repaired, {"surface": cut, "merge": 1e-6, "hole_region": 1}),
        "taubin": (geometry.taubin, {"surface": body, "passes": 2, "shrink": 0.5, "inflate": 0.53}),
        "signed_distance": (geometry.signed_distance, {"grid": grid, "surface": body, "band": 4e-3}),
        "winding_number": (
            geometry.winding_number,
            {"vertices": body.vertices, "faces": body.faces, "points": points.numpy()},
        ),
        "unwrap": (geometry.unwrap, {"speed": np.zeros(grid.shape), "known": np.ones(grid.shape, bool), "limit": 0.4}),
        "grid_winding": (geometry.grid_winding, {"grid": grid, "vertices": body.vertices, "faces": body.faces}),
        "SurfaceIndex": (geometry.SurfaceIndex, {"surface": body, "resolution": 1e-3}),
        "SurfaceIndex.query": (geometry.SurfaceIndex(body).query, {"points": points.numpy()}),
        "surface_from_mask": (
            geometry.surface_from_mask,
            {"mask": inside, "grid": grid, "alpha": 5e-3, "smoothing": 1},
        ),
        "surface_from_points": (geometry.surface_from_points, {"points": body.vertices, "alpha": 5e-3}),
        "surface_from_velocity": (
            geometry.surface_from_velocity,
            {"velocity": field.numpy() * inside, "grid": grid, "threshold": 0.0, "alpha": 5e-3},
        ),
        "read_surface": (
            geometry.read_surface,
            {"path": folder / "body.stl", "scale": 1.0, "mend": True, "hole_region": 0},
        ),
        "write_surface": (geometry.write_surface, {"path": folder / "o.stl", "surface": body, "scale": 1.0}),
        "read_recording": (geometry.read_recording, {"path": folder / "m.h5"}),
        "write_recording": (geometry.write_recording, {"path": folder / "o.h5", "recording": recording()}),
    }


def motions(measured: geometry.Recording) -> dict[str, Call]:
    """Recordings and the motion of their walls."""
    wall = measured.wall_for("abuse")
    motion = geometry.WallMotion.from_recording(measured)
    points = 2e-3 * torch.rand(20, 3)
    parts = ("time", "velocity", "mask", "rho", "mu", "period", "valve_intervals")
    shape = (measured.frames, *measured.grid.shape)
    optional = {
        "weight": np.ones(shape),
        "sigma": np.full((3, *measured.velocity.shape[1:]), 0.1),
        "volume": np.full(3, 1e-6),
    }
    distance = geometry.MovingDistance(measured.grid, motion)
    return {
        "Recording": (
            lambda **given: geometry.check_recording(replace(measured, **given)),
            {name: getattr(measured, name) for name in parts} | optional,
        ),
        "Recording.select": (measured.select, {"frames": np.array([0, 1])}),
        "Wall": (
            lambda **given: geometry.check_recording(replace(measured, wall=geometry.Wall(**given))),
            {"vertices": wall.vertices, "faces": wall.faces, "region": wall.region, "velocity": wall.velocity},
        ),
        "OpeningFlux": (geometry.OpeningFlux, {"region": 1, "value": np.zeros(3), "sigma": np.ones(3)}),
        "WallMotion.through": (
            geometry.WallMotion.through,
            {
                "time": measured.time,
                "vertices": wall.vertices,
                "faces": wall.faces,
                "region": wall.region,
                "period": 0.0,
            },
        ),
        "WallMotion.vertices": (motion.vertices, {"t": 0.005}),
        "WallMotion.volume_rate": (motion.volume_rate, {"t": 0.005, "region": 1}),
        "refined_motion": (geometry.refined_motion, {"motion": motion, "spacing": 2e-3}),
        "wall_points": (geometry.wall_points, {"motion": motion, "t": 0.005, "spacing": 2e-3, "smooth_angle": 40.0}),
        "orifices": (geometry.orifices, {"motion": motion}),
        "MovingDistance": (
            geometry.MovingDistance,
            {"grid": measured.grid, "motion": motion, "band": 5e-3, "travel": 1.0, "keep": 4, "device": "cpu"},
        ),
        "MovingDistance.at": (lambda points, t: distance.at(t).at(points), {"points": points, "t": 0.005}),
        "findings": (geometry.findings, {"recording": measured}),
        "estimated": (geometry.estimated, {"recording": measured}),
        "find_valve_times": (geometry.find_valve_times, {"recording": measured}),
        "measurement_type": (geometry.measurement_type, {"recording": measured}),
        "Ventricle": (
            geometry.Ventricle,
            {"length": 0.03, "semi_major": 0.022, "aortic_radius": 0.0036, "axial_share": 0.35},
        ),
        "Beat": (
            geometry.Beat,
            {"period": 0.45, "stroke_fraction": 0.42, "ejection": (0.03, 0.21), "late_share": 0.35},
        ),
    }


def splines() -> dict[str, Call]:
    """The spline smoother."""
    draw = torch.Generator().manual_seed(0)
    points = 0.02 * torch.rand(300, 3, generator=draw, dtype=torch.float64)
    values = torch.randn(300, 3, generator=draw, dtype=torch.float64)
    weight, each = torch.ones(300, dtype=torch.float64), torch.ones(300, 3, dtype=torch.float64)
    knots = reg.Knots((0.0,) * 3, (5e-3,) * 3, (4, 4, 4), 3)
    normals = torch.nn.functional.normalize(values, dim=1)
    system = reg.System(knots, 3, [reg.VectorRows(knots, points, values, each)], 1e-3)
    field = reg.Smoother(knots=2.0, spacing=(5e-3,) * 3).fixed().fit(points, values, weight)
    known = reg.Smoother(knots=2.0, spacing=(5e-3,) * 3).fixed().fit(points, values, weight, uncertainty=True)
    rows = values[:, None].expand(300, 1, 3)[:9].reshape(9, 3)
    linear = {
        "points": points[:9],
        "rows": rows,
        "group": torch.arange(9) // 3,
        "value": torch.zeros(3).double(),
        "sigma": torch.ones(3).double(),
    }

    def solved(**given: Any) -> object:
        return reg.solve_direct(reg.System(knots, 3, [reg.VectorRows(knots, **given)], 1e-3)).solution.x

    smoother = reg.Smoother(knots=2.0, spacing=(5e-3,) * 3).fixed()
    return {
        "Knots": (reg.Knots, {"origin": (0.0,) * 3, "spacing": (5e-3,) * 3, "cells": (4, 4, 4), "degree": 3}),
        "basis": (reg.basis, {"t": torch.linspace(0, 1, 5), "degree": 3, "order": 0}),
        "VectorRows": (solved, {"points": points, "target": values, "weight": each}),
        "System": (
            lambda components, damping: reg.sparse_matrix(
                reg.System(knots, components, system.blocks, damping)
            ).to_dense(),
            {"components": 3, "damping": 1e-3},
        ),
        "DirectionRows": (
            lambda **given: reg.sparse_matrix(
                reg.System(knots, 3, [reg.DirectionRows(knots, **given)], 1e-3)
            ).to_dense(),
            {"points": points, "direction": normals, "target": values[:, 0], "weight": weight},
        ),
        "DivergenceRows": (
            lambda **given: reg.sparse_matrix(
                reg.System(knots, 3, [reg.DivergenceRows(knots, **given)], 1e-3)
            ).to_dense(),
            {"points": points, "components": 3, "weight": weight},
        ),
        "Smoother": (
            lambda **given: reg.Smoother(**given).fit(points, values, weight).coefficients,
            {"knots": 2.0, "spacing": (5e-3,) * 3, "degree": 3, "divergence": 0.02, "curvature": 3e-3},
        ),
        "Smoother.fit": (
            lambda **given: smoother.fit(**given).coefficients,
            {"points": points, "velocity": values, "weight": weight, "divergence_points": points, "beam": normals},
        ),
        "WallRows": (
            lambda **given: smoother.fit(points, values, weight, reg.WallRows(**given)).coefficients,
            {
                "points": points[:50],
                "normals": normals[:50],
                "velocity": values[:50],
                "weight": weight[:50],
                "no_slip": weight[:50],
            },
        ),
        "SplineField": (field, {"points": points[:20], "outside": 0.0}),
        "SplineField.gradient": (field.gradient, {"points": points[:20], "outside": 0.0}),
        "LinearData": (lambda **given: reg.with_linear_data(known, reg.LinearData(**given)).coefficients, linear),
        "lsmr": (
            lambda b, **more: reg.lsmr(lambda x: x, lambda y: y, b, **more).x,
            {
                "b": torch.rand(5).double(),
                "weight": torch.ones(5).double(),
                "damping": 0.1,
                "tolerance": 1e-6,
                "max_iterations": 50,
            },
        ),
    }


def options() -> dict[str, Call]:
    """What a simulation is told before it begins."""
    return {
        "Fluid": (ts.Fluid, {"density": 1060.0, "viscosity": 0.004}),
        "Valve": (
            ts.Valve,
            {"region": 1, "intervals": ((0.0, 0.1),), "period": 0.5, "pressure": 100.0, "stagnation": True},
        ),
        "Valve of a flux": (ts.Valve, {"region": 1, "intervals": ((0.0, 0.1),), "flux": 1e-5, "flux_sigma": 1e-6}),
        "XSPH": (ts.XSPH, {"epsilon": 0.2, "level": "velocity", "form": "pairs"}),
        "CompleteKernelWall": (ts.CompleteKernelWall, {"no_slip": True, "gap": 0.05}),
        "PotentialWall": (ts.PotentialWall, {"stiffness": 0.2, "reach": 1.0, "relaxation": 1.0}),
        "Reservoir": (ts.Reservoir, {"profile": "field", "run_out": 0.0, "relaxation": 5.0}),
        "PressureSource": (ts.PressureSource, {"core": 0.5}),
        "PopulationControl": (ts.PopulationControl, {"every": 20, "closest": 0.4, "heaviest": 2.5, "missing": 0.75}),
        "Rollback": (ts.Rollback, {"tries": 3, "every": 50, "density": (0.5, 2.0)}),
        "GammaRamp": (ts.GammaRamp, {"start": 1.0, "duration": 0.01, "keep": "prefactor"}),
        "Seeding": (ts.Seeding, {"kind": "quiet", "temperature": 0.1, "relaxations": 5, "packings": 1, "jitter": 0.02}),
        "Projection": (
            ts.Projection,
            {
                "kernel": "wendland_c2",
                "smoothing_ratio": 1.3,
                "shifting": 2.0,
                "relaxation": 2.0,
                "tolerance": 0.02,
                "iterations": 200,
            },
        ),
        "WeaklyCompressible": (
            ts.WeaklyCompressible,
            {
                "kernel": "wendland_c2",
                "smoothing_ratio": 1.3,
                "sound_speed": 5.0,
                "gamma": 1.0,
                "artificial_viscosity": 0.02,
            },
        ),
        "preset": (ts.preset, {"name": "default", "max_step": 5e-4}),
        "kernel": (ts.kernel, {"name": "wendland_c2"}),
        "Transfer": (ts.Transfer, {"fade": 0.015, "projections": 2}),
        "EnsembleOptions": (
            ts.EnsembleOptions,
            {
                "model_error": 0.2,
                "localisation": 0.33,
                "relaxation": 0.5,
                "memory": 8.0,
                "batch": 8,
                "lag": 2,
                "minimum_members": 2,
            },
        ),
    }


def simulations(measured: geometry.Recording) -> dict[str, Call]:
    """Scenes, simulators and what is done to runs."""
    scene = ts.Scene.from_recording(measured, 2.5e-3)
    model = ts.Simulator(scene, ts.preset("default"), seeding=Seeding(relaxations=2, packings=0))
    grid, mask = measured.grid, torch.from_numpy(np.array(measured.mask[0], bool))
    flow, ones = torch.from_numpy(np.array(measured.velocity[0])).float(), torch.ones(grid.shape)
    ready = model.start(0.0, members=2, seed=0)

    def run() -> ts.Simulation:
        return model.resume(ready.particles, 0.0)

    def done(name: str) -> Callable[..., object]:
        def work(**given: Any) -> object:
            going = run()
            found = getattr(going, name)(**given)
            going.advance(max(going.time, 1e-3))
            return found, going.particles.arrays()

        return work

    particles = ready.particles.arrays()

    def resumed(**given: Any) -> object:
        going = model.resume(replace(ready.particles, **given), 0.0)
        going.advance(1e-3)
        return going.particles.arrays()

    return {
        "Scene": (
            lambda **given: replace(scene, **given),
            {
                "spacing": 2.5e-3,
                "gravity": (0.0, 0.0, -9.81),
                "reference_speed": 1.0,
                "dimension": 3,
                "valves": scene.valves,
            },
        ),
        "Scene.from_recording": (ts.Scene.from_recording, {"recording": measured, "spacing": 2.5e-3}),
        "Simulator": (
            lambda **given: ts.Simulator(scene, ts.preset("default"), **given).start(0.0).particles.arrays(),
            {"device": "cpu", "dtype": torch.float32, "backend": "auto"},
        ),
        "Simulator.start": (
            lambda **given: model.start(**given).particles.arrays(),
            {"time": 0.0, "members": 2, "seed": 0},
        ),
        "Simulator.resume": (resumed, particles),
        "Simulation.advance": (done("advance"), {"until": 2e-3}),
        "Simulation.impose": (done("impose"), {"grid": grid, "velocity": flow, "mask": mask, "confidence": ones}),
        "Simulation.pull": (done("pull"), {"grid": grid, "target": flow, "gain": 0.5 * ones, "weight": ones}),
        "Simulation.fetch": (done("fetch"), {"grid": grid, "mask": mask}),
        "Simulation.project": (done("project"), {"times": 1}),
        "Simulation.change": (done("change"), {"viscosity": 0.004}),
        "residual_motion": (ts.residual_motion, {"simulator": model, "time": 0.0, "duration": 2e-3, "seed": 0}),
        "GridForecast": (
            lambda **given: ts.GridForecast(model, seed=0, **given).at(2e-3, mask),
            {"grid": grid, "velocity": flow, "mask": mask, "time": 0.0, "transfer": ts.Transfer(fade=None)},
        ),
    }


def methods(measured: geometry.Recording) -> dict[str, Call]:
    """What is run on a measurement."""
    model = ts.make_model(measured, spacing=2.5e-3)
    splines = reg.Smoother().fixed()
    prepared = ts.PreparedMeasurement(measured, splines)
    return {
        "make_model": (
            lambda **given: ts.make_model(**given).scene.spacing,
            {"recording": measured, "preset": "default", "spacing": 2.5e-3, "device": "cpu"},
        ),
        "smooth": (ts.smooth, {"measured": measured, "smoother": splines}),
        "filter_sph": (
            lambda **given: ts.filter_sph(**given).recording,
            {"measured": measured, "model": model, "seed": 0},
        ),
        "forecast_skill": (
            lambda **given: ts.forecast_skill(**given).leads,
            {
                "recording": measured,
                "leads": (0.01,),
                "every": 2,
                "preset": "default",
                "spacing": 2.5e-3,
                "device": "cpu",
                "seed": 0,
            },
        ),
        "assimilate": (
            lambda **given: ts.assimilate(**given).recording,
            {
                "measured": prepared,
                "model": model,
                "members": 2,
                "options": ts.EnsembleOptions(),
                "also": (),
                "seed": 0,
            },
        ),
        "run_methods": (
            lambda **given: [one.recording for one in ts.run_methods(**given).values()],
            {
                "measured": measured,
                "methods": ("spline",),
                "preset": "default",
                "spacing": 2.5e-3,
                "members": 2,
                "seed": 0,
            },
        ),
    }
