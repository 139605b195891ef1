"""Hysteresis: a partition is kept until another is much more probable; probabilities are unchanged."""

from itertools import pairwise

import numpy as np
import pytest
from modelled_scenes import describe, feed, straight

from sameas.errors import InputError
from sameas.many.hysteresis import with_hysteresis
from sameas.many.identify import identify_many
from sameas.many.rules import PoissonObjects
from sameas.picture import Picture, Watch
from sameas.records import Records
from sameas.tracks.scene import Scene

RULE = PoissonObjects(density=1e-7, q=0.1)


def alongside(echo_x_m):
    """Two vessels with AIS 20 m apart, and one echo at x; rows as in the pooled records."""
    ais = Records.of([[0.0, 0.0], [20.0, 0.0]], sigma=15.0, source="ais", ids=["left", "right"])
    radar = Records.of([[echo_x_m, 0.0]], sigma=10.0, source="radar", ids=["echo"])
    return identify_many([ais, radar], rule=RULE)


def company(found):
    """The AIS record matched with the echo."""
    [members] = found.members[~np.ma.getmaskarray(found.members)[:, 1]]
    return ("left", "right")[int(members[0])]


def was(found, echo_with):
    """The objects of the previous instant: 1 left, 2 right, and the echo with one of them."""
    out = np.full(len(found.pooled), -1)
    for s, source in enumerate(found.pooled.sources):
        ids = source.ids[source.rows]
        objects = {"left": 1, "right": 2, "echo": 1 if echo_with == "left" else 2}
        out[found.pooled.start[s] : found.pooled.start[s + 1]] = [objects[name] for name in ids]
    return out


@pytest.mark.slow
def test_ties_keep_the_previous_partition_and_much_more_probable_ones_replace_it():
    # ln of the odds of right against left is (x² − (20 − x)²) / 2 (15² + 10²); a move breaks one link.
    bound = np.log(3.0)
    for x in np.linspace(-30.0, 50.0, 41):
        found = alongside(x)
        odds = (x**2 - (20.0 - x) ** 2) / (2.0 * 325.0)
        if abs(odds) > 1e-9 and abs(odds - bound) > 0.05:
            shown, kept = with_hysteresis(found, was(found, "left"), bound)
            assert company(shown) == ("right" if odds > bound else "left")
            assert kept.any() == (0.0 < odds < bound)
            np.testing.assert_array_equal(shown.answer.probability, found.answer.probability)
            # The odds of the more probable partition are reported.
            assert shown.groups.gap.max() == pytest.approx(odds if kept.any() else 0.0, abs=1e-6)
    assert company(with_hysteresis(alongside(10.0), was(alongside(10.0), "right"), bound)[0]) == "right"


def test_new_records_join_their_most_probable_object():
    found = alongside(14.0)
    before = was(found, "left")
    before[[found.pooled.start[list(found.pooled.given).index(1)]]] = -1
    assert company(with_hysteresis(found, before, np.log(1e6))[0]) == company(found) == "right"
    assert company(with_hysteresis(found, was(found, "left"), 0.0)[0]) == "right"


def abreast(shift_m):
    """Two vessels with AIS 40 m apart, their tracks of two radars, and those of the first shifted to each other."""
    ais = Records.of([[0.0, 0.0], [40.0, 0.0]], sigma=10.0, source="ais", ids=["left", "right"])
    sides = [[shift_m, 0.0], [40.0 - shift_m, 0.0]]
    west = Records.of(sides, sigma=15.0, source="west", ids=["left", "right"])
    east = Records.of([[0.0, 0.0], [40.0, 0.0]], sigma=15.0, source="east", ids=["left", "right"])
    return identify_many([ais, west, east], rule=RULE)


@pytest.mark.parametrize("shift_m", np.linspace(19.0, 29.0, 6))
def test_an_exchange_of_two_tracks_is_one_change(shift_m):
    found, bound = abreast(shift_m), np.log(4.0)
    before = np.full(len(found.pooled), -1)
    for s, source in enumerate(found.pooled.sources):
        names = source.ids[source.rows]
        before[found.pooled.start[s] : found.pooled.start[s + 1]] = np.where(names == "left", 1, 2)

    def log_odds_against(shown):
        return float(np.subtract(*(x.sets.log_weight[x.answer.chosen].sum() for x in (found, shown))))

    odds = log_odds_against(with_hysteresis(found, before, np.log(1e6))[0])
    shown, kept = with_hysteresis(found, before, bound)
    # It breaks two links, but is shown when b times as probable, not b².
    assert kept.any() == (0.0 < odds < bound)
    assert log_odds_against(shown) == pytest.approx(odds if kept.any() else 0.0)


def moored(seed, looks=60):
    """Two vessels moored side by side, AIS 18 m apart, and their common echo in the tracks of two radars."""
    rng = np.random.default_rng(seed)
    times = 10.0 * np.arange(looks)
    x, v = straight([[0.0, 0.0], [18.0, 0.0]], np.zeros((2, 2)), times)
    mmsi = ["235000001", "235000002"]
    return Scene.of([
        feed(rng, describe("ais", "ais", 15.0, period_s=30.0), times[::3], x[:, ::3], v[:, ::3], 600.0, mmsi,
             {"mmsi": mmsi}),
        feed(rng, describe("radar", "tracks", 15.0), times, x[:1], v[:1], 30.0, ["7"]),
        feed(rng, describe("coast", "tracks", 25.0), times, x[:1], v[:1], 30.0, ["3"]),
    ]), times  # fmt: skip


def changes(picture):
    """How often the records grouped together differ from those of the previous instant."""
    r, out = picture.records, []
    names = np.array([f"{s} {t}" for s, t in zip(r["source"].tolist(), r["track_id"].tolist(), strict=True)])
    for time_s in picture.instants_s:
        here = r["time_s"] == time_s
        out.append({frozenset(names[here & (r["object"] == number)]) for number in np.unique(r["object"][here])})
    return sum(a != b for a, b in pairwise(out))


@pytest.mark.slow
@pytest.mark.long
def test_a_common_echo_of_two_vessels_does_not_alternate():
    steady = restless = 0
    for seed in range(3):
        scene, times = moored(seed)
        steady += changes(Picture.of(scene, times))
        restless += changes(Picture.of(scene, times, watch=Watch(bound=1.0)))
    assert restless >= 10 and steady <= 0.35 * restless


@pytest.mark.slow
def test_a_kept_partition_is_explained_with_its_probability():
    kept = not_kept = 0
    for seed in range(3):
        watch = Watch()
        scene, times = moored(seed)
        for time_s in times:
            state = watch.advance(scene.at(time_s))
            watch = state.watch
            not_kept += np.count_nonzero(~state.detections.by_hysteresis)
            for number in state.number[state.detections.by_hysteresis].tolist():
                kept += 1
                assert "its identity is kept" in " ".join(str(state.explain(number)).split())
    assert kept > 0 and not_kept > 0


def test_a_threshold_below_even_odds_is_refused():
    with pytest.raises(InputError, match=r"bound is 0\.5"):
        Watch(bound=0.5)
