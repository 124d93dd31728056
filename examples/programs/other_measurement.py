"""Another measurement: one component of the velocity, as Doppler measures it, instead of whole vectors.

A recording with `/beam` holds (v . b) b; everything else stays as it is. Prints the relative error of the vectors that
the splines make of the one component, the walls and the conservation of mass.
"""

from dataclasses import replace

import numpy as np

import geometry
import torchsph as ts
from torchsph.data import sample_measurement, sample_truth
from torchsph.evaluation.metrics import evaluate


def main() -> float:
    vectors = geometry.read_recording(sample_measurement())
    vectors = vectors.select(vectors.time > 0.315)  # the filling jet
    beam = np.zeros((3, *vectors.grid.shape), np.float32)
    beam[2] = 1.0  # along z, from the apex
    along = (vectors.velocity * beam).sum(1, keepdims=True) * beam
    doppler = replace(vectors, velocity=along, beam=beam)

    smooth = ts.smooth(doppler)
    truth = geometry.read_recording(sample_truth())
    value = evaluate(smooth, truth)["nrmse"].value
    assert value is not None
    return value


if __name__ == "__main__":
    print(f"relative error of whole vectors from one component: {main():.3f}")
