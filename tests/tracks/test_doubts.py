"""Doubts: systematic errors of a source are reported with cause and remedy; correct sources raise none."""

import re
from dataclasses import replace
from datetime import UTC, datetime

import numpy as np
import pytest
from benchmarks.boat_radar import boat_radar
from harbour import harbour

from sameas.errors import InputError
from sameas.tracks import Description, LocalPlane, MissRate, Reports, Scene, SensorErrors, Site

pytest.importorskip("pymap3d")

PLANE = LocalPlane(50.7, -1.2)
MADE = harbour(5, 40, until_s=150.0)
NOON = datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp()
METRES = {"radar": MADE.sources[0], "ais": MADE.sources[1]}


def on_earth(about, reports):
    """The same source, its positions or its site in degrees, its times in UTC."""
    reports = replace(reports, time_s=reports.time_s + NOON)
    if reports.x_m is not None:
        lat, lon = PLANE.to_geodetic(np.column_stack([reports.x_m, reports.y_m]))
        return about, replace(reports, x_m=None, y_m=None, lat_deg=lat, lon_deg=lon)
    lat, lon = PLANE.to_geodetic([[about.site.east_m, about.site.north_m]])
    return replace(about, site=Site(float(lat[0]), float(lon[0]))), reports


DEGREES = {name: on_earth(*source) for name, source in METRES.items()}


def doubts_with(sources, changed, columns):
    """The doubts of a scene in which one source has other columns."""
    about, reports = sources[changed]
    return Scene.of(list((sources | {changed: (about, replace(reports, **columns))}).values())).doubts()


@pytest.mark.slow
def test_correct_sources_raise_no_doubt():
    assert Scene.of(list(METRES.values())).doubts() == () == Scene.of(list(DEGREES.values())).doubts()


AIS, RADAR = DEGREES["ais"][1], METRES["radar"][1]
PLAIN = METRES["ais"][1]

#: Heading of a boat that turns by a degree in two seconds.
TURNING = (300.0 + 0.5 * (RADAR.time_s - RADAR.time_s[0])) % 360.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("sources", "changed", "columns", "words"),
    [
        (DEGREES, "ais", {"lon_deg": -AIS.lon_deg}, "ais: its longitudes look like they have the wrong sign: .* turn"),
        (METRES, "ais", {"x_m": PLAIN.x_m / 1e3, "y_m": PLAIN.y_m / 1e3}, "ais: its coordinates look like kilometres"),
        (METRES, "ais", {"x_m": PLAIN.y_m, "y_m": PLAIN.x_m}, "ais: its x and y look exchanged"),
        (METRES, "radar", {"range_m": RADAR.range_m / 1e3}, "radar 1: its ranges look like kilometres"),
        (METRES, "radar", {"range_m": RADAR.range_m / 1852.0}, "radar 1: its ranges look like nautical miles"),
        (METRES, "radar", {"range_m": RADAR.range_m / 0.3048}, "radar 1: its ranges look like feet"),
        (METRES, "radar", {"bearing_deg": np.radians(RADAR.bearing_deg)}, "radar 1: its bearings look like radians"),
        (METRES, "radar", {"bearing_deg": (90.0 - RADAR.bearing_deg) % 360.0}, "radar 1: its bearings .*anticlockwise"),
        (METRES, "radar", {"bearing_deg": (RADAR.bearing_deg - TURNING) % 360.0, "station_heading_deg": TURNING},
         "radar 1: its bearings look relative to the bow: with the heading added, .* name their column relative_be"),
        (METRES, "radar", {"bearing_deg": (RADAR.bearing_deg + TURNING) % 360.0, "station_heading_deg": TURNING},
         "radar 1: its bearings look as from north, not from the bow: with the heading taken off"),
        (DEGREES, "ais", {"time_s": AIS.time_s - 5 * 3600.0}, "clock looks 5 h (ahead|behind), as in another"),
        (DEGREES, "ais", {"time_s": AIS.time_s - 400 * 86400.0}, "has no reports while others do: .* 2024-05-01 12:0"),
    ],
)  # fmt: skip
def test_systematic_errors_are_reported_with_the_remedy(sources, changed, columns, words):
    (sentence,) = doubts_with(sources, changed, columns)
    assert re.search(words, sentence), sentence
    if "while others do" not in sentence:
        assert "as given" in sentence and "unless it is" in sentence


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"lat_deg": -AIS.lat_deg}, "latitudes look like they have the wrong sign: with .*, (\\d+) of \\1 "),
        ({"lat_deg": AIS.lon_deg, "lon_deg": AIS.lat_deg}, "ais: its latitudes and longitudes look exchanged"),
        ({"lat_deg": np.radians(AIS.lat_deg), "lon_deg": np.radians(AIS.lon_deg)}, "look like radians: .* unit as rad"),
        ({"lat_deg": AIS.lat_deg - 30.0}, "km from ais, too far for one plane; check the sign and the order"),
    ],
)
def test_sources_too_far_apart_for_one_plane_are_refused(columns, words):
    with pytest.raises(InputError, match=words):
        doubts_with(DEGREES, "ais", columns)


def test_both_explanations_of_a_far_source_are_named():
    """Exchanged coordinates of a site explain the distance as well as exchanged columns of the other source."""
    about, reports = DEGREES["radar"]
    site = replace(about.site, lat_deg=about.site.lon_deg, lon_deg=about.site.lat_deg)
    words = "ais: its latitudes and longitudes look exchanged: .*; or radar 1: its site's latitude and longitude look"
    with pytest.raises(InputError, match=words):
        Scene.of([(replace(about, site=site), reports), DEGREES["ais"]])


def test_ranges_beyond_the_limit_are_named_as_ranges():
    with pytest.raises(
        InputError, match=r"ranges are longer than 900 km \(first: row \d+: \d+ km\); are they in another"
    ):
        doubts_with(DEGREES, "radar", {"range_m": DEGREES["radar"][1].range_m * 1852.0})


@pytest.mark.slow
def test_a_site_with_a_wrong_sign_is_reported():
    about, reports = DEGREES["radar"]
    site = replace(about.site, lon_deg=-about.site.lon_deg)
    (sentence,) = Scene.of([(replace(about, site=site), reports), DEGREES["ais"]]).doubts()
    assert sentence.startswith("radar 1: its site's longitude looks like it has the wrong sign")


@pytest.mark.slow
def test_the_wrong_one_of_three_sources_is_named():
    made = harbour(6, 30, biases=((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)), until_s=100.0)
    about, reports = made.sources[1]
    wrong = (about, replace(reports, range_m=reports.range_m / 1e3))
    (sentence,) = Scene.of([made.sources[0], wrong, made.sources[2]]).doubts()
    assert sentence.startswith("radar 2: its ranges look like kilometres") and "unless" not in sentence


@pytest.mark.slow
def test_a_source_without_common_objects_is_reported():
    rng = np.random.default_rng(7)
    n = len(PLAIN)
    (sentence,) = doubts_with(METRES, "ais", {"x_m": rng.uniform(-12e3, 12e3, n), "y_m": rng.uniform(-9e3, 9e3, n)})
    assert "matches the others no better than by chance" in sentence and "leave it out" in sentence
    assert Scene.of([METRES["ais"]]).doubts() == ()


@pytest.mark.slow
def test_aircraft_among_sources_of_ships_are_no_fault():
    rng, (_, ships) = np.random.default_rng(8), METRES["ais"]
    columns = {"time_s": ships.time_s, "x_m": rng.uniform(-12e3, 12e3, len(ships)),
               "y_m": rng.uniform(-9e3, 9e3, len(ships)), "icao": np.full(len(ships), "4ca123")}  # fmt: skip
    flights = Description("adsb", "ads-b"), Reports.of("adsb", "ads-b", columns)
    (sentence,) = Scene.of([*METRES.values(), flights]).doubts()
    assert sentence.startswith("adsb: matches the others no better than by chance")
    assert "do they observe its aircraft at all? If so, check" in sentence


def test_a_stray_report_is_set_aside_by_its_line_and_the_others_are_kept():
    about, reports = DEGREES["ais"]
    for lon in (54.83, -6.0):
        astray = reports.lon_deg.copy()
        astray[[3, 7]] = lon
        scene = Scene.of([(about, replace(reports, lon_deg=astray))])
        (note,) = scene.notes
        assert note == (f"ais: 2 of {len(reports)} positions lie far outside the rest and were set aside (lines 4, 8)")
        assert np.flatnonzero(~scene.feeds[0].reports.usable).tolist() == [3, 7]
        assert abs(scene.plane.lon_deg + 1.2) < 0.2 and scene.doubts() == ()
    assert Scene.of([DEGREES["ais"]]).notes == ()


def test_absurd_positions_do_not_move_the_centre_of_the_plane():
    lat, lon = np.r_[np.full(30, -17.8), 50.0], np.r_[np.linspace(179.5, 180.5, 30), 0.0]
    plane = LocalPlane.about(lat, (lon + 180.0) % 360.0 - 180.0)
    assert plane.lat_deg == pytest.approx(-17.8, abs=0.02) and abs(abs(plane.lon_deg) - 180.0) < 0.1


def test_mixed_coordinate_types_are_refused():
    bare = Description("bare", "tracks", misses=MissRate(0.1), errors=SensorErrors(position_m=5.0))
    plots = Reports.of("bare", "table", {"time_s": [NOON], "x_m": [0.0], "y_m": [0.0]})
    with pytest.raises(
        InputError, match="bare: positions are metres in a plane of its own; give the origin of that plane, site"
    ):
        Scene.of([DEGREES["ais"], (bare, plots)])


@pytest.mark.slow
@pytest.mark.parametrize(("sign", "words"), [(-1.0, "look relative to the bow"), (1.0, "look as from north, not from")])
def test_bearings_of_a_boats_radar_in_clutter_are_told_from_those_from_its_bow(sign, words):
    """At no single instant: of ten plots one or two are of vessels."""
    (radar, plots), ais = boat_radar(np.random.default_rng(2), common=6).sources
    heading_deg = np.mod(200.0 + 0.2 * (plots.time_s - plots.time_s[0]), 360.0)
    wrong = {"bearing_deg": plots.bearing_deg + sign * heading_deg, "station_heading_deg": heading_deg}
    [sentence] = Scene.of([(radar, Reports.of("radar", "table", plots.columns() | wrong)), ais]).doubts()
    assert words in sentence and "its plots are on the tracks of ais" in sentence, sentence
    right = plots.columns() | {"station_heading_deg": heading_deg}
    assert not Scene.of([(radar, Reports.of("radar", "table", right)), ais]).doubts()


def test_local_times_are_named_where_no_times_are_common():
    (radar, plots), ais = boat_radar(np.random.default_rng(1), common=2, minutes=1.0).sources
    [sentence] = Scene.of([ais, (radar, replace(plots, time_s=plots.time_s + 7200.0))]).doubts()
    assert "it is 2 h behind them, as with local times: give their time_zone" in sentence, sentence


@pytest.mark.parametrize("kind", ["marine radar", "air radar"])
@pytest.mark.parametrize("is_the_same", [True, False])
def test_one_aircraft_on_one_path_is_in_common_and_two_on_two_paths_are_not(kind, is_the_same):
    rng, t = np.random.default_rng(3), np.arange(0.0, 300.0, 3.0)
    course = np.radians(40.0 + 0.3 * t)
    path = np.cumsum(150.0 * np.column_stack([np.sin(course), np.cos(course)]), axis=0) - 6000.0
    lat, lon = PLANE.to_geodetic(path + 8.0 * rng.normal(size=path.shape))
    name = np.full(len(t), "3c4a11")
    columns = {"time_s": NOON + t, "lat_deg": lat, "lon_deg": lon, "icao": name, "track_id": name}
    seen = path if is_the_same else path[::-1] * (1.0, -0.4)
    polar = {"range_m": np.hypot(*seen.T) + 30.0 * rng.normal(size=len(t)),
             "bearing_deg": np.degrees(np.arctan2(*seen.T)) % 360.0 + 0.3 * rng.normal(size=len(t))}  # fmt: skip
    radar = Description("radar", kind, site=Site(PLANE.lat_deg, PLANE.lon_deg))
    sources = [
        (Description("adsb", "ads-b"), Reports.of("adsb", "ads-b", columns)),
        (radar, Reports.of("radar", "table", {"time_s": NOON + t + 0.4, **polar})),
    ]
    assert len(Scene.of(sources).doubts()) == (0 if is_the_same else 1)


def test_errors_too_large_for_an_apron_are_named():
    """Aircraft 60 m apart with the errors of a wide area: "has no report at the times of the others"."""
    rng, n, times = np.random.default_rng(4), 40, np.arange(0.0, 60.0, 1.0)
    stand = 60.0 * np.stack(np.meshgrid(np.arange(8), np.arange(5)), axis=-1).reshape(-1, 2)

    def reports(source, sigma_m, **columns):
        place = (stand + sigma_m * rng.standard_normal((len(times), n, 2))).reshape(-1, 2)
        at = {"time_s": np.repeat(times, n), "x_m": place[:, 0], "y_m": place[:, 1]}
        return Reports.of(source, "table", at | columns)

    numbers = np.tile([f"3c{k:04x}" for k in range(n)], len(times))
    wide = Description("mlat", "mlat", errors=SensorErrors(position_m=400.0))
    radar = Description("smr", "marine radar", site=Site(east_m=0.0, north_m=-500.0))
    scene = Scene.of([(radar, reports("smr", 5.0)), (wide, reports("mlat", 5.0, track_id=numbers, icao=numbers))])
    assert any("errors of one are too large to separate objects as near as these" in str(one) for one in scene.doubts())
    _, found = scene.registered()
    assert any(
        "too large to separate objects as near as these; its biases" in str(n) for one in found for n in one.notes
    )


def test_a_convoy_whose_radar_offsets_are_found_is_not_called_incomparable():
    """Six ships 555 m apart, 12 km from a radar that may be turned by a degree: no ship is told from the next before
    the offset is known, but all together show it."""
    rng, times = np.random.default_rng(5), np.arange(0.0, 2400.0, 3.0)
    along = 3.5 * times[:, None] + 555.0 * np.arange(6)
    ships = np.stack([9000.0 - 0.15 * along + 100.0 * np.sin(along / 1500.0), 8000.0 + 2500.0 - along], axis=-1)

    def seen(source, every, sigma_m, first):
        place = (ships[::every] + sigma_m * rng.standard_normal(ships[::every].shape)).reshape(-1, 2)
        return Reports.of(source, "table", {
            "time_s": np.repeat(times[::every], 6), "x_m": place[:, 0], "y_m": place[:, 1],
            "track_id": np.tile(np.arange(first, first + 6), len(times[::every])),
        })  # fmt: skip

    radar = seen("radar", 1, 8.0, 1)
    polar = {"range_m": np.hypot(radar.x_m, radar.y_m) - 40.0,
             "bearing_deg": np.degrees(np.arctan2(radar.x_m, radar.y_m)) % 360.0}  # fmt: skip
    sources = [
        (Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0)),
         replace(radar, x_m=None, y_m=None, **polar)),
        (Description("ais", "ais"), seen("ais", 4, 5.0, 211000001)),
    ]  # fmt: skip
    scene = Scene.of(sources)
    _, found = scene.registered()
    assert next(one for one in found if one.source == "radar").established
    assert not scene.doubts()
