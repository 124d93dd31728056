"""Forecasts of a ventricle from one of its velocity fields, its moving walls and its valve times.

Prints the error 20 ms ahead over that of assuming that nothing changes.
"""

import geometry
from torchsph import Scene, Simulator, preset, skill
from torchsph.data import sample_truth


def main() -> float:
    recording = geometry.read_recording(sample_truth())
    recording = recording.select(recording.time > 0.275)  # the early filling wave
    scene = Scene.from_recording(recording, spacing=2e-3)
    simulator = Simulator(scene, preset("default"))
    result = skill(recording, simulator, leads=[0.005, 0.02], every=recording.frames)
    error = result.leads[-1]["nrmse"]
    return error["model"] / error["persistence"]


if __name__ == "__main__":
    print(f"error over that of persistence: {main():.3f}")
