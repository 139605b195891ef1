"""Chart tiles of the user below the live map: at their places, fluent, and behind the rules of the server (slow)."""

import json
import sqlite3
from contextlib import closing

import numpy as np
import pytest
from tests.browser import CHROMIUM, Browser
from tests.live.conftest import SITE, replay, served, settings
from tests.live.test_server import ask

from sameas.live.keeper import Keeper
from sameas.live.server import Access
from sameas.pages import png
from sameas.tracks.coordinates import LocalPlane

ZOOMS = range(9, 15)


def grey(zoom, column, row):
    """A grey of its own for neighbouring tiles."""
    return 30 + (zoom * 53 + column * 31 + row * 71) % 200


def places(lat, lon, zoom):
    """Column and row of places in Web Mercator tiles, with fractions."""
    lat = np.radians(lat)
    return (np.asarray(lon) + 180.0) / 360.0 * 2**zoom, (0.5 - np.arcsinh(np.tan(lat)) / (2.0 * np.pi)) * 2**zoom


def tile_file(path, pictures, about):
    """An MBTiles file of {(zoom, column, row): picture}."""
    rows = [(zoom, column, (1 << zoom) - 1 - row, picture) for (zoom, column, row), picture in pictures.items()]
    with closing(sqlite3.connect(path)) as base, base:
        base.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        base.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        base.execute("CREATE INDEX place ON tiles (zoom_level, tile_column, tile_row)")
        base.executemany("INSERT INTO metadata VALUES (?, ?)", list(about.items()))
        base.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)


@pytest.fixture
def chart(tmp_path):
    """Tiles of one grey each within half a degree of the radar; every fifth is missing at the deepest zoom."""
    path, rows = tmp_path / "harbour.mbtiles", {}
    for zoom in ZOOMS:
        (west, south), (east, north) = (places(SITE[0] + d, SITE[1] - s * 0.5, zoom) for d, s in ((-0.4, 1), (0.4, -1)))
        for column in range(int(west), int(east) + 1):
            for row in range(int(north), int(south) + 1):
                if zoom < max(ZOOMS) or (column + row) % 5:
                    rows[zoom, column, row] = png(np.full((256, 256), grey(zoom, column, row), np.uint8))
    about = {"name": "harbour", "format": "png", "attribution": "<b>&copy; Harbour office</b>"}
    tile_file(path, rows, about)
    return path


@pytest.fixture
def charted(tmp_path, chart):
    """A keeper whose map has the chart."""
    made = Keeper(settings(chart=(str(chart),)), tmp_path / "state", replay=replay(until_s=2400.0))
    yield made
    if made.store.journal is not None:
        made.close()


@pytest.mark.slow
def test_tiles_are_served_behind_the_token(charted):
    zoom = 12
    column, row = (int(v) for v in places(*SITE, zoom))
    with served(charted, Access("0.0.0.0", "op", "view")) as url:
        assert ask(f"{url}/chart/0/{zoom}/{column}/{row}")[0] == 401
        status, headers, _ = ask_bytes(f"{url}/chart/0/{zoom}/{column}/{row}", Authorization="Bearer view")
        assert status == 200 and headers["content-type"] == "image/png"
        assert headers["x-content-type-options"] == "nosniff" and headers["cache-control"] == "private, max-age=600"
        assert ask_bytes(f"{url}/chart/0/{zoom}/0/0", Authorization="Bearer view")[0] == 204
        assert ask_bytes(f"{url}/chart/0/99/0/0", Authorization="Bearer view")[0] == 204
        assert ask_bytes(f"{url}/chart/1/{zoom}/{column}/{row}", Authorization="Bearer view")[0] == 404
        assert ask_bytes(f"{url}/chart/0/{zoom}/{column}/../../etc", Authorization="Bearer view")[0] == 404


def ask_bytes(url, **headers):
    import urllib.error
    import urllib.request

    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers), timeout=10.0) as answer:
            return answer.status, {k.lower(): v for k, v in answer.headers.items()}, answer.read()
    except urllib.error.HTTPError as error:
        return error.code, dict(error.headers), error.read()


@pytest.mark.slow
def test_a_watch_without_tiles_serves_none(keeper):
    with served(keeper) as url:
        assert ask(f"{url}/chart/0/1/0/0")[0] == 404


#: Screen places and their greys, well inside the chart and away from symbols.
READ = """(() => {
  const c = document.getElementById('chart'), q = c.getContext('2d'), ratio = devicePixelRatio, out = [];
  const own = mapPage.live.present.own, [ownU, ownV] = mapPage.toScreen(own.x, own.y);
  const symbols = [{ u: ownU, v: ownV }, ...mapPage.hits];
  for (let u = 300; u < c.clientWidth - 120; u += 23) for (let v = 90; v < c.clientHeight - 90; v += 19) {
    if (symbols.some(h => Math.hypot(h.u - u, h.v - v) < 45)) continue;
    const d = q.getImageData(Math.round(u * ratio), Math.round(v * ratio), 1, 1).data;
    out.push([...mapPage.toMetres(u + 0.5 / ratio, v + 0.5 / ratio), d[0], d[1], d[2]]);
  }
  return out;
})()"""
ONLY_THE_CHART = """for (const e of document.querySelectorAll('[data-layer]'))
  if (e.dataset.layer !== 'chart' && e.checked) e.click();
for (const id of ['ring', 'vector', 'trail']) {
  const e = document.getElementById(id);
  e.value = id === 'ring' ? '' : '0';
  e.dispatchEvent(new Event('change'));
}
document.getElementById('legend').open = false;
document.documentElement.classList.contains('night') && document.getElementById('theme').click();"""


def matches(page, zoom):
    """Share of places whose colour is that of the tile there, of those more than two pixels from a tile's edge."""
    read, deepest = np.array(page.js(READ)), max(ZOOMS)
    plane = LocalPlane(*page.js("mapPage.earth.toEarth(0, 0)"))
    lat, lon = plane.to_geodetic(read[:, :2])
    expected, inside = np.full(len(read), -1), np.ones(len(read), bool)
    for level in range(min(zoom, deepest), min(ZOOMS) - 1, -1):
        columns, rows = places(lat, lon, level)
        has = (level < deepest) | ((columns.astype(int) + rows.astype(int)) % 5 != 0)
        new = has & (expected < 0)
        expected[new] = [
            grey(level, c, r) for c, r in zip(columns[new].astype(int), rows[new].astype(int), strict=True)
        ]
        edge = (
            np.minimum(np.abs(columns - np.round(columns)), np.abs(rows - np.round(rows))) * 256 * 2.0 ** (zoom - level)
        )
        inside &= edge > 3.0
    right = np.abs(read[inside, 2:] - expected[inside, None]).max(axis=1) <= 3
    assert inside.sum() > 300
    return right.mean()


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_tiles_lie_at_their_places_at_every_zoom_and_their_credit_is_shown(charted):
    with served(charted) as url, Browser(url) as page:
        page.until("mapPage.live && mapPage.live.tick > 3")
        page.js(ONLY_THE_CHART)
        for zoom in (9, 10, 12, 14, 16):
            # Pixels per metre at which this zoom is drawn, off by a factor: tiles are scaled, too.
            scale = 256 * 2.0**zoom / (40_075_017 * np.cos(np.radians(SITE[0]))) * 1.21
            page.js(f"mapPage.view.scale = {scale}; mapPage.view.x = 3000; mapPage.view.y = -2000; mapPage.paint()")
            page.until("mapPage.chartIsDrawn()")
            scale = page.js("mapPage.view.scale")
            drawn = round(np.log2(scale * 40_075_017 * np.cos(np.radians(SITE[0])) / 256))
            assert matches(page, drawn) == 1.0, zoom
        assert page.js("document.getElementById('credit').textContent").startswith("chart: © Harbour office")
        # At night the chart is dim.
        by_day = np.array(page.js(READ))[:, 2:].mean()
        page.js("document.getElementById('theme').click()")
        page.until("mapPage.chartIsDrawn()")
        assert np.array(page.js(READ))[:, 2:].mean() < 0.4 * by_day
        page.js("document.querySelector('[data-layer=chart]').click()")
        page.settle()
        assert page.errors == [] and page.complaints == []
        assert all(one.startswith(url) for one in page.requests if "about:" not in one)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_panning_over_a_chart_copies_its_tiles_and_asks_for_each_once(charted):
    with served(charted) as url, Browser(url) as page:
        page.until("mapPage.live && mapPage.live.tick > 3 && mapPage.chartIsDrawn()")
        page.js("""window.made = 0;
          const own = document.createElement.bind(document);
          document.createElement = (...a) => (a[0] === 'canvas' && window.made++, own(...a));""")
        steps = page.do("Runtime.evaluate", awaitPromise=True, returnByValue=True, expression="""(async () => {
          for (let k = 0; k < 60; k++) {
            mapPage.view.x += 3 / mapPage.view.scale;
            mapPage.paint();
            await new Promise(requestAnimationFrame);
          }
          return window.made;
        })()""")["result"]["value"]  # fmt: skip
        # 180 pixels: a row or a column of new tiles, while sixty frames were drawn.
        assert steps < 30
        asked = [one for one in page.requests if "/chart/" in one]
        assert 4 <= len(asked) == len(set(asked))


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_chart_with_tiles_that_failed_is_not_said_to_be_drawn(charted):
    with served(charted) as url, Browser(url) as page:
        page.until("mapPage.live && mapPage.live.tick > 3 && mapPage.chartIsDrawn()")
        page.js("""window.failed = 0; const own = window.fetch;
          window.fetch = (at, ...a) =>
            String(at).startsWith('chart/') ? (window.failed++, Promise.reject()) : own(at, ...a);
          mapPage.view.scale /= 4; mapPage.paint()""")
        page.until("window.failed > 0")
        page.settle()
        assert not page.js("mapPage.paint(); mapPage.chartIsDrawn()")


BOX = [[-1.6, 50.3], [-0.3, 50.3], [-0.3, 50.8], [-1.6, 50.8], [-1.6, 50.3]]
LINES = [{"type": "Polygon", "coordinates": [BOX]},
         {"type": "LineString", "coordinates": [[-0.96, 50.5], [-0.92, 50.5]]}]  # fmt: skip


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_charts_lie_on_each_other_and_each_can_be_switched_off(chart, tmp_path):
    files = [tmp_path / name for name in ("land.geojson", "above.mbtiles", "fairway.geojson")]
    for path, feature in ((files[0], 0), (files[2], 1)):
        path.write_text(json.dumps(LINES[feature]))
    above = {(12, *(int(v) for v in places(*SITE, 12))): png(np.full((256, 256), 255, np.uint8))}
    tile_file(files[1], above, {"format": "png", "attribution": "Pilots"})
    order = tuple(map(str, (files[0], chart, files[1], files[2])))
    keeper = Keeper(settings(chart=order), replay=replay(until_s=2400.0))
    with served(keeper) as url, Browser(url) as page:
        page.until("mapPage.live && mapPage.live.tick > 3")
        names = page.js(
            "[...document.querySelectorAll('[data-layer^=chart]')].map(e => e.parentNode.textContent.trim())"
        )
        assert names == ["fairway", "above", "harbour", "land"]
        page.js(ONLY_THE_CHART.replace("!== 'chart'", ".slice(0, 5) !== 'chart'"))
        scale = 256 * 2.0**12 / (40_075_017 * np.cos(np.radians(SITE[0])))
        # Beside own ship, in the one tile of the upper chart; and where the fairway is.
        page.js(f"mapPage.view.scale = {scale}; mapPage.view.x = 0; mapPage.view.y = 0; mapPage.paint()")
        page.until("mapPage.chartIsDrawn()")

        def colour(number=None):
            """The most frequent one at the places, over some of which ships pass, after a click on a tick."""
            if number is not None:
                page.js(f"document.querySelector('[data-layer=\"chart {number}\"]').click()")
            page.until("mapPage.chartIsDrawn()")
            page.js("mapPage.paint()")
            read = page.js("""(() => { const c = document.getElementById('chart'), r = devicePixelRatio;
              return PLACES.map(p => mapPage.toScreen(...p)).map(([u, v]) =>
                [...c.getContext('2d').getImageData(Math.round(u * r), Math.round(v * r), 1, 1).data]); })()
              """.replace("PLACES", json.dumps(at)))  # fmt: skip
            return max(read, key=read.count)

        west, north = (int(v) for v in places(*SITE, 12))
        lon, lat = (west + 0.3) / 2**12 * 360.0 - 180.0, None
        y = (north + 0.3) / 2**12
        lat = np.degrees(np.arctan(np.sinh(np.pi * (1.0 - 2.0 * y))))
        plane = LocalPlane(*page.js("mapPage.earth.toEarth(0, 0)"))
        middle = plane.of_geodetic([lat], [lon])[0]
        at = [(middle + 300.0 * np.array([i, j])).tolist() for i in range(-2, 3) for j in range(-2, 3)]
        assert colour() == [255, 255, 255, 255]
        shade = grey(12, west, north)
        assert np.abs(np.array(colour(3)[:3]) - shade).max() <= 3
        land = colour(2)
        assert np.ptp(land[:3]) > 0 or abs(land[0] - shade) > 3
        assert colour(1) != land
        # The fairway: its line is there with its tick alone.
        at = plane.of_geodetic([50.5] * 9, np.linspace(-0.955, -0.925, 9)).tolist()
        on = colour()
        assert colour(4) != on and colour(4) == on
        assert page.js("document.getElementById('credit').textContent").startswith("chart: © Harbour office, Pilots")
        assert page.errors == [] and page.complaints == []
