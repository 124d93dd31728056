"""Scores against closed forms and brute force; verdicts on filters that are wrong in a known way."""

import json
import math
import textwrap

import pytest
import torch
from scipy.stats import norm

from torchsph import assimilation
from torchsph.assimilation import (
    ETKF,
    AssimilationError,
    FilterRecord,
    InnovationStatistics,
    Observations,
    chi2_band,
    crps,
    desroziers,
    effective_size,
    filter_figure,
    rank_histogram,
    replace_failed,
    spread_skill,
)


def draws(*shape, seed=0):
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


@pytest.mark.parametrize("fair", [False, True])
def test_crps_is_its_definition(fair):
    members, truth = draws(7, 5), draws(5, seed=1)
    pairs = (members.unsqueeze(0) - members.unsqueeze(1)).abs().sum((0, 1)) / (7 * (6 if fair else 7))
    brute = (members - truth).abs().mean(0) - 0.5 * pairs
    assert torch.allclose(crps(members, truth, fair=fair), brute, atol=1e-14)


def test_crps_of_a_gaussian():
    """Gneiting & Raftery 2007, eq. 20: sigma (z (2 Phi(z) - 1) + 2 phi(z) - 1 / sqrt(pi))."""
    members = 2 * draws(200_000) + 1
    for truth in (1.0, 4.0):
        z = (truth - 1) / 2
        closed = 2 * (z * (2 * norm.cdf(z) - 1) + 2 * norm.pdf(z) - 1 / math.sqrt(math.pi))
        assert crps(members, torch.tensor(truth)).item() == pytest.approx(closed, rel=0.01)


def test_rank_histogram_is_flat_for_a_reliable_ensemble_and_u_shaped_for_a_narrow_one():
    generator = torch.Generator().manual_seed(0)
    members, truth = draws(9, 20_000), draws(20_000, seed=1)
    flat = rank_histogram(members, truth, generator)
    statistic = ((flat - 2000) ** 2 / 2000).sum().item()
    assert flat.sum() == 20_000 and statistic < chi2_band(9, 0.998)[1] * 9
    narrow = rank_histogram(0.5 * members, truth, generator)
    assert narrow[0] > 2 * flat[0] and narrow[-1] > 2 * flat[-1]
    # Noisy verification of a perfect ensemble: only flat once the noise is accounted for.
    noisy = truth + 2 * draws(20_000, seed=2)
    told = rank_histogram(members, noisy, generator, variance=4.0)
    assert ((told - 2000) ** 2 / 2000).sum().item() < chi2_band(9, 0.998)[1] * 9
    assert rank_histogram(members, noisy, generator)[0] > 2 * told[0]


def test_rank_histogram_breaks_ties_evenly_and_skips_missing():
    generator = torch.Generator().manual_seed(0)
    equal = rank_histogram(torch.zeros(3, 4000), torch.zeros(4000), generator)
    assert (equal - 1000).abs().max() < 120
    truth = torch.full((10,), torch.nan)
    assert rank_histogram(draws(3, 10), truth, generator).sum() == 0


def test_spread_and_skill_agree_for_a_reliable_ensemble():
    spread, error = spread_skill(3 * draws(4, 100_000), 3 * draws(100_000, seed=1))
    assert spread / error == pytest.approx(1, abs=0.01)


def test_effective_size():
    line = torch.linspace(-1, 1, 7).unsqueeze(-1) * draws(1, 30)
    assert effective_size(line) == pytest.approx(1)
    simplex = torch.eye(7, dtype=torch.float64)
    assert effective_size(simplex) == pytest.approx(6)
    assert effective_size(torch.ones(4, 3)) == 0


def test_desroziers_recovers_both_variances():
    """Scalar optimal update with R = 2, B = 3: residual = R / (R + B) innovation."""
    innovation = math.sqrt(5.0) * draws(200_000)
    observed, forecast = desroziers(innovation, 0.4 * innovation)
    assert observed == pytest.approx(2, rel=0.01) and forecast == pytest.approx(3, rel=0.01)


def test_verdicts():
    assert InnovationStatistics.of(draws(1000)).verdict() is None
    assert "overconfident" in InnovationStatistics.of(3 * draws(1000)).verdict()
    assert "underconfident" in InnovationStatistics.of(0.3 * draws(1000)).verdict()
    # Ten errors that are one error may well be large together: no verdict on few independent numbers.
    assert InnovationStatistics.of(torch.full((10,), 1.8), redundancy=10.0).verdict() is None
    assert InnovationStatistics.of(torch.full((3,), torch.nan)).verdict() is None


def cycles(true_sigma: float) -> FilterRecord:
    """A filter that believes in observation errors of 1 while they are `true_sigma`."""
    generator = torch.Generator().manual_seed(0)
    record = FilterRecord()
    for k in range(30):
        ensemble = torch.randn(30, 20, generator=generator, dtype=torch.float64)
        truth = torch.randn(20, generator=generator, dtype=torch.float64)
        value = truth + true_sigma * torch.randn(20, generator=generator, dtype=torch.float64)
        value[0] = torch.nan
        observations = Observations(value, torch.ones(20).double())
        analysis = ETKF().analyse(ensemble, ensemble, observations)
        jet = torch.arange(20) < 5
        record.add(0.01 * k, analysis, observations, regions={"jet": jet}, forecast=ensemble, truth=truth)
    return record


def test_record_of_a_right_filter_is_calm_and_json():
    record = cycles(1.0)
    summary = json.loads(json.dumps(record.summary(), allow_nan=False))
    assert summary["warnings"] == []
    assert summary["observations"] == {"used": 570, "missing": 30}
    assert summary["innovations"]["all"]["count"] == 570
    assert summary["innovations"]["jet"]["count"] == 120
    assert summary["spread_over_skill"] == pytest.approx(1, abs=0.1)
    assert sum(summary["rank_histogram"]) == 600
    assert len(summary["cycles"]) == 30 and summary["cycles"][3]["time"] == pytest.approx(0.03)


def test_observations_ten_times_noisier_than_said_are_noticed():
    words = cycles(10.0).warnings()
    assert any(text.startswith("all: overconfident") for text in words)
    assert any(text.startswith("jet: overconfident") for text in words)


def test_record_without_any_observation_is_json_too():
    ensemble = draws(5, 4)
    silent = Observations(torch.full((4,), torch.nan).double(), torch.ones(4).double())
    record = FilterRecord()
    for k in range(10):
        record.add(k, ETKF().analyse(ensemble, ensemble, silent), silent)
    summary = json.loads(json.dumps(record.summary(), allow_nan=False))
    assert summary["warnings"] == [
        "no observation was used in this cycle: the analysis is the forecast (10 of 10 cycles)"
    ]


def test_failed_members_are_replaced_from_the_survivors():
    ensemble = 5 + draws(12, 3)
    ensemble[4, 1] = torch.nan
    failed = torch.arange(12) == 7
    repaired = replace_failed(ensemble, failed, torch.Generator().manual_seed(1))
    again = replace_failed(ensemble, failed, torch.Generator().manual_seed(1)).ensemble
    whole, events = repaired.ensemble, repaired.events
    keep = [k for k in range(12) if k not in (4, 7)]
    assert torch.equal(whole, again) and torch.isfinite(whole).all()
    assert torch.equal(whole[keep], ensemble[keep])
    assert [event.member for event in events] == [4, 7]
    assert len({event.donor for event in events}) == 2 and all(event.donor in keep for event in events)
    assert not torch.allclose(whole[4], whole[7])


def test_replacements_have_the_survivors_mean_and_covariance():
    ensemble = draws(4000, 2) @ torch.tensor([[1.0, 0.5], [0.0, 2.0]]).double()
    ensemble[2000:] = torch.nan
    none = torch.zeros(4000, dtype=torch.bool)
    whole = replace_failed(ensemble, none, torch.Generator().manual_seed(1)).ensemble
    assert torch.allclose(torch.cov(whole[2000:].T), torch.cov(whole[:2000].T), rtol=0.1, atol=0.1)


def test_a_dead_ensemble_is_an_error():
    with pytest.raises(AssimilationError, match="only 1 of 3"):
        replace_failed(draws(3, 2), torch.tensor([False, True, True]), torch.Generator())


def test_figure_shows_what_the_record_holds(tmp_path):
    figure = filter_figure(cycles(10.0).summary())
    assert "overconfident" in figure.get_suptitle()
    labels = [text.get_text() for axes in figure.axes if axes.get_legend() for text in axes.get_legend().texts]
    assert {"error, forecast", "jet", "missing", "used"} <= set(labels)
    bars = figure.axes[1].patches
    assert sum(bar.get_height() for bar in bars) == pytest.approx(1) and len(bars) == 31
    figure.savefig(tmp_path / "filter.png")
    assert (tmp_path / "filter.png").stat().st_size > 10_000
    assert filter_figure(FilterRecord().summary()).get_suptitle() == ""


def test_the_packages_example_runs():
    """The lines in the package's docstring, with a small model in the place of a large one."""
    code = textwrap.dedent(assimilation.__doc__.split("\n\n")[2])
    draw = torch.Generator().manual_seed(0)
    nodes = torch.rand(20, 3, generator=draw) * 0.02
    names = {
        **vars(assimilation),
        "value": torch.randn(60, generator=draw),
        "variance": torch.ones(60),
        "nodes": nodes,
        "grid": nodes,
        "times": (0.0, 0.01, 0.02),
        "model": lambda ensemble: 1.1 * ensemble,
        "operator": lambda ensemble: ensemble,
        "ensemble": torch.randn(6, 60, generator=draw),
        "record": FilterRecord(),
    }
    exec(code, names)
    assert len(names["record"].cycles) == 3
    assert names["analysis"].spread_after < 1
