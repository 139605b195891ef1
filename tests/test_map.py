"""Maps: coastlines against known places, checks of sheets, pages in a browser, static charts."""

from __future__ import annotations

import base64
import gzip
import json
import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from browser import CHROMIUM, Browser
from charted import SOLENT, START_S, charted
from sameas.errors import InputError
from sameas.maps import MapSensor, MapSheet, outline
from sameas.maps.outline import Outline
from sameas.maps.sheet import members_of
from sameas.pages.map import map_page, packed, write_map_page
from sameas.plots.map import graticule
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.source import Description, SensorCoverage, Site

pytest.importorskip("pymap3d", reason="maps of the earth need the extra sameas[targets]")

HOSTILE = '</script><script>document.title="taken"</script><img src=x onerror="document.title=1">'
in_a_browser = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to show the page in")


# ---- the earth ----


def winding(rings: tuple[NDArray[Any], ...], place: tuple[float, float]) -> int:
    """Winding number of all rings around a place: 1 on land, 0 on water."""
    total = 0.0
    for ring in rings:
        angle = np.unwrap(np.arctan2(*(np.vstack([ring, ring[:1]]) - place).T))
        total += angle[-1] - angle[0]
    return -round(total / (2.0 * np.pi))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("lat", "lon", "land"),
    [
        (51.5, -0.1, True), (50.2, -1.3, False), (50.67, -1.3, True),  # London, the Channel, the Isle of Wight
        (-16.6, 179.3, True), (-16.5, -179.5, False), (-17.8, 178.0, True),  # Fiji, over the antimeridian
        (-90.0, 0.0, True), (90.0, 0.0, False),  # the poles
        (47.7, -87.5, False), (46.5, -88.5, True),  # Lake Superior and its shore
        (25.0, 10.0, True), (25.0, 15.0, True), (30.0, 10.0, True),  # the Sahara, corners of cells in it
    ],
)  # fmt: skip
@pytest.mark.parametrize("off", [0.0, 2.0])
def test_land_and_water_at_known_places(lat: float, lon: float, land: bool, off: float) -> None:
    plane = LocalPlane(float(np.clip(lat - off, -90.0, 90.0)), lon + off)
    place = plane.of_geodetic([lat], [lon])[0] + [3.0, 7.0]
    around = outline(plane, -400e3, -400e3, 400e3, 400e3)
    assert winding(around.land, tuple(place)) == int(land)


def test_cell_borders_are_no_coast() -> None:
    around = outline(LocalPlane(25.0, 10.0), -400e3, -400e3, 400e3, 400e3)
    assert len(around.land) >= 4 and not around.coast and around.borders
    sea = outline(LocalPlane(0.0, -25.0), -300e3, -300e3, 300e3, 300e3)
    assert not sea.land and not sea.coast and not sea.borders


def test_the_coast_is_the_shore_of_the_land() -> None:
    around = outline(SOLENT, -60e3, -60e3, 60e3, 60e3)
    for line in around.coast:
        here, there = line[:-1], line[1:]
        middle, along = (here + there) / 2.0, (there - here) / np.hypot(*(there - here).T)[:, None]
        left = middle + 3.0 * np.column_stack([-along[:, 1], along[:, 0]])
        inside = (np.abs(left) < 59e3).all(axis=1)
        for place in left[inside][::7]:
            assert winding(around.land, tuple(place)) == 1
    assert all(np.abs(ring).max() <= 60e3 + 1e-6 for ring in around.land)


def test_an_empty_box_is_refused() -> None:
    with pytest.raises(InputError, match="give west < east"):
        outline(SOLENT, 10.0, 0.0, -10.0, 5.0)


@pytest.mark.parametrize(("lat", "lon"), [(50.77, -1.25), (-17.5, 179.9), (89.6, 40.0), (0.0, 0.0)])
def test_graticule_lines_are_at_their_labels(lat: float, lon: float) -> None:
    plane = LocalPlane(lat, lon)
    lines = graticule(plane, -90e3, -90e3, 90e3, 90e3)
    assert min(sum(line.parallel for line in lines), sum(not line.parallel for line in lines)) >= 3
    for line in lines:
        degrees, minutes, letter = re.fullmatch(r"(\d+)°([\d.]+)′([NSEW])", line.words).groups()
        angle_deg = (float(degrees) + float(minutes) / 60.0) * (-1.0 if letter in "SW" else 1.0)
        inside = line.points[np.abs(line.points).max(axis=1) < 500e3]
        own = plane.to_geodetic(inside)[0 if line.parallel else 1]
        assert np.allclose((own - angle_deg + 180.0) % 360.0 - 180.0, 0.0, atol=1e-6), line.words


# ---- sheets ----


def test_invalid_columns_of_a_sheet_are_refused_by_name() -> None:
    good = {"time_s": [0.0], "object": [1], "stage": ["confirmed"], "x_m": [0.0], "y_m": [0.0]}
    with pytest.raises(InputError, match="objects: there is no column y_m"):
        MapSheet.of("map", {name: good[name] for name in list(good)[:4]}, {})
    with pytest.raises(InputError, match="objects: column x_m has 2 rows, time_s has 1"):
        MapSheet.of("map", good | {"x_m": [0.0, 1.0]}, {})
    with pytest.raises(InputError, match="stage is 'sunk'; give one of tentative, confirmed"):
        MapSheet.of("map", good | {"stage": ["sunk"]}, {})
    with pytest.raises(InputError, match="1 times are not among the instants"):
        MapSheet.of("map", good, {}, instants_s=[5.0])
    with pytest.raises(InputError, match="x_m is of type <U3; give numbers"):
        MapSheet.of("map", good | {"x_m": ["far"]}, {})
    with pytest.raises(InputError, match="no instant to show"):
        MapSheet.of("map", {}, {})


def test_masked_cells_are_absent_and_unknown_sources_get_a_place() -> None:
    objects = {"time_s": [0.0, 0.0], "object": [2, 1], "stage": ["confirmed"] * 2,
               "x_m": np.ma.array([1.0, 2.0], mask=[True, False]), "y_m": [0.0, 0.0]}  # fmt: skip
    records = {"time_s": [0.0], "source": ["esm"], "row": [4], "object": [1]}
    sheet = MapSheet.of("map", objects, records, sensors=[MapSensor("radar")])
    assert sheet.objects["object"].tolist() == [1, 2] and np.isnan(sheet.objects["x_m"][1])
    assert [sensor.name for sensor in sheet.sensors] == ["radar", "esm"]
    assert sheet.extent() == sheet.home() == (-48.0, -50.0, 52.0, 50.0)


def test_the_first_view_contains_confirmed_objects_and_sites() -> None:
    stage = ["confirmed", "confirmed", "tentative"]
    objects = {"time_s": [0.0] * 3, "object": [1, 2, 3], "stage": stage, "x_m": [0.0, 500.0, 9e5], "y_m": [0.0] * 3}
    sheet = MapSheet.of("map", objects, {}, sensors=[MapSensor("radar", x_m=-100.0, y_m=-300.0)])
    assert sheet.home() == (-100.0, -300.0, 500.0, 0.0) and sheet.extent()[2] == 9e5
    content = json.loads(map_page(sheet).split('id="data">')[1].split("</script>")[0])
    assert content["extent"] == [-100.0, -300.0, 500.0, 0.0] and content["box"][2] >= 9e5


def test_an_empty_instant_is_shown_too() -> None:
    sheet = MapSheet.of("map", {}, {}, instants_s=[0.0, 1.0])
    assert len(sheet.instants_s) == 2 and "columns" in map_page(sheet)


@settings(max_examples=60, deadline=None)
@given(
    st.tuples(st.integers(0, 359), st.integers(1, 360)),
    st.lists(st.tuples(st.integers(0, 359), st.integers(1, 90)), max_size=3),
)
def test_the_coverage_of_a_sensor_is_its_sector_minus_shadows(
    whole: tuple[int, int], dark: list[tuple[int, int]]
) -> None:
    sector = (float(whole[0]), float(sum(whole) % 360))
    shadows = tuple((float(a), float((a + w) % 360)) for a, w in dark)
    coverage = SensorCoverage(range_m=1000.0, sector_deg=sector, shadows_deg=shadows)
    sensor = MapSensor.of(Description("radar", "other", Site(east_m=0.0, north_m=0.0), coverage), None)
    bearing = np.arange(360) + 0.5
    seen = np.zeros(360, np.bool_)
    for start, stop in sensor.visible_deg:
        seen |= (bearing - start) % 360.0 <= stop - start
    assert np.array_equal(seen, coverage.covers(500.0, bearing))


def test_members_are_read_from_their_list() -> None:
    assert members_of("radar:12 north ais:3 adsb:0") == [("radar", 12), ("north ais", 3), ("adsb", 0)]
    assert members_of("") == []


# ---- packing ----


def unpack(heads: list[dict[str, Any]], text: str) -> dict[str, NDArray[Any]]:
    """From the definition in pages/map.py."""
    data, at, found = gzip.decompress(base64.b64decode(text)), 0, {}
    for head in heads:
        n, total, values = head["n"], 0, []
        for k in range(n):
            zigzag = sum(data[at + b * n + k] << (8 * b) for b in range(head["bytes"]))
            total += -(zigzag + 1) // 2 if zigzag % 2 else zigzag // 2
            values.append(total * head["step"])
        at += head["bytes"] * n
        if head["holes"]:
            values = [v if data[at + k] else np.nan for k, v in enumerate(values)]
            at += n
        found[head["name"]] = np.array(values)
    assert at == len(data)
    return found


@pytest.mark.slow
@given(st.lists(st.one_of(st.just(np.nan), st.floats(-1e6, 1e6)), max_size=30), st.sampled_from([0.01, 0.5, 1.0]))
def test_packed_columns_round_trip_to_half_a_step(values: list[float], step: float) -> None:
    column = np.array(values, np.float64)
    back = unpack(*packed({"a": (column, step), "b": (column[::-1], 1.0)}))
    assert np.array_equal(np.isnan(back["a"]), np.isnan(column))
    assert np.nanmax(np.abs(back["a"] - column), initial=0.0) <= step * 0.5000001
    assert np.nanmax(np.abs(back["b"] - column[::-1]), initial=0.0) <= 0.5000001


def test_numbers_too_large_to_be_shown_are_refused() -> None:
    with pytest.raises(InputError, match="column x holds 1e"):
        packed({"x": (np.array([1e20]), 0.1)})


# ---- the page ----


@pytest.mark.slow
def test_the_page_is_small_and_makes_no_requests() -> None:
    sheet = charted(60, 60, reach_m=20e3)
    page = map_page(sheet)
    assert len(page) < 600_000 + 45 * len(sheet.objects["object"])
    assert not re.search(r"https?://|src=|href=", page.replace("http://www.w3.org/2000/svg", ""))
    assert "default-src 'none'" in page


def test_received_names_cannot_end_the_script() -> None:
    page = map_page(charted(3, 4, names={1: HOSTILE, 2: "{{js}}", 3: "\u2028"}))
    assert HOSTILE not in page and page.count("</script>") == 4
    assert "\\u003c/script>\\u003cscript>" in page
    assert page.count("mapPage = {") == 1


def test_an_unwritable_page_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="does not exist"):
        write_map_page(charted(2, 2), tmp_path / "none" / "map.html")


@pytest.fixture(scope="module")
def shown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Browser, MapSheet]]:
    """A browser with the map of twelve vessels; the first has a hostile name."""
    folder = tmp_path_factory.mktemp("map")
    sheet = charted(names={1: HOSTILE})
    write_map_page(sheet, folder / "map.html")
    with Browser(folder / "map.html", (1400, 900)) as browser:
        yield browser, sheet


def key(browser: Browser, name: str, code: str = "", text: str = "") -> None:
    for kind in ("keyDown", "keyUp"):
        browser.do(
            "Input.dispatchKeyEvent", type=kind, key=name, code=code or name, text=text if kind == "keyDown" else ""
        )


def centre_of(browser: Browser, selector: str) -> tuple[float, float]:
    browser.settle()
    box = f"document.querySelector({json.dumps(selector)}).getBoundingClientRect()"
    found = browser.js(f"(r => [r.left + r.width / 2, r.top + r.height / 2])({box})")
    return found[0], found[1]


def place_of(browser: Browser, number: int) -> tuple[float, float]:
    """Where an object is drawn on the page."""
    return tuple(browser.js(
        f"(row => {{ const r = document.getElementById('chart').getBoundingClientRect(), o = mapPage.objects;"
        "const [u, v] = mapPage.toScreen(o.x[row], o.y[row]); return [r.left + u, r.top + v]; })"
        f"(mapPage.now.rowOf.get({number}))"
    ))  # fmt: skip


def words(browser: Browser, name: str) -> str:
    return str(browser.js(f"document.getElementById('{name}').innerText"))


@pytest.mark.slow
@in_a_browser
def test_the_page_contains_the_columns_of_the_sheet(shown: tuple[Browser, MapSheet]) -> None:
    browser, sheet = shown
    for table, columns in (("objects", sheet.objects), ("records", sheet.records)):
        for here, there, step in (("x", "x_m", 0.01), ("y", "y_m", 0.01), ("n", "object", 1e-9)):
            read = [np.nan if v is None else v for v in browser.js(f"[...mapPage.{table}.{here}]")]
            assert np.allclose(read, columns[there].astype(float), atol=step, equal_nan=True)
    assert browser.js("mapPage.records.bearing.filter(v => !isNaN(v)).length") == int(
        np.isfinite(sheet.records["bearing_deg"]).sum()
    )


@pytest.mark.slow
@in_a_browser
def test_page_and_local_plane_give_equal_coordinates(shown: tuple[Browser, MapSheet]) -> None:
    browser, _ = shown
    rng = np.random.default_rng(1)
    xy = rng.uniform(-300e3, 300e3, (20, 2))
    lat, lon = SOLENT.to_geodetic(xy)
    read = np.array(browser.js(f"{xy.tolist()}.map(p => mapPage.earth.toEarth(...p))"))
    assert np.allclose(read, np.column_stack([lat, lon]), atol=1e-9)
    back = np.array(browser.js(f"{read.tolist()}.map(p => mapPage.earth.toPlane(...p))"))
    assert np.allclose(back, xy, atol=1e-3)


@pytest.mark.slow
@in_a_browser
def test_the_slider_changes_the_drawn_instant(shown: tuple[Browser, MapSheet]) -> None:
    browser, sheet = shown
    browser.js("mapPage.show(0)")
    assert words(browser, "time") == "22:13:20" and words(browser, "day") == "2023-11-14"
    pixels = "document.getElementById('chart').toDataURL()"
    browser.until("document.body.dataset.drawn === '0'")
    before = browser.js(pixels)
    browser.click(*centre_of(browser, "#slider"))
    browser.until("document.body.dataset.drawn !== '0'")
    k = browser.js("mapPage.now.k")
    assert abs(k - (len(sheet.instants_s) - 1) / 2) <= 1 and browser.js(pixels) != before
    key(browser, "ArrowRight")
    browser.until(f"document.body.dataset.drawn === '{k + 1}'")
    seconds = int(sheet.instants_s[k + 1] - START_S)
    # The counts above the slider are a band without gaps: an empty column would be an instant without objects. At the
    # first two all are tentative.
    empty, wide = browser.js(
        "(s => { const p = s.getContext('2d').getImageData(0, s.height - 2, s.width, 1).data; let n = 0;"
        "for (let k = 3; k < p.length; k += 4) if (!p[k]) n++;"
        "return [n, s.width]; })(document.getElementById('strip'))"
    )
    assert empty <= wide * 2 / len(sheet.instants_s)
    assert words(browser, "time") == f"22:{13 + (20 + seconds) // 60}:{(20 + seconds) % 60:02d}"
    browser.click(*centre_of(browser, "#play"))
    browser.until(f"mapPage.now.k >= {k + 3}")
    key(browser, " ", "Space")
    browser.until("document.getElementById('play').getAttribute('aria-label') === 'play'")


@in_a_browser
def test_a_click_on_an_object_explains_it(shown: tuple[Browser, MapSheet]) -> None:
    browser, sheet = shown
    browser.js("mapPage.show(20); mapPage.pick(null)")
    browser.until("document.body.dataset.drawn === '20'")
    browser.click(*place_of(browser, 9))
    browser.until("mapPage.picked === 9")
    browser.until("document.getElementById('object').innerText.includes('Why')")
    details = words(browser, "object")
    row = int(np.flatnonzero((sheet.objects["object"] == 9) & (sheet.instant_of(sheet.objects) == 20))[0])
    speed = sheet.objects["speed_m_per_s"][row]
    lat, _ = SOLENT.to_geodetic([[sheet.objects["x_m"][row], sheet.objects["y_m"][row]]])
    # A table in the reasons keeps its columns: it is not wrapped.
    columns = "[...document.querySelectorAll('#object pre.columns')].map(e => e.textContent)"
    assert any("positions       " in block and "prior           " in block for block in browser.js(columns))
    assert "VESSEL 09" in details and f"{speed / (1852 / 3600):.1f} kn" in details and f"({speed:.1f} m/s)" in details
    assert f"{int(lat[0])}°{(lat[0] % 1) * 60:06.3f}′N" in details
    assert "one object: probability 0.99" in details and "marine.csv line 200010" in details and "camera.csv" in details
    assert sheet.texts[20, 9].splitlines()[1] in details
    assert browser.js("location.hash") == "#t=20&object=9"
    browser.js("mapPage.show(22)")
    browser.until("document.getElementById('object').innerText.includes('Why')")
    assert sheet.texts[20, 9].splitlines()[1] in words(browser, "object")
    key(browser, "Escape")
    assert browser.js("mapPage.picked") is None and browser.js("document.getElementById('object').hidden")


@in_a_browser
def test_an_ambiguous_object_shows_its_alternatives(shown: tuple[Browser, MapSheet]) -> None:
    browser, _ = shown
    browser.js("mapPage.show(20); mapPage.pick(1)")
    browser.until("document.getElementById('object').innerText.includes('Why')")
    details = words(browser, "object")
    assert (
        "ambiguous" in details
        and "probability 0.71" in details
        and "with probability 0.28: with harbour radar 101" in details
    )
    # Doubts are before what a narrow header cuts.
    assert "1 ambiguous, " in words(browser, "counts")


@in_a_browser
def test_a_hostile_name_stays_text(shown: tuple[Browser, MapSheet]) -> None:
    browser, sheet = shown
    browser.js("mapPage.show(20); mapPage.pick(1)")
    assert browser.js("document.querySelector('#object h2').textContent") == HOSTILE
    assert browser.js("document.querySelector('#rows tr.picked td.label').textContent") == HOSTILE
    assert browser.js("document.title") == f"{sheet.title} · map"
    assert browser.js("document.images.length") == 0


@pytest.mark.slow
@in_a_browser
def test_list_search_alarms_and_layers(shown: tuple[Browser, MapSheet]) -> None:
    browser, _ = shown
    browser.js("mapPage.show(20); mapPage.pick(null)")
    numbers = "[...document.querySelectorAll('#rows tr[data-number]')].map(tr => +tr.dataset.number)"
    assert browser.js(numbers) == sorted(browser.js(numbers))
    browser.click(*centre_of(browser, "#columns th[data-key=speed] button"))
    speeds = browser.js(
        "[...document.querySelectorAll('#rows tr[data-number] td:nth-child(3)')].map(td => +td.innerText)"
    )
    assert len(speeds) > 5 and speeds == sorted(speeds)
    browser.click(*centre_of(browser, "#search"))
    browser.do("Input.insertText", text="vessel 11")
    assert browser.js(numbers) == [11]
    browser.click(*centre_of(browser, "#rows tr[data-number='11']"))
    assert browser.js("mapPage.picked") == 11
    browser.js("(s => { s.value = ''; s.dispatchEvent(new Event('input')); })(document.getElementById('search'))")
    browser.js("mapPage.pick(null)")
    # The list is in another order when the button is released, as of a live page.
    x, y = centre_of(browser, "#rows tr[data-number='5']")
    browser.do("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y, button="left", clickCount=1)
    browser.js("document.querySelector('#columns th[data-key=speed] button').click()")
    browser.do("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=y, button="left", clickCount=1)
    assert browser.js("mapPage.picked") == 5
    browser.click(*centre_of(browser, "#alarm-button"))
    assert "shown twice" in words(browser, "alarms")
    assert words(browser, "tab-alarms") == "Alarms 1"
    browser.js("mapPage.show(3)")
    # There are alarms, though none at this instant.
    assert words(browser, "tab-alarms") == "Alarms 1" and not browser.js("document.querySelector('#tab-alarms span')")
    browser.click(*centre_of(browser, "#alarms button"))
    assert browser.js("mapPage.now.k") == 20 and browser.js("mapPage.picked") == 3
    browser.click(*centre_of(browser, "#tab-summary"))
    assert "misses.q = 0.1" in words(browser, "summary")
    browser.click(*centre_of(browser, "#tab-list"))
    pixels = "(mapPage.paint(), document.getElementById('chart').toDataURL())"
    before = browser.js(pixels)
    browser.click(*centre_of(browser, "[data-source='0']"))
    assert browser.js(pixels) != before
    browser.click(*centre_of(browser, "[data-source='0']"))
    assert browser.js(pixels) == before


@in_a_browser
def test_wheel_and_drag_move_the_chart(shown: tuple[Browser, MapSheet]) -> None:
    browser, _ = shown
    browser.js("mapPage.pick(null); document.getElementById('whole').click()")
    x, y = place_of(browser, 8)
    scale = browser.js("mapPage.view.scale")
    browser.wheel(x, y, -500)
    browser.until(f"mapPage.view.scale > 1.8 * {scale}")
    assert np.allclose(place_of(browser, 8), (x, y), atol=1.0)  # the place under the hand stays
    browser.do("Input.dispatchMouseEvent", type="mousePressed", x=x, y=y + 60, button="left", clickCount=1)
    browser.do("Input.dispatchMouseEvent", type="mouseMoved", x=x - 80, y=y + 110, button="left", buttons=1)
    browser.do("Input.dispatchMouseEvent", type="mouseReleased", x=x - 80, y=y + 110, button="left", clickCount=1)
    assert np.allclose(place_of(browser, 8), (x - 80, y + 50), atol=1.0)
    assert browser.js("mapPage.picked") is None
    key(browser, "0")
    assert browser.js("mapPage.view.scale") == pytest.approx(scale)


@in_a_browser
def test_aircraft_have_flight_levels_and_arrows_of_climb_and_what_has_no_transponder_metres(tmp_path: Path) -> None:
    sheet = charted(4, 4)
    number, columns = sheet.objects["object"], dict(sheet.objects)
    # An airliner that climbs, a rescue aircraft that sinks, a glider in level flight, a ship.
    for name, values in (
        ("height_m", (9144.0, 306.0, 800.0)), ("sigma_height_m", (12.0, 30.0, 10.0)),
        ("climb_m_per_s", (10.2, -2.0, 0.4)), ("speed_m_per_s", (231.5, 60.0, 30.0)),
    ):  # fmt: skip
        known = np.ma.filled(columns[name].astype(np.float64), np.nan)
        for n, value in enumerate(values, 1):
            known[number == n] = value
        columns[name] = np.ma.masked_invalid(known)
    columns["icao"] = np.where(number == 1, "4CA1B2", columns["icao"])
    write_map_page(replace(sheet, objects=columns), tmp_path / "map.html")
    said = (
        "(said => { const c = CanvasRenderingContext2D.prototype, f = c.fillText;"
        " c.fillText = function (words, ...at) { said.push(words); return f.call(this, words, ...at); };"
        " mapPage.paint(); c.fillText = f; return said.join('|'); })([])"
    )
    with Browser(tmp_path / "map.html", (1400, 900)) as browser:
        browser.js("mapPage.show(3)")
        for n, label, height in (
            (1, r"\|450 kn \d{3}° FL300↑\|", "9 144 m ± 24 m (FL300↑), climbs 10.2 m/s"),
            (2, r"\|117 kn \d{3}° 310 m↓\|", "306 m ± 60 m, sinks 2.0 m/s"),
            (3, r"\|58\.3 kn \d{3}° 800 m\|", "800 m ± 20 m"),
        ):
            browser.js(f"mapPage.pick({n})")
            assert re.search(label, browser.js(said))
            facts = " ".join(browser.js("document.getElementById('object').innerText").split())
            assert f"Height {height} " in facts


@in_a_browser
def test_no_script_errors_and_no_requests(shown: tuple[Browser, MapSheet]) -> None:
    browser, _ = shown
    assert not browser.errors
    assert not [url for url in browser.requests if not url.startswith(("file:", "data:", "blob:"))]


@pytest.mark.slow
@in_a_browser
def test_thousands_of_ships_are_thinned_and_complete_after_zooming_in(tmp_path: Path) -> None:
    sheet = charted(2000, 2, reach_m=20_000.0)
    sheet.objects["stage"][:] = "confirmed"
    write_map_page(sheet, tmp_path / "map.html")
    with Browser(tmp_path / "map.html", (1400, 900)) as browser:
        marks = "(mapPage.paint(), mapPage.hits.filter(hit => hit.record).length)"
        ambiguous = "[...mapPage.now.rows].filter(r => mapPage.objects.ambiguous[r]).map(r => mapPage.objects.n[r])"
        few, whole = browser.js(marks), browser.js("mapPage.now.marks.length")
        assert browser.js("mapPage.crowd.radius") < 5 and whole > 2000
        # Of the records only those of the ambiguous two are left.
        assert few <= 3 * len(browser.js(ambiguous))
        # Dots are clickable like symbols.
        assert browser.js("mapPage.hits.filter(hit => !hit.record).length") > 1500
        for _ in range(7):
            browser.js("document.getElementById('closer').click()")
        browser.js("mapPage.paint()")
        assert browser.js("mapPage.crowd.radius") == 8 and browser.js("mapPage.crowd.details")
        assert browser.js(marks) > 5
        # However many are in sight, a frame strokes few paths: symbols are copied, and lines of one kind are one path.
        count = (
            "(() => { const canvas = CanvasRenderingContext2D.prototype, own = canvas.stroke; let n = 0;"
            "canvas.stroke = function (...path) { n++; return own.apply(this, path); };"
            "mapPage.paint(); canvas.stroke = own; return n; })()"
        )
        for key_ in ("whole", *["closer"] * 6):
            browser.js(f"document.getElementById('{key_}').click(); mapPage.paint()")
            assert browser.js(count) < 120
        # The chosen row is in the middle of the chart, wherever it was.
        browser.click(*centre_of(browser, "#rows tr[data-number='4']"))
        assert place_of(browser, 4) == pytest.approx(centre_of(browser, "#chart"), abs=2.0)
        assert not browser.errors


@pytest.mark.slow
@in_a_browser
def test_tentative_objects_are_not_shown_as_equals(tmp_path: Path) -> None:
    sheet = charted(6, 6)
    sheet.objects["stage"][np.isin(sheet.objects["object"], [4, 5])] = "tentative"
    sheet.objects["ambiguous"][sheet.objects["object"] == 4] = True
    write_map_page(sheet, tmp_path / "map.html")
    with Browser(tmp_path / "map.html", (1400, 900)) as browser:
        numbers = "[...document.querySelectorAll('#rows tr[data-number]')].map(tr => +tr.dataset.number)"
        drawn = "(mapPage.paint(), [...new Set(mapPage.hits.filter(hit => !hit.record).map(hit => hit.n))].sort())"
        browser.js("mapPage.show(3)")
        assert "4 objects" in words(browser, "counts") and "2 tentative" in words(browser, "counts")
        # Many at sea are clutter: they are last, whatever the order, and are not said to be ambiguous.
        assert browser.js(numbers) == [1, 2, 3, 6, 4, 5]
        browser.click(*centre_of(browser, "#columns th[data-key=number] button"))
        assert browser.js(numbers) == [6, 3, 2, 1, 5, 4]
        assert not browser.js("document.querySelectorAll('#rows tr.ambiguous[data-number=\"4\"]').length")
        assert browser.js(drawn) == [1, 2, 3, 4, 5, 6]
        browser.click(*centre_of(browser, "[data-layer=tentative]"))
        assert browser.js(drawn) == [1, 2, 3, 6] and browser.js(numbers) == [6, 3, 2, 1]
        # One that is asked for is shown.
        browser.js("mapPage.pick(5)")
        assert browser.js(drawn) == [1, 2, 3, 5, 6] and 5 in browser.js(numbers)
        assert not browser.errors


@pytest.mark.slow
@in_a_browser
def test_improbable_objects_do_not_count_as_seen_by_several(tmp_path: Path) -> None:
    sheet = charted(6, 6)
    several = np.asarray(sheet.objects["n_sources"]) > 1
    first = int(np.flatnonzero(several & (sheet.instant_of(sheet.objects) == 3) & (sheet.objects["object"] != 1))[0])
    number, sources = int(sheet.objects["object"][first]), int(sheet.objects["n_sources"][first])
    sheet.objects["probability"][first] = 0.00005
    sheet.objects["probability"][sheet.instant_of(sheet.objects) == 4] = 0.3
    write_map_page(sheet, tmp_path / "map.html")
    with Browser(tmp_path / "map.html", (1400, 900)) as browser:
        browser.js(f"mapPage.show(3); mapPage.pick({number})")
        browser.until("document.getElementById('object').innerText.includes('These records may be one object')")
        details = words(browser, "object")
        assert f"perhaps {sources} sources" in details and "probability < 0.0001" in details
        assert f"\n{sources} sources" not in details and "These records are one object" not in details
        row = f"document.querySelector('#rows tr[data-number=\"{number}\"]')"
        assert browser.js(f"{row}.querySelector('.sources').textContent") == "?"
        # Numbers and sources are not cut off.
        cells = "[...document.querySelectorAll('#rows td.number, #rows td.sources')]"
        cut = f"{cells}.filter(td => td.scrollWidth > td.clientWidth).length"
        assert browser.js(cut) == 0
        seen = int(np.sum(several & (sheet.instant_of(sheet.objects) == 3))) - 1
        assert f"{seen} seen by two or more sources" in words(browser, "counts")
        browser.js("mapPage.show(4)")
        assert browser.js("document.querySelectorAll('#rows .unsure').length") > 1 and browser.js(cut) == 0
        assert not browser.errors


@pytest.mark.slow
@in_a_browser
def test_local_metres_make_a_map_on_a_phone(tmp_path: Path) -> None:
    write_map_page(charted(plane=None), tmp_path / "map.html")
    with Browser(tmp_path / "map.html", (1000, 700)) as browser:
        browser.do("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=2, mobile=True)
        browser.js("mapPage.show(20); mapPage.pick(9)")
        assert words(browser, "time") == "200 s" and words(browser, "zone") == ""
        assert " m  y " in browser.js("document.getElementById('object').textContent")
        assert words(browser, "credit") == ""
        browser.until("document.getElementById('chart').clientWidth <= 390")
        assert browser.js("document.documentElement.scrollWidth") <= 390
        assert not browser.errors


# ---- the picture ----


@pytest.mark.slow
def test_the_number_of_drawn_paths_does_not_grow_with_objects() -> None:
    pytest.importorskip("matplotlib", reason="charts need the extra sameas[plots]")
    from sameas.plots.map import chart

    few, many = (chart(charted(vessels, 3)).axes[0] for vessels in (40, 160))
    texts = [len(axes.texts) for axes in (few, many)]
    assert len(many.get_children()) - texts[1] <= len(few.get_children()) - texts[0] + 30


@pytest.mark.slow
@pytest.mark.parametrize("plane", [SOLENT, None, LocalPlane(89.6, 40.0), LocalPlane(-17.5, 179.9)])
def test_the_chart_is_drawn_anywhere(plane: LocalPlane | None, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib", reason="plots need the extra sameas[plots]")
    from sameas.plots import save
    from sameas.plots.map import chart

    sheet = charted(6, 6, plane=plane, names={1: "$x_1$ <b>"})
    figure = chart(sheet, sheet.instants_s[3])
    assert figure.get_suptitle().startswith(f"{sheet.title}: 6 objects")
    texts = [text.get_text() for text in figure.axes[0].texts]
    assert "$x_1$ <b>" in texts and "harbour radar" in texts and "N" in texts
    assert any("Natural Earth" in text for text in texts) == (plane is not None)
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert labels[0].startswith("harbour radar (") and any("ahead" in label for label in labels)
    save(figure, tmp_path / "map.png")
    assert (tmp_path / "map.png").stat().st_size > 20_000


def test_long_names_of_sources_stay_inside_the_chart() -> None:
    """Title and legend were cut off at the sides."""
    pytest.importorskip("matplotlib", reason="charts need the extra sameas[plots]")
    from sameas.plots.map import chart

    plain = charted(6, 6)
    names = {sensor.name: f"long-range surveillance radar of {sensor.name} 80/12" for sensor in plain.sensors}
    sources = np.array([names[str(source)] for source in plain.records["source"]])
    sensors = tuple(replace(sensor, name=names[sensor.name]) for sensor in plain.sensors)
    records = {**plain.records, "source": sources}
    figure = chart(replace(plain, title=", ".join(names.values()), sensors=sensors, records=records))
    figure.draw_without_rendering()
    for part in (*figure.texts, *figure.legends):
        box = part.get_window_extent()
        assert box.x0 >= 0 and box.x1 <= figure.bbox.x1
    assert len(figure.legends) == 1


def test_chart_and_page_agree_on_objects_seen_by_several() -> None:
    pytest.importorskip("matplotlib", reason="charts need the extra sameas[plots]")
    from sameas.plots.map import chart

    sheet = charted(6, 6)
    now = sheet.instant_of(sheet.objects) == 3
    several = int((sheet.objects["n_sources"][now] > 1).sum())
    assert several > 1
    first = int(np.flatnonzero(now & (sheet.objects["n_sources"] > 1))[0])
    sheet.objects["probability"][first] = 0.3
    assert f"{several - 1} seen by two or more sources" in chart(sheet, sheet.instants_s[3]).get_suptitle()


def test_a_users_coastline_replaces_the_default() -> None:
    island = np.array([[0.0, 0.0], [900.0, 0.0], [900.0, 900.0]])
    sheet = replace(charted(3, 3), ground=Outline((island,), (island,)))
    page = map_page(sheet)
    assert '"land":[[0,0,900,0,900,900]]' in page and "Natural Earth, ±" not in page


def test_the_chart_says_which_objects_are_tentative() -> None:
    """They had a paler mark that the legend did not explain."""
    pytest.importorskip("matplotlib", reason="charts need the extra sameas[plots]")
    from sameas.plots.map import chart

    for stage, has in (("tentative", True), ("coasting", False)):
        objects = {"time_s": [0.0, 0.0], "object": [1, 2], "stage": ["confirmed", stage]}
        objects |= {"x_m": [0.0, 100.0], "y_m": [0.0, 80.0]}
        figure = chart(MapSheet.of("Harbour", {name: np.array(column) for name, column in objects.items()}, {}))
        labels = [text.get_text() for text in figure.legends[0].get_texts()]
        assert ("tentative" in labels) == has and labels[-2:] == ["ambiguous", "coasting"]
        marks = [line for line in figure.axes[0].lines if line.get_marker() == "o" and line.get_alpha() == 0.6]
        assert bool(marks) == has
