"""The phase convention of IQ: told apart, converted, refused where it is neither."""

from dataclasses import replace

import pytest
import torch
from ultrasound_cases import lattice, packet

from geometry import Grid
from torchsph.ultrasound import (
    Acquisition,
    Beams,
    ColourDoppler,
    IQPhase,
    Packet,
    SectorPointSpread,
    SpeckleTracker,
    baseband,
    colour_doppler,
    phase_slope,
)

PLAIN = SpeckleTracker(clutter=None)


def plane(step=1e-4, half=30):
    return Grid((-half * step, 24e-3 - half * step), (step, step), (2 * half + 1,) * 2)


def turned(scene, carriers):
    """The packet with a phase that runs along depth, stated by nobody."""
    depth = scene.beams.depth(scene.grid.nodes()).reshape(scene.grid.shape)
    phase = carriers * scene.acquisition.phase_per_metre * depth
    return scene.with_iq((scene.iq * torch.polar(torch.ones_like(phase), phase)).to(scene.iq), noise=scene.noise)


SCENES = {
    "plane": lambda: packet((0.1, 0.2), grid=plane(), beams=Beams((0.0, 1.0)), tissue=None),
    "fine": lambda: packet((0.1, 0.2), grid=plane(4e-5), beams=Beams((0.0, 1.0)), tissue=None),
    "coarse": lambda: packet((0.1, 0.2), grid=plane(2e-4), beams=Beams((0.0, 1.0)), tissue=None),
    "volume": lambda: packet((0.1, -0.1, 0.2), tissue=None),
    "fan": lambda: packet(
        (0.1, 0.2),
        grid=plane(),
        beams=Beams((0.0, 1.0), apex=(0.0, 12e-3)),
        pointspread=SectorPointSpread(0.5e-3, 1.2e-3, 12e-3),
        tissue=None,
    ),
    "slanted": lambda: packet((0.1, 0.2), grid=plane(), beams=Beams((0.5, 0.8)), tissue=None),
}


@pytest.mark.parametrize("name", SCENES)
def test_both_conventions_give_the_same_samples(name):
    scene = SCENES[name]()
    silent, left_in = scene.with_iq(scene.iq), turned(scene, 1.0)
    assert baseband(silent).iq is scene.iq  # not touched
    assert silent.phase is None and baseband(silent).phase is IQPhase.BASEBAND
    found = baseband(left_in)
    assert found.phase is IQPhase.BASEBAND
    torch.testing.assert_close(found.iq, scene.iq, atol=2e-5, rtol=1e-4)
    assert phase_slope(left_in).coherence == pytest.approx(phase_slope(silent).coherence, rel=0.05)


def test_velocities_do_not_depend_on_the_convention():
    scene = SCENES["plane"]()
    points = lattice(centre=(0.0, 24e-3), half=1)
    wanted, found = (PLAIN.track(one, points) for one in (scene, turned(scene, 1.0)))
    assert bool(found.accepted.all())
    torch.testing.assert_close(found.velocity, wanted.velocity, atol=1e-4, rtol=1e-3)
    speeds = [colour_doppler(one, points, ColourDoppler(clutter=None)).speed for one in (scene, turned(scene, 1.0))]
    torch.testing.assert_close(*speeds, atol=1e-4, rtol=1e-3)


@pytest.mark.parametrize("carriers", [0.5, -0.5, 1.4])
def test_a_slope_of_neither_is_refused(carriers):
    scene = turned(packet((0.1, 0.2), grid=plane(5e-5), beams=Beams((0.0, 1.0)), tissue=None), carriers)
    assert phase_slope(scene).carriers == pytest.approx(carriers, abs=0.06)
    with pytest.raises(ValueError, match=r"times the carrier's.*0 \(baseband\)"):
        PLAIN.track(scene, lattice(centre=(0.0, 24e-3), half=0))
    with pytest.raises(ValueError, match="complex conjugates"):
        colour_doppler(scene, lattice(centre=(0.0, 24e-3), half=0), ColourDoppler(clutter=None))


def test_the_conjugate_of_beamformed_samples_is_refused():
    scene = turned(packet((0.1, 0.2), grid=plane(5e-5), beams=Beams((0.0, 1.0)), tissue=None), 1.0)
    with pytest.raises(ValueError, match=r"-1\.0\d? times"):
        baseband(scene.with_iq(scene.iq.conj().resolve_conj()))


def test_what_is_stated_is_believed():
    scene = SCENES["plane"]()
    left_in = turned(scene, 1.0)
    stated = replace(left_in, phase=IQPhase.BASEBAND)
    assert baseband(stated) is stated
    torch.testing.assert_close(baseband(replace(left_in, phase=IQPhase.CARRIER)).iq, scene.iq, atol=2e-5, rtol=1e-4)


def test_noise_and_samples_half_a_wavelength_apart_are_left_alone():
    generator = torch.Generator().manual_seed(0)
    noise = torch.randn((8, 41, 41), generator=generator, dtype=torch.complex64)
    silent = Packet(noise, plane(half=20), Acquisition(), Beams((0.0, 1.0)))
    assert not phase_slope(silent).significant and baseband(silent).iq is noise
    step = 1540.0 / (2 * 5e6)  # on it the carrier turns by a whole turn: both conventions are one
    scene = packet((0.1, 0.2), grid=plane(step, 15), beams=Beams((0.0, 1.0)), tissue=None)
    both = phase_slope(scene)
    assert both.baseband == pytest.approx(both.carrier, abs=0.01)
    constant = torch.polar(torch.tensor(1.0), torch.tensor(scene.acquisition.phase_per_metre * scene.grid.origin[1]))
    torch.testing.assert_close(turned(scene, 1.0).iq, scene.iq * constant, atol=1e-3, rtol=1e-3)
    bad = torch.full((4, 5, 5), complex("nan"), dtype=torch.complex64)
    assert not phase_slope(Packet(bad, plane(half=2), Acquisition(), Beams((0.0, 1.0)))).significant
