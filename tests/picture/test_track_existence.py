"""Track existence: long-lived tracks are real with calibrated probability; broken tracks keep their object number."""

import numpy as np
import pytest
from modelled_scenes import describe, feed, straight

from sameas.errors import InputError
from sameas.picture import Picture, Stages, Watch
from sameas.picture.track_existence import DurationMixture
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene

RADAR = describe("radar", "marine radar", clutter_per_km2=0.01)


def joined(parts):
    """Reports of several parts joined into one source."""
    names = ("time_s", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s", "track_id")
    columns = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return RADAR, Reports.of("radar", "table", columns)


def radar_with_false_tracks(seed, real=12, false=160, looks=80, lasting=3.0):
    """Real objects in all scans, and false tracks that begin at any scan and last for ``lasting`` scans."""
    rng = np.random.default_rng(seed)
    parts = []
    for k in range(real + false):
        begin = 0 if k < real else int(rng.integers(0, looks - 1))
        end = looks if k < real else min(begin + int(rng.geometric(1.0 / lasting)), looks)
        times = 10.0 * np.arange(begin, end)
        x, v = straight(rng.uniform(-15e3, 15e3, (1, 2)), 4.0 * rng.standard_normal((1, 2)) * (k < real), times)
        parts.append(feed(rng, RADAR, times, x, v, 0.0, [f"{'real' if k < real else 'false'} {k}"])[1])
    return Scene.of([joined(parts)]), 10.0 * np.arange(looks)


def confirmed(picture):
    """(real, false) : how many confirmed objects began with a track of either kind."""
    o, r = picture.objects, picture.records
    sure = np.unique(o["object"][o["stage"] == "confirmed"])
    first = [str(r["track_id"][np.argmax(r["object"] == number)]) for number in sure]
    return np.array([sum(name.startswith(kind) for name in first) for kind in ("real", "false")])


@pytest.mark.slow
def test_false_tracks_are_not_confirmed_and_real_ones_are():
    counts = sum(confirmed(Picture.of(*radar_with_false_tracks(seed))) for seed in range(3))
    assert counts[0] == 36
    # At 99 % one in a hundred of the confirmed may be false: 0.4 are expected, and more than 3 have a chance of 1e-3.
    assert counts[1] <= 3


def test_a_mixture_of_track_durations_is_fitted():
    rng = np.random.default_rng(1)
    n, real = 1500, rng.random(1500) < 0.2
    life = np.where(real, rng.exponential(900.0, n), rng.exponential(12.0, n))
    limit = rng.uniform(0.0, 600.0, n)
    ended, life = life < limit, np.minimum(life, limit)
    mixture, source, later = DurationMixture().with_sources(np.array([3.0])), np.zeros(n, np.int64), np.ones(n, bool)
    for _ in range(60):
        mixture = mixture.fitted(source, later, life, ended, np.zeros(n, bool))
    assert abs(mixture.false_s[0] - 12.0) < 2.0 and abs(mixture.share[0, 1] - 0.2) < 0.04
    assert 600.0 < mixture.real_s[0] < 1400.0
    # Of those that it gives a probability p, a share p is real.
    p = 1.0 / (1.0 + np.exp(-mixture.log_odds(source, later, life, ended)))
    for low, high in ((0.0, 0.1), (0.1, 0.9), (0.9, 1.0)):
        some = (p >= low) & (p <= high)
        error = np.sqrt(p[some].mean() * (1.0 - p[some].mean()) / some.sum())
        assert abs(p[some].mean() - real[some].mean()) < 3.5 * error + 0.02


@pytest.mark.slow
def test_a_broken_track_keeps_its_object_number():
    times = np.arange(0.0, 401.0, 10.0)
    before, after = times <= 180.0, times >= 220.0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        # They meet while undetected: only their velocities distinguish them.
        x, v = straight([[-800.0, 10.0], [800.0, -10.0]], [[4.0, 0.0], [-4.0, 0.0]], times)
        parts = [feed(rng, RADAR, times[part], x[:, part], v[:, part], 0.0, names)[1]
                 for part, names in ((before, ["a 1", "b 1"]), (after, ["a 2", "b 2"]))]  # fmt: skip
        picture = Picture.of(Scene.of([joined(parts)]), times)
        r, o = picture.records, picture.objects
        numbers = {name: set(r["object"][r["track_id"] == name].tolist()) for name in ("a 1", "a 2", "b 1", "b 2")}
        assert numbers["a 1"] == numbers["a 2"] and numbers["b 1"] == numbers["b 2"]
        # The evidence of their first tracks is kept: they are confirmed soon after at the latest.
        assert set(o["stage"][o["time_s"] >= 300.0].tolist()) == {"confirmed"}


def test_invalid_confirmation_probabilities_are_refused():
    with pytest.raises(InputError, match="sure and real as probabilities"):
        Watch(stages=Stages(real=1.0))
