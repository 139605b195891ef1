"""Manoeuvres: an old report stays with its ship after the ship has departed."""

import numpy as np
import pytest
from modelled_scenes import describe, feed

from sameas.picture import Picture
from sameas.tracks.scene import Scene


def departing(seed):
    """A stationary ferry that departs at 8 m/s after 62 s; AIS every 60 s, a precise radar and a coarse one."""
    rng = np.random.default_rng(seed)
    times = 10.0 * np.arange(18)
    speed = np.where(times > 62.0, 8.0, 0.0)
    x = np.zeros((1, 18, 2))
    x[0, :, 0] = 8.0 * np.maximum(times - 62.0, 0.0)
    v = np.stack([speed, np.zeros(18)], axis=-1)[None]
    mmsi = {"mmsi": ["235000001"]}
    # Other ships around, so that densities can be estimated.
    far = rng.uniform(-4e3, 4e3, (30, 1, 2)) + np.zeros((30, 18, 2))
    return Scene.of([
        feed(rng, describe("ais", "ais", 15.0, period_s=60.0), times[::6], x[:, ::6], v[:, ::6], 600.0, ["a"], mmsi),
        feed(rng, describe("radar", "tracks", 10.0), times, np.vstack([x, far]), np.vstack([v, 0.0 * far]), 30.0,
             [str(k) for k in range(31)]),
        feed(rng, describe("coast", "tracks", 60.0), times, x, v, 30.0, ["3"]),
    ]), times  # fmt: skip


@pytest.mark.slow
def test_a_ferry_that_departs_from_its_report_is_not_split():
    apart = 0
    for seed in range(16):
        scene, times = departing(seed)
        r = Picture.of(scene, times).records
        for time_s in times:
            here = r["time_s"] == time_s
            hers = here & ((r["source"] == "ais") | ((r["source"] == "radar") & (r["track_id"] == "0")))
            apart += len(set(r["object"][hers].tolist())) > 1
    assert apart <= 8


def passed_by(seed):
    """A ferry whose AIS is silent from 60 to 190 s and who turns then; a radar and the AIS of another ship see this one
    pass her at 130 s."""
    rng = np.random.default_rng(seed)
    times = 10.0 * np.arange(22)
    ferry = np.stack([6.0 * np.minimum(times, 62.0), 6.0 * np.maximum(times - 62.0, 0.0)], axis=-1)
    other = ferry[13] + np.stack([4.0 * (times - 130.0), 0.0 * times], axis=-1)
    x = np.stack([ferry, other])
    v = np.gradient(x, 10.0, axis=1)
    v[0] = np.where(times[:, None] > 62.0, [0.0, 6.0], [6.0, 0.0])
    far = rng.uniform(-4e3, 4e3, (20, 1, 2)) + np.zeros((20, 22, 2))
    mmsi = {"mmsi": ["235000000", "235000001"]}
    ais, by_ais = feed(rng, describe("ais", "ais", 10.0), times, x, v, 0.0, ["a", "b"], mmsi)
    received = (by_ais.time_s <= 60.0) | (by_ais.time_s >= 190.0) | (np.asarray(by_ais.mmsi) == "235000001")
    return Scene.of([
        (ais, by_ais.where(received)),
        feed(rng, describe("radar", "tracks", 15.0), times, np.vstack([x, far]), np.vstack([v, 0.0 * far]), 0.0,
             [str(k) for k in range(22)]),
    ]), times  # fmt: skip


@pytest.mark.slow
def test_a_ferry_that_turned_unreported_stays_one_when_another_passes_her():
    apart = 0
    for seed in range(4):
        scene, times = passed_by(seed)
        r = Picture.of(scene, times).records
        for time_s in times[13:]:
            hers = (r["time_s"] == time_s) & (((r["source"] == "ais") & (r["track_id"] == "a")) | (
                (r["source"] == "radar") & (r["track_id"] == "0")))  # fmt: skip
            apart += len(set(r["object"][hers].tolist())) > 1
    assert apart == 0
