"""Estimates from a sample of cells agree with those from all records, with complete cells, for any row order."""

import math
from dataclasses import replace

import numpy as np
import pytest

from sameas import Radius, Records
from sameas.estimate.coverage import Coverage
from sameas.estimate.gate_search import MatchTuning
from sameas.estimate.match import match
from sameas.estimate.sample import Sampling, Setting
from sameas.evidence import Magnitudes
from sameas.simulate.scenes import Cap, poisson_field, sky_field

#: Small limits, so that the scenes of a test count as large.
FEW = Sampling(enough=700, cell=100)


def field(seed, extent=90.0):
    return poisson_field(
        np.random.default_rng(seed), density=1.0, extent=(extent, extent), q1=0.2, q2=0.3, sigma_1=0.1, sigma_2=0.12
    )


def setting(first, second):
    return Setting.whole(Radius(6.0)(first, second), Coverage.of(first, second))


def shuffled(records, order):
    """The same records in the given row order, with their ids."""
    return Records.of(
        records.features[order], variance=records.covariance[order], ids=records.ids[order], space=records.space
    )


def test_a_sample_holds_all_candidates_of_its_records_and_their_rivals():
    made = field(0)
    whole = setting(made.first, made.second)
    part = whole.sample(FEW)
    n1, n2 = part.n_counted
    assert 700 <= n1 < 0.25 * len(made.first) and 700 <= n2 < 0.25 * len(made.second)
    inside = [np.zeros(len(records), np.bool_) for records in (made.first, made.second)]
    for k in range(2):
        inside[k][part.rows[k][part.counted[k]]] = True
    theirs = inside[0][whole.pairs.i] | inside[1][whole.pairs.j]
    kept = set(zip(part.rows[0][part.pairs.i].tolist(), part.rows[1][part.pairs.j].tolist(), strict=True))
    wanted = set(zip(whole.pairs.i[theirs].tolist(), whole.pairs.j[theirs].tolist(), strict=True))
    assert wanted <= kept and len(kept) < 0.5 * len(whole.pairs)
    rivals = np.isin(whole.pairs.j, whole.pairs.j[theirs])
    assert set(zip(whole.pairs.i[rivals].tolist(), whole.pairs.j[rivals].tolist(), strict=True)) <= kept
    np.testing.assert_array_equal(part.pairs.first.features, made.first.features[part.rows[0]])
    assert part.pairs.place_1.max() < len(part.rows[0]) and part.pairs.place_2.max() < len(part.rows[1])


def test_small_sources_are_taken_whole_even_next_to_a_large_one():
    made = field(1)
    some = np.arange(1000)
    poor = replace(made.first, features=made.first.features[some], covariance=made.first.covariance[some], rows=some)
    whole = setting(poor, made.second)
    assert whole.sample(FEW) is whole


def test_estimates_from_a_sample_agree_with_those_from_all_records():
    made = field(2)
    _, by_sample = match(made.first, made.second, sampling=FEW)
    assert max(by_sample.learned_from) < 0.3 * len(made.first)
    _, by_all = match(made.first, made.second)
    assert by_all.learned_from == (len(made.first), len(made.second))
    for name in ("common", "share_1", "share_2", "error_scale"):
        some, every = by_sample.quantities[name], by_all.quantities[name]
        assert some.value == pytest.approx(every.value, abs=3 * some.standard_error)
        # Fewer records give larger standard errors.
        assert some.standard_error > every.standard_error or name == "error_scale"
    assert by_sample.typical_scale == pytest.approx(1.0, abs=0.1)


def test_the_row_order_does_not_change_a_sample():
    made = sky_field(
        np.random.default_rng(3), n_common=5000, n_only_1=800, n_only_2=1500, sigma_arcsec=(0.2, 0.5),
        area=Cap(30.0, 80.0, 0.2),
    )  # fmt: skip
    answer, found = match(made.first, made.second, sampling=FEW)
    assert max(found.learned_from) < 0.3 * len(made.second)
    rng = np.random.default_rng(4)
    turned = [shuffled(r, rng.permutation(len(r))) for r in (made.first, made.second)]
    other, again = match(*turned, sampling=FEW)
    assert again.learned_from == found.learned_from and again.common == pytest.approx(found.common, rel=1e-9)
    before, now = (
        {(a.first.ids[i], a.second.ids[j]): p for i, j, p in zip(a.rows_1, a.rows_2, a.p_pair, strict=True)}
        for a in (answer, other)
    )
    assert before.keys() == now.keys()
    assert max(abs(before[pair] - now[pair]) for pair in before) < 1e-8


def test_after_an_unrepresentative_sample_em_runs_over_all_records():
    made = field(5, extent=75.0)
    _, sampled = match(made.first, made.second, sampling=FEW)
    # No sample is accepted.
    _, found = match(made.first, made.second, sampling=FEW, tuning=MatchTuning(max_sample_error=-1e3))
    assert max(sampled.learned_from) < len(made.first)
    assert found.learned_from == (len(made.first), len(made.second)) and found.iterations > sampled.iterations
    true = len(made.true_pairs()[0])
    assert found.common == pytest.approx(true, abs=4 * math.sqrt(true) * 0.3)


def test_samples_of_an_uneven_sky_are_representative():
    """One half of the field has hardly any common objects; by chance all sampled cells may lie there."""
    made = field(6)
    keep = (made.second.features[:, 0] < 45.0) | (np.random.default_rng(7).uniform(size=len(made.second)) < 0.1)
    second = replace(
        made.second, features=made.second.features[keep], covariance=made.second.covariance[keep],
        rows=made.second.rows[keep],
    )  # fmt: skip
    _, by_sample = match(made.first, second, sampling=FEW)
    _, by_all = match(made.first, second)
    assert max(by_sample.learned_from) < len(made.first)
    assert by_sample.common == pytest.approx(by_all.common, rel=0.015)


def test_a_sample_of_a_large_source_grows_with_it():
    made = field(0)
    whole = setting(made.first, made.second)
    few = Sampling(enough=700, cell=100, share=0.15)
    n1, n2 = whole.sample(few).n_counted
    assert min(n1, n2) >= 0.15 * min(len(made.first), len(made.second)) > 700
    assert few.size(1_000) == 700 and few.size(10**9) == few.most


def test_unrelated_magnitudes_are_noted_where_estimates_are_from_a_sample():
    """The probabilities of the sample's pairs were looked up among all pairs: an unexpected IndexError."""
    made, rng = field(8), np.random.default_rng(9)
    one, two = (rng.normal(20.0, 1.0, len(records)) for records in (made.first, made.second))
    rows_1, rows_2 = (rows[np.arange(len(rows)) % 5 < 2] for rows in made.true_pairs())
    two[rows_2] = one[rows_1] + rng.normal(0.0, 0.05, len(rows_1))
    magnitudes = Magnitudes(one), Magnitudes(two)
    answer, found = match(made.first, made.second, sampling=FEW, brightness=magnitudes)
    assert max(found.learned_from) < 0.3 * len(made.first) and len(answer.pairs) > len(made.first)
    assert any("of the pairs are unrelated, and have hardly any weight" in note for note in found.notes)
