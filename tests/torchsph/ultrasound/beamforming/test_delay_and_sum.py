"""Delay-and-sum: points where they are, their phase, PyMUST's numbers, and a rotating disk from its MATLAB file."""

import math

import numpy as np
import pytest
import torch
from channel_cases import FREQUENCY, SOUND_SPEED, plane, rotating_disk, scanned

from geometry import Grid
from torchsph.ultrasound import (
    Acquisition,
    ChannelData,
    DelayAndSum,
    IQPhase,
    SpeckleTracker,
    delay_and_sum,
    demodulated,
    read_channel_data,
)
from torchsph.ultrasound.beamforming.channel_data import diverging_wave_delays, linear_array, plane_wave_delays

WAVE = 4 * math.pi * FREQUENCY / SOUND_SPEED  # phase per metre, there and back
SOURCE = (1e-3, -8e-3)


def silent(elements):
    return torch.zeros(len(elements)).double()


def diverging(places):
    """When the wave of the virtual source is at places: 0 is when the first element transmits."""
    first = diverging_start()
    return (np.linalg.norm(places - np.array(SOURCE), axis=1) - first) / SOUND_SPEED


def diverging_start():
    return float((linear_array(64, 0.3e-3) - torch.tensor(SOURCE).double()).norm(dim=1).min())


def steered(places):
    direction = np.array([math.sin(0.15), math.cos(0.15)])
    first = float((linear_array(64, 0.3e-3).numpy() @ direction).min())
    return (places @ direction - first) / SOUND_SPEED


WAVES = {
    "plane": (silent, plane),
    "steered": (
        lambda elements: plane_wave_delays(elements, (math.sin(0.15), math.cos(0.15)), SOUND_SPEED),
        steered,
    ),
    "diverging": (lambda elements: diverging_wave_delays(elements, SOURCE, SOUND_SPEED), diverging),
}


@pytest.mark.parametrize("name", WAVES)
@pytest.mark.parametrize("place", [(0.0, 18e-3), (1.3e-3, 22.2e-3)])
def test_a_point_is_seen_where_it_is(name, place):
    delays, arrival = WAVES[name]
    data = scanned([np.array([place])], np.ones(1), delays, arrival)
    step = 0.02e-3
    grid = Grid((place[0] - 25 * 4 * step, place[1] - 25 * step), (4 * step, step), (51, 51))
    image = delay_and_sum(data, grid).iq[0].abs()
    row, column = divmod(int(image.argmax()), 51)
    assert abs(row - 25) <= 1 and abs(column - 25) <= 1
    assert image[25, 25] > 0.99 * image.max()
    assert image[25, 25] > 3 * image[[0, -1]].max()  # a pulse of .25 mm ends within half a millimetre


def test_the_phase_of_a_point_is_twice_its_way():
    """Baseband: -4 pi f z / c at every depth sampled; carrier: what the sample's own depth adds."""
    place = np.array([[0.0, 20.013e-3]])
    data = scanned([place], np.ones(1), *WAVES["plane"])
    grid = Grid((0.0, 19.95e-3), (1e-4, 0.01e-3), (13, 1))
    z = grid.nodes()[:, 1]
    # few elements: the ways to the outer ones are longer, and their phases less than twice the depth
    base = delay_and_sum(data, grid, DelayAndSum(f_number=10.0)).iq[0, :, 0].to(torch.complex128)
    carrier = delay_and_sum(data, grid, DelayAndSum(f_number=10.0, phase=IQPhase.CARRIER)).iq[0, :, 0]
    off = torch.polar(torch.ones_like(z), torch.full_like(z, WAVE * place[0, 1]))
    assert (base * off).angle().abs().max() < 0.02
    torch.testing.assert_close(base * torch.polar(torch.ones_like(z), WAVE * z), carrier.to(torch.complex128))
    slope = np.polyfit(z.numpy(), np.unwrap(carrier.angle().numpy()), 1)[0]
    assert slope == pytest.approx(WAVE, rel=0.005)


def test_a_disk_from_its_matlab_file_turns_as_it_did(tmp_path):
    """Channel data of MATLAB to velocities: a solid rotation within 2 %.

    The axial component alone keeps these 2 % in every derivative; the lateral one, which has no phase to go by, is
    some 5 times as noisy, and its own derivatives are held to 5 %.
    """
    from scipy.io import savemat

    rate, data = 60.0, rotating_disk(60.0, images=12)
    parameters = {
        "fc": FREQUENCY,
        "fs": data.sampling_rate,
        "pitch": 0.3e-3,
        "c": SOUND_SPEED,
        "t0": data.start,
        "PRF": data.acquisition.prf,
        "TXdelay": np.zeros(64),
        "bandwidth": 60.0,
    }
    savemat(tmp_path / "disk.mat", {"RF": data.signals.permute(1, 2, 0).numpy(), "param": parameters})
    read = read_channel_data(tmp_path / "disk.mat")
    torch.testing.assert_close(read.signals, data.signals.float())
    assert read.acquisition == data.acquisition and read.bandwidth == pytest.approx(0.6)
    step = 1e-4
    packet = delay_and_sum(read, Grid((-6e-3, 14e-3), (step, step), (121, 121)), DelayAndSum(f_number=1.5))
    axis = torch.arange(-9, 10).double() * 0.4e-3
    points = torch.cartesian_prod(axis, axis) + torch.tensor([0.0, 20e-3]).double()
    points = points[(points - torch.tensor([0.0, 20e-3])).norm(dim=1) < 3.8e-3]
    found = SpeckleTracker(clutter=None, kernel=2e-3).track(packet, points)
    assert found.accepted.float().mean() > 0.95
    places, velocity = points[found.accepted].numpy(), found.velocity[found.accepted].double().numpy()
    (dux, duz), (dwx, dwz) = np.linalg.lstsq(np.c_[places, np.ones(len(places))], velocity, rcond=None)[0][:2].T
    assert 0.5 * (dwx - duz) == pytest.approx(rate, rel=0.02)
    assert dwx == pytest.approx(rate, rel=0.02) and abs(dwz) < 0.02 * rate
    assert -duz == pytest.approx(rate, rel=0.05) and abs(dux) < 0.05 * rate


def pymust_parameters(data):
    pymust = pytest.importorskip("pymust")
    parameters = pymust.utils.Param()
    parameters.fs, parameters.fc, parameters.pitch = data.sampling_rate, FREQUENCY, 0.3e-3
    parameters.c, parameters.t0, parameters.fnumber = SOUND_SPEED, np.array([data.start]), 1.5
    parameters.bandwidth, parameters.Nelements, parameters.TXdelay = 60.0, 64, data.delays.numpy()
    return pymust, parameters


@pytest.mark.parametrize("name", WAVES)
def test_iq_and_images_are_those_of_pymust(name):
    """PyMUST 0.1.9, rf2iq and dasmtx (linear); its transmitting elements are interpolated, ours are as they are."""
    generator = np.random.default_rng(1)
    places = np.stack([generator.uniform(-4e-3, 4e-3, 200), generator.uniform(16e-3, 24e-3, 200)], 1)
    data = scanned([places, places], generator.normal(size=200), *WAVES[name])
    pymust, parameters = pymust_parameters(data)
    rf = np.ascontiguousarray(data.signals.permute(1, 2, 0).numpy())
    theirs = pymust.rf2iq(rf, parameters)
    ours = demodulated(data).signals.permute(1, 2, 0).numpy()
    np.testing.assert_allclose(ours, theirs, atol=1e-9 * abs(theirs).max())
    grid = Grid((-4e-3, 16e-3), (2e-4, 2e-4), (41, 41))
    x, z = (part.reshape(grid.shape).numpy() for part in grid.nodes().unbind(1))
    operator = pymust.dasmtx(1j * np.array(theirs.shape[:2]), x, z, parameters, "linear")
    image = (operator @ theirs[..., 0].reshape(-1, order="F")).reshape(grid.shape, order="F")
    found = delay_and_sum(data, grid, DelayAndSum(f_number=1.5, phase=IQPhase.CARRIER)).iq[0].numpy()
    assert np.linalg.norm(found - image) < 0.01 * np.linalg.norm(image)


def test_what_cannot_be_beamformed_is_refused(tmp_path):
    elements, signals = linear_array(8, 0.3e-3), torch.zeros((2, 50, 8))
    slow = ChannelData(signals, elements, silent(elements), 6.67e6, Acquisition())
    with pytest.raises(ValueError, match="bandwidth is"):
        demodulated(slow)
    wide = ChannelData(signals, elements, silent(elements), 6.67e6, Acquisition(), bandwidth=0.9)
    with pytest.raises(ValueError, match="folds onto"):
        demodulated(wide)
    with pytest.raises(ValueError, match="elements are 2-D"):
        delay_and_sum(wide, Grid((0.0,) * 3, (1e-3,) * 3, (2, 2, 2)))
    with pytest.raises(ValueError, match=r"elements must be \(8"):
        ChannelData(signals, elements[:4], silent(elements), 25e6, Acquisition())
    with pytest.raises(ValueError, match="delays"):
        ChannelData(signals, elements, silent(elements) * math.nan, 25e6, Acquisition())
    with pytest.raises(FileNotFoundError):
        read_channel_data(tmp_path / "none.mat")
    (tmp_path / "text.mat").write_text("nothing")
    with pytest.raises(ValueError, match="no MATLAB file"):
        read_channel_data(tmp_path / "text.mat")
    from scipy.io import savemat

    savemat(tmp_path / "bare.mat", {"RF": np.zeros((50, 8, 2))})
    with pytest.raises(ValueError, match="structure param"):
        read_channel_data(tmp_path / "bare.mat")
    savemat(tmp_path / "lacking.mat", {"RF": np.zeros((50, 8, 2)), "param": {"fs": 1e7}})
    with pytest.raises(ValueError, match="lacks fc, pitch"):
        read_channel_data(tmp_path / "lacking.mat")
