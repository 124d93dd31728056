"""PySPH's side of peers.py: its own two-dimensional dam break, timed without set-up and compilation.

    PYTHON-WITH-PYSPH examples/benchmarks/peers/peers_pysph.py RESULT.json SPACING DURATION SCHEME THREADS

Scheme, sound speed, kernel, integrator and adaptive steps are those of ``pysph.examples.dam_break_2d``; only the
particles are placed so that the column is as wide as it says, and nothing is written while the clock runs.
"""

import json
import sys
import tempfile
import time

import numpy as np
from pysph.base.utils import get_particle_array
from pysph.examples import dam_break_2d as example
from pysph.tools.geometry import get_2d_tank


class DamBreak(example.DamBreak2D):
    """The example with a column of exactly WIDTH x HEIGHT beside the wall, which lies half a spacing from 0."""

    def create_particles(self):
        dx = self.dx
        mass = dx * dx * example.ro
        columns = (np.arange(round(example.fluid_column_width / dx)) + 1.0) * dx
        rows = (np.arange(round(example.fluid_column_height / dx)) + 1.0) * dx
        x, y = (c.ravel() for c in np.meshgrid(columns, rows, indexing="ij"))
        fluid = get_particle_array(name="fluid", x=x, y=y, h=self.h, m=mass, rho=example.ro)
        x, y = get_2d_tank(
            dx=dx, length=example.container_width, height=example.container_height, base_center=[2, 0], num_layers=4
        )
        boundary = get_particle_array(name="boundary", x=x, y=y, h=self.h, m=mass, rho=example.ro)
        self.scheme.setup_properties([fluid, boundary])
        self.kernel_corrections(fluid, boundary)
        self.front = []
        return [fluid, boundary]

    def pre_step(self, solver):
        # the last particle's centre is as far from the wall's first layer as its edge from the wall
        self.front.append((solver.t, float(self.particles[0].x.max())))


def main(result: str, spacing: str, duration: str, scheme: str, threads: str) -> None:
    """Run, write times and the front's path."""
    with tempfile.TemporaryDirectory() as folder:
        # the number of threads comes from OMP_NUM_THREADS, which OpenMP read before this line
        parallel = "--openmp" if int(threads) > 1 else "--no-openmp"
        app = DamBreak(fname="dam_break")
        app.setup(
            [
                "--dx",
                spacing,
                "--tf",
                duration,
                "--scheme",
                scheme,
                parallel,
                "--pfreq",
                "1000000000",
                "-d",
                folder,
            ]
        )
        cpu, wall = time.process_time(), time.perf_counter()
        app.solver.solve(show_progress=False)
        cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
    fluid, boundary = app.particles
    row = {
        "wall_s": wall,
        "cpu_s": cpu,
        "steps": app.solver.count,
        "particles": fluid.get_number_of_particles(),
        "boundary": boundary.get_number_of_particles(),
        "front": app.front,
    }
    with open(result, "w") as out:
        json.dump(row, out)


if __name__ == "__main__":
    main(*sys.argv[1:])
