"""The curves of a whole recording and the numbers of its beat, on a flow that speeds up between walls."""

from __future__ import annotations

import numpy as np
import pytest

from torchsph.haemodynamics.beat import BEAT_UNITS, beat_numbers
from torchsph.haemodynamics.domain import FlowDomain, long_axis
from torchsph.haemodynamics.quantities import UNITS, flow_quantities

TIMES = (0.0, 0.01, 0.02, 0.03)


def speeding(points, time):
    """u_z = -(0.5 + 20 t): a plug that speeds up by 20 m/s2, in through the top of the box."""
    return np.tile([0.0, 0.0, -(0.5 + 20 * time)], (len(points), 1))


@pytest.fixture(name="recording")
def _recording(box_recording):
    return box_recording(speeding, times=TIMES, nodes=10)


def test_curves_of_a_plug_that_speeds_up(recording):
    domain = FlowDomain.from_recording(recording)
    still = domain.motion  # the walls stand still and would shear the plug: the pressure must not see them
    found = flow_quantities(domain, recording.velocity)
    speed = 0.5 + 20 * np.array(TIMES)
    assert set(found) == set(UNITS) and still.dimension == 3
    np.testing.assert_allclose(found["volume"], 1e-6, rtol=1e-9)
    np.testing.assert_allclose(found["kinetic_energy"], 0.5 * 1060 * speed**2 * 1e-6, rtol=1e-6)
    # the orifice is the top: axis from the farthest corner below to its middle; the force points down
    base, apex = long_axis(domain.motion.surface(0.0))
    axis = (base - apex) / np.linalg.norm(base - apex)
    np.testing.assert_allclose(found["force_axial"], -1060 * 20 * 1e-6 * axis[2], rtol=1e-4)
    np.testing.assert_allclose(found["force_across"], 1060 * 20 * 1e-6 * np.sqrt(1 - axis[2] ** 2), rtol=1e-4)
    assert found["pressure_difference"] == pytest.approx(found["pressure_difference"][0], rel=1e-4)
    # grad p = rho 20 along z: about 6 mm between the places, of which the nodes within 2 mm are averaged
    assert 100 < found["pressure_difference"][0] < 1060 * 20 * 0.01
    np.testing.assert_allclose(found["flow_inlet"], 1e-4 * speed, rtol=1e-5)
    assert not found["flow_outlet"].any()


def test_members_side_by_side_and_the_variance(recording):
    domain = FlowDomain.from_recording(recording)
    alone = flow_quantities(domain, recording.velocity, sigma=np.full_like(recording.velocity, 0.1))
    both = flow_quantities(domain, np.stack([recording.velocity, 0.5 * recording.velocity]))
    single = flow_quantities(domain, recording.velocity)
    for name in UNITS:
        assert both[name].shape == (2, 4)
        np.testing.assert_allclose(both[name][0], single[name], rtol=1e-9, atol=1e-12, err_msg=name)
    np.testing.assert_allclose(both["kinetic_energy"][1], 0.25 * single["kinetic_energy"])
    np.testing.assert_allclose(alone["kinetic_energy"] - single["kinetic_energy"], 0.5 * 1060 * 0.03 * 1e-6, rtol=1e-5)


def test_a_shut_valve_lets_nothing_through(box_recording):
    shut = box_recording(speeding, times=TIMES, valve_intervals=np.array([[1.0, 0.015, 0.025]]))
    domain = FlowDomain.from_recording(shut)
    assert (flow_quantities(domain, shut.velocity)["flow_inlet"] > 0).tolist() == [False, False, True, False]
    assert domain.events == [0.015, 0.025]


def test_what_does_not_fit_is_refused(box_recording, recording):
    with pytest.raises(ValueError, match="must be"):
        flow_quantities(FlowDomain.from_recording(recording), recording.velocity[:2])


def test_numbers_of_a_beat():
    time = np.linspace(0, 0.4, 401)
    filling = np.maximum(np.sin(2 * np.pi * (time - 0.2) / 0.2), 0) * (time >= 0.2)
    ejection = np.sin(np.pi * time / 0.2) * (time < 0.2)
    curves = {name: np.zeros_like(time) for name in UNITS} | {
        "volume": 6e-6 - 2e-6 * np.sin(np.pi * time / 0.4),
        "flow_inlet": 3e-5 * filling,
        "flow_outlet": 2e-5 * ejection,
        "kinetic_energy": np.full_like(time, 2e-4),
        "energy_loss": np.full_like(time, 1e-3),
        "pressure_difference": 50 * np.cos(2 * np.pi * (time - 0.1) / 0.4),
    }
    found = beat_numbers(time, {name: np.stack([curve, 2 * curve]) for name, curve in curves.items()})
    assert set(found) == set(BEAT_UNITS) and all(value.shape == (2,) for value in found.values())
    assert found["stroke_volume_wall"] == pytest.approx([2e-6, 4e-6]) and found["ejection_fraction"][
        0
    ] == pytest.approx(1 / 3)
    assert found["stroke_volume"][0] == pytest.approx(2e-5 * 0.4 / np.pi, rel=1e-4)
    assert found["filling_volume"][0] == pytest.approx(3e-5 * 0.2 / np.pi, rel=1e-3)
    assert found["e_time"][0] == pytest.approx(0.25, abs=1e-4) and np.isnan(found["e_over_a"]).all()
    assert found["energy_lost"][0] == pytest.approx(4e-4)
    assert found["kinetic_energy_mean"][0] == pytest.approx(2e-4)
    assert found["pressure_difference_highest"][0] == pytest.approx(50, rel=1e-4)
    assert found["pressure_difference_lowest_time"][0] == pytest.approx(0.3, abs=1e-4)
    assert found["regurgitant_fraction_outlet"][0] == pytest.approx(0, abs=1e-9)
