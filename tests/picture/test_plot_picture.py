"""Pictures of bare plots process every scan and report the tracker's objects."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_plot_tracker import course, crossing, plots, sensor

from sameas.errors import InputError
from sameas.many.identify import identify_many
from sameas.many.observations import records_of
from sameas.picture import Picture, PlotPicture, Watch
from sameas.picture.bernoulli import KNOWN
from sameas.picture.picture_state import TrackedObjects
from sameas.picture.plot_picture import nameless, scan_times_between
from sameas.tracks.feed import Feed
from sameas.tracks.reports import Reports
from sameas.tracks.scene import POSITION_AND_VELOCITY, Scene
from sameas.tracks.source import Description, Site


def passing(seed, until_s=30.0, ends_s=np.inf):
    """Two boats that pass each other before a lidar and a radar."""
    rng = np.random.default_rng(seed)
    tracks = course((-60.0, 8.0), (4.0, 0.0)), course((60.0, -8.0), (-4.0, 0.0), ends_s)
    near, far = sensor("lidar", 2.0, 0.5, clutter_per_km2=11.0), sensor("radar", 4.0, 1.5, clutter_per_km2=11.0)
    return Scene(tuple(plots(rng, description, tracks, until_s) for description in (near, far)))


def columns(picture):
    """Columns of the objects at the last instant."""
    last = picture.objects["time_s"] == picture.objects["time_s"].max()
    return {name: np.ma.filled(column[last], np.nan) if column.dtype.kind == "f" else column[last]
            for name, column in picture.objects.items()}  # fmt: skip


@pytest.mark.slow
def test_scans_between_two_instants_are_processed():
    """Objects are tracked equally for rare instants and for an instant at every scan."""
    scene = passing(1)
    looks = scan_times_between(scene.feeds, -1.0, 20.0)
    often = Picture.of(scene, [*looks, 20.0])
    seldom = Picture.of(scene, [0.0, 20.0])
    one, other = columns(often), columns(seldom)
    for name in ("object", "stage", "members", "runner_up"):
        assert one[name].tolist() == other[name].tolist(), name
    for name in ("x_m", "y_m", "vx_m_per_s", "var_x_m2", "probability"):
        np.testing.assert_allclose(one[name], other[name], rtol=1e-9, atol=1e-12)
    assert (one["stage"] == "confirmed").sum() == 2


def test_nearly_simultaneous_scans_are_processed_together():
    scene = passing(1, 6.0)
    lidar, radar = scene.feeds
    late = replace(radar, scan_times_s=radar.scan_times_s + 0.05)
    assert scan_times_between((lidar, late), -1.0, 2.3) == [0.05, 0.5, 1.0, 1.55, 2.0]
    assert scan_times_between((lidar, late), 1.0, 1.2) == [] and scan_times_between((), 0.0, 9.0) == []


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 5])
def test_coincident_false_plots_are_not_confirmed(seed):
    """With seven false plots per scan some coincide every few seconds, and briefly exist with 99 %."""
    scene, tracks = crossing(seed, until_s=50.0)
    o = Picture.of(scene, np.arange(1.0, 49.0)).objects
    sure = o["stage"] == "confirmed"
    place, times = np.column_stack([o["x_m"], o["y_m"]])[sure], o["time_s"][sure]
    off = [np.linalg.norm(place - np.array([track(t) for t in times]), axis=1) for track in tracks]
    assert np.min(off, axis=0).max() < 12.0 and len(np.unique(o["object"][sure])) == 2
    assert sure.sum() > 80


def test_the_share_of_undetected_objects_falls_with_every_scan():
    scene = Scene(passing(1, 12.0).feeds[:1])
    carried, looks = PlotPicture(), scan_times_between(scene.feeds, -1.0, 10.0)
    shares = []
    for t in looks:
        carried = carried.updated(scene.at(t, features=POSITION_AND_VELOCITY))
        shares.append(carried.confirmation.unseen_share)
    lasts, q = np.exp(-0.5 / 60.0), 0.2
    assert shares[0] == 1.0 and shares[1] == pytest.approx(q * lasts + 1.0 - lasts)
    assert shares[-1] == pytest.approx((1.0 - lasts) / (1.0 - q * lasts), rel=1e-3)
    assert set(carried.confirmation.share) == set(carried.confirmation.plots) == set(carried.tracks.number.tolist())


@pytest.mark.slow
def test_an_undetected_object_coasts_and_ends_once():
    scene = passing(3, 60.0, ends_s=25.0)
    picture = Picture.of(scene, np.arange(2.0, 58.0, 1.0))
    o = picture.objects
    went = [number for number in set(o["object"].tolist())
            if "confirmed" in o["stage"][o["object"] == number].tolist()
            and o["time_s"][(o["object"] == number)].max() < 50.0]  # fmt: skip
    assert len(went) == 1
    mine = o["object"] == went[0]
    stages = o["stage"][mine].tolist()
    assert stages[-1] == "ended" and stages.count("ended") == 1 and "coasting" in stages
    unseen = mine & (o["n_sources"] == 0)
    assert (o["members"][unseen] == "").all() and np.ma.getmaskarray(o["probability"])[unseen].all()
    assert not np.ma.getmaskarray(o["x_m"])[unseen].any()
    times = o["time_s"][mine]
    assert 25.0 < times.max() < 45.0


@pytest.mark.slow
def test_probabilities_of_records_are_summed_over_known_objects():
    """Sets that differ only in the remembered object count as one."""
    state = PlotPicture().at(passing(2), 16.1)
    assert isinstance(state.detections, TrackedObjects)
    found, scan = state.detections.tracks.identification, state.scan
    names = [records_of(source).source for source in found.pooled.sources]
    assert KNOWN in names and len(state.members) > 3
    start = dict(zip((d.name for d in scan.now.descriptions), range(len(scan.start) - 1), strict=True))
    several = 0
    for members, p, alone in zip(state.members, state.probability, _p_alone(state), strict=True):
        same = 0.0
        for own, probability in zip(found.sets.members, found.answer.probability, strict=True):
            there = set()
            for k in own[own >= 0].tolist():
                u = int(np.searchsorted(found.pooled.start, k, side="right")) - 1
                if names[u] != KNOWN:
                    row = records_of(found.pooled.sources[u]).rows[k - found.pooled.start[u]]
                    there.add(int(scan.find(start[names[u]], np.array([row]))[0]))
            same += probability * (there == set(members[members >= 0].tolist()))
        assert p == pytest.approx(same, abs=1e-9)
        assert (members >= 0).sum() > 1 or alone == pytest.approx(p, abs=1e-9)
        several += (members >= 0).sum() > 1
    assert several >= 1
    rivals = state.runner_up
    for k, (rival, p) in enumerate(zip(rivals, state.p_runner_up, strict=True)):
        assert (p > 0.0) == (rival >= 0).any()
        assert p == 0.0 or (set(rival[rival >= 0]) & set(state.members[k]) and not (rival == state.members[k]).all())


def _p_alone(state):
    return state.p_alone[[members[members >= 0][0] for members in state.members]]


@pytest.mark.slow
def test_explanations_name_remembered_objects_by_number():
    state = PlotPicture().at(passing(2), 15.0)
    sure = state.objects.number[(state.objects.stage == 1) & (state.objects.detected)]
    assert len(sure) == 2
    for number in sure.tolist():
        reasons = state.explain(number)
        text = str(reasons)
        assert text.startswith(f"Object {number} is ") and KNOWN not in text
        assert ("known object", number) in reasons.chosen.members
    with pytest.raises(InputError, match="object 99999 is not shown"):
        state.explain(99999)


def test_the_plot_tracker_needs_positions_and_no_ids():
    scene = passing(1, 6.0)
    assert nameless(scene) and isinstance(Picture.of(scene, [3.0]).watch, PlotPicture)
    columns: dict[str, Any] = {"time_s": [0.0, 1.0], "x_m": [0.0, 1.0], "y_m": [0.0, 0.0]}
    for more in ({"track_id": ["a", "a"]}, {"callsign": ["KLM12", "KLM12"]}):
        named = Feed.of(sensor("tracker", 2.0, 0.5), Reports.of("tracker", "table", columns | more))
        mixed = Scene((*scene.feeds, named))
        assert not nameless(mixed) and isinstance(Picture.of(mixed, [1.0]).watch, Watch)
    assert isinstance(Picture.of(scene, [3.0], watch=Watch()).watch, Watch)


def test_a_picture_without_memory_agrees_with_identify_many():
    scene = passing(4)
    now = scene.at(0.0, features=POSITION_AND_VELOCITY)
    state = PlotPicture().advance(now)
    assert isinstance(state.detections, TrackedObjects)
    rule = state.detections.tracks.rule
    found = identify_many(now.sources, rule=rule, region=now.region)
    there = [tuple(sorted(m[m >= 0].tolist())) for m in state.scan.places(found.members)]
    mine = [tuple(sorted(m[m >= 0].tolist())) for m in state.members]
    assert sorted(there) == sorted(mine)
    by_set = dict(zip(there, found.probability.tolist(), strict=True))
    assert [by_set[m] for m in mine] == pytest.approx(state.probability.tolist(), abs=1e-9)


@pytest.mark.slow
def test_a_picture_is_continued_forward_only():
    scene = passing(1, 20.0)
    whole = Picture.of(scene, [5.0, 10.0, 15.0])
    first = Picture.of(scene, [5.0, 10.0])
    rest = Picture.of(scene, [15.0], watch=first.watch)
    assert columns(whole)["object"].tolist() == columns(rest)["object"].tolist()
    np.testing.assert_array_equal(columns(whole)["x_m"], columns(rest)["x_m"])
    with pytest.raises(InputError, match="in the order of time"):
        Picture.of(scene, [9.0], watch=first.watch)
    with pytest.raises(InputError, match="real is 1"):
        PlotPicture(real=1.0)


@pytest.mark.slow_after(1)
def test_aircraft_that_turn_keep_their_numbers_in_plots_with_transponder_codes():
    """A code is not a name, which several aircraft share: the plots were decided scan by scan, with new objects each
    time. Two radars, in 4.8 and 12 s a turn; three of six aircraft turn at 3° a second for half a minute."""
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 300.0, 0.2)
    angle = np.radians(rng.uniform(0.0, 360.0, 6)[:, None] + np.where(np.arange(6) < 3, 3.0, 0.0)[:, None]
                       * np.clip(t - 120.0, 0.0, 30.0))  # fmt: skip
    speed = rng.uniform(110.0, 220.0, 6)[:, None, None] * np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    place = rng.uniform(-3e4, 3e4, (6, 1, 2)) + np.cumsum(0.2 * speed, axis=1)
    codes = np.array(["1000", "1000", "1000", "4521", "4522", "1000"])
    sources, truth = [], {}
    for name, site, turn_s in (("approach", (0.0, 0.0), 4.8), ("route", (9e3, 2e4), 12.0)):
        rows = []
        for k in range(6):
            bearing = np.degrees(np.arctan2(*(place[k] - site).T)) % 360.0
            phase = (t / turn_s - bearing / 360.0) % 1.0
            seen = np.flatnonzero((np.diff(phase) < -0.5) & (rng.random(len(t) - 1) < 0.92))
            for n in seen:
                east, north = place[k, n] - site
                rows.append((t[n], np.hypot(east, north) + 60.0 * rng.normal(), bearing[n] + 0.08 * rng.normal(), k))
        rows.sort()
        time_s, range_m, bearing_deg, who = map(np.array, zip(*rows, strict=True))
        truth[name] = who
        table = {"time_s": time_s, "range_m": range_m, "bearing_deg": bearing_deg % 360.0, "mode_a": codes[who]}
        description = Description(name, "air radar", site=Site(east_m=site[0], north_m=site[1]))
        sources.append((description, Reports.of(name, "table", table)))
    scene = Scene.of(sources)
    assert nameless(scene)
    picture = Picture.of(scene, np.arange(60.0, 300.0, 10.0))
    records, objects = picture.records, picture.objects
    who = np.array([truth[s][r] for s, r in zip(records["source"], records["row"], strict=True)])
    for k in range(6):
        numbers = records["object"][who == k]
        assert np.mean(numbers == np.bincount(numbers).argmax()) > 0.95
    shown = objects["stage"] == "confirmed"
    assert len(np.unique(objects["object"][shown])) == 6 and set(objects["mode_a"][shown]) == set(codes)
