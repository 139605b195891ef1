"""Echoes of hulls: several plots a scan of one ship with a name are no further objects; a boat beside her is one."""

import numpy as np
import pytest

from sameas.picture import Picture, instants
from sameas.picture.hull_echoes import HullEchoes, Hulls, ScanPlots, owners_among
from sameas.picture.tables import ObjectTable
from sameas.tracks import Description, Reports, Scene, SensorErrors, Site
from sameas.tracks.source import SensorCoverage, Timing

VELOCITY, START, SPAN_S = np.array([4.0, 1.0]), np.array([-1200.0, 900.0]), 300.0
ALONG = VELOCITY / np.hypot(*VELOCITY)
ACROSS = np.array([-ALONG[1], ALONG[0]])


def ferry_scene(seed, echoes, boat=None):
    """A ferry of 200 m with AIS, seen in 80 % of a radar's scans as one plot and ``echoes`` more, among false plots;
    boat : (along, across) of one without AIS that keeps there beside her."""
    rng = np.random.default_rng(seed)
    rows, ais = [], []
    for t in np.arange(0.0, SPAN_S, 2.5):
        ferry = START + VELOCITY * t
        hull = rng.uniform(-80.0, 80.0, (rng.random() < 0.8) * (1 + rng.poisson(echoes)))
        seen = [ferry + ALONG * x for x in hull]
        if boat is not None and rng.random() < 0.8:
            seen.append(ferry + boat[0] * ALONG + boat[1] * ACROSS)
        rows += [(t, *(place + rng.normal(0.0, 12.0, 2))) for place in seen]
        rows += [(t, *place) for place in rng.uniform(-3000.0, 3000.0, (rng.poisson(3), 2))]
    ais = [(t, *(START + VELOCITY * t + rng.normal(0.0, 6.0, 2)), *VELOCITY) for t in np.arange(2.0, SPAN_S, 6.0)]
    plots = Reports.of("radar", "table", dict(zip(("time_s", "x_m", "y_m"), np.array(rows).T, strict=True)))
    names = ("time_s", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s")
    tracks = dict(zip(names, np.array(ais).T, strict=True)) | {"track_id": ["ferry"] * len(ais)}
    radar = Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0), timing=Timing(2.5, 0.0, 0.0),
                        coverage=SensorCoverage(range_m=5000.0), errors=SensorErrors(position_m=12.0))  # fmt: skip
    return Scene.of([(radar, plots), (Description("ais", "ais"), Reports.of("ais", "table", tracks))])


def confirmed_at(scene, along, across, reach=(160.0, 60.0)):
    """Mean number of confirmed objects within ``reach`` of a place beside the ferry, along and across her course."""
    objects = Picture.of(scene, instants(scene.span_s, 5.0)).objects
    late = np.isin(objects["stage"], ("confirmed", "coasting")) & (objects["time_s"] >= 60.0)
    places = np.column_stack([objects["x_m"], objects["y_m"]])[late]
    off = places - START - VELOCITY * objects["time_s"][late, None]
    near = (np.abs(off @ ALONG - along) < reach[0]) & (np.abs(off @ ACROSS - across) < reach[1])
    return near.sum() / len(np.unique(objects["time_s"][late]))


@pytest.mark.slow
@pytest.mark.parametrize("echoes", [1.0, 3.0])
@pytest.mark.long_after(1)
def test_a_hull_of_several_plots_a_scan_is_one_object(echoes):
    """With two plots a scan it was two for most of the time, with four 1.6."""
    assert np.mean([confirmed_at(ferry_scene(seed, echoes), 0.0, 0.0) for seed in range(2)]) < 1.2


@pytest.mark.slow
@pytest.mark.parametrize("echoes", [0.0, 1.0])
@pytest.mark.long_after(1)
def test_a_boat_beside_a_hull_is_an_object(echoes):
    found = [confirmed_at(ferry_scene(seed, echoes, (0.0, 110.0)), 0.0, 110.0, (50.0, 50.0)) for seed in range(2)]
    assert np.mean(found) > 0.9


def ship():
    return ObjectTable(np.array([7]), np.zeros((1, 4)), np.eye(4)[None])


def plots(place, own=0):
    place = np.array(place, float)
    return ScanPlots(place, np.tile(100.0 * np.eye(2), (len(place), 1, 1)), np.full(len(place), own))


def test_the_density_is_that_of_the_echoes_but_for_those_of_an_object_at_the_place_itself():
    rng = np.random.default_rng(1)
    spread, hull = np.array([60.0, 15.0]), HullEchoes()
    for _ in range(40):
        hull = hull.after(1.0, ship(), plots(spread * rng.normal(size=(2, 2))))
    assert len(hull.number) == 48  # the last 24 looks
    density = hull.per_m2(plots([[0.0, 0.0], [90.0, 0.0], [0.0, 150.0]]), ship())
    total = spread**2 + 101.0
    places = np.array([[0.0, 0.0], [90.0, 0.0]])
    exact = 2.0 * np.exp(-0.5 * (places**2 / total).sum(axis=1)) / (2.0 * np.pi * np.sqrt(total.prod()))
    assert density[:2] == pytest.approx(exact, rel=0.5) and density[2] < 1e-8

    boat = HullEchoes()
    for _ in range(40):
        boat = boat.after(1.0, ship(), plots(np.array([[0.0, 80.0]]) + rng.normal(0.0, 10.0, (1, 2))))
    assert (boat.per_m2(plots([[0.0, 80.0], [0.0, 85.0]]), ship()) < 1e-5).all()


def test_plots_of_a_hull_may_be_of_any_place_of_it_and_those_of_a_boat_beside_are_not():
    rng, hull = np.random.default_rng(2), HullEchoes()
    for _ in range(24):
        echoes = np.vstack([rng.uniform(-80.0, 80.0, 3), rng.normal(0.0, 10.0, 3)]).T
        boat = np.array([[0.0, 120.0]]) + rng.normal(0.0, 10.0, (1, 2))
        hull = hull.after(1.0, ship(), plots(np.vstack([echoes, boat])))
    extent = hull.extent(plots([[70.0, 0.0], [0.0, 120.0]]), ship())
    # Uniform over the hull, ± 46 m; a part of the echoes may be of an object at their place.
    assert 20.0 < np.sqrt(extent[0, 0, 0]) < 60.0 and np.sqrt(extent[0, 1, 1]) < 20.0
    assert not extent[1].any()
    hulls = Hulls(ship(), {"radar": hull})
    assert hulls.per_m2("radar", plots([[70.0, 0.0]], own=7))[0] == 0.0  # an owner's
    assert hulls.of_objects(np.array([3, 7]))[:, 0, 0] == pytest.approx([0.0, extent[0, 0, 0]])
    assert not hulls.extent("other", plots([[0.0, 0.0]])).any()


def test_of_two_objects_without_names_the_first_owns_the_echoes():
    place, named = (
        np.array([[0.0, 0.0], [90.0, 0.0], [250.0, 0.0], [260.0, 0.0]]),
        np.array([False, False, False, True]),
    )
    assert owners_among(place, named).tolist() == [True, False, False, True]


def test_plots_far_from_owners_are_no_echoes():
    hull = HullEchoes().after(1.0, ship(), plots([[201.0, 0.0], [10.0, 0.0]]))
    assert hull.number.tolist() == [7] and hull.offset.tolist() == [[10.0, 0.0]] and not hull.is_own.any()
    assert hull.after(1.0, ship().take(np.empty(0, np.int64)), plots([[10.0, 0.0]])).number.tolist() == [7]
    assert HullEchoes().per_m2(plots([[0.0, 0.0]]), ship()).tolist() == [0.0]
    assert HullEchoes().after(1.0, ship(), plots([[10.0, 0.0]], own=7)).is_own.all()
