"""A sensor aboard a vessel is where another source says that the vessel is."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import ReadOptions, read_reports, read_sources
from sameas.io.sensors.sentences import AisWriter, clock, heading, position
from sameas.picture.live import LivePicture
from sameas.tracks import Description, Platform, Reports, Scene, SensorErrors, Timing
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.source import Site, read_descriptions

PLANE, START_S = LocalPlane(50.7, -1.2), 1_714_560_000.0
TIMES = START_S + np.arange(0.0, 120.0, 2.5)
BUOY = np.array([900.0, 1400.0])


def boat(time_s):
    """She goes north-east, and turns east."""
    t = np.asarray(time_s) - START_S
    return np.column_stack([3.0 * t, 4.0 * np.minimum(t, 60.0)])


def gps(every_s=1.0, **more):
    times = np.arange(START_S - 5.0, START_S + 130.0, every_s)
    lat, lon = PLANE.to_geodetic(boat(times))
    return Reports.of("gps", "table", {"time_s": times, "lat_deg": lat, "lon_deg": lon} | more)


def ais(mmsi, every_s=10.0):
    reports = gps(every_s)
    columns = {"time_s": reports.time_s, "lat_deg": reports.lat_deg, "lon_deg": reports.lon_deg}
    return Reports.of("ais", "ais", columns | {"mmsi": [mmsi] * len(reports)})


def plots(times=TIMES):
    """Ranges and bearings of a buoy from the boat."""
    arm = BUOY - boat(times)
    return Reports.of(
        "radar", "table", {"time_s": times, "range_m": np.hypot(*arm.T), "bearing_deg": np.degrees(np.arctan2(*arm.T))}
    )


def described(**platform):
    return Description("radar", "marine radar", platform=Platform(**platform), errors=SensorErrors(range_m=5.0))


def scene(radar, *others, **options):
    errors = SensorErrors(position_m=5.0)
    given = [(Description(one.source, "ais", errors=errors), one) for one in others]
    return Scene.of([(radar, options.pop("reports", plots())), *given], PLANE, **options)


@pytest.mark.parametrize(
    ("platform", "other"),
    [({"source": "gps"}, gps()), ({"mmsi": "235000111"}, ais("235000111")),
     ({"source": "ais", "mmsi": "235000111"}, ais("235000111"))],
)  # fmt: skip
def test_plots_are_placed_from_where_the_vessel_is(platform, other):
    feed = scene(described(**platform), other).feeds[0]
    # A turn between two positions ten seconds apart is cut by ten metres.
    assert np.abs(feed.sensor_m - boat(TIMES)).max() < (0.1 if other.source == "gps" else 10.1)
    assert np.abs(feed.reports.state[:, :2] - BUOY).max() < (0.1 if other.source == "gps" else 10.1)


@pytest.mark.parametrize("bow", [False, True])
def test_a_radar_with_late_stamps_is_where_the_vessel_was_when_it_measured(bow):
    """She was taken to be where she was at the time of the stamps: a known latency put every target elsewhere."""
    made, turned = bow_plots() if bow else plots(), Timing(latency_s=20.0, latency_sigma_s=0.1)
    late = replace(made, time_s=made.time_s + 20.0)
    radar = replace(described(source="gps"), timing=turned)
    places = scene(radar, compass() if bow else gps(), reports=late).feeds[0].reports
    assert len(places) == len(TIMES) and np.abs(places.state[:, :2] - BUOY).max() < 1.0
    assert places.time_s == pytest.approx(TIMES)


def test_plots_at_times_without_a_position_are_set_aside_and_counted():
    known = gps()
    seen = known.where((known.time_s < START_S + 40.0) | (known.time_s > START_S + 300.0))
    [feed] = scene(described(source="gps"), seen).feeds
    assert len(feed.reports) == np.sum(TIMES < START_S + 50.0)
    assert any("28 of 48 reports are set aside" in note for note in feed.notes), feed.notes


def test_a_vessel_across_the_date_line():
    plane = LocalPlane(0.0, 180.0)
    lat, lon = plane.to_geodetic(boat([START_S, START_S + 60.0]) - [90.0, 0.0])
    track = Reports.of("gps", "table", {"time_s": [START_S, START_S + 60.0], "lat_deg": lat, "lon_deg": lon})
    given = [(described(source="gps"), plots(START_S + np.array([30.0]))), (Description("gps", "ais"), track)]
    assert np.abs(Scene.of(given, plane).feeds[0].sensor_m - [[0.0, 120.0]]).max() < 0.5


@pytest.mark.parametrize(
    ("platform", "others", "words"),
    [
        ({"source": "plotter"}, (ais("235000111"),), "there is no source 'plotter'"),
        ({"mmsi": "235000222"}, (ais("235000111"),), "of which no source has a position"),
        ({"mmsi": "235000111"}, (ais("235000111"), gps(mmsi=["235000111"] * 135)), "which ais and gps report"),
        ({"source": "gps"}, (gps(mmsi=(["235000111", "235000222"] * 68)[:135]),), "2 tracks: 235000111 and 235000222"),
    ],
)
def test_a_vessel_that_is_not_known_is_refused(platform, others, words):
    with pytest.raises(InputError, match=words):
        scene(described(**platform), *others)
    # Others are used, if that is asked for.
    aside = {}
    used = scene(described(**platform), *others, set_aside=aside).feeds
    assert [feed.description.name for feed in used] == [one.source for one in others]
    assert words in str(aside["radar"])


def test_positions_of_another_day_are_named_as_such():
    with pytest.raises(InputError, match=r"has no position at the times of its 48 reports"):
        scene(described(source="gps"), gps(), reports=plots(TIMES + 86400.0))


def test_the_platform_of_a_file_of_descriptions(tmp_path):
    path = tmp_path / "sensors.toml"
    path.write_text('[sources.radar]\nkind = "marine radar"\nplatform = { source = "ais", mmsi = 235000111 }\n')
    [radar] = read_descriptions(path)
    assert radar.platform == Platform("235000111", "ais") and str(radar.platform) == "vessel 235000111 of source ais"
    for wrong, words in (("{ mmsi = 12 }", "nine digits"), ("{ ship = 'x' }", "'ship'"), ("{ }", "give the mmsi")):
        path.write_text(f'[sources.radar]\nkind = "marine radar"\nplatform = {wrong}\n')
        with pytest.raises(InputError, match=words):
            read_descriptions(path)
    with pytest.raises(InputError, match="a site and a platform"):
        Description.from_mapping("radar", {"site": {"east_m": 0, "north_m": 0}, "platform": {"source": "gps"}})


def test_a_live_radar_is_where_her_vessel_was_last():
    picture = LivePicture([described(source="gps"), Description("gps", "ais")], plane=PLANE)
    with pytest.raises(InputError, match="of which no source has a position"):
        picture.add("radar", plots(TIMES[:1]))
    for k, t in enumerate(TIMES[:20]):
        known = gps()
        picture.add("gps", known.where((known.time_s <= t - 1.0) & (known.time_s > t - 3.5)))
        named = plots(TIMES[k : k + 1])
        picture.add("radar", Reports.of("radar", "table", {
            "time_s": named.time_s, "range_m": named.range_m, "bearing_deg": named.bearing_deg, "track_id": ["7"],
        }))  # fmt: skip
        state = picture.advance(float(t))
    objects = picture.objects
    at = np.hypot(objects["x_m"] - BUOY[0], objects["y_m"] - BUOY[1])
    assert state.objects.number.tolist() == [1] and at.max() < 30.0


def test_live_reports_without_a_position_are_counted():
    """Plots of a time at which the boat's place is not known; a plot without a range."""
    picture = LivePicture([described(source="gps"), Description("gps", "ais")], plane=PLANE)
    known = gps()
    picture.add("gps", known.where(known.time_s < START_S + 20.0))
    batch = plots(START_S + np.array([5.0, 10.0, 100.0, 110.0]))
    batch.range_m[0] = np.nan
    picture.add("radar", batch)
    counts = picture.counts["radar"]
    assert (counts.taken, counts.unplaced) == (1, 3)


def headings(time_s):
    """She turns by half a degree a second, beyond north."""
    return np.mod(330.0 + 0.5 * (np.asarray(time_s) - START_S), 360.0)


def compass(every_s=1.0):
    times = gps(every_s).time_s
    return gps(every_s, heading_deg=headings(times))


def bow_plots(times=TIMES, **more):
    """The plots of the buoy with bearings from the bow."""
    seen = plots(times)
    relative = seen.bearing_deg - headings(times)
    columns = {"time_s": times, "range_m": seen.range_m, "relative_bearing_deg": relative}
    return Reports.of("radar", "table", columns | more)


@pytest.mark.parametrize("every_s", [1.0, 10.0])
def test_bearings_from_the_bow_are_turned_by_the_heading_of_the_vessel(every_s):
    lat, lon = PLANE.to_geodetic(boat(TIMES))
    placed = bow_plots(station_lat_deg=lat, station_lon_deg=lon)
    [feed] = scene(described(source="gps"), compass(every_s), reports=placed).feeds
    assert np.abs(feed.reports.state[:, :2] - BUOY).max() < 0.1
    [feed] = scene(described(source="gps"), compass(), reports=bow_plots()).feeds
    assert np.abs(feed.reports.state[:, :2] - BUOY).max() < 0.1


def gyro(tmp_path, name="gyro", head="time,heading"):
    """A log of her compass alone, read from its file."""
    times = gps().time_s + 0.3
    rows = [f"{t:.2f},{deg:.3f}" for t, deg in zip(times, headings(times), strict=True)]
    (tmp_path / f"{name}.csv").write_text("\n".join([head, *rows]) + "\n")
    [reports] = read_reports(tmp_path / f"{name}.csv", ReadOptions(source=name))
    return reports


@pytest.mark.parametrize("head", ["time,heading", "timestamp,gyro", "t,own_heading"])
def test_a_compass_may_have_a_file_of_its_own(tmp_path, head):
    [feed] = scene(described(source="gps"), gps(), gyro(tmp_path, head=head), reports=bow_plots()).feeds
    assert np.abs(feed.reports.state[:, :2] - BUOY).max() < 0.5
    by_ais = scene(described(mmsi="235000111"), ais("235000111", 1.0), gyro(tmp_path, head=head), reports=bow_plots())
    assert np.abs(by_ais.feeds[0].reports.state[:, :2] - BUOY).max() < 0.5
    assert [feed.description.name for feed in by_ais.feeds] == ["radar", "ais"]


def test_files_of_a_radar_a_receiver_and_a_compass_need_no_description(tmp_path):
    for reports, names in (
        (bow_plots(), {"time_s": "time", "range_m": "range", "relative_bearing_deg": "relative_bearing"}),
        (gps(), {"time_s": "time", "lat_deg": "lat", "lon_deg": "lon"}),
    ):
        columns = [getattr(reports, column).tolist() for column in names]
        rows = [",".join(f"{cell:.8f}" for cell in row) for row in zip(*columns, strict=True)]
        (tmp_path / f"{reports.source}.csv").write_text("\n".join([",".join(names.values()), *rows]) + "\n")
    gyro(tmp_path)
    sources = read_sources([tmp_path / f"{name}.csv" for name in ("radar", "gps", "gyro")])
    assert "the compass of own ship" in sources[2].lines()[0]
    states: Any = Scene.of([(one.description, one.reports) for one in sources], PLANE).feeds[0].reports
    assert np.abs(states.state[:, :2] - BUOY).max() < 0.5
    with pytest.raises(InputError, match="gyro has the heading, and no source the positions of the vessel"):
        Scene.of([(one.description, one.reports) for one in sources[::2]], PLANE)


def test_which_of_two_compasses_is_hers_is_asked(tmp_path):
    with pytest.raises(InputError, match="the heading of the vessel of source gps is in gyro and fluxgate"):
        scene(described(source="gps"), gps(), gyro(tmp_path), gyro(tmp_path, "fluxgate"), reports=bow_plots())


def test_a_heading_of_the_reports_themselves_needs_no_other():
    [feed] = scene(described(source="gps"), gps(), reports=bow_plots(station_heading_deg=headings(TIMES))).feeds
    assert np.abs(feed.reports.state[:, :2] - BUOY).max() < 0.1


def test_a_log_of_own_ship_alone_carries_a_radar_and_is_no_object(tmp_path):
    """Her receivers' sentences, without AIS or targets."""
    lines = []
    for time_s, (lat, lon) in zip(gps().time_s, zip(gps().lat_deg, gps().lon_deg, strict=True), strict=True):
        lines += [clock(time_s), *position(lat, lon), heading(45.0)]
    (tmp_path / "gps.nmea").write_text("\n".join(lines))
    [own] = read_reports(tmp_path / "gps.nmea", ReadOptions(source="gps"))
    np.testing.assert_allclose(own.lat_deg, gps().lat_deg, atol=1e-7)
    assert own.object_ids is None and own.extra["own_heading_deg"][-1] == 45.0
    [feed] = scene(described(source="gps"), own).feeds
    assert np.abs(feed.reports.state[:, :2] - BUOY).max() < 15.0
    with pytest.raises(InputError, match="gps: only the positions of own ship"):
        Scene.of([(Description("gps", "tracks"), own)], PLANE)


def test_a_track_of_gpx_carries_a_radar(tmp_path):
    def point(lat, lon, time):
        return f'<trkpt lat="{lat}" lon="{lon}"><ele>3</ele>{time}</trkpt>'

    times = [f"<time>{np.datetime64(round(t), 's')}Z</time>" for t in gps().time_s]
    points = [point(*one) for one in zip(gps().lat_deg, gps().lon_deg, times, strict=True)]
    more = point(50.0, 1.0, ""), point("north", 1.0, times[0]), point(91.0, 1.0, times[0])
    head = '<?xml version="1.0"?>\n<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1">'
    text = f"{head}<wpt lat='1' lon='1'/><trk><trkseg>{''.join([*reversed(points), *more])}</trkseg></trk></gpx>"
    (tmp_path / "own.gpx").write_text(text)
    [own] = read_reports(tmp_path / "own.gpx", ReadOptions(source="gps"))
    assert own.damaged.counts() == {"no time": 1, "no position": 1, "position outside the earth": 1}
    assert own.extra["own_lat_deg"].tolist() == own.lat_deg.tolist() == gps().lat_deg.tolist()
    [feed] = scene(described(source="gps"), own).feeds
    assert np.abs(feed.reports.state[:, :2] - BUOY).max() < 0.1


@pytest.mark.parametrize(
    ("content", "words"),
    [("<gpx><trk>", "is no GPX: no element found"), ("<gpx><wpt lat='1' lon='1'/></gpx>", "no point of a track"),
     ("<!DOCTYPE gpx><gpx/>", "has a document type")],
)  # fmt: skip
def test_gpx_that_is_no_track_is_refused(content, words, tmp_path):
    (tmp_path / "own.gpx").write_text(content)
    with pytest.raises(InputError, match=words):
        read_reports(tmp_path / "own.gpx")


def test_without_headings_the_course_of_a_vessel_under_way_is_used_and_said():
    known = gps()
    speed = np.where(known.time_s < START_S + 60.0, 5.0, 0.5)
    known = gps(course_deg=headings(known.time_s), speed_m_per_s=speed)
    [feed] = scene(described(source="gps"), known, reports=bow_plots()).feeds
    assert any("the course of the vessel of source gps is used as its heading" in note for note in feed.notes), (
        feed.notes
    )
    assert any("20 of 48 reports are set aside: the heading of the vessel of source gps" in note for note in feed.notes)
    assert len(feed.reports) == 28 and np.abs(feed.reports.state[:24, :2] - BUOY).max() < 0.1


def test_bearings_from_the_bow_without_any_heading_are_refused():
    with pytest.raises(InputError, match="has no heading at the times of its 48 reports"):
        scene(described(source="gps"), gps(), reports=bow_plots())
    fixed = Description("radar", "marine radar", errors=SensorErrors(range_m=5.0))
    with pytest.raises(InputError, match="relative to the bow, and no source gives the heading"):
        scene(fixed, gps(), reports=bow_plots())


def test_a_live_radar_turns_with_the_heading_last_received():
    picture = LivePicture([described(source="gps"), Description("gps", "ais")], plane=PLANE)
    for t in TIMES[:20]:
        known = compass()
        picture.add("gps", known.where((known.time_s <= t - 1.0) & (known.time_s > t - 3.5)))
        picture.add("radar", bow_plots(np.array([t]), track_id=["7"]))
        picture.advance(float(t))
    at = np.hypot(picture.objects["x_m"] - BUOY[0], picture.objects["y_m"] - BUOY[1])
    assert at.max() < 40.0 and picture.counts["radar"].unplaced == 0
    assert picture.counts["gps"].taken == len(compass().where(compass().time_s <= TIMES[19] - 1.0)) - 2


def log_of_her_receivers(tmp_path, own_as):
    """A ship's log of others' AIS every 20 s, with her own heading and position every second."""
    writer, lines = AisWriter(), []
    for t in np.arange(START_S - 2.0, START_S + 122.0):
        lat, lon = (float(one[0]) for one in PLANE.to_geodetic(boat([t])))
        lines += [clock(t), heading(float(headings([t])[0]))]
        own = {"type": 1, "mmsi": 235000111, "lat": lat, "lon": lon, "heading": 511, "second": int(t % 60)}
        lines += position(lat, lon) if own_as == "GLL" else writer(own, own=True)
        if t % 20 == 0:
            lines += writer(own | {"mmsi": 235000222, "lat": 50.72})
    (tmp_path / "boat.nmea").write_text("\n".join(lines) + "\n")
    [log] = read_reports(tmp_path / "boat.nmea", ReadOptions("boat"))
    return log


@pytest.mark.parametrize(("own_as", "platform"), [("GLL", {"source": "boat"}), ("VDO", {"mmsi": "235000111"}),
                                                  ("VDO", None)])  # fmt: skip
def test_a_ships_log_of_ais_places_and_turns_the_radar_aboard(own_as, platform, tmp_path):
    """Her own reports were passed over: nobody had a position of her MMSI, or the log had several tracks."""
    log = log_of_her_receivers(tmp_path, own_as)
    assert set(log.mmsi) == {"235000222"}
    radar = replace(described(source="boat"), platform=Platform(**platform) if platform else None)
    feed = scene(radar, log, reports=bow_plots()).feeds[0]
    # A VDO has no clock of its own finer than that of the log.
    assert np.abs(feed.reports.state[:, :2] - BUOY).max() < 12.0
    assert any("taken to be aboard the vessel of source boat" in note for note in feed.notes) == (platform is None)


def test_a_radar_without_a_place_is_aboard_the_only_ship_with_positions_of_her_own():
    radar = Description("radar", "marine radar", errors=SensorErrors(range_m=5.0))
    own = replace(gps(), kind="own ship")
    feed = scene(radar, own).feeds[0]
    assert np.abs(feed.reports.state[:, :2] - BUOY).max() < 0.1
    assert any("taken to be aboard the vessel of source gps" in note for note in feed.notes)
    # A radar with a site is there, and of two ships nobody knows which.
    fixed = replace(radar, site=Site(50.7, -1.2))
    assert np.ptp(scene(fixed, own, ais("235000111")).feeds[0].reports.state[:, 0]) > 100.0
    with pytest.raises(InputError, match="site"):
        scene(radar, own, replace(own, source="plotter"), ais("235000111"))


@pytest.mark.parametrize("places", ["degrees", "metres about her"])
def test_plots_that_a_radar_aboard_gives_as_places_are_measured_from_her(places):
    """Their azimuth was not seen to be wrong, or they were refused as of a plane of their own."""
    arm = BUOY - boat(TIMES)
    lat, lon = PLANE.to_geodetic(BUOY + 0.0 * arm)
    given = {"lat_deg": lat, "lon_deg": lon} if places == "degrees" else {"x_m": arm[:, 0], "y_m": arm[:, 1]}
    found = Reports.of("radar", "table", {"time_s": TIMES} | given)
    radar = Description("radar", "marine radar", errors=SensorErrors(range_m=5.0))
    feed = scene(radar, replace(gps(), kind="own ship"), reports=found).feeds[0]
    assert np.abs(feed.sensor_m - boat(TIMES)).max() < 0.1 and np.abs(feed.reports.state[:, :2] - BUOY).max() < 0.5
    # Those of a tracker, with ids, may be of another radar.
    named = replace(found, track_id=np.full(len(found), "1", object))
    if places == "degrees":
        assert scene(radar, replace(gps(), kind="own ship"), reports=named).feeds[0].sensor_m is None


@pytest.mark.parametrize("bow", [False, True])
def test_a_radar_aboard_whose_stamps_are_a_minute_late_is_doubted_as_such(bow):
    """She was placed where she was a minute later: her radar was said to match nothing, or to be read wrongly."""
    rng, times = np.random.default_rng(2), START_S + np.arange(0.0, 300.0, 3.0)
    start, velocity = rng.uniform(-4e3, 4e3, (7, 2)), rng.normal(0.0, 5.0, (7, 2))
    seen, told = [], []
    for t in times:
        for k, place in enumerate(start + velocity * (t - START_S)):
            arm = place - boat(t)[0]
            bearing = np.degrees(np.arctan2(*arm)) - (headings(np.array([t]))[0] if bow else 0.0)
            seen.append((t + 60.0, f"{k}", np.hypot(*arm) + 5.0 * rng.normal(), (bearing + 0.3 * rng.normal()) % 360.0))
            if t % 9.0 == 0.0:
                told.append((t, f"21130000{k}", *PLANE.to_geodetic(place[None] + 5.0 * rng.normal(size=2))))
    time_s, track, range_m, bearing_deg = map(list, zip(*seen, strict=True))
    columns = {"time_s": time_s, "track_id": track, "range_m": range_m}
    radar = Reports.of("radar", "table", columns | {"relative_bearing_deg" if bow else "bearing_deg": bearing_deg})
    time_s, mmsi, lat, lon = zip(*told, strict=True)
    heard = {"time_s": np.array(time_s), "lat_deg": np.concatenate(lat), "lon_deg": np.concatenate(lon)}
    ais_reports = Reports.of("ais", "ais", heard | {"mmsi": np.array(mmsi)})
    long = np.arange(START_S - 5.0, START_S + 370.0, 1.0)
    lat, lon = PLANE.to_geodetic(boat(long))
    more = {"heading_deg": headings(long)} if bow else {}
    own = Reports.of("gps", "table", {"time_s": long, "lat_deg": lat, "lon_deg": lon} | more)
    [doubt] = scene(described(source="gps"), own, ais_reports, reports=radar).doubts()
    assert "radar: its stamps look about 60 s late: with that removed" in str(doubt), doubt
    assert "give latency_s = 60 in its timing" in str(doubt)


@pytest.mark.parametrize(("late_s", "azimuth_deg"), [(0.0, 1.5), (4.0, -2.0)])
def test_late_stamps_aboard_a_turning_vessel_are_told_from_an_error_of_the_azimuth(late_s, azimuth_deg):
    """Stamps of 4 s later are a degree and a half of heading, now to one side and now to the other."""
    rng, times = np.random.default_rng(8), np.arange(0.0, 600.0)
    heading_deg = 40.0 + 60.0 * np.sin(times / 120.0)
    course = np.radians(heading_deg)
    own = np.cumsum(6.0 * np.column_stack([np.sin(course), np.cos(course)]), axis=0)
    start, velocity = rng.uniform(-6e3, 6e3, (9, 2)), 5.0 * rng.standard_normal((9, 2))
    messages, targets = [], []
    for t in times.astype(int).tolist():
        place = start + velocity * t
        for ship in range(9):
            if (t + 3 * ship) % 10 == 0:
                messages.append((START_S + t, *(place[ship] + 8.0 * rng.standard_normal(2)), *velocity[ship], ship))
            if t % 3 == 0 and rng.random() < 0.9:
                east, north = place[ship] - own[t]
                bow_deg = np.degrees(np.arctan2(east, north)) - heading_deg[t] + azimuth_deg
                range_m, bow_deg = (
                    np.hypot(east, north) + 25.0 * rng.standard_normal(),
                    bow_deg + 0.5 * rng.standard_normal(),
                )
                targets.append((START_S + t + late_s, range_m, bow_deg % 360.0, ship))
    time_s, x, y, vx, vy, ship = np.transpose(messages)
    lat, lon = PLANE.to_geodetic(np.column_stack([x, y]))
    mmsi = [f"23500{int(one)}111" for one in ship]
    columns = {"time_s": time_s, "lat_deg": lat, "lon_deg": lon, "vx_m_per_s": vx, "vy_m_per_s": vy, "mmsi": mmsi}
    others = Reports.of("ais", "ais", columns)
    time_s, range_m, bow_deg, ship = np.transpose(targets)
    columns = {
        "time_s": time_s,
        "range_m": range_m,
        "relative_bearing_deg": bow_deg,
        "track_id": ship.astype(int).astype(str),
    }
    plots = Reports.of("radar", "table", columns)
    lat, lon = PLANE.to_geodetic(own)
    carrier = Reports.of(
        "gps", "own ship", {"time_s": START_S + times, "lat_deg": lat, "lon_deg": lon, "heading_deg": heading_deg}
    )
    given = [
        (Description("ais", "ais"), others),
        (Description("radar", "marine radar"), plots),
        (Description("gps", "ais"), carrier),
    ]
    scene, biases = Scene.of(given, PLANE).registered()
    [radar] = [one for one in biases if one.source == "radar"]
    assert radar.parameters["azimuth_deg"].value == pytest.approx(azimuth_deg, abs=0.2)
    assert radar.parameters["time_s"].value == pytest.approx(late_s, abs=1.0)
    assert len(scene.feeds) == 2
