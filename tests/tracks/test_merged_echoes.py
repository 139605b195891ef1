"""An echo near a ship may be of another object that hides her: the stated probability is the frequency."""

from dataclasses import replace

import numpy as np

from sameas import Radius
from sameas.many.identify import identify_many
from sameas.many.observations import records_of
from sameas.tracks.reports import Reports
from sameas.tracks.scene import HIDDEN, Scene
from sameas.tracks.source import Clutter, Description, MissRate, Motion, Resolution, SensorErrors, Site, Timing

CELL_M, BEAM_DEG, RANGE_M = 80.0, 2.5, 8000.0
WALK = Motion(0.01, 8.0)
RADAR = Description(
    "radar", "marine radar", site=Site(east_m=0.0, north_m=-RANGE_M), misses=MissRate(0.1), clutter=Clutter(0.0),
    resolution=Resolution(CELL_M, BEAM_DEG), motion=WALK, errors=SensorErrors(30.0, 0.0, 0.3, extent_m=0.0),
    timing=Timing(3.0, 0.0, 0.0),
)  # fmt: skip
AIS = Description(
    "ais", "ais", misses=MissRate(0.3), motion=WALK, errors=SensorErrors(position_m=15.0, extent_m=0.0),
    timing=Timing(3.0, 0.0, 0.0),
)  # fmt: skip


def merged(rng, x, named):
    """The objects that the radar shows: of two in one cell one is not, of two with one name mostly the other."""
    shown = rng.random(len(x)) > 0.1
    arm = x - [0.0, -RANGE_M]
    r, a = np.hypot(*arm.T), np.degrees(np.arctan2(*arm.T))
    near = (abs(r[:, None] - r) < CELL_M) & (abs(a[:, None] - a) < BEAM_DEG)
    for i, j in np.argwhere(np.triu(near, 1)):
        p_first = 0.5 if named[i] == named[j] else (1.0 - HIDDEN if named[i] else HIDDEN)
        shown[j if rng.random() < p_first else i] = False
    return shown


def scene(seed, objects=120, half_m=2500.0):
    """An instant of objects at random, and which object each record of the radar and of AIS is of."""
    rng = np.random.default_rng(seed)
    x, named = rng.uniform(-half_m, half_m, (objects, 2)), rng.random(objects) > 0.3
    seen, sent = np.flatnonzero(merged(rng, x, named)), np.flatnonzero(named)
    arm = x[seen] - [0.0, -RANGE_M]
    radar = {"time_s": np.zeros(len(seen)), "range_m": np.hypot(*arm.T) + 30.0 * rng.standard_normal(len(seen))}
    radar["bearing_deg"] = np.degrees(np.arctan2(*arm.T)) + 0.3 * rng.standard_normal(len(seen))
    radar["bearing_deg"] = radar["bearing_deg"] % 360.0
    place = x[sent] + 15.0 * rng.standard_normal((len(sent), 2))
    ais = {"time_s": np.zeros(len(sent)), "x_m": place[:, 0], "y_m": place[:, 1]}
    reports = Reports.of("radar", "table", radar), Reports.of("ais", "ais", ais)
    return Scene.of([(RADAR, reports[0]), (AIS, reports[1])]).at(0.0), seen, sent


def stated_and_right(evidence_of):
    p, right = [], []
    for seed in range(40):
        now, seen, sent = scene(seed)
        found = identify_many(now.sources, rule=evidence_of(now), region=now.region)
        pairs = ~np.ma.getmaskarray(found.members).any(axis=1)
        at = found.members.data[pairs]
        p.append(found.probability[pairs])
        right.append(seen[at[:, 0]] == sent[at[:, 1]])
    return np.concatenate(p), np.concatenate(right)


def overstated(p, right):
    """The mean probability of the pairs stated with 0.8 to 0.99, minus how often they are right."""
    some = (p > 0.8) & (p < 0.99)
    assert some.sum() > 300
    return p[some].mean() - right[some].mean()


def test_an_echo_that_may_hide_a_ship_is_hers_as_often_as_stated():
    assert overstated(*stated_and_right(lambda now: now.rule())) > 0.03
    assert abs(overstated(*stated_and_right(lambda now: now.rule() + now.resolution()))) < 0.015


def test_sources_that_both_resolve_or_both_merge_are_not_compared():
    plot = {"time_s": [0.0], "x_m": [20.0], "y_m": [0.0]}
    for one, other in ((AIS, replace(AIS, name="other")), (RADAR, replace(RADAR, name="other"))):
        now = Scene.of([(each, Reports.of(each.name, "table", plot)) for each in (one, other)]).at(0.0)
        assert now.resolution()(Radius(500.0)(*map(records_of, now.sources))).log_ratio.tolist() == [0.0]
