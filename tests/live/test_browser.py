"""The live map in a real browser (slow)."""

import json
import socket
import threading
import time
from dataclasses import replace

import pytest
from tests.browser import CHROMIUM, Browser
from tests.live.conftest import EVIL, harbour, replay, served, settings
from tests.live.test_inputs import free_port

from sameas.live.keeper import Keeper
from sameas.live.replay import Replay
from sameas.live.server import Access
from sameas.live.settings import read_settings
from sameas.live.situation import Alarm, Situation
from sameas.picture.live import Registered
from sameas.registration import Parameter
from sameas.tracks.registration import SourceBiases

pytestmark = [pytest.mark.slow, pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")]


def test_the_map_updates_shows_the_past_and_runs_no_markup_in_names(keeper, tmp_path):
    with served(keeper) as url, Browser(url) as page:
        page.until("mapPage.live && mapPage.live.tick > 8 && document.body.dataset.live === 'yes'")
        first = page.js("mapPage.live.tick")
        page.until(f"mapPage.live.tick > {first + 4}")
        assert page.js("mapPage.now.time") == pytest.approx(page.js("mapPage.live.present.t"), abs=21.0)
        # A name with markup stays text.
        page.until(f"[...document.querySelectorAll('#rows .label')].some(e => e.textContent === {EVIL!r})")
        assert page.js("document.querySelectorAll('img').length") == 0
        number = next(n for n, row in keeper.situation.object_rows.items() if EVIL in row)
        page.js(f"mapPage.pick({number})")
        page.until(f"document.querySelector('#object h2')?.textContent === {EVIL!r}")
        page.until("document.querySelector('#object pre')?.textContent.includes('probability')")
        assert page.js("document.getElementById('live-state').textContent") == "replay"
        assert len(page.js("mapPage.now.marks.length && [...mapPage.now.members.values()].map(m => m.length)")) == 5
        # Going back holds the instant; the present goes on behind it.
        page.until("document.getElementById('slider').max > 3")
        page.js("(s => { s.value = 0; s.dispatchEvent(new Event('input')); })(document.getElementById('slider'))")
        held = page.js("mapPage.now.time")
        tick = page.js("mapPage.live.tick")
        page.until(f"mapPage.live.tick > {tick + 3}")
        assert page.js("mapPage.now.time") == held and page.js("document.body.dataset.live") == "back"
        # Records, evidence and approaches are those of the present: none of them is shown for the past.
        of_object = "document.querySelector('#object').textContent"
        page.until(f"{of_object}.includes('records are kept for the present only')")
        page.until("!document.querySelector('#object pre')")
        assert not page.js(f"{of_object}.includes('CPA')")
        page.js("document.getElementById('play').click()")
        page.until("document.body.dataset.live === 'yes' && mapPage.now.time > " + str(held))
        assert page.errors == [] and all(one.startswith(url) for one in page.requests if "about:" not in one)
        page.picture(tmp_path / "live.png")
        assert (tmp_path / "live.png").stat().st_size > 20_000


def test_a_viewer_sees_alarms_and_an_operator_acknowledges_them(keeper):
    keeper.settings.watch.__dict__.update(cpa_m=1e5, tcpa_s=1e5)
    with served(keeper, Access("0.0.0.0", "op", "view")) as url:
        for token, buttons in (("view", False), ("op", True)):
            with Browser(f"{url}/?token={token}") as page:
                page.until("mapPage.live && document.querySelectorAll('#alarms li').length > 0")
                assert bool(page.js("document.querySelectorAll('#alarms .acknowledge').length")) == buttons
                if not buttons:  # the first page: later no alarm may be active any more
                    # An active alarm shows the present closest approach as well as the one when it was raised, and the
                    # tab counts what the button counts: the active alarms, not the past ones.
                    current = "[...document.querySelectorAll('#alarms li.current')]"
                    page.until(f"{current}.some(e => / – now \\d+ m in \\d+\\.\\d min/.test(e.textContent))", 60.0)
                    counted = "+(document.querySelector('#tab-alarms span')?.textContent ?? 0)"
                    assert page.js(f"{current}.length === {counted}")
                assert page.js("location.search") == "" and page.js("document.cookie") == ""
                if buttons:
                    page.js("document.querySelector('#alarms .acknowledge').click()")
                    page.until("document.querySelector('#alarms').textContent.includes('acknowledged')")
        assert any(one["acknowledged_by"] for one in keeper.alarm_list())


def test_the_page_reports_a_lost_connection(keeper):
    with served(keeper) as url, Browser(url) as page:
        page.until("mapPage.live && document.body.dataset.live === 'yes'")
        keeper.tick = lambda now_s=None: None
        keeper.deltas.clear()
        page.js("{ const now = performance.now.bind(performance); performance.now = () => now() + 4500; }")
        page.until("document.body.dataset.live === 'broken'", patience_s=20.0)
        assert "no news" in page.js("document.getElementById('live-state').textContent")


def test_ranges_are_from_own_ship_and_an_approach_at_the_limit_is_one_alarm(keeper, monkeypatch):
    keeper.settings.watch.__dict__.update(cpa_m=500.0, tcpa_s=1200.0)
    metres = {"now": 450.0}

    def approach(situation):
        numbers, mmsi = situation.objects["object"].tolist(), situation.objects["mmsi"].tolist()
        return {n: (metres["now"], 300.0) for n, m in zip(numbers, mmsi, strict=True) if m == "235000111"}

    monkeypatch.setattr(Situation, "cpa", property(approach))
    with served(keeper) as url, Browser(url) as page:
        page.until("mapPage.live && document.querySelectorAll('#alarms li.current').length === 1", 60.0)
        # Ranges and bearings are from own ship, unless the user chooses another centre.
        assert page.js("document.getElementById('ring').value") == "own"
        number = next(n for n, row in keeper.situation.object_rows.items() if EVIL in row)
        page.js(f"mapPage.pick({number})")
        page.until("document.querySelector('#object')?.textContent.includes('From own ship')")
        facts = "document.querySelector('#object').textContent"
        assert page.js(f"{facts}.includes('TCPA')") and "°" in page.js(facts)
        # The list has the closest approach of the ship that has one, in nautical miles.
        heads = "[...document.querySelectorAll('#list th')]"
        place = page.js(f"{heads}.findIndex(e => e.textContent.startsWith('CPA'))")
        assert place > 0
        cells = f"[...document.querySelectorAll('#rows tr')].map(e => e.children[{place}]?.textContent)"
        page.until(f"{cells}.filter(e => e).join() === '0.24'")
        # Within 1.2 times the limit and 0.3 m/s of the time to it an active alarm stays; beyond, it ends.
        metres["now"] = 580.0
        page.until(f"{cells}.filter(e => e).join() === '0.31'")
        tick = page.js("mapPage.live.tick")
        page.until(f"mapPage.live.tick > {tick + 6}")
        assert page.js("document.querySelectorAll('#alarms li.current').length") == 1
        metres["now"] = 700.0
        page.until("document.querySelectorAll('#alarms li.current').length === 0")
        # It is not raised again before the limit itself.
        metres["now"] = 580.0
        tick = page.js("mapPage.live.tick")
        page.until(f"mapPage.live.tick > {tick + 6}")
        assert page.js("document.querySelectorAll('#alarms li.current').length") == 0
        assert len([one for one in keeper.alarm_list() if one["kind"] == "cpa"]) == 1 and page.errors == []


def test_the_page_shows_the_offsets_of_the_sensors_and_an_operator_holds_them(keeper):
    azimuth = {"azimuth_deg": Parameter(1.5, 0.1, "deg")}
    keeper.picture.take_off(Registered((SourceBiases("radar", ("ais",), azimuth, established=False),)))
    with served(keeper) as url, Browser(url) as page:
        sensors = "document.getElementById('summary').textContent"
        page.until(f"mapPage.live && {sensors}.includes('azimuth +1.500 ± 0.100°not established, not subtracted')")
        page.js("document.querySelector('.sensor > button').click()")
        page.until(f"{sensors}.includes('not subtracted, held')")
        assert keeper.picture.held == {"radar"}
        # One is set: a value in nautical miles, then one that is refused.
        form = "document.querySelectorAll('.sensor form')[1]"
        page.js(f"{form}.closest('details').open = true; {form}[0].value = 'range_m'; "
                f"{form}[0].dispatchEvent(new Event('change')); {form}[1].value = '0.05'; {form}[2].value = 'nm'; "
                f"{form}.requestSubmit()")  # fmt: skip
        page.until(f"{sensors}.includes('range +92.6 m set by handsubtracted, held')")
        page.js(f"{form}.closest('details').open = true; {form}[0].value = 'azimuth_deg'; {form}[1].value = '400'; "
                f"{form}[0].dispatchEvent(new Event('change')); {form}.requestSubmit()")  # fmt: skip
        page.until(f"{form}.textContent.includes('azimuth_deg is 400')")
        assert page.errors == []


def test_a_page_that_was_opened_before_the_first_reports_shows_them_where_they_are(tmp_path):
    port = free_port(socket.SOCK_DGRAM)
    path = tmp_path / "sensors.toml"
    path.write_text(
        "[watch]\nevery_s = 0.25\nregister_every_s = 0\nfaults_every_s = 0\n"
        f'[sources.coast]\nkind = "ais"\ninput = {{ url = "udp://127.0.0.1:{port}", format = "table" }}\n'
    )
    keeper, at = Keeper(read_settings(path)), {1: (50.8, -1.3), 2: (50.82, -1.25)}
    over = threading.Event()

    def send():
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not over.wait(0.3):
                for ship, (lat, lon) in list(at.items()):
                    row = {"time": time.time(), "mmsi": f"23500{ship}111", "lat": lat, "lon": lon, "sog": 0, "cog": 0}
                    sender.sendto(json.dumps(row).encode() + b"\n", ("127.0.0.1", port))

    with served(keeper) as url, Browser(url) as page:
        sending = threading.Thread(target=send)
        try:
            page.until("mapPage.live && mapPage.live.tick > 2")
            assert not page.js("!!mapPage.earth")
            page.js("document.getElementById('theme').click()")
            night = page.js("document.documentElement.classList.contains('night')")
            sending.start()
            page.until("document.body?.dataset.ready === 'yes' && mapPage.earth && mapPage.now.rows.length === 2", 60.0)
            # The colours stay; both ships are on the chart.
            assert page.js("document.documentElement.classList.contains('night')") == night
            shown = "((u, v) => u > 0 && v > 0 && u < mapPage.view.w && v < mapPage.view.h)"
            place = "...mapPage.toScreen(mapPage.objects.x[r], mapPage.objects.y[r])"
            page.until(f"[...mapPage.now.rows].every(r => {shown}({place}))")
            # One that comes up beyond what could be shown: the page grows, and keeps what is looked at.
            page.js("sessionStorage.clear(); window.former = true; mapPage.view.scale *= 2; mapPage.paint()")
            scale = page.js("mapPage.view.scale")
            at[3] = (52.5, 1.0)
            page.until(
                "!window.former && document.body?.dataset.ready === 'yes' && mapPage.now?.rows.length === 3", 60.0
            )
            page.until(f"Math.abs(mapPage.view.scale - {scale}) < 1e-9")
            assert page.js("mapPage.view.least") < 0.01
            assert page.errors == [] and page.complaints == []
        finally:
            over.set()
            sending.join()


def test_a_ship_has_nautical_miles_and_vectors_of_six_minutes_however_near_all_else_is(tmp_path):
    """A page that was opened with one ship beside own ship had kilometres, and vectors of five seconds."""
    keeper = Keeper(settings(), tmp_path / "state", replay=replay(pace=1.0, ships=1, seed=16))
    with served(keeper) as url, Browser(url) as page:
        page.until("mapPage.live && document.querySelectorAll('#rows tr[data-number]').length === 1", 60.0)
        page.js("mapPage.pick(+document.querySelector('#rows tr[data-number]').dataset.number)")
        page.until("/From own ship.*nm/.test(document.querySelector('#object')?.textContent)")
        assert page.js("document.getElementById('vector').value") == "360"
    keeper.close()


def test_own_ship_is_shown_with_her_speed_and_alarms_that_nobody_acknowledged_are_first(keeper):
    keeper.settings.watch.__dict__.update(cpa_m=1e5, tcpa_s=1e5)
    with served(keeper) as url, Browser(url) as page:
        page.until("mapPage.live && document.querySelectorAll('#alarms li.current').length > 1", 60.0)
        assert page.js("document.getElementById('own-ship').textContent") == "own ship 0.0 kn"
        heads = page.js("[...document.querySelectorAll('#list th')].map(e => e.textContent)")
        assert "CPA nm" in heads and "TCPA min" in heads
        page.until("document.title.startsWith('⚠ ')")
        first = page.js("document.querySelector('#alarms li > button').textContent").split(" – ")[0]
        page.js("document.querySelector('#alarms .acknowledge').click()")
        # The one that was acknowledged goes behind the others.
        texts = "[...document.querySelectorAll('#alarms li')].map(e => e.textContent)"
        page.until(f"{texts}[0] && !{texts}[0].startsWith({first!r})")
        # When all are, the button is no longer filled.
        page.until(
            "(document.querySelector('#alarms li.current .acknowledge')?.click(), "
            "document.querySelectorAll('#alarms li.current .acknowledge').length === 0)",
            60.0,
        )
        page.until("document.getElementById('alarm-button').classList.contains('acknowledged')")
        assert not page.js("document.title").startswith("⚠") and page.errors == []


def test_a_crowd_of_forged_ships_is_folded_and_hides_no_other_alarm(keeper, monkeypatch):
    silent = Alarm("silent coast", "source", "coast has sent no report")
    forged = [Alarm(f"identity mmsi {k}", "identity", f"MMSI {k} is forged") for k in range(130)]
    ticks = iter([[silent]])
    monkeypatch.setattr("sameas.live.keeper.identity_alarms", lambda state: next(ticks, [silent, *forged]))
    with served(keeper) as url, Browser(url) as page:
        page.until("document.querySelectorAll('#alarms li.current').length === 131")
        rows = "[...document.querySelectorAll('#alarms > ul > li')].map(e => e.textContent)"
        page.until(f"{rows}.length === 7")
        shown = page.js(rows)
        assert any("coast has sent no report" in one for one in shown)
        assert any("and 125 more of identity" in one for one in shown)
        # An open one stays open when the list changes.
        page.js("document.querySelector('#alarms details').open = true")
        page.js("document.querySelector('#alarms > ul > li .acknowledge').click()")
        page.until("document.querySelector('#alarms details')?.textContent.includes('124 more')", 30.0)
        assert page.js("document.querySelector('#alarms details').open")
        [button] = ["[...document.querySelectorAll('#alarms .acknowledge')].find(e => / all /.test(e.textContent))"]
        page.js(f"{button}.click()")
        page.until("[...document.querySelectorAll('#alarms .acknowledge')].length === 1", 60.0)
        assert "coast" in page.js("document.querySelector('#alarms .acknowledge').closest('li').textContent")
        assert page.errors == []


def test_keys_go_back_in_time_open_the_alarms_and_choose_colours_that_stay(keeper):
    with served(keeper) as url, Browser(url) as page:

        def key(name):
            page.do("Input.dispatchKeyEvent", type="keyDown", key=name, code=name)
            page.do("Input.dispatchKeyEvent", type="keyUp", key=name, code=name)

        page.until("mapPage.live && document.getElementById('slider').max > 2")
        key("ArrowLeft")
        page.until("document.body.dataset.live === 'back'")
        held, tick = page.js("mapPage.now.time"), page.js("mapPage.live.tick")
        page.until(f"mapPage.live.tick > {tick + 3}")
        assert page.js("mapPage.now.time") == held
        key(" ")
        page.until(f"document.body.dataset.live === 'yes' && mapPage.now.time > {held}")
        key("Home")
        page.until("document.body.dataset.live === 'back' && mapPage.now.k === 0")
        key("a")
        page.until("!document.getElementById('alarms').hidden")
        night = "document.documentElement.classList.contains('night')"
        before = page.js(night)
        key("d")
        assert page.js(night) != before
        page.do("Page.reload")
        page.until("document.body?.dataset.ready === 'yes'")
        page.until(f"{night} === {str(not before).lower()}")
        assert page.errors == []


def test_on_a_tablet_own_ship_is_not_covered_and_dangers_are_first(keeper):
    keeper.settings.watch.__dict__.update(cpa_m=1500.0, tcpa_s=1e5)
    with served(keeper) as url, Browser(url, (1024, 768)) as page:
        page.until("mapPage.live && document.querySelectorAll('#alarms li.current').length", 60.0)
        assert page.js("document.getElementById('legend').open") is False
        rows = "[...document.querySelectorAll('#rows tr[data-number]')]"
        page.until(f"{rows}[0]?.classList.contains('alarmed') && !{rows}.at(-1).classList.contains('alarmed')", 60.0)
        assert page.js("document.querySelector('#list th[aria-sort=ascending]').dataset.key") == "cpa"
        assert page.errors == []


@pytest.mark.parametrize("size", [(1280, 800), (390, 844)])
def test_the_first_view_is_about_own_ship_wherever_the_others_are(keeper, size):
    with served(keeper) as url, Browser(url, size) as page:
        page.until("mapPage.live?.present.own && mapPage.now?.rows.length > 1", 60.0)
        # The others are within miles of her, to one side.
        off = "(([u, v]) => Math.hypot(u - mapPage.view.w / 2, v - mapPage.view.h / 2))"
        own = "mapPage.toScreen(mapPage.live.present.own.x, mapPage.live.present.own.y)"
        page.until(f"{off}({own}) < 20")
        each = "mapPage.toScreen(mapPage.objects.x[r], mapPage.objects.y[r])"
        assert page.js(f"mapPage.now.rows.every(r => {off}({each}) < Math.hypot(mapPage.view.w, mapPage.view.h) / 2)")
        assert page.errors == []


def test_in_a_crowd_what_is_in_an_alarm_has_its_name(monkeypatch):
    alarmed = [f"23500{ship}111" for ship in (9, *range(90, 100))]
    reports = harbour(ships=150, until_s=60.0)
    reports["ais"] = replace(reports["ais"], name=reports["ais"].mmsi)

    def approach(situation):
        numbers, mmsi = situation.objects["object"].tolist(), situation.objects["mmsi"].tolist()
        return {n: (100.0, 300.0) for n, m in zip(numbers, mmsi, strict=True) if m in alarmed}

    monkeypatch.setattr(Situation, "cpa", property(approach))
    given = settings(cpa_m=500.0, tcpa_s=1200.0, faults_every_s=0.0)
    keeper = Keeper(given, replay=Replay(list(reports.items()), 5.0))
    with served(keeper) as url, Browser(url, (1280, 800)) as page:
        page.until(f"mapPage.live && mapPage.now?.alarmed.size === {len(alarmed)}", 60.0)
        page.js("""(() => {
            const write = CanvasRenderingContext2D.prototype.fillText;
            CanvasRenderingContext2D.prototype.fillText = function (...given) {
                (window.written ||= new Set()).add(given[0]);
                return write.apply(this, given);
            };
            mapPage.view.scale = 0.06;
            mapPage.paint();
        })()""")
        page.until("window.written?.size > 30")
        # Names may cover symbols, but not each other: one of the eleven has no place. Before, nine had none.
        page.until(f"{json.dumps(alarmed)}.filter(name => !window.written.has(name)).length <= 1")
        assert page.errors == []


#: Whether each row of the tables is where its frame and the row before it are, and the counts are those of the frames.
CONSISTENT = """(() => {
    const { objects, frames, counts } = mapPage.live.tables;
    let at = 0;
    frames.forEach((frame, k) => {
        for (const row of frame.objects.values()) {
            const before = objects.before[at];
            const older = frames.slice(0, k).filter(f => f.objects.has(row[0])).length;
            if (objects.n[at] !== row[0] || objects.t[at] !== k || objects.x[at] !== row[2]) at = NaN;
            else if ((before >= 0) !== older > 0) at = NaN;
            else if (before >= 0 && (objects.n[before] !== row[0] || objects.t[before] >= k)) at = NaN;
            at++;
        }
    });
    const counted = counts.length === frames.length && frames.every((f, k) => counts[k][0] <= f.objects.size);
    return at === objects.n.length && counted;
})()"""


def test_the_history_is_kept_row_by_row_and_forgotten_from_its_beginning():
    keeper = Keeper(settings(history_s=60.0), None, replay=replay(pace=40.0, until_s=6000.0))
    with served(keeper) as url, Browser(url) as page:
        page.until("mapPage.live && document.body.dataset.tick > 0")
        first = page.js("mapPage.live.tables.frames[0].t")
        for _ in range(8):  # a frame is kept every ten seconds, for a minute, and six pass in less than two seconds
            tick = page.js("+document.body.dataset.tick")
            page.until(f"+document.body.dataset.tick > {tick + 1}")
            assert page.js(CONSISTENT), page.js("mapPage.live.tables.frames.length")
        page.until(f"mapPage.live.tables.frames[0].t > {first} && mapPage.live.tables.frames.length > 4", 60.0)
        assert page.js(CONSISTENT) and page.errors == []


#: Mean opacity of the layer of objects about the place of every object on the chart.
LAYER = """(() => {
    const { layer, view, now, objects } = mapPage, spare = (layer.canvas.width - view.w) / 2;
    const c = layer.canvas.getContext('2d');
    const u = (view.x - layer.x) * view.scale + spare - 12, v = (layer.y - view.y) * view.scale + spare - 12;
    const inked = now.rows.map(r => mapPage.toScreen(objects.x[r], objects.y[r]))
        .filter(([a, b]) => a > 0 && b > 0 && a < view.w && b < view.h)
        .map(([a, b]) => c.getImageData(a + u, b + v, 24, 24).data.some((x, k) => k % 4 === 3 && x > 100));
    return [inked.filter(x => x).length, inked.length];
})()"""


def test_a_dragged_chart_takes_in_new_data_and_shows_every_object_meanwhile(keeper):
    with served(keeper) as url, Browser(url) as page:
        mouse = {"button": "left", "buttons": 1, "clickCount": 1}
        page.until("mapPage.live && +document.body.dataset.tick > 0 && mapPage.now.marks.length > 4")
        page.do("Input.dispatchMouseEvent", type="mousePressed", x=500, y=500, **mouse)
        ticks, seen = [], []
        for k in range(400):  # farther than the spare edge of the layer, and back
            if k >= 60 and ticks[-1] >= ticks[0] + 3:
                break
            page.do("Input.dispatchMouseEvent", type="mouseMoved", x=500 + 350 * abs(30 - k % 60) / 30, y=500, **mouse)
            page.settle()
            ticks.append(page.js("+document.body.dataset.tick"))
            seen.append(page.js(LAYER))
        # Within a frame or two the layer has what came meanwhile; objects at its edge appear once it is complete.
        assert ticks[-1] >= ticks[0] + 3
        assert page.js("mapPage.now.k") == page.js("+document.getElementById('slider').max")
        assert sum(inked for inked, _ in seen) >= 0.95 * sum(n for _, n in seen)
        released = {"type": "mouseReleased", "button": "left", "clickCount": 1}
        page.do("Input.dispatchMouseEvent", x=850, y=500, **released)
        page.settle()
        # After it, a click meets the object that is where it is drawn.
        page.js("mapPage.pick(null)")
        page.settle()
        hit = "mapPage.hits.find(h => !h.record && h.u > 60 && h.v > 60)"
        u, v, n = page.js(f"(hit => [hit.u, hit.v, hit.n])({hit})")
        box = page.js("(b => [b.left, b.top])(document.getElementById('chart').getBoundingClientRect())")
        page.do("Input.dispatchMouseEvent", type="mousePressed", x=box[0] + u, y=box[1] + v, **mouse)
        page.settle()  # while the first layer is painted
        page.do("Input.dispatchMouseEvent", x=box[0] + u, y=box[1] + v, **released)
        assert page.js("mapPage.picked") == n and page.js("mapPage.layer === null") and page.errors == []


#: How many pixels of a name are cut from its cell in the list; of an ambiguous object in an alarm.
CUT = """(name => {
    const cell = document.querySelector('#rows td.label'), row = cell.parentElement;
    const was = [cell.textContent, row.className];
    [cell.textContent, row.className] = [name, 'ambiguous alarmed'];
    const cut = cell.scrollWidth - cell.clientWidth;
    [cell.textContent, row.className] = was;
    return cut;
})"""


@pytest.mark.parametrize("size", [(1280, 800), (1024, 768), (820, 1180)])
def test_names_are_not_cut_and_a_page_fits_its_screen(size, keeper):
    with served(keeper) as url, Browser(url, size) as page:
        shape = {"width": size[0], "height": size[1], "deviceScaleFactor": 1, "mobile": False}
        page.do("Emulation.setDeviceMetricsOverride", **shape)
        page.until("mapPage.live && !!document.querySelector('.own-ship #rows td.label')")
        names = ["367800930", "SUNSET CROSSING"][: 1 if size[0] == 1024 else 2]
        assert [page.js(f"{CUT}({name!r})") for name in names] == [0] * len(names)
        # The chart, the list and the slider are in sight together.
        assert page.js("document.documentElement.scrollHeight - innerHeight") <= 0
        assert page.js("document.getElementById('list-scroll').clientHeight") > 180
        assert page.js("document.getElementById('chart').clientHeight") > 0.5 * size[1]
        assert page.errors == []


def test_a_source_in_an_alarm_is_marked_where_the_sources_are(keeper, monkeypatch):
    silent = [Alarm("silent radar", "source", "radar is silent for 61 s")]
    monkeypatch.setattr("sameas.live.keeper.identity_alarms", lambda state: list(silent))
    with served(keeper) as url, Browser(url) as page:
        marked = "[...document.querySelectorAll('#sources .faulty .name')].map(e => e.textContent).join()"
        page.until(f"mapPage.live && {marked} === 'radar'")
        assert page.js("document.querySelector('#sources .faulty').title") == "radar is silent for 61 s"
        page.js("document.getElementById('theme').click()")  # the list of sources is made anew
        assert page.js(marked) == "radar"
        silent.clear()
        page.until(f"{marked} === ''", 60.0)


def test_the_button_that_is_aimed_at_does_not_move_away(keeper, monkeypatch):
    keeper.settings.watch.__dict__.update(cpa_m=500.0, tcpa_s=1200.0)
    seconds = {"235000111": 300.0}

    def approach(situation):
        numbers, mmsi = situation.objects["object"].tolist(), situation.objects["mmsi"].tolist()
        return {n: (400.0, seconds[m]) for n, m in zip(numbers, mmsi, strict=True) if m in seconds}

    monkeypatch.setattr(Situation, "cpa", property(approach))
    with served(keeper) as url, Browser(url) as page:
        order = "[...document.querySelectorAll('#alarms li.current')].map(e => /SHIP 2/.test(e.textContent)).join()"
        page.until(f"mapPage.live && {order} === 'false'", 60.0)
        page.js("document.getElementById('tab-alarms').click()")
        box = "document.querySelector('#alarms .acknowledge').getBoundingClientRect()"
        x, y = page.js(f"(b => [b.left + 9, b.top + 9])({box})")
        page.do("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y)
        tick = page.js("mapPage.live.tick")
        seconds["235002111"] = 200.0
        page.until(f"mapPage.live.tick > {tick + 3}")
        assert page.js(order) == "false"
        page.click(x, y)
        page.until("document.querySelector('#alarms').textContent.includes('acknowledged')")
        done = [one["objects"] for one in keeper.alarm_list() if one["acknowledged_by"]]
        number = next(n for n, row in keeper.situation.object_rows.items() if EVIL in row)
        assert done == [[number]]
        page.until(f"{order} === 'true,false'")


def test_looking_back_shows_no_own_ship_of_now_and_the_alarms_of_now(keeper, monkeypatch):
    keeper.settings.watch.__dict__.update(cpa_m=0.1)
    past = [Alarm(f"identity mmsi {k}", "identity", f"MMSI {k} is forged") for k in range(3)]
    monkeypatch.setattr("sameas.live.keeper.identity_alarms", lambda state: list(past))
    with served(keeper) as url, Browser(url) as page:
        button = "document.getElementById('alarm-button')"
        number = next(iter(keeper.situation.object_rows))
        page.until(f"mapPage.live && {button}.textContent.includes('3 alarms')")
        page.until("document.getElementById('slider').max > 2")
        page.js(f"mapPage.pick({number})")
        page.until("document.querySelector('#object')?.textContent.includes('From own ship')")
        del past[1:]
        page.until(f"{button}.textContent.includes('1 alarm')", 60.0)
        for instant in range(3):  # the others began at one of these
            slide = f"(s => {{ s.value = {instant}; s.dispatchEvent(new Event('input')); }})"
            page.js(f"{slide}(document.getElementById('slider'))")
            assert page.js(f"{button}.textContent") == "⚠ 1 alarm"
            assert not page.js("document.querySelector('#object').textContent.includes('own ship')")
        assert page.js("document.getElementById('own-ship').hidden")
        page.js("document.getElementById('play').click()")
        page.until("document.querySelector('#object').textContent.includes('From own ship')")
        assert not page.js("document.getElementById('own-ship').hidden") and page.errors == []
