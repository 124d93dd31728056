"""Convex arrays, several waves of one image, and MATLAB files of either kind, beside PyMUST."""

import math

import h5py
import numpy as np
import pytest
import torch
from channel_cases import BANDWIDTH, FREQUENCY, SOUND_SPEED, echoes

from geometry import Grid
from torchsph.ultrasound import (
    Acquisition,
    ChannelData,
    DelayAndSum,
    IQPhase,
    convex_array,
    delay_and_sum,
    demodulated,
    read_channel_data,
    read_transmissions,
)
from torchsph.ultrasound.beamforming.channel_data import linear_array, plane_wave_delays

COUNT, PITCH, RADIUS = 64, 0.4e-3, 40e-3
RATE, START, SAMPLES, PRF = 25e6, 10e-6, 1024, 6e3
ANGLES = (-0.12, 0.0, 0.12)


def convex_data(places, amplitudes):
    """Channel data of a convex array whose elements fire together: the wave diverges from the circle's middle."""
    elements, normals = convex_array(COUNT, PITCH, RADIUS)
    middle = (elements - RADIUS * normals).mean(0).numpy()
    arrival = (np.linalg.norm(places - middle, axis=1) - RADIUS) / SOUND_SPEED
    rf = echoes(places, amplitudes, arrival, elements.numpy(), rate=RATE, start=START, samples=SAMPLES)
    acquisition = Acquisition(FREQUENCY, SOUND_SPEED, PRF, 1)
    silent = torch.zeros(COUNT).double()
    return ChannelData(torch.from_numpy(rf)[None], elements, silent, RATE, acquisition, START, BANDWIDTH, normals)


def steered_data(places, amplitudes, angle, *, images=1):
    """Channel data of a linear array and one steered plane wave."""
    elements = linear_array(COUNT, 0.3e-3)
    direction = np.array([math.sin(angle), math.cos(angle)])
    delays = plane_wave_delays(elements, tuple(direction), SOUND_SPEED)
    arrival = (places @ direction - (elements.numpy() @ direction).min()) / SOUND_SPEED
    rf = echoes(places, amplitudes, arrival, elements.numpy(), rate=RATE, start=START, samples=SAMPLES)
    acquisition = Acquisition(FREQUENCY, SOUND_SPEED, PRF / len(ANGLES), images)
    signals = torch.from_numpy(np.stack([rf] * images))
    return ChannelData(signals, elements, delays, RATE, acquisition, START, BANDWIDTH)


def pymust_parameters(data, **more):
    pymust = pytest.importorskip("pymust")
    parameters = pymust.utils.Param()
    parameters.fs, parameters.fc, parameters.c = RATE, FREQUENCY, SOUND_SPEED
    parameters.t0, parameters.fnumber, parameters.bandwidth = np.array([START]), 1.5, 100 * BANDWIDTH
    parameters.Nelements, parameters.TXdelay = COUNT, data.delays.numpy()
    for name, value in more.items():
        setattr(parameters, name, value)
    return pymust, parameters


def pymust_image(data, grid, **more):
    """The image that rf2iq and dasmtx (linear) of PyMUST 0.1.9 make."""
    pymust, parameters = pymust_parameters(data, **more)
    iq = pymust.rf2iq(np.ascontiguousarray(data.signals[0].numpy()), parameters)
    x, z = (part.reshape(grid.shape).numpy() for part in grid.nodes().unbind(1))
    operator = pymust.dasmtx(1j * np.array(iq.shape[:2]), x, z, parameters, "linear")
    return (operator @ iq.reshape(-1, order="F")).reshape(grid.shape, order="F")


def speckle(seed=1, count=200):
    generator = np.random.default_rng(seed)
    places = np.stack([generator.uniform(-4e-3, 4e-3, count), generator.uniform(16e-3, 24e-3, count)], 1)
    return places, generator.normal(size=count)


GRID = Grid((-4e-3, 16e-3), (2e-4, 2e-4), (41, 41))


def test_a_convex_array_lies_as_pymust_places_it():
    _, parameters = pymust_parameters(convex_data(*speckle(count=1)), pitch=PITCH, radius=RADIUS)
    x, z, angle, apothem = (np.asarray(part).ravel() for part in parameters.getElementPositions())
    elements, normals = convex_array(COUNT, PITCH, RADIUS)
    np.testing.assert_allclose(elements.numpy(), np.stack([x, z], 1), atol=1e-12)
    np.testing.assert_allclose(normals.numpy(), np.stack([np.sin(angle), np.cos(angle)], 1), atol=1e-12)
    beams = delay_and_sum(convex_data(*speckle(count=1)), GRID).beams
    assert beams.apex == pytest.approx((0.0, -float(apothem[0])), abs=1e-9)
    chord = (elements[1:] - elements[:-1]).norm(dim=1)
    torch.testing.assert_close(chord, torch.full_like(chord, PITCH))


def test_images_of_a_convex_array_are_those_of_pymust():
    data = convex_data(*speckle())
    image = pymust_image(data, GRID, pitch=PITCH, radius=RADIUS)
    found = delay_and_sum(data, GRID, DelayAndSum(f_number=1.5, phase=IQPhase.CARRIER)).iq[0].numpy()
    assert np.linalg.norm(found - image) < 0.01 * np.linalg.norm(image)


@pytest.mark.parametrize("place", [(0.0, 18e-3), (9e-3, 21e-3)])
def test_a_convex_array_sees_a_point_where_it_is(place):
    data = convex_data(np.array([place]), np.ones(1))
    step = 0.02e-3
    grid = Grid((place[0] - 25 * 4 * step, place[1] - 25 * step), (4 * step, step), (51, 51))
    image = delay_and_sum(data, grid, DelayAndSum(f_number=1.0)).iq[0].abs()
    row, column = divmod(int(image.argmax()), 51)
    assert abs(row - 25) <= 1 and abs(column - 25) <= 1


def test_several_waves_are_compounded_as_pymust_images_add_up():
    waves = [steered_data(*speckle(), angle) for angle in ANGLES]
    image = sum(pymust_image(wave, GRID, pitch=0.3e-3) for wave in waves) / len(waves)
    found = delay_and_sum(waves, GRID, DelayAndSum(f_number=1.5, phase=IQPhase.CARRIER)).iq[0].numpy()
    assert np.linalg.norm(found - image) < 0.01 * np.linalg.norm(image)
    single = [delay_and_sum(wave, GRID).iq for wave in waves]
    torch.testing.assert_close(delay_and_sum(waves, GRID).iq, sum(single) / 3)


def test_compounding_sharpens_a_point():
    place = np.array([[0.0, 20e-3]])
    waves = [steered_data(place, np.ones(1), angle) for angle in np.linspace(-0.25, 0.25, 11)]
    grid = Grid((-5e-3, 20e-3), (5e-5, 1e-4), (1, 201))
    options = DelayAndSum(f_number=2.0)
    one, all_of_them = (delay_and_sum(data, grid, options).iq[0, 0].abs() for data in (waves[5], waves))
    aside = slice(0, 80)  # more than a millimetre away
    assert all_of_them[aside].max() / all_of_them.max() < 0.7 * one[aside].max() / one.max()
    assert all_of_them.argmax() == 100


def test_waves_that_do_not_belong_together_are_refused():
    waves = [steered_data(*speckle(count=5), 0.0, images=images) for images in (1, 2)]
    with pytest.raises(ValueError, match="one acquisition and as many images"):
        delay_and_sum(waves, GRID)
    with pytest.raises(ValueError, match="there is no wave"):
        delay_and_sum([], GRID)
    with pytest.raises(ValueError, match="radius of a convex array"):
        convex_array(8, 1e-3, 0.0)


def parameters_of(**more):
    common = {
        "fc": FREQUENCY,
        "fs": RATE,
        "pitch": 0.3e-3,
        "c": SOUND_SPEED,
        "t0": START,
        "PRF": PRF,
        "bandwidth": 60.0,
    }
    return {**common, **more}


def save_73(path, signals, parameters, *, cells=False):
    """As MATLAB's save -v7.3 lays arrays, complex ones, structures and cells out."""
    with h5py.File(path, "w", userblock_size=512) as file:

        def put(group, name, values):
            values = np.asarray(values)
            if values.dtype.kind == "c":
                pairs = np.empty(values.T.shape, [("real", "f8"), ("imag", "f8")])
                pairs["real"], pairs["imag"] = values.T.real, values.T.imag
                values = pairs.T
            node = group.create_dataset(name, data=values.T)
            node.attrs["MATLAB_class"] = np.bytes_("double")
            return node

        if cells:
            parts = [put(file, f"#refs#/{number}", part) for number, part in enumerate(signals)]
            node = file.create_dataset("RF", (len(parts), 1), h5py.ref_dtype)
            for number, part in enumerate(parts):
                node[number, 0] = part.ref
            node.attrs["MATLAB_class"] = np.bytes_("cell")
        else:
            put(file, "IQ" if np.iscomplexobj(signals) else "RF", signals)
        group = file.create_group("param")
        group.attrs["MATLAB_class"] = np.bytes_("struct")
        for name, value in parameters.items():
            put(group, name, np.atleast_2d(value))
        name = file.create_dataset("name", data=np.frombuffer("disk".encode("utf-16-le"), np.uint16)[:, None])
        name.attrs["MATLAB_class"] = np.bytes_("char")


def test_version_7_3_reads_as_version_5(tmp_path):
    from scipy.io import savemat

    data = steered_data(*speckle(count=20), 0.12, images=2)
    iq = demodulated(data).signals
    for values in (data.signals, iq):
        stored = values.permute(1, 2, 0).numpy()
        said = parameters_of(TXdelay=data.delays.numpy())
        savemat(tmp_path / "five.mat", {"IQ" if values.is_complex() else "RF": stored, "param": said})
        save_73(tmp_path / "seven.mat", stored, said)
        for name in ("five.mat", "seven.mat"):
            found = read_channel_data(tmp_path / name)
            torch.testing.assert_close(found.signals, values.to(found.signals.dtype))
            torch.testing.assert_close(found.delays, data.delays)
            assert found.acquisition.packet == 2 and found.bandwidth == pytest.approx(0.6) and found.start == START


@pytest.mark.parametrize("layout", ["one axis", "two axes", "cells"])
@pytest.mark.parametrize("version", [5, 7.3])
def test_the_waves_of_an_image_are_told_apart(tmp_path, layout, version):
    from scipy.io import savemat

    waves = [steered_data(*speckle(count=20), angle, images=2) for angle in ANGLES]
    signals = np.stack([wave.signals.permute(1, 2, 0).numpy() for wave in waves], axis=2)  # samples, elements, W, T
    said = parameters_of(TXdelay=np.stack([wave.delays.numpy() for wave in waves]))
    stored = signals
    if layout == "one axis":  # wave after wave, image after image
        stored = signals.transpose(0, 1, 3, 2).reshape(*signals.shape[:2], -1)
    if layout == "cells":
        stored = np.empty((1, 3), object)
        for wave in range(3):
            stored[0, wave] = signals[:, :, wave]
    if version == 5:
        savemat(tmp_path / "waves.mat", {"RF": stored, "param": said})
    else:
        save_73(tmp_path / "waves.mat", list(stored[0]) if layout == "cells" else stored, said, cells=layout == "cells")
    found = read_transmissions(tmp_path / "waves.mat")
    assert len(found) == 3
    for mine, wave in zip(found, waves, strict=True):
        torch.testing.assert_close(mine.signals, wave.signals.float())
        torch.testing.assert_close(mine.delays, wave.delays)
        assert mine.acquisition == wave.acquisition
    with pytest.raises(ValueError, match="describes 3 waves; use read_transmissions"):
        read_channel_data(tmp_path / "waves.mat")


def test_convex_files_and_places_of_elements(tmp_path):
    from scipy.io import savemat

    data = convex_data(*speckle(count=20))
    rf = data.signals.permute(1, 2, 0).numpy()
    savemat(tmp_path / "convex.mat", {"RF": rf, "param": parameters_of(pitch=PITCH, radius=RADIUS)})
    found = read_channel_data(tmp_path / "convex.mat")
    torch.testing.assert_close(found.elements, data.elements)
    torch.testing.assert_close(found.normals, data.normals)
    places = data.elements.numpy()
    said = {name: value for name, value in parameters_of().items() if name != "pitch"}
    savemat(tmp_path / "own.mat", {"RF": rf, "param": {**said, "elements": places.T}})
    torch.testing.assert_close(read_channel_data(tmp_path / "own.mat").elements, data.elements)
    savemat(tmp_path / "row.mat", {"RF": rf, "param": {**said, "elements": places[:, 0]}})
    own = read_channel_data(tmp_path / "row.mat")
    torch.testing.assert_close(own.elements[:, 0], data.elements[:, 0])
    assert not own.elements[:, 1].any()
    savemat(tmp_path / "odd.mat", {"RF": rf, "param": {**said, "elements": places[:5]}})
    with pytest.raises(ValueError, match=r"odd\.mat: param: elements must be x, or x and z, of 64"):
        read_channel_data(tmp_path / "odd.mat")
    savemat(tmp_path / "waves.mat", {"RF": rf, "param": parameters_of(TXdelay=np.zeros((5, COUNT)))})
    with pytest.raises(ValueError, match="TXdelay describes 5 waves"):
        read_channel_data(tmp_path / "waves.mat")
