"""The live picture: what the batch picture makes of a file, made of the same reports as they arrive."""

import pickle
from typing import Any

import numpy as np
import pytest
from tests.picture.modelled_scenes import describe, feed, straight

from sameas.errors import InputError
from sameas.picture import LivePicture, PlotPicture, picture_states
from sameas.picture.live import Registered, Window
from sameas.tracks import Clutter, Description, LocalPlane, MissRate, Motion, Scene, SensorErrors, Site, Timing
from sameas.tracks.biases import TIME
from sameas.tracks.registration import DELAY_S, SourceBiases
from sameas.tracks.reports import Reports

INSTANTS = np.arange(5.0, 300.0, 5.0)


def sources(seed=1, ships=12, filtered=False, seen=0.9):
    """Ships on straight courses, two radars that number them and AIS."""
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(-400.0, 400.0, (ships, 2)), rng.normal(0.0, 4.0, (ships, 2))
    made = []
    for name, kind, every, tau in (
        ("radar", "tracks", 3.0, 20.0),
        ("coast", "tracks", 4.0, 20.0),
        ("ais", "ais", 10.0, 600.0),
    ):
        times = np.arange(0.7, 300.0, every)
        x, v = straight(start, velocity, times)
        ids = {"mmsi": [f"23500{k:04d}" for k in range(ships)]} if kind == "ais" else None
        description, reports = feed(
            rng, describe(name, kind, period_s=every), times, x, v, tau, [f"{name}{k}" for k in range(ships)], ids
        )
        received = np.sort(rng.permutation(len(reports))[: int(seen * len(reports))])
        reports = reports.where(received[np.argsort(reports.time_s[received], kind="stable")])
        if filtered:
            columns = {n: c for n, c in reports.columns().items() if not n.startswith("v")}
            reports = Reports.of(name, reports.kind, columns)
        made.append((description, reports))
    return made


def batches(made, late=None, every_s=1.0):
    """(arrival, source, reports) in the order of arrival; ``late`` (n,) seconds of delay for each source's reports."""
    out = []
    for k, (description, reports) in enumerate(made):
        arrival = reports.time_s if late is None else reports.time_s + late[k][: len(reports)]
        for tick in np.unique(np.ceil(arrival / every_s)):
            rows = np.flatnonzero(np.ceil(arrival / every_s) == tick)
            out.append((tick * every_s, description.name, reports.where(rows[np.argsort(arrival[rows])])))
    return sorted(out, key=lambda one: one[0])


def live_states(made, instants_s, arrivals, picture=None, behind_s=0.0, **options):
    picture = picture or LivePicture([d for d, _ in made], **options)
    queue = list(arrivals)
    for instant_s in instants_s:
        while queue and queue[0][0] <= instant_s + behind_s:
            _, name, reports = queue.pop(0)
            picture.add(name, reports)
        yield picture.advance(instant_s)


def groups(state):
    """Objects of a state by number: the tracks that they have, with stage, place and probability."""
    scan = state.scan
    names = [d.name for d in scan.now.descriptions]
    label = [f"{names[s]}:{t}" for s, t in zip(scan.source, scan.track, strict=True)]
    objects = {}
    for number, stage, k, place in zip(
        *(getattr(state.objects, n).tolist() for n in ("number", "stage", "detection")),
        state.objects.state,
        strict=True,
    ):
        members = frozenset(label[m] for m in state.members[k] if m >= 0) if k >= 0 else frozenset()
        objects[number] = (stage, members, place, state.probability[k] if k >= 0 else np.nan)
    return objects


def assert_same(live, batch):
    """The same objects at every instant, one number of the one for one number of the other throughout."""
    numbers, instants = {}, 0
    for one, other in zip(live, batch, strict=True):
        one, other = groups(one), groups(other)
        assert len(one) == len(other)
        by_members = {members: number for number, (_, members, _, _) in other.items() if members}
        for number, (_, members, _, _) in one.items():
            numbers.setdefault(number, by_members.get(members))
        for number, (stage, members, place, p) in one.items():
            assert (stage, members) == other[numbers[number]][:2]
            np.testing.assert_allclose(place, other[numbers[number]][2], rtol=1e-6, atol=1e-6)
            np.testing.assert_allclose(p, other[numbers[number]][3], rtol=1e-6, atol=1e-9)
        instants += 1
    assert len(set(numbers.values())) == len(numbers) and instants > 20


@pytest.mark.slow
@pytest.mark.parametrize("filtered", [False, True])
def test_a_live_picture_agrees_with_the_batch_picture(filtered):
    # Nothing is missed: the batch picture knows how long tracks are silent before it begins, the live one learns it.
    made = sources(filtered=filtered, seen=1.0)
    scene, picture = Scene.of(made), LivePicture([d for d, _ in made])
    # What is random of the stated errors, a file shows at once, and a live picture when it is registered.
    picture.take_off(Registered(random={feed.description.name: feed.random for feed in scene.feeds}))
    batch = list(picture_states(scene, INSTANTS))
    live = list(live_states(made, INSTANTS, batches(made), picture))
    assert sum(len(s.objects) for s in batch) > 300
    assert_same(live, batch)


@pytest.mark.slow
@pytest.mark.parametrize("filtered", [False, True])
def test_late_and_unordered_reports_within_the_lag_change_nothing(filtered):
    made = sources(2, filtered=filtered)
    rng = np.random.default_rng(0)
    late = [rng.uniform(0.0, 6.0, len(reports)) for _, reports in made]
    in_time = list(live_states(made, INSTANTS, batches(made), lag_s=16.0))
    shuffled = list(live_states(made, INSTANTS, batches(made, late), behind_s=8.0, lag_s=16.0))
    assert_same(shuffled, in_time)


@pytest.mark.slow
def test_reports_later_than_the_lag_are_counted_and_ignored():
    made = sources(3)
    picture = LivePicture([d for d, _ in made], lag_s=5.0)
    list(live_states(made, INSTANTS[:20], batches(made), picture))
    name, reports = made[0][0].name, made[0][1]
    picture.add(name, reports.where(np.flatnonzero(reports.time_s < 10.0)))
    assert picture.counts[name].late == np.sum(reports.time_s < 10.0)


@pytest.mark.slow
def test_a_pickled_picture_continues_with_the_same_numbers():
    made = sources(4)
    picture = LivePicture([d for d, _ in made])
    arrivals = batches(made)
    before = [a for a in arrivals if a[0] <= 150.0]
    list(live_states(made, INSTANTS[INSTANTS <= 150.0], before, picture))
    again = pickle.loads(pickle.dumps(picture))
    after, rest = INSTANTS[INSTANTS > 150.0], [a for a in arrivals if a[0] > 150.0]
    assert_same(live_states(made, after, rest, again), list(live_states(made, after, rest, picture)))


@pytest.mark.slow
def test_memory_stays_constant():
    made = sources(5, ships=6)
    picture = LivePicture([d for d, _ in made])
    sizes = []
    for state in live_states(made, INSTANTS, batches(made), picture):
        sizes.append(sum(len(feed._rows) for feed in picture._feeds.values()))
        assert len(state.objects) < 60
    assert sizes[-1] == sizes[len(sizes) // 3]


def bare(seed=0):
    """Two boats that pass, seen by a lidar and a radar that name nothing, with clutter."""
    rng = np.random.default_rng(seed)
    made = []
    for name, sigma_m, period_s in (("lidar", 2.0, 0.5), ("radar", 4.0, 1.5)):
        columns = {"time_s": [], "x_m": [], "y_m": []}
        for t in np.arange(0.0, 40.0, period_s):
            place = np.array([[4.0 * t - 80.0, 6.0], [80.0 - 4.0 * t, -6.0]])[rng.random(2) < 0.8]
            for x, y in np.vstack(
                [place + sigma_m * rng.normal(size=place.shape), rng.uniform(-300, 300, (rng.poisson(2), 2))]
            ):
                for key, value in zip(columns, (t, x, y), strict=True):
                    columns[key].append(value)
        sensor = Description(
            name, "lidar", site=Site(east_m=0.0, north_m=0.0), motion=Motion(0.02, 4.0), misses=MissRate(0.2),
            clutter=Clutter(per_km2=6.0), errors=SensorErrors(position_m=sigma_m, extent_m=0.0),
            timing=Timing(period_s=period_s),
        )  # fmt: skip
        made.append((sensor, Reports.of(name, "table", columns)))
    return made


@pytest.mark.slow
def test_plots_without_ids_keep_their_identity_when_rows_are_reused():
    made = bare()
    times = np.arange(1.0, 40.0, 1.0)
    picture = LivePicture([d for d, _ in made])
    states = list(live_states(made, times, batches(made, every_s=0.25), picture))
    assert all(isinstance(state.watch, PlotPicture) for state in states)
    batch = list(picture_states(Scene.of(made), times))
    for one, other in zip(states[20:], batch[20:], strict=True):
        confirmed = [s.objects.stage == 1 for s in (one, other)]
        np.testing.assert_allclose(one.objects.state[confirmed[0]], other.objects.state[confirmed[1]], atol=1.0)
    numbers = [set(s.objects.number[s.objects.stage == 1].tolist()) for s in states[20:]]
    assert set.intersection(*numbers) and max(map(len, numbers)) == 2


@pytest.mark.slow
def test_one_id_at_two_positions_becomes_two_objects():
    rng = np.random.default_rng(1)
    picture = LivePicture([Description("ais", "ais")])
    for t in np.arange(0.0, 120.0, 2.0):
        x = [0.0, 30e3][int(t / 2) % 2] + rng.normal(0.0, 5.0)
        picture.add(
            "ais",
            Reports.of(
                "ais",
                "ais",
                {
                    "time_s": [t],
                    "x_m": [x],
                    "y_m": [0.0],
                    "mmsi": ["235000001"],
                    "vx_m_per_s": [0.0],
                    "vy_m_per_s": [0.0],
                },
            ),
        )
        state = picture.advance(t)
    assert sorted(np.round(state.objects.state[state.objects.detected, 0] / 1e3).tolist()) == [0.0, 30.0]
    assert state.alarms and state.alarms[0].value == "235000001"


@pytest.mark.slow
def test_biases_are_estimated_from_the_last_minutes_and_removed():
    from tests.tracks.harbour import harbour

    made = harbour(3, biases=((60.0, 1.0, 0.0),)).sources
    picture = LivePicture([d for d, _ in made], lag_s=5.0)
    arrivals = batches([(d, r.in_time_order()) for d, r in made])
    states = list(live_states(made, np.arange(3.0, 300.0, 3.0), [a for a in arrivals if a[0] < 300.0], picture))
    found = {one.source: one for one in picture.register()}
    assert found["radar 1"].established
    assert found["radar 1"].parameters["azimuth_deg"].value == pytest.approx(1.0, abs=0.2)
    after = list(live_states(made, np.arange(303.0, 390.0, 3.0), [a for a in arrivals if a[0] >= 300.0], picture))
    several = [np.mean((s.members >= 0).sum(axis=1) > 1) for s in (states[-1], after[-1])]
    assert several[0] < 0.2 < 0.5 < several[1]


@pytest.mark.slow
@pytest.mark.parametrize("delay_s", [0.0, 2.5])
def test_a_report_stays_current_until_the_next_one_can_have_arrived(delay_s):
    """Latency, transport and a delay of the stamps make reports older than the interval before the next one arrives."""
    picture, current = LivePicture([Description("sbs", "ads-b", timing=Timing(period_s=1.0, latency_s=0.2))]), []
    if delay_s:
        theta = np.where(np.arange(6) == TIME, delay_s, 0.0)
        picture.take_off(Registered((SourceBiases("sbs", theta=theta, covariance=np.zeros((6, 6))),)))
    for k in range(60):
        columns: dict[str, Any] = {"time_s": [k + 0.1], "x_m": [200.0 * k], "y_m": [0.0], "icao": ["400a00"]}
        picture.add("sbs", Reports.of("sbs", "adsb", columns))
        current += [len(picture.advance(k + t).scan.time_s) for t in (1.0, 1.05, 1.09)]
    assert len(current) == 180 and all(current[9:])
    assert [len(picture.advance(60.0 + t).scan.time_s) for t in (1.5, 5.0)] == [0, 0]


def test_the_first_scan_of_a_radar_makes_a_picture():
    """Before the second scan nothing is known of the period."""
    picture = LivePicture([Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0))])
    plots = {"time_s": [0.0, 0.0], "range_m": [900.0, 2000.0], "bearing_deg": [10.0, 50.0]}
    picture.add("radar", Reports.of("radar", "table", plots))
    assert len(picture.advance(1.0).objects) == 2


def test_a_picture_of_plots_without_ids_goes_on_with_its_own_sources_only():
    site, given = Site(east_m=0.0, north_m=0.0), {"range_m": [900.0], "bearing_deg": [10.0]}
    radar = Description("radar", "marine radar", site=site)
    picture = LivePicture([radar])
    picture.add("radar", Reports.of("radar", "table", {"time_s": [0.0], **given}))
    picture.advance(1.0)
    assert picture.describe([radar]) == ()
    with pytest.raises(InputError, match="plots without ids of radar cannot go on with other sources"):
        picture.describe([radar, Description("ais", "ais")])


@pytest.mark.slow
def test_reports_that_drift_against_the_instants_are_always_there():
    """A report of each second that arrives 0.6 s later; the instants are 3 ms later every time."""
    picture, arrived, present = LivePicture([Description("sbs", "ads-b", timing=Timing(period_s=1.0))]), 20, []
    for n in range(100):
        instant_s = 20.9 + 1.003 * n
        for k in range(arrived, int(instant_s - 0.6) + 1):
            columns: dict[str, Any] = {"time_s": [float(k)], "x_m": [200.0 * k], "y_m": [0.0], "icao": ["400a00"]}
            picture.add("sbs", Reports.of("sbs", "adsb", columns))
            arrived = k + 1
        present.append(len(picture.advance(instant_s).scan.time_s))
    assert present.count(0) <= 1


def test_a_ships_radar_without_a_site_centres_the_plane_on_the_ship():
    picture = LivePicture([Description("radar", "marine radar")])
    columns: dict[str, Any] = {"time_s": [0.0], "range_m": [900.0], "bearing_deg": [90.0], "track_id": ["1"]}
    columns |= {"station_lat_deg": [50.0], "station_lon_deg": [-1.0]}
    picture.add("radar", Reports.of("radar", "arpa", columns))
    assert picture.plane == LocalPlane(50.0, -1.0)
    np.testing.assert_allclose(picture.advance(1.0).objects.state[0, :2], [900.0, 0.0], atol=1.0)


def test_refusals_name_the_error():
    picture = LivePicture([Description("ais", "ais")])
    with pytest.raises(InputError, match="no source 'radar'"):
        picture.add("radar", Reports.of("radar", "table", {"time_s": [0.0], "x_m": [0.0], "y_m": [0.0]}))
    picture.add("ais", Reports.of("ais", "ais", {"time_s": [], "x_m": [], "y_m": []}))
    picture.advance(5.0)
    with pytest.raises(InputError, match="order of time"):
        picture.advance(4.0)
    with pytest.raises(InputError, match="own name"):
        LivePicture([Description("ais", "ais")] * 2)
    assert LivePicture([Description("r", "marine radar", site=Site(lat_deg=50.0, lon_deg=1.0))]).plane == LocalPlane(
        50.0, 1.0
    )


@pytest.mark.slow
@pytest.mark.parametrize("late_s", [3.0, -5.0])
def test_a_delay_of_the_stamps_is_removed_live_and_estimated_again_in_every_window(late_s):
    from tests.tracks.test_delays import aircraft

    made = [(d, reports.in_time_order()) for d, reports in aircraft(1, late_s)]
    arrivals = batches(made)
    picture = LivePicture([d for d, _ in made], lag_s=5.0)
    list(live_states(made, np.arange(3.0, 100.0), [a for a in arrivals if a[0] < 100.0], picture))
    picture.register()
    radar = picture.biases["radar"]
    assert abs(radar.parameters["time_s"].value - late_s) < 3.5 * radar.parameters["time_s"].standard_error
    assert any("which its description does not mention" in note for note in radar.notes)
    after = list(live_states(made, np.arange(100.0, 280.0), [a for a in arrivals if a[0] >= 100.0], picture))
    # No track is missing for a moment, and those of an aircraft are one object again.
    assert np.mean([len(state.scan) for state in after]) > 15.8
    assert np.mean((after[-1].members >= 0).sum(axis=1) > 1) > 0.8
    assert [d.bias.time_s for d, _ in picture.recent()] == [None, DELAY_S]
    assert picture.descriptions[1].bias.time_s is None


@pytest.mark.parametrize("off_s", [30 * 86400.0, -30 * 86400.0])
def test_a_wrong_date_does_not_stretch_the_last_minutes_that_are_searched(off_s):
    picture = LivePicture([Description("ais", "ais")], window=Window(span_s=60.0))
    for t in np.arange(0.0, 200.0, 5.0):
        row = {"time_s": [1e9 + t + off_s * (t == 100.0)], "x_m": [t], "y_m": [0.0], "mmsi": ["235000001"]}
        picture.add("ais", Reports.of("ais", "ais", row))
        picture.advance(1e9 + t)
    [(_, recent)] = picture.recent()
    assert np.ptp(recent.time_s) <= 65.0 and len(recent) >= 12


def test_a_first_position_of_zero_degrees_is_not_the_middle_of_the_picture():
    picture = LivePicture([Description("ais", "ais"), Description("other", "ais")])
    fix: dict[str, Any] = {"time_s": [0.0], "lat_deg": [0.0], "lon_deg": [0.0], "mmsi": ["235000001"]}
    with pytest.raises(InputError, match="other: its latitudes and longitudes are 0, and no other position"):
        picture.add("other", Reports.of("other", "ais", fix))
    picture.add("ais", Reports.of("ais", "ais", fix | {"lat_deg": [50.5], "lon_deg": [-1.0]}))
    assert len(picture.advance(1.0).objects.number) == 1
