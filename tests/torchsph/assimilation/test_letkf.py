"""The local filter against the global one, a dense local reference, and its own limits."""

import pytest
import torch

from torchsph.assimilation import (
    ETKF,
    LETKF,
    AssimilationError,
    Localisation,
    Multiplicative,
    Observations,
    Reason,
    gaspari_cohn,
)
from torchsph.assimilation.filters.localisation import PatchGrid


def field(members=8, side=6, seed=0, components=3):
    """A component-major field of vectors on a square grid, observed at every second node."""
    draw = torch.Generator().manual_seed(seed)
    axis = torch.arange(side, dtype=torch.float64)
    place = torch.cartesian_prod(axis, axis)
    ensemble = torch.randn(members, components * len(place), generator=draw, dtype=torch.float64)
    seen = torch.arange(0, len(place), 2)
    predicted = ensemble.reshape(members, components, -1)[:, :, seen].reshape(members, -1)
    value = torch.randn(predicted.shape[1], generator=draw, dtype=torch.float64)
    variance = 0.5 + torch.rand(value.shape, generator=draw, dtype=torch.float64)
    return ensemble, predicted, Observations(value, variance, place[seen]), place


def test_gaspari_cohn():
    r = torch.linspace(-1.2, 1.2, 4001, dtype=torch.float64)
    taper = gaspari_cohn(r)
    assert gaspari_cohn(torch.zeros(1)).item() == 1.0
    assert (taper[r.abs() >= 1] == 0).all() and (taper >= 0).all() and (taper <= 1).all()
    assert torch.allclose(taper, taper.flip(0), atol=1e-15)
    half = taper[2000:]
    assert (half.diff() <= 1e-15).all()
    # Gaspari & Cohn 1999, eq. 4.10 at r = c: -1/4 + 1/2 + 5/8 - 5/3 + 1 = 5/24.
    assert gaspari_cohn(torch.tensor(0.5, dtype=torch.float64)).item() == pytest.approx(5 / 24, abs=1e-14)
    second = taper.diff().diff() / (r[1] - r[0]) ** 2
    assert second.diff().abs().max() < 0.2  # twice continuously differentiable


def test_gaspari_cohn_is_a_correlation_function():
    point = torch.rand(60, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    matrix = Localisation(0.7).taper(point / 0.7, point / 0.7)
    assert torch.linalg.eigvalsh(matrix)[0] > -1e-12


@pytest.mark.parametrize("patch", [None, 0.25, 1.0])
def test_huge_radius_is_the_global_filter(patch):
    ensemble, predicted, observations, place = field()
    letkf = LETKF(localisation=Localisation(1e9), patch=patch)
    local = letkf.analyse(ensemble, predicted, observations, state_positions=place)
    everywhere = ETKF().analyse(ensemble, predicted, observations)
    assert torch.allclose(local.ensemble, everywhere.ensemble, atol=1e-9)


@pytest.mark.parametrize("patch", [None, 0.25])
def test_zero_radius_changes_nothing(patch):
    ensemble, predicted, observations, place = field()
    letkf = LETKF(localisation=Localisation(0.0), patch=patch, inflation=Multiplicative(1.3))
    analysis = letkf.analyse(ensemble, predicted, observations, state_positions=place)
    assert torch.allclose(analysis.ensemble, ensemble, atol=1e-14)
    assert analysis.counts() == {"out_of_reach": len(observations)}


def test_exact_patches_equal_one_analysis_per_place():
    ensemble, predicted, observations, place = field()
    letkf = LETKF(localisation=Localisation(2.5), patch=None)
    analysis = letkf.analyse(ensemble, predicted, observations, state_positions=place)
    for node in (0, 7, 35):
        distance = (observations.places - place[node]).norm(dim=-1) / 2.5
        variance = observations.variance / gaspari_cohn(distance)
        alone = ETKF().analyse(ensemble, predicted, Observations(observations.value, variance))
        here = [node, node + 36, node + 72]
        assert torch.allclose(analysis.ensemble[:, here], alone.ensemble[:, here], atol=1e-10)


def test_patches_converge_to_exact_local_analyses():
    """On a smooth ensemble, multilinear interpolation of taper and weights is of second order."""
    draw = torch.Generator().manual_seed(2)
    place = torch.rand(150, 2, generator=draw, dtype=torch.float64)
    phase = torch.rand(6, 4, generator=draw, dtype=torch.float64) * 6.28
    wave = torch.randn(6, 4, 2, generator=draw, dtype=torch.float64) * 3
    ensemble = torch.sin((wave @ place.T) + phase.unsqueeze(-1)).sum(1)
    value = torch.randn(150, generator=draw, dtype=torch.float64)
    observations = Observations(value, torch.full_like(value, 4.0), place)
    results = {}
    for patch in (None, 0.5, 0.25, 0.125):
        letkf = LETKF(localisation=Localisation(0.6), patch=patch)
        results[patch] = letkf.analyse(ensemble, ensemble, observations, state_positions=place).ensemble
    change = (results[None] - ensemble).norm()
    error = [((results[p] - results[None]).norm() / change).item() for p in (0.5, 0.25, 0.125)]
    assert error[1] < 0.1
    assert error[0] / error[1] > 2.5 and error[1] / error[2] > 3


@pytest.mark.parametrize("patch", [None, 0.3])
def test_influence_ends_at_the_radius(patch):
    place = torch.arange(40, dtype=torch.float64).unsqueeze(-1)
    draw = torch.Generator().manual_seed(3)
    ensemble = torch.randn(5, 40, generator=draw, dtype=torch.float64)
    one = Observations(torch.tensor([5.0]).double(), torch.tensor([0.1]).double(), place[20:21])
    letkf = LETKF(localisation=Localisation(6.0), patch=patch)
    analysis = letkf.analyse(ensemble, ensemble[:, 20:21], one, state_positions=place)
    changed = ((analysis.ensemble - ensemble).abs() > 1e-13).any(0)
    assert changed[20] and changed[18] and changed[22]
    slack = 0 if patch is None else 2  # a patch spacing: what a patch knows reaches the nodes around it
    assert not changed[: 15 - slack].any() and not changed[26 + slack :].any()


@pytest.mark.parametrize("patch", [None, 0.5])
def test_periodic_domain_has_no_seam(patch):
    draw = torch.Generator().manual_seed(4)
    place = torch.arange(24, dtype=torch.float64).unsqueeze(-1)
    ensemble = torch.randn(6, 24, generator=draw, dtype=torch.float64)
    value = torch.randn(24, generator=draw, dtype=torch.float64)
    letkf = LETKF(localisation=Localisation(8.0, period=(24.0,)), patch=patch)

    def analyse(shift: int):
        turned = ensemble.roll(shift, 1)
        observations = Observations(value.roll(shift), torch.ones(24).double(), place)
        return letkf.analyse(turned, turned, observations, state_positions=place).ensemble.roll(-shift, 1)

    assert torch.allclose(analyse(0), analyse(4), atol=1e-12)


def test_radius_per_dimension_is_a_stretched_domain():
    ensemble, predicted, observations, place = field()
    stretch = torch.tensor([1.0, 2.0], dtype=torch.float64)
    plain = LETKF(localisation=Localisation(2.5), patch=None)
    isotropic = plain.analyse(ensemble, predicted, observations, state_positions=place)
    tall = Observations(observations.value, observations.variance, observations.position * stretch)
    oblong = LETKF(localisation=Localisation((2.5, 5.0)), patch=None)
    result = oblong.analyse(ensemble, predicted, tall, state_positions=place * stretch)
    assert torch.allclose(result.ensemble, isotropic.ensemble, atol=1e-12)


def test_channel_periodic_in_one_direction():
    """Moving everything along the periodic direction, out of the box, changes nothing; across does."""
    ensemble, predicted, observations, place = field()
    ring = LETKF(localisation=Localisation(2.5, period=(6.0, torch.inf)), patch=0.4)
    results = []
    for observed_shift in ((0.0, 0.0), (-12.0, 0.0), (0.0, 6.0)):
        moved = Observations(
            observations.value,
            observations.variance,
            observations.position + torch.tensor(observed_shift, dtype=torch.float64),
        )
        results.append(ring.analyse(ensemble, predicted, moved, state_positions=place).ensemble)
    assert torch.allclose(results[0], results[1], atol=1e-10)
    assert (results[0] - results[2]).abs().max() > 0.1
    turned = torch.where(torch.arange(2) == 0, (place + 40 * 6.0), place)
    again = ring.analyse(ensemble, predicted, observations, state_positions=turned).ensemble
    assert torch.allclose(results[0], again, atol=1e-9)


def test_float32_sums_are_given_up_for_very_precise_observations():
    ensemble, predicted, observations, place = field()
    exact = Observations(observations.value, observations.variance * 1e-9, observations.position)
    letkf = LETKF(localisation=Localisation(2.5), patch=None)
    single = letkf.analyse(ensemble.float(), predicted.float(), exact, state_positions=place)
    double = letkf.analyse(ensemble.float().double(), predicted.float().double(), exact, state_positions=place)
    assert torch.allclose(single.ensemble.double(), double.ensemble, atol=1e-3)


def test_far_observations_are_named():
    ensemble, predicted, observations, place = field()
    moved = observations.places.clone()
    moved[3] += 1000.0
    letkf = LETKF(localisation=Localisation(2.5))
    far = Observations(observations.value, observations.variance, moved)
    analysis = letkf.analyse(ensemble, predicted, far, state_positions=place)
    assert analysis.reason[3] == Reason.OUT_OF_REACH
    assert analysis.counts() == {"used": len(observations) - 1, "out_of_reach": 1}


def test_inflation_does_not_grow_where_nothing_is_observed():
    place = torch.arange(40, dtype=torch.float64).unsqueeze(-1)
    ensemble = torch.randn(5, 40, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    one = Observations(torch.tensor([5.0]).double(), torch.tensor([0.1]).double(), place[:1])
    for everywhere in (False, True):
        letkf = LETKF(localisation=Localisation(6.0), inflation=Multiplicative(1.5, everywhere=everywhere))
        analysis = letkf.analyse(ensemble, ensemble[:, :1], one, state_positions=place)
        ratio = analysis.ensemble[:, 20:].std(0) / ensemble[:, 20:].std(0)
        assert torch.allclose(ratio, torch.full_like(ratio, 1.5 if everywhere else 1.0), atol=1e-12)


def test_parameters_without_a_place_take_the_average_weights():
    ensemble, predicted, observations, place = field(components=1)
    draw = torch.Generator().manual_seed(9)
    extended = torch.cat([ensemble, torch.randn(8, 2, generator=draw, dtype=torch.float64)], 1)
    positions = torch.cat([place, torch.full((2, 2), torch.nan, dtype=torch.float64)])
    letkf = LETKF(localisation=Localisation(1e9))
    local = letkf.analyse(extended, predicted, observations, state_positions=positions)
    everywhere = ETKF().analyse(extended, predicted, observations)
    assert torch.allclose(local.ensemble, everywhere.ensemble, atol=1e-9)


def test_layouts_of_patch_grids():
    points = torch.rand(50, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    grid = PatchGrid.around(points, 0.3, torch.full((3,), torch.inf, dtype=torch.float64))
    index, weight = grid.share(points)
    assert torch.allclose(weight.sum(-1), torch.ones(50).double(), atol=1e-14)
    back = (grid.nodes(index.flatten()).reshape(50, 8, 3) * weight.unsqueeze(-1)).sum(1)
    assert torch.allclose(back, points, atol=1e-13)  # multilinear shares reproduce linear functions


def test_batch_and_members_of_two():
    ensemble, predicted, observations, place = field(members=2)
    letkf = LETKF(localisation=Localisation(3.0))
    alone = letkf.analyse(ensemble, predicted, observations, state_positions=place)
    pair = Observations(observations.value.expand(2, -1), observations.variance, observations.position)
    states, seen = torch.stack([ensemble, 2 * ensemble]), torch.stack([predicted, 2 * predicted])
    both = letkf.analyse(states, seen, pair, state_positions=place)
    assert torch.allclose(both.ensemble[0], alone.ensemble, atol=1e-12)
    assert torch.isfinite(both.ensemble).all()


def test_places_are_required():
    ensemble, predicted, observations, place = field()
    letkf = LETKF(localisation=Localisation(3.0))
    with pytest.raises(AssimilationError, match="needs places"):
        letkf.analyse(ensemble, predicted, observations)
    with pytest.raises(AssimilationError, match="do not divide"):
        letkf.analyse(ensemble, predicted, observations, state_positions=place[:7])
    with pytest.raises(AssimilationError, match="patch"):
        LETKF(localisation=Localisation(3.0), patch=0.0)
    with pytest.raises(AssimilationError, match="radius"):
        Localisation(-1.0)
