"""A column of water collapses: free surface, gravity, walls.

Prints the mean relative difference of the surge front from that of Martin and Moyce (1952).
"""

import math

import numpy as np

from torchsph import Simulator, WeaklyCompressible
from torchsph.validation.dam_breaks import GRAVITY, MARTIN_MOYCE_1952, column_scene, front_error, surge_front
from torchsph.validation.exact_flows import FREE_SURFACE_OPTIONS
from torchsph.validation.free_surface import resting_block


def main() -> float:
    scene = column_scene(spacing=0.1, viscosity=25.0)  # a column 1 m wide, 2 m high; the bed brakes the front
    scheme = WeaklyCompressible(**(FREE_SURFACE_OPTIONS | {"sound_speed": 5 * scene.reference_speed}))
    simulator = Simulator(scene, scheme)
    run = simulator.resume(resting_block(simulator, (0.0, 0.0), (1.0, 2.0)), time=0.0)

    times = np.arange(0.2, 2.5, 0.2)  # in units of sqrt(a / 2 g), as the experiment counts
    fronts = []
    for time in times:
        run.advance(time / math.sqrt(2 * GRAVITY))
        fronts.append(surge_front(run))
    return front_error(times, np.array(fronts), MARTIN_MOYCE_1952)


if __name__ == "__main__":
    print(f"front differs from the experiment by {main():.3f}")
