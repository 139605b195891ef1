"""Identity as evidence: for and against, never decisive alone; calibrated odds; alarms."""

import math
import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sameas import CommonObjects, Field, InputError, Plane, Records, Sphere, identify
from sameas.evidence.identity import (
    MODELS,
    Category,
    Code,
    Frequency,
    Identity,
    Size,
    alarms,
    differ_by_one_bit,
    differ_by_one_typing,
    n_one_bit_apart,
    n_one_typing_apart,
    plain,
)
from sameas.gate import Radius


def column(*values):
    return np.array(values, dtype=np.str_)


def ratio(model, first, second, pool=()):
    return float(model(column(first), column(second), column(*{first, second}, *pool))[0])


def damerau(a, b):
    """Optimal string alignment distance (textbook algorithm)."""
    d = {(i, 0): i for i in range(len(a) + 1)} | {(0, j): j for j in range(len(b) + 1)}
    for i in range(1, len(a) + 1):
        for j in range(1, len(b) + 1):
            d[i, j] = min(d[i - 1, j] + 1, d[i, j - 1] + 1, d[i - 1, j - 1] + (a[i - 1] != b[j - 1]))
            if i > 1 and j > 1 and a[i - 1] == b[j - 2] and a[i - 2] == b[j - 1]:
                d[i, j] = min(d[i, j], d[i - 2, j - 2] + 1)
    return d[len(a), len(b)]


TEXT = st.text("AB1", max_size=6)


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(TEXT, TEXT)
def test_one_typing_error_is_a_distance_of_one(a, b):
    assert bool(differ_by_one_typing(column(a), column(b))[0]) == (damerau(a, b) == 1)


@settings(max_examples=100, deadline=None)
@given(st.integers(0, 2**24 - 1), st.integers(0, 2**24 - 1), st.integers(0, 23))
def test_one_differing_bit_is_found(a, b, bit):
    one, other, flipped = (f"{v:06X}" for v in (a, b, a ^ (1 << bit)))
    assert differ_by_one_bit(column(one), column(flipped))[0]
    assert bool(differ_by_one_bit(column(one), column(other))[0]) == (bin(a ^ b).count("1") == 1)
    assert not differ_by_one_bit(column("", "XYZ"), column("1", "XYY")).any()


def test_spelling_is_normalised_and_placeholders_are_missing():
    assert list(plain([" ever given ", None, "unknown", "NaN"], ("unknown",))) == ["EVER GIVEN", "", "", ""]
    assert list(plain(np.ma.array([235, 7], mask=[False, True]))) == ["235", ""]
    assert list(plain([235, None])) == ["235", ""]
    np.testing.assert_array_equal(plain([None, 12.5]), [np.nan, 12.5])


def test_numeric_codes_become_text():
    one, two, _ = scene((["A", "B"], ["A", "B"]))
    pairs = Radius(9.0)(one, two)
    first, second = [235000001.0, np.nan], [235000001.0, 247000009.0]
    numbers = Identity({"radar": {"mmsi": first}, "adsb": {"mmsi": second}})
    texts = Identity({"radar": {"mmsi": ["235000001", None]}, "adsb": {"mmsi": ["235000001", "247000009"]}})
    np.testing.assert_array_equal(numbers(pairs).log_ratio, texts(pairs).log_ratio)
    nothing = Identity({"radar": {"mmsi": [None, None]}, "adsb": {"mmsi": second}})(pairs)
    assert not nothing.log_ratio.any() and not nothing.informative.any()


@pytest.mark.parametrize(("name", "form"), [("icao", "3C{:04X}"), ("mmsi", "2110{:05d}"), ("callsign", "DLH{}")])
def test_addresses_and_call_signs_of_a_fleet_follow_each_other_and_are_no_slips(name, form):
    """Two aircraft at neighbouring stands, one with ADS-B and one in multilateration, were one at 0.98."""
    fleet, model = [form.format(k) for k in range(40, 70)], MODELS[name]
    near = [ratio(model, fleet[k], fleet[k + 1], fleet[:k] + fleet[k + 2 :]) for k in range(0, 29, 2)]
    others = [form.format(k) for k in range(11_111, 60_000, 4001)]
    assert max(near) < 0.0 < ratio(model, fleet[0], fleet[1], others) - 0.5
    assert ratio(model, fleet[0], fleet[0], fleet[1:]) > 5.0


def test_equal_codes_favour_a_pair_one_bit_off_less_so_and_different_codes_oppose_it():
    icao = MODELS["icao"]
    equal, near, far = (ratio(icao, "4B1814", other) for other in ("4B1814", "4B1815", "3C6444"))
    assert equal == pytest.approx(math.log(0.985 * 1e5), abs=1e-3)
    assert 0 < near < equal and near == pytest.approx(math.log(0.01 / 24 * 1e5), abs=0.02)
    assert far == pytest.approx(math.log(0.005), abs=1e-9)


def test_common_code_values_have_little_weight():
    mode_a = MODELS["mode_a"]
    assert ratio(mode_a, "7000", "7000") < 1.5 < 7.0 < ratio(mode_a, "4521", "4521")
    # A value that one source gives to one object in four is no identity.
    crowd = ["X"] * 25 + [f"N{k}" for k in range(75)]
    assert ratio(MODELS["name"], "X", "X", crowd) == pytest.approx(math.log(1 / 0.25), abs=0.2)


@pytest.mark.slow
@pytest.mark.parametrize("slips", [0.02, 0.2])
def test_odds_of_codes_are_calibrated(slips):
    """Codes drawn from the model: among pairs with a stated λ, the odds of one object are λ."""
    rng = np.random.default_rng(1)
    bits, n = 10, 200_000
    model = Code(2.0**bits, slips=slips, other=0.1, bits=True, neighbours=bits)
    truth = rng.integers(0, 2**bits, n)
    same = rng.random(n) < 0.5
    kind = rng.random(n)
    second = np.where(kind < slips, truth ^ (1 << rng.integers(0, bits, n)), truth)
    second = np.where((kind > 1.0 - 0.1) | ~same, rng.integers(0, 2**bits, n), second)
    a, b = (np.array([f"{v:03X}" for v in values]) for values in (truth, second))
    log_ratio = model(a, b, np.unique(a))
    for value in np.unique(log_ratio.round(9)):
        here = np.abs(log_ratio - value) < 1e-6
        odds = same[here].sum() / max((~same[here]).sum(), 1)
        assert math.log(odds) == pytest.approx(value, abs=0.25)


def test_sizes_agree_within_their_errors_and_differ_beyond():
    lengths = [8.0, 12.0, 60.0, 120.0, 200.0, 300.0]
    pool = np.array(lengths)
    size = Size()
    assert size(np.array([200.0]), np.array([205.0]), pool)[0] > 0.5
    far = size(np.array([200.0]), np.array([12.0]), pool)[0]
    assert math.log(0.05) <= far < -2.0
    cargo = Category()(column("CARGO", "CARGO", "TUG"), column("CARGO", "TUG", "TUG"), column(*["CARGO"] * 9, "TUG"))
    assert cargo[1] < 0 < cargo[0] < cargo[2]


def scene(codes, sigma=10.0, apart=4.0):
    one = Records.of([[0.0, 0.0], [50.0, 0.0]], sigma=sigma, source="radar")
    two = Records.of([[0.0, apart], [50.0, apart]], sigma=sigma, source="adsb")
    return one, two, Identity({"radar": {"icao": codes[0]}, "adsb": {"icao": codes[1]}})


def test_evidence_is_bounded_on_both_sides():
    one, two, _ = scene((["A", "B"], ["A", "B"]))
    many = {name: ["1234", "5678"] for name in ("mmsi", "imo", "callsign", "name", "icao")}
    rule = Identity({"radar": many, "adsb": many}, borrowed=0.02, duplicate=1e-4)
    pairs = Radius(9.0)(one, two)
    evidence = rule(pairs)
    same = pairs.i == pairs.j
    assert evidence.log_ratio[same] == pytest.approx(math.log(0.98 / 1e-4), abs=1e-3)
    assert evidence.log_ratio[~same] == pytest.approx(math.log(0.02), abs=1e-3)
    assert set(evidence.terms) == {*many, "borrowed or shared"}
    np.testing.assert_allclose(np.sum(list(evidence.terms.values()), axis=0), evidence.log_ratio)


def test_records_without_identity_are_matched_by_position_only():
    for codes in ((["4B1814", None], [None, "4B1814"]), ([None, ""], ["000000", None])):
        one, two, rule = scene(codes)
        pairs = Radius(3.0)(one, two)
        assert len(pairs) and not rule(pairs).log_ratio.any()


@pytest.mark.long
def test_identity_decides_pairs_that_positions_leave_open():
    prior, field = CommonObjects(0.3, 0.3), Field(1e-4)
    one, two, agreeing = scene((["4B1814", "3C6444"], ["4B1814", "3C6444"]), apart=45.0)
    plain_answer = identify(one, two, rule=field, prior=prior)
    joined = identify(one, two, rule=field + agreeing, prior=prior)
    assert len(plain_answer.matches) == 0 and list(joined.matches.rows_1) == list(joined.matches.rows_2) == [0, 1]
    one, two, crossed = scene((["4B1814", "3C6444"], ["A0F123", "71BE22"]), apart=12.0)
    assert len(identify(one, two, rule=field, prior=prior).matches) == 2
    assert len(identify(one, two, rule=field + crossed, prior=prior).matches) == 0


def test_an_identity_is_no_hard_key():
    """A neighbour's address in a record does not override clear positions."""
    one, two, swapped = scene((["4B1814", "3C6444"], ["3C6444", "4B1814"]), sigma=1.0, apart=0.5)
    answer = identify(one, two, rule=Field(1e-5) + swapped, prior=CommonObjects(0.1, 0.1), gate=Radius(60.0))
    assert list(answer.matches.rows_1) == list(answer.matches.rows_2) == [0, 1]


def test_swapping_the_sources_changes_nothing():
    rng = np.random.default_rng(3)
    names = ["EVER GIVEN", "EVER GIVE", "MAERSK", None, "EVER GREEN", "MAERSK"]
    one, two = (Records.of(rng.normal(size=(6, 2)), sigma=1.0, source=s) for s in ("a", "b"))
    rule = Identity({"a": {"name": names, "length_m": [400.0, 30.0, None, 12.0, 390.0, 300.0]},
                     "b": {"name": names[::-1], "length_m": [410.0, 30.0, 14.0, 12.0, 390.0, None]}})  # fmt: skip
    forth, back = Radius(9.0)(one, two), Radius(9.0)(two, one)
    a = {(i, j): v for i, j, v in zip(forth.i, forth.j, rule(forth).log_ratio, strict=True)}
    b = {(j, i): v for i, j, v in zip(back.i, back.j, rule(back).log_ratio, strict=True)}
    assert a.keys() == b.keys() and all(a[key] == pytest.approx(b[key]) for key in a)


def test_an_identity_at_two_positions_raises_an_alarm_and_at_one_position_none():
    one, two, rule = scene((["4B1814", "3C6444"], ["3C6444", "4B1814"]), sigma=1.0, apart=0.5)
    raised = alarms([one, two], rule)
    assert [(alarm.value, alarm.first, alarm.second) for alarm in raised] == [
        ("3C6444", ("radar", 1), ("adsb", 0)),
        ("4B1814", ("radar", 0), ("adsb", 1)),
    ]
    assert str(raised[1]).startswith(
        "icao 4B1814 contradicts positions: radar row 0 and adsb row 1 are 50 apart (35.4 σ)"
    )
    one, two, fine = scene((["4B1814", "3C6444"], ["4B1814", "3C6444"]), sigma=1.0, apart=0.5)
    assert alarms([one, two], fine) == []


def test_a_source_that_shows_one_identity_twice_raises_an_alarm():
    ais = Records.of([[0.0, 0.0], [9e3, 0.0], [5.0, 0.0]], sigma=10.0, source="ais")
    rule = Identity({"ais": {"mmsi": ["235000001", "235000001", "235000001"]}})
    assert [(a.first[1], a.second[1]) for a in alarms([ais], rule)] == [(0, 1), (1, 2)]
    assert "mmsi 235000001 shown twice: ais row 0 and ais row 1 are 9000 apart" in str(alarms([ais], rule)[0])
    known_nothing = Identity({"ais": {"mmsi": ["123456789"] * 3}})
    assert alarms([ais], known_nothing) == []


def test_positions_on_both_sides_of_a_period_raise_no_alarm():
    space = Plane((360.0, None))
    one = Records.of([[359.9, 5.0]], sigma=0.5, source="radar", space=space)
    two = Records.of([[0.1, 5.0]], sigma=0.5, source="adsb", space=space)
    rule = Identity({"radar": {"icao": ["4B1814"]}, "adsb": {"icao": ["4B1814"]}})
    assert len(Radius(3.0)(one, two)) == 1
    assert alarms([one, two], rule) == []


def test_rows_set_aside_do_not_shift_the_attributes_of_others():
    one = Records.of([[np.nan, 0.0], [50.0, 0.0]], sigma=1.0, source="radar")
    two = Records.of([[50.0, 0.5]], sigma=1.0, source="adsb")
    rule = Identity({"radar": {"icao": ["AAAAAA", "4B1814"]}, "adsb": {"icao": ["4B1814"]}})
    assert rule(Radius(3.0)(one, two)).log_ratio[0] > 6.0


def test_there_are_no_alarms_on_the_sphere():
    one = Records.of([[10.0, 0.0]], sigma=1.0, source="a", space=Sphere())
    assert alarms([one, one], Identity({"a": {"mmsi": ["1"]}})) == []
    assert Plane() == Records.of([[0.0]], sigma=1.0).space


def test_invalid_identities_are_refused_with_a_clear_message():
    one, two, _ = scene((["A", "B"], ["A", "B"]))
    with pytest.raises(InputError, match="radar: no model for 'colour'"):
        Identity({"radar": {"colour": ["red", "blue"]}})
    short = Identity({"radar": {"icao": ["A"]}, "adsb": {"icao": ["A", "B"]}})
    with pytest.raises(InputError, match="radar: 1 values of icao for 2 rows"):
        short(Radius(9.0)(one, two))
    with pytest.raises(InputError, match="strictly between 0 and 1"):
        Identity({}, borrowed=0.0)
    with pytest.raises(InputError, match="shares of errors"):
        Code(10.0, slips=0.9, other=0.2)


def test_pairs_are_compared_with_all_frequencies_some_at_a_time():
    # All at once, 2 500 emitters of two receivers took 200 MB, and four times as many sixteen times that.
    rng, n = np.random.default_rng(3), 2000
    true = rng.uniform(1e8, 1e9, n)
    first, second = (true + 2e3 * rng.standard_normal(n) for _ in range(2))
    pool = np.concatenate([first, second])
    tracemalloc.start()
    log_ratio = Frequency()(first, second, pool)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 40e6
    alone = [Frequency()(first[k : k + 1], second[k : k + 1], pool)[0] for k in range(0, n, 97)]
    assert np.array_equal(log_ratio[::97], alone)
    assert len(Frequency()(first[:0], second[:0], pool)) == 0


def test_frequencies_of_two_receivers_are_one_within_their_errors():
    def of(first, second, *pool):
        return float(Frequency()(np.array([first]), np.array([second]), np.array([first, second, *pool]))[0])

    assert of(156.8e6, 156.801e6) > 4.0  # one channel, which nobody else uses
    assert of(156.8e6, 156.825e6) == pytest.approx(math.log(0.005))  # the next channel
    assert of(9.41e9, 9.412e9) > 3.0  # a magnetron drifts
    # On a channel that all use, it tells little.
    assert abs(of(156.8e6, 156.8e6, *[156.8e6] * 20)) < 0.1


@pytest.mark.parametrize(("counted", "differ"), [
    (n_one_bit_apart, differ_by_one_bit), (n_one_typing_apart, differ_by_one_typing),
])  # fmt: skip
def test_the_values_one_error_away_are_counted_as_by_comparing_each_with_each(counted, differ):
    """Each near pair of a fleet of a thousand aircraft was compared with all of them: 0.3 s of each live instant."""
    rng = np.random.default_rng(3)
    for _ in range(60):
        texts = ["".join(rng.choice(list("AB1"), rng.integers(0, 6))) for _ in range(rng.integers(1, 40))]
        values = column(*texts)
        values = np.unique(values)
        asked = values[rng.integers(0, len(values), 5)]
        each = [np.count_nonzero(differ(np.broadcast_to(one, values.shape), values)) for one in asked]
        assert counted(asked, values).tolist() == each
