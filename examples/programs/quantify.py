"""What people read out of a flow: kinetic energy, energy loss, pressure difference, forces, flow rates over time.

Prints the kinetic energy of the smoothed measurement over the true one, at the peak of the filling jet.
"""

import numpy as np

import geometry
import torchsph as ts
from torchsph.data import sample_measurement, sample_truth
from torchsph.haemodynamics import FlowDomain, flow_quantities


def curves(recording: geometry.Recording) -> dict[str, np.ndarray]:
    """Every quantity of a recording, (T,) each; units in `haemodynamics.quantities.UNITS`."""
    return flow_quantities(FlowDomain.from_recording(recording), np.nan_to_num(recording.velocity))


def main() -> float:
    measured = geometry.read_recording(sample_measurement())
    measured = measured.select(measured.time > 0.295)
    truth = geometry.read_recording(sample_truth())
    found, true = curves(ts.smooth(measured)), curves(truth.select(truth.time > 0.295))
    return float(found["kinetic_energy"].max() / true["kinetic_energy"].max())


if __name__ == "__main__":
    print(f"kinetic energy over the true one: {main():.3f}")
