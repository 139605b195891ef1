"""Guard zones: what is inside, how surely, and when the alarm begins and ends."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import norm
from tests.live.conftest import SITE, START_S, replay, settings

from sameas.errors import InputError
from sameas.live.guard import GuardZones, PlacedZone, placed
from sameas.live.keeper import Keeper
from sameas.live.own_ship import OwnShipState
from sameas.live.settings import OwnShip, read_settings
from sameas.live.zones import Zone, read_zones, zone_of
from sameas.tracks.coordinates import LocalPlane

PLANE = LocalPlane(*SITE)


def of_metres(*rings):
    return PlacedZone(Zone("box", ((),)), tuple(np.array(ring, float) for ring in rings))


BOX = of_metres([[-100, -100], [100, -100], [100, 100], [-100, 100]])


@pytest.mark.parametrize("east", [-400.0, -100.0, 0.0, 60.0, 100.0, 130.0, 1000.0])
@pytest.mark.parametrize("sigma", [1.0, 40.0, 300.0])
def test_the_probability_is_the_share_of_the_normal_distribution_inside(east, sigma):
    p = BOX.probability(np.array([[east, 20.0]]), sigma**2 * np.eye(2)[None])[0]
    box = [norm.cdf((100.0 - c) / sigma) - norm.cdf((-100.0 - c) / sigma) for c in (east, 20.0)]
    assert p == pytest.approx(box[0] * box[1], abs=0.01)


def test_a_correlated_error_counts_and_no_position_is_nowhere():
    tilted = np.array([[900.0, 890.0], [890.0, 900.0]])
    p = BOX.probability(np.array([[100.0, -100.0], [100.0, 100.0], [np.nan, 0.0]]), np.stack([tilted] * 3))
    assert p[0] < 0.1 and 0.4 < p[1] < 0.55 and p[2] == 0.0


def test_holes_and_parts_of_polygons_and_sectors_over_north_are_right():
    with_hole = of_metres(
        [[-9, -9], [9, -9], [9, 9], [-9, 9]], [[-3, -3], [3, -3], [3, 3], [-3, 3]], [[20, 0], [30, 0], [25, 9]]
    )
    assert with_hole.has(np.array([[5.0, 5.0], [0.0, 0.0], [25.0, 3.0], [15.0, 0.0]])).tolist() == [
        True,
        False,
        True,
        False,
    ]
    zone = zone_of({"name": "ahead", "radius_m": 100, "nearest_m": 10, "sector_deg": [340, 20]}, "zones[0]")
    sector = placed(zone, None, OwnShipState(0.0, 0.0))
    assert isinstance(sector, PlacedZone)
    angle = np.radians([0.0, 19.0, 21.0, 345.0, 335.0, 180.0])
    ring = 50.0 * np.column_stack([np.sin(angle), np.cos(angle)])
    assert sector.has(ring).tolist() == [True, True, False, True, False, False]
    assert not sector.has(0.1 * ring[:1])[0] and not sector.has(2.1 * ring[:1])[0]
    [outline] = sector.outline()
    assert outline[0] == outline[-1] and max(math.hypot(*place) for place in outline) == pytest.approx(100.0, abs=0.1)


def test_a_zone_to_the_bow_turns_with_the_heading_then_the_course_and_else_is_all_around():
    zone = Zone("bow", radius_m=1000.0, sector_deg=(-10.0, 10.0), to_bow=True)
    east, north = np.array([[500.0, 0.0]]), np.array([[0.0, 500.0]])
    for own, inside in (
        (OwnShipState(0.0, 0.0, 0.0, 5.0, 90.0), (True, False)),
        (OwnShipState(0.0, 0.0, 5.0, 0.0), (True, False)),
        (OwnShipState(0.0, 0.0, 0.0, 5.0), (False, True)),
        (OwnShipState(0.0, 0.0), (True, True)),
    ):
        now = placed(zone, PLANE, own)
        assert isinstance(now, PlacedZone) and (bool(now.has(east)[0]), bool(now.has(north)[0])) == inside


def test_zones_that_cannot_be_placed_say_why():
    assert placed(Zone("a", radius_m=9.0), PLANE, None) == "the position of own ship is not known"
    assert "metres of its own" in str(placed(Zone("a", lat_deg=1.0, lon_deg=2.0, radius_m=9.0), None, None))


def geojson(tmp_path, *features):
    path = tmp_path / "zones.geojson"
    whole = {"type": "FeatureCollection", "features": [{"type": "Feature"} | one for one in features]}
    path.write_text(json.dumps(whole))
    return path


RING = [[-1.0, 50.5], [-0.9, 50.5], [-0.9, 50.6], [-1.0, 50.6], [-1.0, 50.5]]
POLYGON = {"geometry": {"type": "Polygon", "coordinates": [RING]}, "properties": {"name": "roads", "colour": "red"}}
POINT = {"geometry": {"type": "Point", "coordinates": [-1.0, 50.5]}, "properties": {"name": "buoy", "radius_m": 300}}
OWN = {"geometry": None, "properties": {"name": "own", "radius_m": 926, "sector_deg": [270, 90], "to_bow": True}}


def test_zones_of_geojson_are_polygons_circles_and_those_about_own_ship(tmp_path):
    roads, buoy, own = read_zones(geojson(tmp_path, POLYGON, POINT, OWN))
    assert len(roads.rings[0]) == 4 and not roads.about_own_ship
    assert (buoy.lat_deg, buoy.lon_deg, buoy.radius_m) == (50.5, -1.0, 300.0) and not buoy.about_own_ship
    assert own.about_own_ship and own.to_bow and own.sector_deg == (270.0, 90.0)


@pytest.mark.parametrize(("feature", "words"), [
    (POLYGON | {"properties": {}}, "feature 0: has no name"),
    (POLYGON | {"geometry": {"type": "Polygon", "coordinates": [RING[:2]]}}, "feature 0: coordinates that are not"),
    (POLYGON | {"geometry": {"type": "Polygon", "coordinates": [[["a", 1]]]}}, "coordinates that are not pairs"),
    (POLYGON | {"geometry": {"type": "LineString", "coordinates": RING}}, "feature 0: is 'LineString'"),
    (POINT | {"properties": {"name": "b"}}, "feature 0: has no radius_m above"),
    (OWN | {"properties": {"name": "b", "radius_m": 5, "sector_deg": [1]}}, "feature 0: sector_deg is [1]"),
    (POINT | {"properties": {"name": "b", "radius_m": 5, "to_bow": True}}, "feature 0: to_bow is True"),
])  # fmt: skip
def test_a_feature_that_is_no_zone_is_refused_by_its_number(tmp_path, feature, words):
    with pytest.raises(InputError) as refusal:
        read_zones(geojson(tmp_path, feature))
    assert words in str(refusal.value)


def test_a_sensor_file_has_zones_as_tables_and_files(tmp_path):
    geojson(tmp_path, POLYGON)
    path = tmp_path / "sensors.toml"
    text = '[watch]\nzones = ["zones.geojson", { name = "ring", radius_m = 500 }]\n'
    text += '[sources.a]\nkind = "ais"\ninput = "stdin:"\n'
    path.write_text(text)
    found = read_settings(path)
    assert [zone.name for zone in found.watch.zones] == ["roads", "ring"]
    with pytest.raises(InputError, match="two guard zones are called 'roads'"):
        found.with_zones([tmp_path / "zones.geojson"])
    for before, after, words in (
        ("radius_m", "radius", "'radius' is not known"),
        ('"ring"', "1", "is no zone with a name"),
    ):
        path.write_text(text.replace(before, after))
        with pytest.raises(InputError, match=words):
            read_settings(path)


def test_a_ship_that_enters_is_one_alarm_until_it_has_left():
    zone = Zone("roads", lat_deg=SITE[0], lon_deg=SITE[1], radius_m=2500.0)
    keeper = Keeper(settings(zones=(zone,), own_ship=OwnShip(*SITE)), replay=replay(ships=8, until_s=200.0))
    begun, inside = set(), set()
    for k in range(10, 90):
        situation = keeper.tick(START_S + 2.0 * k)
        o = situation.objects
        shown = np.isin(o["stage"], ("confirmed", "coasting"))
        near = np.ma.filled(np.hypot(o["x_m"], o["y_m"]), np.inf) < 2300.0
        inside |= set(o["object"][shown & near].tolist())
        begun |= {alarm.objects[0] for alarm in situation.alarms if alarm.kind == "zone"}
    rows = [row for row in keeper.alarm_list() if row["kind"] == "zone"]
    assert inside and inside <= begun and "is in the guard zone roads (probability " in rows[0]["text"]
    assert keeper.zones.outlines[0][0] == "roads"
    keeper.close()


def test_an_object_on_the_border_is_one_alarm_and_own_ship_none():
    keeper = Keeper(settings(), replay=replay())
    for k in range(1, 40):
        situation = keeper.tick(START_S + 2.0 * k)
    o = situation.objects
    k = int(np.flatnonzero((o["stage"] == "confirmed") & (o["mmsi"] != ""))[0])
    lat, lon = PLANE.to_geodetic(np.array([[o["x_m"][k], o["y_m"][k]]]))
    # A circle through the object: probability about a half, now below and now above.
    zone = Zone("edge", lat_deg=float(lat[0]) + 0.01, lon_deg=float(lon[0]), radius_m=0.01 * 111_240.0 - 3.0)
    situation = replace(situation, plane=PLANE)
    guard, key = GuardZones((zone,)), f"zone edge {o['object'][k]}"
    first, held = guard.alarms(situation, ()), guard.alarms(situation, {key})
    assert key in {alarm.key for alarm in held} and {alarm.key for alarm in first} <= {alarm.key for alarm in held}
    assert key not in {alarm.key for alarm in guard.alarms(situation, {key}, (str(o["mmsi"][k]),))}
    unwatched = GuardZones((Zone("own", radius_m=500.0),)).alarms(replace(situation, own_ship=None), ())
    assert [alarm.text for alarm in unwatched] == [
        "guard zone own is not watched: the position of own ship is not known"
    ]
    keeper.close()


def test_a_zone_raises_no_alarm_before_the_first_report(tmp_path):
    """The plane of a picture is that of its first reports: until then a fixed own ship was said to have no position."""
    path = tmp_path / "sensors.toml"
    path.write_text(
        "[watch]\nown_ship = { lat_deg = 50.55, lon_deg = -0.95 }\n"
        'zones = [{ name = "ahead", radius_m = 1500 }]\n[sources.ais]\nkind = "ais"\ninput = "stdin:"\n'
    )
    keeper = Keeper(read_settings(path), tmp_path / "state", clock=lambda: START_S)
    keeper.tick(START_S)
    assert not [one for one in keeper.alarm_list() if "guard zone" in one["text"]]
    keeper.close()
