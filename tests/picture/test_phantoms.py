"""Ships in AIS only, where a radar sees others: alarms for a fleet, none for weak, hidden or berthed ships."""

import numpy as np
import pytest
from modelled_scenes import describe, feed, straight, watched_live

from sameas.picture.phantoms import (
    HIDDEN_SHARE,
    INVENTED_ODDS,
    INVENTED_SHARE,
    RadarLooks,
    ShipSightings,
    phantoms,
    proven,
)
from sameas.picture.picture import Picture
from sameas.tracks.scene import Scene

TIMES = np.arange(0.0, 601.0, 10.0)


def fleet(seed, real=24, invented=0, weak=0, hidden_sector=False, berthed=0, lengths=None):
    """A radar that tracks ships within 10 km, and AIS of these and of others; the invented ones are the last."""
    rng = np.random.default_rng(seed)
    counts = (real, weak, berthed, invented)
    n, kind = sum(counts), np.repeat(np.arange(4), counts)
    angle, distance = rng.uniform(0.0, 2.0 * np.pi, n), 10e3 * np.sqrt(rng.uniform(0.05, 0.9, n))
    distance[kind == 3] *= 0.6
    course, speed = rng.uniform(0.0, 2.0 * np.pi, n), np.where(kind == 2, 0.0, rng.uniform(3.0, 8.0, n))
    start = distance[:, None] * np.column_stack([np.sin(angle), np.cos(angle)])
    x, v = straight(start, speed[:, None] * np.column_stack([np.sin(course), np.cos(course)]), TIMES)
    seen = rng.random((n, len(TIMES))) < np.array([0.95, 0.15, 0.0, 0.0])[kind][:, None]
    if hidden_sector:
        bearing = np.degrees(np.arctan2(x[..., 0], x[..., 1]))
        seen &= ~((bearing > 20.0) & (bearing < 80.0) & (np.hypot(x[..., 0], x[..., 1]) > 2500.0))
    mmsi = [f"2350001{k:02d}" for k in range(n)]
    extra = {"mmsi": mmsi} | ({} if lengths is None else {"length_m": np.where(kind == 3, *lengths)})
    radar = feed(rng, describe("radar", "tracks"), TIMES, x, v, 30.0, [f"r{k}" for k in range(n)])
    ais = feed(rng, describe("ais", "ais"), TIMES, x, v, 300.0, mmsi, extra)
    return [(radar[0], radar[1].where(seen.ravel())), ais], set(np.array(mmsi)[kind == 3])


def alarms(sources):
    made = Scene.of(sources)
    return Picture.of(made, TIMES[1:]).summary.faults


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_fleet_in_ais_only_is_an_alarm_of_each_of_its_ships(seed):
    sources, invented = fleet(seed, invented=5)
    found = alarms(sources)
    assert {fault.kind for fault in found} == {"phantom"} and len(found) >= 3
    assert {fault.track for fault in found} <= invented
    assert "may be invented: radar never saw it in " in str(found[0]) and " others " in str(found[0])
    assert all(0.95 < fault.probability <= 1.0 for fault in found)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize(
    "changes",
    [{}, {"weak": 4}, {"hidden_sector": True, "real": 40}, {"berthed": 6}, {"invented": 1}],
    ids=["nothing", "weak boats", "land", "berths", "one alone"],
)
def test_weak_hidden_and_berthed_ships_and_a_single_one_are_no_alarm(changes):
    for seed in range(2):
        assert not alarms(fleet(seed, **changes)[0])


@pytest.mark.slow
def test_short_hulls_are_not_expected_to_be_seen():
    assert alarms(fleet(1, invented=5, lengths=(90.0, 120.0))[0])
    assert not alarms(fleet(1, invented=5, lengths=(12.0, 120.0))[0])


@pytest.mark.slow
def test_a_radar_that_sees_few_of_the_ships_accuses_none():
    # Its offset may be unknown, or it shows acquired targets only.
    (radar, tracks), ais = fleet(1, invented=5)[0]
    few = tracks.where(np.isin(tracks.track_id, ["r0", "r1", "r2"]))
    assert not alarms([(radar, few), ais])


@pytest.mark.slow
def test_a_second_radar_that_sees_them_acquits_them():
    (radar, tracks), ais = fleet(1, invented=5)[0]
    assert alarms([(radar, tracks), ais])
    rng, (_, reports) = np.random.default_rng(9), ais
    x = np.column_stack([reports.x_m, reports.y_m]).reshape(-1, len(TIMES), 2)
    v = np.column_stack([reports.vx_m_per_s, reports.vy_m_per_s]).reshape(x.shape)
    other = feed(rng, describe("other", "tracks"), TIMES, x, v, 30.0, [f"o{k}" for k in range(len(x))])
    assert not alarms([(radar, tracks), other, ais])


def looks(hits, n_looks, chance=0.02, **grids):
    """Looks in one range bin."""
    hits = np.asarray(hits)
    names, n = tuple(f"{k}" for k in range(len(hits))), np.full((len(hits), 1), n_looks)
    times, ones = np.zeros(len(hits)), np.ones(1)
    return RadarLooks(
        "ais", "radar", names, n, hits[:, None], chance * ones, ones, 1.0 + times, times, times, 1e4, **grids
    )


def test_the_log_odds_grow_with_unseen_ships_and_shrink_with_weak_ones():
    def last(*hits):
        return looks(hits, 20).log_odds()[-1]

    sound = [19, 20, 18, 20, 19, 17, 20, 20, 19, 18, 20, 19]
    by_number = [last(*sound, *[0] * k) for k in range(1, 7)]
    assert (np.diff(by_number) > 0.0).all() and by_number[0] < 0.0 < 3.0 < by_number[4]
    assert last(*sound, 1, 2, 4, 9, 0, 0, 0, 0) < last(*sound, 0, 0, 0, 0) - 1.0
    assert last(*sound, 0, 0, 0, 0, 20) < -10.0


def test_the_posterior_is_that_of_the_sum_over_all_assignments():
    # One mean and width, three ships: every assignment to seen, hidden and invented, by hand.
    hits, n, chance, d = [9, 0, 0], 10, 0.05, (np.arange(50) + 0.5) / 50
    one = looks(hits, n, chance, mean_detectabilities=(0.9,), detectability_widths=(8.0,)).log_odds()
    from scipy.stats import beta

    weight = np.diff(beta.cdf(np.linspace(0.0, 1.0, 51), 7.2, 0.8))
    p = d + (1.0 - d) * chance
    real = np.array([np.sum(weight * p**k * (1.0 - p) ** (n - k)) for k in hits])
    none = np.array([chance**k * (1.0 - chance) ** (n - k) for k in hits])
    edges = np.append(0.0, np.logspace(-4.0, 0.0, 33))
    h, p_h = 0.5 * (edges[1:] + edges[:-1]), np.diff(beta.cdf(edges, *HIDDEN_SHARE))
    edges = np.linspace(0.0, 1.0, 21)
    t, p_t = 0.5 * (edges[1:] + edges[:-1]), np.diff(beta.cdf(edges, *INVENTED_SHARE))
    total, own = 0.0, np.zeros(3)
    for invented in np.ndindex(2, 2, 2):
        for k, p_hidden in zip(h, p_h, strict=True):
            exists = np.where(invented, none, (1.0 - k) * real + k * none).prod() * p_hidden
            share = [np.where(invented, one, 1.0 - one).prod() for one in t]
            weight_of = exists * (INVENTED_ODDS * np.dot(share, p_t) + (not any(invented)))
            total, own = total + weight_of, own + weight_of * np.array(invented)
    assert one == pytest.approx(np.log(own / (total - own)), abs=1e-6)


def test_a_place_is_seen_only_where_another_ship_at_its_bearing_is_seen_as_far_away():
    bearing = np.array([0.0, 2.0, 2.0, 24.0, 38.0, 31.0, 180.0])
    range_m = np.array([5e3, 6e3, 7e3, 8e3, 8e3, 5e3, 5e3])
    seen, ship = np.array([0, 1, 0, 1, 1, 0, 1], bool), np.array([0, 1, 2, 3, 4, 5, 6])
    arm = range_m[:, None] * np.column_stack([np.sin(np.radians(bearing)), np.cos(np.radians(bearing))])
    zeros = np.zeros(len(ship))
    one = ShipSightings(tuple("abcdefg"), ship, zeros, arm, seen, zeros, seen, zeros)
    # Number 5 is between two ships, 7° to either side; no ship proves her own place.
    assert proven(one, bearing, False).tolist() == [True, False, False, False, False, True, False]


def test_nothing_is_said_without_records():
    records = {"time_s": np.empty(0)}
    assert phantoms((), records) == []


@pytest.mark.slow
def test_a_live_picture_finds_a_fleet_in_ais_only_too():
    made, invented = fleet(1, invented=5)
    found = watched_live(made, TIMES).faults()
    assert {fault.kind for fault in found} == {"phantom"} and {fault.track for fault in found} <= invented
