"""Pages run only their own script, for any names in them; layout and colours."""

import base64
import hashlib
import itertools
import re

import numpy as np
import pytest
from astropy.table import Table

from browser import CHROMIUM, Browser
from charted import charted
from sameas.pages import asset, page_of, script_safe
from sameas.pages.map import map_page
from sameas.plots import frame as frame_plots

HOSTILE = '</script><script>document.title="taken"</script><img src=x onerror="document.title=1">{{js}}{{policy}}'
TEMPLATES = ["map.html", "frame.html", "series.html", "movers.html"]


def filled(template, title="", **marks):
    names = ("css", "data", "texts", "columns", "picture")
    return page_of(template, title, "page", dict.fromkeys(names, "") | {"js": "1 < 2;"} | marks)


@pytest.mark.parametrize("template", TEMPLATES)
def test_the_content_policy_allows_only_the_hash_of_the_script(template):
    page = filled(template, data=script_safe({"name": HOSTILE}))
    (script,) = re.findall(r"<script>(.*?)</script>", page, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    (policy,) = re.findall(r'<meta http-equiv="Content-Security-Policy" content="([^"]*)">', page)
    rules = dict(rule.split(" ", 1) for rule in policy.split("; "))
    assert rules.pop("script-src") == f"'sha256-{digest}'"
    assert rules.pop("default-src") == "'none'" and rules.pop("img-src") == "data:"
    assert rules == {"style-src": "'unsafe-inline'", "base-uri": "'none'", "form-action": "'none'"}
    # The policy applies to the content after it.
    assert page.index("Content-Security-Policy") < page.index("<title>")


@pytest.mark.parametrize("template", TEMPLATES)
def test_replacement_text_is_not_replaced_again(template):
    page = filled(template, title="{{data}}", data=script_safe({"name": HOSTILE}))
    assert "<title>{{data}}" in page and page.count("{{js}}") == 1 and HOSTILE not in page


@pytest.mark.parametrize("template", TEMPLATES)
def test_pages_contain_no_terminal_control_characters(template):
    hostile = "a \x1b[31mred\x1b]0;t\x07\x85 \u2028 b"
    page = filled(template, title=hostile, data=script_safe({"name": hostile}))
    # In data JSON's own escapes stand for the first 32 characters; what stands for others shows nowhere.
    assert not re.search(r"[\x00-\x08\x0b\x0c\x0e-\x1f\u2028]", page) and "<title>a \\x1b[31mred" in page


def test_templates_have_no_inline_handlers():
    for template in ["head.html", *TEMPLATES]:
        assert not re.search(r"\son\w+=|javascript:", asset(template))


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to show the page in")
def test_an_injected_script_is_not_run(tmp_path):
    page = map_page(charted(12, 4, names={1: HOSTILE}))
    broken = page.replace("<body>", "<body>" + HOSTILE.replace("</script><script>", "<script>", 1), 1)
    assert broken != page and np.char.count(broken, "document.title=1") > 0
    (tmp_path / "map.html").write_text(broken, encoding="utf-8")
    with Browser(tmp_path / "map.html") as browser:
        assert browser.js("document.title").endswith("map")  # and the page's own script has made it ready
        assert not [url for url in browser.requests if not url.startswith(("file:", "data:"))]


#: A laptop's window and a phone's.
SIZES = ((1400, 900), (390, 844))


@pytest.fixture(scope="module")
def every_page(tmp_path_factory):
    """A page of each kind, by name: of frames, their series, what moves on them, and a map."""
    return pages_in(tmp_path_factory.mktemp("pages"), "long_name_of", {}, "A VESSEL OF A VERY LONG NAME" * 3)[0]


def pages_in(folder, name, cards, ship):
    """The pages by kind, and what was printed. name : what frames begin with. cards : more of their headers."""
    for package in ("photutils", "matplotlib"):
        pytest.importorskip(package, reason="frames need the extras sameas[frames,plots]")
    from astropy.io import fits
    from typer.testing import CliRunner

    from sameas.cli.app import app
    from sameas.io import write_table
    from sameas.simulate import Camera, frame_of_sky
    from sameas.sky import Pointing
    from sameas.space import unit_vectors

    rng, side = np.random.default_rng(5), 260
    (folder / "night").mkdir()
    ra, dec, mag = 62.6 + rng.uniform(-0.06, 0.06, 150), 22.9 + rng.uniform(-0.06, 0.06, 150), rng.uniform(12, 18, 150)
    wcs = Pointing(unit_vectors(62.6, 22.9), np.diag([-6e-6, 6e-6]), np.full(2, (side - 1) / 2)).to_wcs((side, side))
    for k in range(4):
        seen = frame_of_sky(
            rng, ra_deg=np.append(ra, 62.6 - 0.001 * k), dec_deg=np.append(dec, 22.9), magnitude=np.append(mag, 14.5),
            wcs=wcs, zero_point=20.5, camera=Camera(shape=(side, side)),
        )  # fmt: skip
        header = wcs.to_header()
        header.update({"DATE-OBS": f"2018-10-18T03:{10 * k:02d}:00", "EXPTIME": 60.0, "GAIN": 1.5, "RDNOISE": 6.0})
        header.update(cards)
        fits.PrimaryHDU(seen.frame.image.astype(np.uint16), header).writeto(folder / "night" / f"{name}_{k}.fits")
    stars = {"source_id": np.arange(150) + 10**17, "ra": ra, "dec": dec, "phot_g_mean_mag": mag}
    write_table(Table({**stars, "ref_epoch": np.full(150, 2018.8)}), folder / "stars.fits", provenance={})
    where = [str(folder / "night"), "-c", str(folder / "stars.fits"), "-j", "1", "-o"]
    printed = ""
    for command in ("frame", "movers"):
        done = CliRunner().invoke(app, [command, *where, str(folder / command)])
        assert done.exit_code == 0, done.output
        printed += done.output
    (folder / "map.html").write_text(map_page(charted(80, 6, names={1: ship})), "utf-8")
    return {
        "frame": folder / "frame" / f"{name}_0.html", "series": folder / "movers" / "index.html",
        "movers": folder / "movers" / "movers.html", "map": folder / "map.html",
        "frames": folder / "frame" / "index.html",
    }, printed  # fmt: skip


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to show the page in")
def test_names_of_files_and_in_headers_are_never_executed(tmp_path):
    """A folder of frames: file names that are markup, a filter and an object that end a script; and what is printed."""
    markup, script = "<img src=x onerror=document.title=1>", "</script><script>document.title=2</script>"
    (tmp_path / '"><img src=x onerror=document.title=3>').mkdir()
    folder = tmp_path / '"><img src=x onerror=document.title=3>'
    before = set(tmp_path.rglob("*"))
    pages, printed = pages_in(folder, f"{{{{data}}}}{markup}", {"FILTER": script, "OBJECT": script}, HOSTILE)
    assert all(line.isprintable() for line in printed.split("\n"))
    made = {path.relative_to(tmp_path).parts[0] for path in set(tmp_path.rglob("*")) - before}
    assert made == {folder.name}
    for kind, page in pages.items():
        with Browser(page) as browser:
            assert browser.js("document.title") not in ("1", "2", "3")
            assert browser.js("document.querySelectorAll('[onerror]').length") == 0, kind
            assert browser.errors == [] and browser.complaints == [], kind
            assert not [url for url in browser.requests if not url.startswith(("file:", "data:", "blob:"))], kind


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to show the page in")
def test_on_a_phone_the_record_is_below_the_frame_and_numbers_are_not_cut(every_page):
    with Browser(every_page["frame"], SIZES[1]) as browser:
        browser.do("Emulation.setDeviceMetricsOverride", width=390, height=844, deviceScaleFactor=1, mobile=True)
        browser.until("innerWidth === 390")
        browser.js("framePage.pick({ kind: 'measured', row: 3 })")
        assert browser.js("document.getElementById('beyond').offsetHeight") == 0  # all its stars are in the catalogue
        top, bottom = (f"document.getElementById('{name}').getBoundingClientRect()" for name in ("record", "viewer"))
        assert 0 < browser.js(f"{top}.top - {bottom}.bottom") < 30
        lines = (
            "[...document.querySelectorAll('.rivals td + td')].filter(td => td.textContent).map(td => {"
            "const r = document.createRange(); r.selectNodeContents(td); return r.getClientRects().length; })"
        )
        assert set(browser.js(lines)) == {1}


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to show the page in")
def test_measurements_fainter_than_the_catalogue_are_counted_separately(every_page, tmp_path):
    page = every_page["frame"].read_text("utf-8")
    stars = re.search(r'"measured":.*?"star":\[(.*?)\]', page)[1].split(",")
    alone = [row for row, star in enumerate(stars) if star == "null"]
    assert alone and '"beyond":[]' in page
    (tmp_path / "page.html").write_text(page.replace('"beyond":[]', f'"beyond":[{alone[0]}]'), "utf-8")
    with Browser(tmp_path / "page.html") as browser:
        counts = [browser.js(f"document.getElementById('{name}').textContent") for name in ("n-alone", "n-beyond")]
        assert counts == [str(len(alone) - 1), "1"]
        assert browser.js("document.getElementById('beyond').offsetHeight") > 0
        # They are not drawn at first, as on the picture.
        assert not browser.js("document.getElementById('show-beyond').checked")
        browser.js(f"framePage.pick({{ kind: 'measured', row: {alone[0]} }})")
        assert "fainter than the catalogue reaches" in browser.js("document.getElementById('record').innerText")


@pytest.mark.long
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium to show the page in")
@pytest.mark.parametrize("size", SIZES, ids=["window", "phone"])
@pytest.mark.parametrize("kind", ["frame", "series", "movers", "map"])
def test_no_page_is_wider_than_its_window_in_either_colour_scheme(every_page, kind, size):
    with Browser(every_page[kind], size) as browser:
        browser.do(
            "Emulation.setDeviceMetricsOverride", width=size[0], height=size[1], deviceScaleFactor=1,
            mobile=size[0] < 500,
        )  # fmt: skip
        browser.until(f"innerWidth === {size[0]}")
        if kind == "map":
            browser.js("mapPage.pick(1)")
        grounds = []
        for _ in range(2):
            assert browser.js("document.documentElement.scrollWidth - innerWidth") <= 0
            grounds.append(browser.js("getComputedStyle(document.body).backgroundColor"))
            browser.js("document.getElementById('theme').click()")
        assert len(set(grounds)) == 2
        assert browser.errors == [] and browser.complaints == []
        assert not [url for url in browser.requests if not url.startswith(("file:", "data:", "blob:"))]


# Marks are told apart by everyone.

#: Deuteranopia, on linear red, green and blue: Machado, Oliveira, Fernandes 2009, IEEE TVCG 15, 1291, severity 1.
DEUTERANOPIA = [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
SRGB_TO_XYZ = [[0.4124564, 0.3575761, 0.1804375], [0.2126729, 0.7151522, 0.0721750], [0.0193339, 0.1191920, 0.9503041]]


def lab(colour, seen_by):
    """CIE L*a*b* (D65) of #rrggbb as an eye sees it."""
    channel = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0
    linear = np.where(channel <= 0.04045, channel / 12.92, ((channel + 0.055) / 1.055) ** 2.4)
    x, y, z = np.array(SRGB_TO_XYZ) @ np.clip(seen_by @ linear, 0.0, 1.0) / [0.95047, 1.0, 1.08883]
    fx, fy, fz = (np.cbrt(t) if t > 216 / 24389 else (24389 / 27 * t + 16) / 116 for t in (x, y, z))
    return 116 * fy - 16, 500 * (fx - fy), 200 * (fy - fz)


def ciede2000(one, two):
    """CIEDE2000 colour difference: Sharma, Wu, Dalal 2005, Color Res. Appl. 30, 21."""
    (l1, a1, b1), (l2, a2, b2) = one, two
    mean = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    g = 0.5 * (1 - np.sqrt(mean**7 / (mean**7 + 25.0**7)))
    a1, a2 = (1 + g) * a1, (1 + g) * a2
    c1, c2 = np.hypot(a1, b1), np.hypot(a2, b2)
    h1, h2 = (np.degrees(np.arctan2(b, a)) % 360 for a, b in ((a1, b1), (a2, b2)))
    turn = (h2 - h1 + 180) % 360 - 180 if c1 * c2 else 0.0
    hue = (h1 + turn / 2) % 360 if c1 * c2 else h1 + h2
    bright, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    waves = ((0.17, 1, -30), (-0.24, 2, 0), (-0.32, 3, 6), (0.20, 4, -63))
    t = 1 - sum(f * np.cos(np.radians(n * hue + shift)) for f, n, shift in waves)
    dl = (l2 - l1) / (1 + 0.015 * (bright - 50) ** 2 / np.sqrt(20 + (bright - 50) ** 2))
    dc = (c2 - c1) / (1 + 0.045 * chroma)
    dh = 2 * np.sqrt(c1 * c2) * np.sin(np.radians(turn / 2)) / (1 + 0.015 * chroma * t)
    both = -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7)) * np.sin(np.radians(60 * np.exp(-(((hue - 275) / 25) ** 2))))
    return np.sqrt(dl**2 + dc**2 + dh**2 + both * dc * dh)


def test_colour_differences_agree_with_the_published_pairs():
    # Pairs 1, 7, 17 and 25 of Sharma's table 1.
    assert ciede2000((50, 2.6772, -79.7751), (50, 0, -82.7485)) == pytest.approx(2.0425, abs=1e-4)
    assert ciede2000((50, 0, 0), (50, -1, 2)) == pytest.approx(2.3669, abs=1e-4)
    assert ciede2000((50, 2.5, 0), (73, 25, -18)) == pytest.approx(27.1492, abs=1e-4)
    assert ciede2000((60.2574, -34.0099, 36.2677), (60.4626, -34.1751, 39.4387)) == pytest.approx(1.2644, abs=1e-4)


@pytest.mark.parametrize("theme", [":root", ":root.day"])
@pytest.mark.parametrize("eye", [np.eye(3), np.array(DEUTERANOPIA)], ids=["all cones", "deuteranopia"])
def test_marks_of_a_frame_are_distinguishable_from_each_other_and_the_sky(theme, eye):
    (block,) = re.findall(rf"^{theme} {{(.*?)}}", asset("frame.css"), re.DOTALL | re.MULTILINE)
    named = dict(re.findall(r"--(\w+): (#\w{6})\b", block))
    marks = {name: lab(named[name], eye) for name in ("found", "alone", "lost", "odd", "night")}
    apart = {pair: ciede2000(marks[pair[0]], marks[pair[1]]) for pair in itertools.combinations(marks, 2)}
    assert min(apart.values()) >= 25.0, apart
    if theme == ":root":
        assert [named[n] for n in ("found", "alone", "lost")] == [frame_plots.BLUE, frame_plots.YELLOW, frame_plots.RED]
