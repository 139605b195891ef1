"""Faults of sources: clock jumps, early ends, frozen or flooding sources; correct ones raise no alarm."""

from dataclasses import replace

import numpy as np
import pytest
from benchmarks.boat_radar import boat_radar

from sameas.io.sensors.format import unwrapped
from sameas.tracks.faults import Fault, source_faults
from sameas.tracks.scene import Scene


def sources(seed=0):
    return boat_radar(np.random.default_rng(seed), common=6).sources


def found(radar, ais):
    """Kinds of alarms by source."""
    return [(fault.kind, fault.source) for fault in source_faults(Scene.of([radar, ais]).feeds)]


def with_jump(reports, seconds):
    """Reports whose clock jumps in the middle of the file."""
    time_s = reports.time_s.copy()
    time_s[len(time_s) // 2 :] += seconds
    return replace(reports, time_s=time_s)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("seed", range(3))
def test_correct_sources_raise_no_alarm(seed):
    assert found(*sources(seed)) == []


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [30.0, -30.0])
def test_a_clock_jump_is_reported_with_size_and_time(seconds):
    radar, (described, ais) = sources()
    (fault,) = source_faults(Scene.of([radar, (described, with_jump(ais, seconds))]).feeds)
    assert fault.kind == "clock" and fault.probability > 0.95
    assert f"its clock jumps by {seconds:+.0f} s" in str(fault) or abs(float(str(fault).split()[5]) - seconds) <= 4.0
    assert abs(fault.first_s - ais.time_s[len(ais) // 2]) < 60.0


def off_for_a_while(reports, seconds, begin_s=300.0, end_s=325.0):
    """Reports whose clock is off by so much between two times."""
    since = reports.time_s - reports.time_s.min()
    wrong = (since >= begin_s) & (since < end_s)
    return replace(reports, time_s=np.where(wrong, reports.time_s + seconds, reports.time_s)), wrong


@pytest.mark.parametrize("seconds", [3600.0, -3600.0, 7200.0, -86400.0])
@pytest.mark.parametrize("seed", range(3))
def test_a_clock_that_is_hours_off_for_half_a_minute_is_reported_and_its_reports_set_aside(seconds, seed):
    radar, (described, ais) = sources(seed)
    stamped, wrong = off_for_a_while(ais, seconds)
    scene = Scene.of([radar, (described, stamped)])
    (fault,) = source_faults(scene.feeds)
    assert fault.kind == "clock" and fault.source == "ais" and fault.probability > 0.95
    sense = "ahead" if seconds > 0.0 else "behind"
    assert f" s {sense} for " in str(fault) and f"the {wrong.sum()} reports of it are set aside" in str(fault)
    assert abs(float(str(fault).split()[4]) - abs(seconds)) < 15.0
    assert abs(fault.first_s - ais.time_s[wrong].min()) < 15.0
    feed = scene.feeds[1].reports
    assert not feed.usable[wrong].any() and np.allclose(feed.time_s, ais.time_s, atol=15.0)


@pytest.mark.parametrize("seed", range(3))
def test_an_hour_without_reception_and_an_hour_of_late_reports_are_no_wrong_clock(seed):
    radar, (described, ais) = sources(seed)
    since = ais.time_s - ais.time_s.min()
    # A file of another hour; a receiver that was switched off; reports that come an hour late, as from a satellite.
    velocity = ais.velocity_m_per_s()
    later = np.where(since > 300.0, 3600.0, 0.0)
    moved = ais.lat_deg + later * velocity[:, 1] / 111e3
    paused = replace(ais, time_s=ais.time_s + later, lat_deg=moved)
    assert Scene.of([radar, (described, paused)]).feeds[1].leaps == ()
    late = ais.where(np.concatenate([np.flatnonzero(since > 325.0), np.flatnonzero(since <= 325.0)]))
    assert Scene.of([radar, (described, late)]).feeds[1].leaps == ()


def test_one_leaping_ship_is_no_clock_jump():
    radar, (described, ais) = sources()
    mine = (ais.mmsi == ais.mmsi[0]) & (np.arange(len(ais)) > len(ais) // 2)
    leapt = replace(ais, lat_deg=np.where(mine, ais.lat_deg + 0.001, ais.lat_deg))
    assert ("clock", "ais") not in found(radar, (described, leapt))


def test_a_source_that_ends_early_is_reported():
    radar, (described, ais) = sources()
    assert found(radar, (described, ais.where(ais.time_s < ais.time_s.min() + 300.0))) == [("ended", "ais")]


def test_a_frozen_source_is_reported():
    radar, (described, ais) = sources()
    lat, lon = np.array(ais.lat_deg), np.array(ais.lon_deg)
    for name in set(ais.mmsi):
        late = np.flatnonzero((ais.mmsi == name) & (ais.time_s > ais.time_s.min() + 400.0))
        lat[late], lon[late] = lat[late[0]], lon[late[0]]
    assert found(radar, (described, replace(ais, lat_deg=lat, lon_deg=lon))) == [("frozen", "ais")]


def test_a_flooding_source_is_reported():
    (described, radar), ais = sources()
    burst = np.flatnonzero(np.abs(radar.time_s - radar.time_s.mean()) < 10.0)
    rows = np.sort(np.concatenate([np.arange(len(radar)), np.repeat(burst, 20)]))
    assert found((described, radar.where(rows)), ais) == [("flood", "radar")]


@pytest.mark.parametrize(("log_odds", "p"), [(-2000.0, 0.0), (0.0, 0.5), (2000.0, 1.0)])
def test_evidence_of_any_size_gives_a_valid_probability(log_odds, p):
    # One stationary track among hundreds of moving ones is evidence of this size against a frozen source.
    assert Fault("frozen", "radar", 0.0, 1.0, log_odds, "").probability == p


def counted(reports, pauses):
    """AIS without time stamps: silent in receiver pauses, its clock counted from the seconds in messages."""
    since = reports.time_s - reports.time_s.min()
    kept = ~np.any([(since > begin) & (since < end) for begin, end in pauses], axis=0)
    left = reports.where(kept)
    return replace(left, time_s=unwrapped(left.time_s % 60.0, 60.0, left.time_s[0]), counted_clock=True), left.time_s


@pytest.mark.parametrize("seed", [0, 1])
def test_minutes_lost_by_a_counted_clock_are_restored_from_track_motion(seed):
    radar, (described, ais) = sources(seed)
    reports, truth = counted(ais, [(120.0, 200.0), (330.0, 470.0)])
    assert np.ptp(reports.time_s) < np.ptp(truth) - 100.0
    scene = Scene.of([radar, (described, reports)])
    mended = scene.feeds[1].reports.time_s
    assert np.allclose(mended - mended[0], truth - truth[0], atol=1.0)
    assert any("counted on from the seconds in messages; 3 minutes" in note for note in scene.notes)


def test_a_counted_clock_without_pauses_is_unchanged():
    radar, (described, ais) = sources()
    reports, _ = counted(ais, [(1e6, 2e6)])
    feed = Scene.of([radar, (described, reports)]).feeds[1]
    assert np.allclose(feed.reports.time_s, reports.time_s) and "0 minutes" in feed.notes[-1]
