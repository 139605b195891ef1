"""Heights of targets without a reported one are those that the sources of the scene report."""

from typing import Any

import numpy as np
import pymap3d
import pytest

from sameas.picture.live import LivePicture
from sameas.tracks import Description, Reports, Scene, Site
from sameas.tracks.reports import joined
from sameas.tracks.source import Targets
from sameas.tracks.target_heights import PartnerHeights

SITE = Site(lat_deg=51.0, lon_deg=1.0, height_m=60.0)


def sources(*, n=60, targets=None):
    rng = np.random.default_rng(1)
    time_s, alt_m = np.arange(float(n)), 900.0 + 100.0 * rng.standard_normal(n)
    adsb = Reports.of("adsb", "table", {
        "time_s": time_s, "lat_deg": np.full(n, 51.1), "lon_deg": np.full(n, 1.1), "alt_m": alt_m,
        "track_id": np.full(n, "a"),
    })  # fmt: skip
    radar = Reports.of("radar", "table", {
        "time_s": time_s, "range_m": np.full(n, 15_000.0), "bearing_deg": np.full(n, 33.0), "track_id": np.full(n, "7"),
    })  # fmt: skip
    given = {} if targets is None else {"targets": targets}
    return [(Description("adsb", "ads-b"), adsb), (Description("radar", "air radar", site=SITE, **given), radar)]


def of_radar(**given):
    """The description of the radar in a scene of both."""
    return next(feed.description for feed in Scene.of(sources(**given)).feeds if feed.description.name == "radar")


def test_assumed_heights_are_those_that_other_sources_report():
    description = of_radar()
    assert description.targets.height_m == pytest.approx(900.0, abs=50.0)
    assert description.targets.height_sigma_m == pytest.approx(450.0, abs=25.0)
    line = next(line for line in description.assumed if line.name == "targets.height_m")
    assert "60 heights" in line.why and line.value == description.targets.height_m


def test_given_heights_and_few_reports_change_nothing():
    assert of_radar(targets=Targets(height_m=2000.0, height_sigma_m=100.0)).targets.height_m == 2000.0
    assert of_radar(n=20).targets.height_m == 5000.0


def test_live_the_heights_are_those_with_which_the_offsets_hold():
    adsb, radar = sources()
    picture = LivePicture([adsb[0], radar[0]], lag_s=1.0)
    for description, reports in (adsb, radar):
        picture.add(description.name, reports)
    picture.advance(59.0)
    picture.register()
    (again,) = (description for description, _ in picture.recent() if description.name == "radar")
    assert again.targets.height_m == pytest.approx(900.0, abs=50.0)
    assert again.is_assumed("targets.height_m")


def flights(*, n=60, reported=True, jet=(15_000.0, -20_000.0)):
    """A jet at 10 km and a helicopter at 300 m, seen by ADS-B and by a radar without heights, and a glider that only
    the radar sees; (n, 2) the places of the first two."""
    site, time_s = (SITE.lat_deg, SITE.lon_deg, SITE.height_m), np.arange(float(n)) * 4.0
    rng, columns, places = np.random.default_rng(3), [], {}
    for name, east, north, height, v in (
        ("jet", *jet, 10_000.0, (20.0, 180.0)),
        ("heli", -9000.0, 6000.0, 300.0, (60.0, 10.0)),
        ("glider", 4000.0, 12_000.0, 1500.0, (-20.0, 15.0)),
    ):
        lat, lon, alt = pymap3d.enu2geodetic(east + v[0] * time_s, north + v[1] * time_s, height, *site)
        places[name] = lat, lon, alt
        azimuth, _, range_m = pymap3d.geodetic2aer(lat, lon, alt, *site)
        columns.append((name, range_m + rng.normal(0.0, 50.0, n), azimuth + rng.normal(0.0, 0.06, n)))
    heights = {"alt_m": np.concatenate([places[name][2] for name in ("jet", "heli")])} if reported else {}
    adsb = Reports.of("adsb", "table", {
        "time_s": np.tile(time_s, 2), "track_id": np.repeat(["jet", "heli"], n), **heights,
        "lat_deg": np.concatenate([places[name][0] for name in ("jet", "heli")]),
        "lon_deg": np.concatenate([places[name][1] for name in ("jet", "heli")]),
    })  # fmt: skip
    radar = Reports.of("radar", "table", {
        "time_s": np.tile(time_s, 3), "track_id": np.repeat([name for name, *_ in columns], n),
        "range_m": np.concatenate([c[1] for c in columns]),
        "bearing_deg": np.concatenate([c[2] for c in columns]) % 360.0,
    })  # fmt: skip
    return [(Description("adsb", "ads-b"), adsb), (Description("radar", "air radar", site=SITE), radar)]


def apart_m(scene, track):
    """(n,) distances of the measured places of a track of the radar from those of ADS-B."""
    places = {feed.description.name: feed.as_measured.reports for feed in scene.feeds}
    one, other = (each.state[each.track == track, :2] for each in (places["radar"], places["adsb"]))
    return np.hypot(*(one - other).T)


def test_a_track_takes_the_height_of_the_aircraft_that_it_keeps_to():
    scene = Scene.of(flights())
    for track in ("jet", "heli"):
        assert np.median(apart_m(scene, track)) < 100.0
    radar = next(feed for feed in scene.feeds if feed.description.name == "radar")
    own = radar.raw_reports.track_id == "glider"
    assert np.isnan(radar.raw_reports.target_height_m[own]).all()
    # What was taken from ADS-B is no evidence of heights.
    assert scene.heights[1] is None


def test_without_heights_that_others_report_nothing_is_taken():
    radar = next(feed for feed in Scene.of(flights(reported=False)).feeds if feed.description.name == "radar")
    assert radar.raw_reports.target_height_m is None


def test_an_aircraft_that_is_only_passed_gives_no_height():
    (adsb_description, adsb), (description, radar) = flights()
    crossing = adsb.where((adsb.track_id == "heli") & (adsb.time_s < 80.0))
    scene = Scene.of([(adsb_description, joined([adsb.where(adsb.track_id == "jet"), crossing])), (description, radar)])
    raw = next(feed.raw_reports for feed in scene.feeds if feed.description.name == "radar")
    assert np.isnan(raw.target_height_m[raw.track_id == "heli"]).all()


def places_of(records):
    """(2,) the places of records, by source and track."""
    return {
        (source, track): np.array([x, y])
        for source, track, x, y in zip(*(records[c] for c in ("source", "track_id", "x_m", "y_m")), strict=True)
    }


def test_live_a_track_takes_the_last_height_of_its_aircraft():
    sources = flights()
    picture = LivePicture([description for description, _ in sources], lag_s=1.0)
    for begin_s, end_s in ((0.0, 200.0), (200.0, 240.0)):
        for description, reports in sources:
            batch = reports.where((reports.time_s >= begin_s) & (reports.time_s < end_s))
            picture.add(description.name, batch)
        picture.advance(end_s - 4.0)
        picture.register()
    place = places_of(picture.records)
    assert np.hypot(*(place["radar", "jet"] - place["adsb", "jet"])) < 200.0


def test_live_a_track_that_takes_a_height_was_never_elsewhere():
    adsb, radar = flights(jet=(10_000.0, -2000.0))
    picture = LivePicture([radar[0], adsb[0]], lag_s=3.0)
    apart = []
    for now_s in np.arange(5.0, 240.0, 5.0).tolist():
        # The height is known after the next report of the radar has come.
        for description, reports in (radar, adsb):
            picture.add(description.name, reports.where((reports.time_s > now_s - 5.0) & (reports.time_s <= now_s)))
        picture.advance(now_s)
        records = picture.records
        owner = {(s, t): n for s, t, n in zip(*(records[c] for c in ("source", "track_id", "object")), strict=True)}
        apart.append(owner["radar", "jet"] != owner["adsb", "jet"])
        if now_s == 60.0:
            # By the height that is assumed its positions are 3 km from those of ADS-B.
            assert apart[-1]
            picture.register()
    assert not any(apart[13:])


def test_the_heights_of_partners_are_the_mean_of_those_that_are_known_now():
    radar = Description("radar", "air radar", site=SITE)
    given = {"1": (("a", "x"), ("a", "y")), "2": (("a", "y"), ("b", "y")), "3": (("b", "z"),)}
    heights = PartnerHeights().with_partners({"radar": given})
    for source, time_s, ids, alt_m in (
        ("a", [0.0, 99.0, 100.0], ["y", "x", "x"], [500.0, 3900.0, 4000.0]),
        ("b", [80.0, 90.0, 90.0], ["y", "y", "w"], [np.nan, 2000.0, 1.0]),
    ):
        columns: dict[str, Any] = {"time_s": time_s, "track_id": ids, "alt_m": alt_m}
        places = {"lat_deg": np.full(len(ids), 51.1), "lon_deg": np.full(len(ids), 1.1)}
        heights.take(source, Reports.of(source, "table", {**columns, **places}))

    def measured(ids):
        n = len(ids)
        columns = {"time_s": np.full(n, 100.0), "track_id": ids, "range_m": np.full(n, 9000.0)}
        return Reports.of("radar", "table", columns | {"bearing_deg": np.full(n, 33.0)})

    # The height of a/y is 100 s old: it counts no more.
    reports, elsewhere = heights.applied(radar, measured(["2", "4", "1", "3", "1"]))
    np.testing.assert_array_equal(reports.target_height_m, [2000.0, np.nan, 4000.0, np.nan, 4000.0])
    # 5000 m is what is assumed: 1 km over the ground to 2000 m, and to 4000 m, too.
    assert elsewhere and not heights.applied(radar, measured(["2", "1"]))[1]
    # A track that keeps to nothing any more is measured by what is assumed again.
    heights = heights.with_partners({"radar": {"1": given["1"]}})
    reports, elsewhere = heights.applied(radar, measured(["1", "2"]))
    np.testing.assert_array_equal(reports.target_height_m, [4000.0, np.nan])
    assert elsewhere and not heights.applied(radar, measured(["2"]))[1]
