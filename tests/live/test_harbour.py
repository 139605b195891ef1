"""Alarms of approaches in a harbour: berthed ships are many and no danger, those at anchor ahead are."""

import json

import numpy as np
import pytest
from tests.live.conftest import START_S, replay

from sameas.live.keeper import Keeper
from sameas.live.outputs import sentence
from sameas.live.settings import LiveSource, OwnShip, Settings, WatchSettings, read_settings
from sameas.live.situation import Situation
from sameas.tracks import Description, SensorErrors, Site
from sameas.tracks.reports import Reports

KNOT = 0.5144
OWN = "235000009"


class Sea:
    """Ships by their paths, seen by AIS and, where ``radar`` is set, by a radar without names."""

    def __init__(self, own, others, *, status=None, radar=False, seed=1, **watch):
        self.status = status or {}
        self.rng = np.random.default_rng(seed)
        self.paths = {OWN: own, **others}
        self.constant = {mmsi: self.rng.normal(0.0, 4.0, 2) for mmsi in self.paths}
        sources = [Description("ais", "ais")]
        if radar:
            errors = SensorErrors(range_m=15.0, range_share=0.0, bearing_deg=0.3, extent_m=10.0)
            sources.append(Description("radar", "marine radar", site=Site(lat_deg=50.0, lon_deg=-1.0), errors=errors))
        plane = {"lat_deg": 50.0, "lon_deg": -1.0}
        given = WatchSettings(own_ship=OwnShip(mmsi=OWN), register_every_s=0.0, plane=plane, **watch)
        self.radar = radar
        self.keeper = Keeper(Settings({one.name: LiveSource(one) for one in sources}, given), replay=replay())
        self.keeper.clock.replay.sources, self.keeper.clock.replay._next = [], []

    def run(self, until_s, every_s=5.0, silent=(), interval_s=None):
        """The objects of alarms of approaches by the names of ships: {MMSI: time of the first alarm}."""
        alarms = {}
        for t in np.arange(0.0, until_s, every_s):
            targets, rows = [], []
            for k, (mmsi, path) in enumerate(self.paths.items()):
                place, speed = path(t), (path(t + 1.0) - path(t - 1.0)) / 2.0
                fast = np.hypot(*speed) > 3.0 * KNOT
                interval = (interval_s or {}).get(mmsi, 180.0 if mmsi != OWN and not fast else every_s)
                if (t + every_s * k) % interval < every_s and mmsi not in silent:
                    rows.append(self.ais(t, mmsi, place, speed))
                if self.radar and mmsi != OWN:
                    targets.append(self.target(t, k, place))
            self.add("ais", "ais", rows, START_S + t)
            self.add("radar", "table", targets, START_S + t)
            situation = self.keeper.tick(START_S + t)
            mmsi_of = dict(zip(situation.objects["object"].tolist(), situation.objects["mmsi"].tolist(), strict=True))
            for alarm in situation.alarms:
                if alarm.kind == "cpa":
                    alarms.setdefault(mmsi_of[alarm.objects[0]] or f"object {alarm.objects[0]}", t)
        self.keeper.close()
        return alarms

    def add(self, source, kind, rows, time_s):
        if rows:
            columns = {name: [row[name] for row in rows] for name in rows[0]}
            self.keeper.reception.add(source, Reports.of(source, kind, columns), time_s)

    def ais(self, t, mmsi, place, speed):
        # Errors of a receiver that move slowly, and a speed in tenths of a knot.
        east, north = place + self.constant[mmsi] + self.rng.normal(0.0, 1.0, 2)
        knots = np.round(np.hypot(*speed) / KNOT + self.rng.exponential(0.05), 1)
        course = np.arctan2(*speed) if np.hypot(*speed) > 0.1 else self.rng.uniform(0.0, 2.0 * np.pi)
        return {
            "time_s": START_S + t, "lat_deg": 50.0 + north / 111_229.0, "lon_deg": -1.0 + east / 71_695.7,
            "mmsi": mmsi, "nav_status": float(self.status.get(mmsi, np.nan)),
            "vx_m_per_s": knots * KNOT * np.sin(course), "vy_m_per_s": knots * KNOT * np.cos(course),
        }  # fmt: skip

    def target(self, t, number, place):
        east, north = place + self.rng.normal(0.0, 10.0, 2)
        return {"time_s": START_S + t, "range_m": np.hypot(east, north), "track_id": f"{number}",
                "bearing_deg": np.degrees(np.arctan2(east, north)) % 360.0}  # fmt: skip


def at(east, north):
    return lambda t: np.array([east, north], float)


def straight(start, velocity):
    """A straight course at a velocity in m/s."""
    return lambda t: np.array(start, float) + np.multiply(velocity, t)


def leg(start, *legs):
    """A path of straight legs: (seconds, knots, course in degrees) each."""
    ends, places = [0.0], [np.array(start, float)]
    for seconds, knots, course in legs:
        way = KNOT * knots * np.array([np.sin(np.radians(course)), np.cos(np.radians(course))])
        ends.append(ends[-1] + seconds)
        places.append(places[-1] + seconds * way)
    places = np.array(places)
    return lambda t: np.array([np.interp(t, ends, places[:, 0]), np.interp(t, ends, places[:, 1])])


def at_anchor(east, north, swing_m=120.0, period_s=1500.0):
    """A ship on her chain, which swings by 40 degrees to each side."""

    def path(t):
        angle = np.radians(40.0) * np.sin(2.0 * np.pi * t / period_s)
        return np.array([east, north]) + swing_m * np.array([np.cos(angle), np.sin(angle)])

    return path


def berthed(rng, n=26):
    """Ships at both sides of a basin 260 m wide and 2.6 km long, and two elsewhere."""
    rows = {}
    for k in range(n):
        side = -1.0 if k % 2 else 1.0
        rows[f"2110000{k:02d}"] = at(side * 130.0 + rng.normal(0.0, 5.0), -400.0 + 200.0 * (k // 2))
    rows["211000090"], rows["211000091"] = at(-500.0, -650.0), at(80.0, 3300.0)
    return rows


#: Twenty minutes alongside, off the quay, along the basin at 3, 5 and 7 kn, and round its end.
DEPARTURE = leg((95.0, -300.0), (1200, 0, 0), (60, 1.2, 290), (240, 3, 355), (300, 5, 0), (420, 7, 0), (300, 7, 60))
MOORED, AT_ANCHOR = 5, 1


@pytest.mark.slow
@pytest.mark.parametrize(("radar", "says_so"), [(False, False), (True, False), (False, True)])
@pytest.mark.long_after(1)
def test_a_departure_along_berthed_ships_raises_no_alarms_of_them(radar, says_so):
    ships = berthed(np.random.default_rng(5))
    alarms = Sea(DEPARTURE, ships, status=dict.fromkeys(ships, MOORED) if says_so else {}, radar=radar).run(
        2500.0, every_s=10.0
    )
    # The ship a kilometre beyond all others, right ahead for ten minutes.
    assert set(alarms) <= {"211000091"}


@pytest.mark.slow
@pytest.mark.parametrize("quay_m", [None, 30.0, 250.0])
def test_a_ship_that_lies_alone_is_berthed_where_the_chart_has_a_quay_beside_her(tmp_path, quay_m):
    """She sends no status, and no other ship is near. quay_m : how far the land of the chart is from her."""
    chart = []
    if quay_m is not None:
        ring = [(80.0 + quay_m, 2000.0), (900.0, 2000.0), (900.0, 4000.0), (80.0 + quay_m, 4000.0)]
        ring = [[-1.0 + east / 71_695.7, 50.0 + north / 111_229.0] for east, north in [*ring, ring[0]]]
        chart = [tmp_path / "quays.geojson"]
        chart[0].write_text(json.dumps({"type": "Polygon", "coordinates": [ring]}))
    own = leg((0.0, 0.0), (1200, 0, 0), (2000, 5.0, 0))
    sea = Sea(own, {"211000091": at(80.0, 3300.0)}, chart=tuple(map(str, chart)))
    assert set(sea.run(2200.0, every_s=10.0)) == (set() if quay_m == 30.0 else {"211000091"})
    assert (len(sea.keeper.approaches.berthed) == 1) == (quay_m == 30.0)


@pytest.mark.slow
def test_without_the_harbour_speed_every_berthed_ship_is_an_alarm():
    alarms = Sea(DEPARTURE, berthed(np.random.default_rng(5)), harbour_kn=0.0).run(1800.0, every_s=10.0)
    assert len(alarms) >= 15


@pytest.mark.slow
@pytest.mark.parametrize("knots", [4.0, 9.0, 14.0])
@pytest.mark.parametrize(("swing_m", "status"), [(120.0, {}), (30.0, {}), (0.0, {}), (0.0, {"211000001": AT_ANCHOR})])
def test_an_anchored_ship_ahead_at_sea_is_an_alarm_in_good_time(knots, swing_m, status):
    """One that does not swing, in a calm, too; among others that say that they are at anchor."""
    ahead, anchorage = KNOT * knots * 1500.0, {}
    if status:
        anchorage = {f"21100001{k}": at(200.0 * k - 500.0, ahead + 200.0) for k in range(5)}
        status = status | dict.fromkeys(anchorage, AT_ANCHOR)
    own = leg((0.0, 0.0), (4000, knots, 0))
    others = {"211000001": at_anchor(-100.0, ahead, swing_m), **anchorage}
    alarms = Sea(own, others, status=status).run(600.0)
    # As soon as two reports of three minutes have been received, 18 minutes before.
    assert alarms.get("211000001", np.inf) < 420.0


@pytest.mark.slow
def test_above_the_speed_of_a_harbour_every_ship_at_rest_is_an_alarm():
    own = leg((0.0, 0.0), (4000, 14.0, 0))
    ships = {f"21100000{k}": at(300.0, KNOT * 14.0 * 1000.0 + 150.0 * k) for k in range(4)}
    assert set(Sea(own, ships, status=dict.fromkeys(ships, MOORED)).run(600.0)) == set(ships)


#: Own ship alongside for ten minutes, then on a straight course along berthed ships.
QUAY = {f"21100002{k}": at(200.0, 300.0 * k) for k in range(9)}


@pytest.mark.slow
def test_a_course_right_at_a_berthed_ship_is_an_alarm_in_the_harbour_too():
    own = leg((0.0, 0.0), (600, 0, 0), (1000, 6.0, 0))
    others = {"211000001": at(10.0, KNOT * 6.0 * 600.0), **QUAY}
    alarms = Sea(own, others, status=dict.fromkeys(others, MOORED)).run(1190.0)
    # Within the last minute, not before.
    assert set(alarms) == {"211000001"} and 1130.0 <= alarms["211000001"] <= 1170.0


@pytest.mark.slow
@pytest.mark.parametrize(("radar", "interval_s"), [(False, 10.0), (True, 180.0)])
@pytest.mark.long_after(1)
def test_a_berthed_ship_that_begins_to_move_across_the_course_is_an_alarm(radar, interval_s):
    """With AIS that still reports every three minutes, as it does below 3 kn, the radar shows that she moves."""
    own = leg((0.0, 0.0), (600, 0, 0), (3000, 5.0, 0))
    leaves_s, meet_s = 900.0, 1200.0
    place = KNOT * 5.0 * (meet_s - 600.0)
    moving = leg((KNOT * 2.5 * (meet_s - leaves_s), place), (leaves_s, 0, 0), (2000, 2.5, 270))
    others = {"211000001": moving, **QUAY}
    sea = Sea(own, others, status=dict.fromkeys(others, MOORED), radar=radar)
    alarms = sea.run(1000.0, interval_s={"211000001": interval_s})
    # The radar's track is an object of its own until AIS reports again.
    [name] = alarms
    assert (name == "211000001" or (radar and name.startswith("object"))) and leaves_s < alarms[name] <= leaves_s + 75.0


@pytest.mark.slow
def test_own_ship_in_the_ais_of_others_is_no_approach(tmp_path):
    """A station on shore receives her, too; her own transponder (VDO) says which ship she is."""
    pyais = pytest.importorskip("pyais")
    now = [START_S]
    path = tmp_path / "sensors.toml"
    path.write_text(
        '[watch]\nown_ship = { source = "bridge" }\nplane = { lat_deg = 50.0, lon_deg = -1.0 }\n'
        '[sources.bridge]\nkind = "marine radar"\ninput = "tcp://127.0.0.1:10110"\n'
        '[sources.shore]\nkind = "ais"\ninput = "tcp://127.0.0.1:10111"\n'
    )
    keeper = Keeper(read_settings(path), clock=lambda: now[0])
    bridge, shore = keeper.wires.values()
    for t in range(60):
        now[0] += 1.0
        lat = 50.0 + 5.0 * t / 111_229.0
        shown = {"mmsi": 235000009, "lat": lat, "lon": -1.0, "speed": 9.7, "course": 0.0, "type": 1, "second": t % 60}
        bridge.receive(pyais.encode_dict(shown, sentence_type="VDO")[0].encode() + b"\r\n", last=True)
        bridge.receive(sentence("GPVTG,0.0,T,,M,9.7,N,,K,A"), last=True)
        if t % 3 == 0:
            # Late, so that she is astern of her own position.
            shown |= {"lat": lat + 0.0002, "speed": 8.0}
            other = {"mmsi": 235000001, "lat": 50.02 - 3.0 * t / 111_229.0, "lon": -1.0, "speed": 5.8, "course": 180.0}
            for one in (shown, other | {"type": 1, "second": t % 60}):
                shore.receive(pyais.encode_dict(one, sentence_type="VDM")[0].encode() + b"\r\n", last=True)
        situation = keeper.tick()
    assert set(situation.objects["mmsi"].tolist()) == {"235000009", "235000001"}
    assert [alarm.text.split()[0] for alarm in situation.alarms if alarm.kind == "cpa"] == ["235000001"]
    keeper.close()


def test_an_approach_that_wanders_with_the_courses_is_one_alarm(monkeypatch):
    """In a convoy, the CPA in 20 minutes changes by 300 m with the courses: it raised five alarms in four minutes."""
    by_minute = [(885.0, 1170.0), (1278.0, 1040.0), (1207.0, 1010.0), (1303.0, 860.0), (929.0, 850.0), (1500.0, 800.0)]

    def approach(situation):
        ship = situation.objects["object"][situation.objects["mmsi"] == "235000001"].tolist()
        return dict.fromkeys(ship, by_minute[int((situation.time_s - START_S) // 60.0)])

    monkeypatch.setattr(Situation, "cpa", property(approach))
    sea = Sea(straight([0.0, 0.0], [0.0, 3.0]), {"235000001": straight([5000.0, 5000.0], [-3.0, 0.0])}, harbour_kn=0.0)
    sea.run(350.0)
    [row] = [row for row in sea.keeper.alarm_list() if row["kind"] == "cpa"]
    assert not row["active"] and 290.0 <= row["last_s"] - START_S < 300.0


@pytest.mark.slow
@pytest.mark.parametrize("apart_m", [350.0, 800.0])
def test_a_yacht_in_company_is_one_alarm_of_an_approach(apart_m):
    """She closes and opens by a few decimetres a second: the alarm began and ended every other minute."""

    def company(t):
        swing = 60.0 * np.sin(t / 70.0), 40.0 * np.cos(t / 55.0)
        return straight([apart_m, 0.0], [0.0, 3.0])(t) + np.array(swing)

    sea = Sea(straight([0.0, 0.0], [0.0, 3.0]), {"235000001": company}, harbour_kn=0.0)
    sea.run(1200.0)
    rows = [row for row in sea.keeper.alarm_list() if row["kind"] == "cpa"]
    assert len(rows) == 1, [(row["first_s"] - START_S, row["last_s"] - START_S) for row in rows]


@pytest.mark.slow
def test_an_approach_ends_soon_after_the_ship_has_passed():
    sea = Sea(straight([0.0, 0.0], [0.0, 5.0]), {"235000001": straight([300.0, 3000.0], [0.0, -5.0])}, harbour_kn=0.0)
    sea.run(600.0)
    [row] = [row for row in sea.keeper.alarm_list() if row["kind"] == "cpa"]
    assert not row["active"] and 290.0 < row["last_s"] - START_S < 330.0
