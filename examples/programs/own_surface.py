"""Your own surface, an STL cut open at both ends: lids, valves, and a flow that is driven through it.

Prints the flow that leaves over the flow that enters.
"""

import tempfile
from pathlib import Path

import trimesh

import geometry
from torchsph import Scene, Simulator, Valve, preset

FLOW = 2e-5  # m^3/s


def stand_in(folder: str) -> Path:
    """An STL without lids, in mm, as a segmentation tool would write it."""
    tube = geometry.tube(radius=6.0, length=20.0, spacing=1.2)
    wall = trimesh.Trimesh(tube.vertices, tube.faces[tube.region == 0])
    wall.export(Path(folder) / "vessel.stl")
    return Path(folder) / "vessel.stl"


def main() -> float:
    with tempfile.TemporaryDirectory() as folder:
        cut = trimesh.load(stand_in(folder))  # STL repeats every vertex: loading merges them, and closes nothing
    surface = geometry.Surface(1e-3 * cut.vertices, cut.faces)
    closed = geometry.with_lids(surface)  # lids get the regions 1, 2, ...; geometry.openings(surface) lists them
    always = ((0.0, 1.0),)
    valves = (Valve(1, always, flux=FLOW), Valve(2, always))  # the second carries what is left
    scene = Scene(spacing=2e-3, walls=geometry.WallMotion.at_rest(closed), valves=valves)
    run = Simulator(scene, preset("default")).start(time=0.0)
    run.advance(0.15)
    return float(run.record.outflow[0, 1] / run.record.inflow[0, 0])


if __name__ == "__main__":
    print(f"outflow over inflow {main():.3f}")
