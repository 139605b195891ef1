"""Sources that a doubt says are read wrongly: what only they show is not confirmed, in files and live."""

import numpy as np
import pytest

import sameas
from sameas.picture import LivePicture, Watch
from sameas.picture.live import Registered, Window
from sameas.tracks import Description, Reports, Site

N, SPAN_S = 8, 240.0


def sources_of(seed, wrong):
    """Ships with AIS, and a radar's plots of them, and of one boat more; wrong : with angles from the east."""
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(-4000.0, 4000.0, (N + 1, 2)), rng.normal(0.0, 4.0, (N + 1, 2))
    ais, radar = [], []
    for t in np.arange(0.0, SPAN_S, 3.0):
        place = start + velocity * t
        for k in np.flatnonzero(rng.random(N + 1) < 0.9).tolist():
            bearing = np.degrees(np.arctan2(*place[k])) + 0.3 * rng.normal()
            radar.append((t, np.hypot(*place[k]) + 15.0 * rng.normal(), (90.0 - bearing if wrong else bearing) % 360.0))
        for k in range(N) if t % 9.0 == 0.0 else ():
            ais.append((t + 0.3 * k, f"23500000{k}", *(place[k] + 5.0 * rng.normal(size=2)), *velocity[k]))
    columns = zip(*ais, strict=True)
    named = dict(zip(("time_s", "mmsi", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s"), map(list, columns), strict=True))
    plots = dict(zip(("time_s", "range_m", "bearing_deg"), np.array(radar).T, strict=True))
    return {"ais": named, "radar": plots}


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [True, False])
def test_what_only_a_misread_radar_shows_is_not_confirmed(wrong, tmp_path):
    """A radar whose bearings were angles from the east showed nine confirmed objects beside the doubt that says so."""
    toml = tmp_path / "sensors.toml"
    toml.write_text('[sources.radar]\nkind = "marine radar"\nsite = { east_m = 0, north_m = 0 }\n')
    found = sameas.match_picture(sources_of(1, wrong), sensors=toml, every=15.0, registration=False)
    assert any("look exchanged" in doubt and "unless it is radar" in doubt for doubt in found.doubts) == wrong
    objects = found.table
    late = objects[objects["time_s"] == objects["time_s"].max()]
    alone = late[late["sources"] == "radar"]
    assert int(np.isin(alone["stage"], ("confirmed", "coasting")).sum()) == (0 if wrong else 1)
    assert len(alone) >= 8 if wrong else len(alone) >= 1
    assert int((late["stage"] == "confirmed").sum()) == N + (not wrong)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [True, False])
def test_what_only_a_misread_radar_shows_is_not_confirmed_live(wrong):
    """It was for as long as the radar showed it: live, no doubt was looked for."""
    given = sources_of(1, wrong)
    radar = Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0))
    picture = LivePicture([Description("ais", "ais"), radar])
    feeds = {name: Reports.of(name, "ais" if name == "ais" else "table", given[name]) for name in given}
    for t in np.arange(5.0, SPAN_S, 5.0).tolist():
        for name, reports in feeds.items():
            picture.add(name, reports.where(np.flatnonzero((reports.time_s > t - 5.0) & (reports.time_s <= t))))
        if t % 60.0 == 0.0:
            picture.register()
        state = picture.advance(t)
    assert any("look exchanged" in doubt for doubt in picture.doubts) == wrong
    objects = picture.objects
    confirmed = np.isin(objects["stage"], ("confirmed", "coasting"))
    assert int((confirmed & (objects["sources"] == "radar")).sum()) == (0 if wrong else 1)
    assert int((objects["stage"] == "confirmed").sum()) >= N
    assert isinstance(state.watch, Watch) and ("radar" in state.watch.misread) == wrong


def test_a_doubt_stays_for_the_reports_that_raised_it_and_ends_with_another_description():
    radar, ais = Description("radar", "marine radar", site=Site(east_m=0.0, north_m=0.0)), Description("ais", "ais")
    picture = LivePicture([ais, radar], window=Window(span_s=100.0))
    reports = Reports.of("radar", "table", {"time_s": [0.0], "range_m": [500.0], "bearing_deg": [10.0]})
    picture.add("radar", reports)
    picture.advance(1.0)
    picture.take_off(Registered(doubts=("radar: its bearings …",), misread=frozenset({"radar"})))
    for t, stays in ((60.0, True), (100.0, True), (102.0, False)):
        picture.advance(t)
        picture.take_off(Registered())
        assert (picture.doubts == ("radar: its bearings …",)) == stays
    picture.take_off(Registered(doubts=("radar: its bearings …",), misread=frozenset({"radar"})))
    picture.describe([ais, radar])
    assert picture.doubts
    picture.describe([ais, Description("radar", "marine radar", site=Site(east_m=1.0, north_m=0.0))])
    assert not picture.doubts
