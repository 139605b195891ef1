"""``sameas picture`` on plots without ids: objects are followed from scan to scan through misses and clutter."""

import csv
import json
import re

import numpy as np
import pytest

from browser import CHROMIUM, Browser
from sameas.io import read_table

START = 1714605000.0  # 2024-05-01 23:10 UTC
UNTIL_S = 60.0
SENSORS = {"lidar": (2.0, 0.5), "radar": (4.0, 1.5)}  # 1σ in metres, seconds between looks
COURSES = np.array([[-120.0, 6.0], [120.0, -6.0]]), np.array([[4.0, 0.0], [-4.0, 0.0]])
TOML = """
[sources.{name}]
kind = "{kind}"
site = {{ east_m = 0, north_m = 0 }}
coverage = {{ range_m = 500 }}
motion = {{ acceleration_m2_per_s3 = 0.02, speed_m_per_s = 4 }}
misses = {{ q = 0.2 }}
clutter = {{ per_km2 = 11 }}
errors = {{ position_m = {sigma_m}, extent_m = 0 }}
timing = {{ period_s = {period_s}, latency_sigma_s = 0 }}
resolution = {{ split = 0.02 }}
"""


@pytest.fixture(scope="module")
def quay(tmp_path_factory):
    """Bare plots of a lidar and a radar: two boats that pass each other at 12 m, one detection in five missed, and as
    many false plots as true ones."""
    folder, rng = tmp_path_factory.mktemp("quay"), np.random.default_rng(4)
    for name, (sigma_m, period_s) in SENSORS.items():
        rows = []
        for t in np.arange(0.0, UNTIL_S, period_s).tolist():
            place = (COURSES[0] + t * COURSES[1])[rng.random(2) < 0.8]
            false = rng.uniform(-300.0, 300.0, (rng.poisson(4), 2))
            seen = np.vstack([place + sigma_m * rng.standard_normal(place.shape), false])
            rows += [[START + t, *np.round(plot, 2).tolist()] for plot in seen[rng.permutation(len(seen))]]
        with open(folder / f"{name}.csv", "w", newline="") as file:
            csv.writer(file).writerows([["time", "x_m", "y_m"], *rows])
    kinds = zip(SENSORS.items(), ("lidar", "marine radar"), strict=True)
    tables = [TOML.format(name=name, kind=kind, sigma_m=s, period_s=p) for (name, (s, p)), kind in kinds]
    (folder / "sensors.toml").write_text("".join(tables))
    return folder


@pytest.fixture(scope="module")
def made(quay, tmp_path_factory):
    """The picture every five seconds (ten lidar scans): printed text and folder."""
    from typer.testing import CliRunner

    from sameas.cli.app import app

    out = tmp_path_factory.mktemp("made") / "picture"
    files = [quay / f"{name}.csv" for name in SENSORS]
    words = ["picture", *files, "-s", quay / "sensors.toml", "-o", out, "--every", "5s"]
    result = CliRunner().invoke(app, [str(word) for word in words])
    assert result.exit_code == 0, result.output
    return result.stdout, out


def truth(t):
    return COURSES[0] + (t - START) * COURSES[1]


def confirmed(objects):
    return objects[np.isin(objects["stage"], ["confirmed", "coasting"])]


@pytest.mark.slow
def test_two_passing_boats_are_confirmed_and_keep_their_numbers_and_false_plots_are_not_confirmed(made):
    _, out = made
    there = confirmed(read_table(out / "objects.parquet"))
    there = there[there["time_s"] > START + 5.0]
    numbers = []
    for t in np.unique(there["time_s"]).tolist():
        now = there[there["time_s"] == t].filled(np.nan)
        place = np.column_stack([now["x_m"], now["y_m"]])
        off = np.linalg.norm(place[:, None] - truth(t), axis=2)
        assert off.shape == (2, 2) and off.min(axis=0).max() < 8.0, (t, off)
        numbers.append(np.asarray(now["object"])[off.argmin(axis=0)].tolist())
        velocity = np.column_stack([now["vx_m_per_s"], now["vy_m_per_s"]])[off.argmin(axis=0)]
        if t > START + 15.0:
            assert np.abs(velocity - COURSES[1]).max() < 1.5, velocity
    assert len(numbers) >= 10 and len({tuple(pair) for pair in numbers}) == 1 and len(set(numbers[0])) == 2
    summary = json.loads((out / "summary.json").read_text())
    assert summary["confirmed_objects_by_number_of_sources"] == [0, 0, 2]
    assert summary["unconfirmed_objects"] > 20
    # The miss share is that of the boats, without false plots: one in five, from about twenty scans.
    assert summary["misses"] and all(one["share"] < 0.5 for one in summary["misses"])


@pytest.mark.slow
def test_members_are_plots_of_the_files_and_no_remembered_objects(made, quay):
    _, out = made
    objects, records = read_table(out / "objects.parquet"), read_table(out / "identities.parquet")
    assert set(" ".join(objects["sources"]).split()) == {"lidar", "radar"} == set(records["source"])
    for text in [*objects["members"], *objects["runner_up"]]:
        assert re.fullmatch(r"((lidar|radar):\d+( |$))*", text), text
    unseen = objects["n_sources"] == 0
    assert set(objects["stage"][unseen]) <= {"coasting", "ended"}
    assert (np.asarray(objects["members"][unseen]) == "").all()
    # Every record is in the one object that has it as a member, with the probability that the object has.
    held = {(t, member): (n, p) for t, n, p, text in zip(
        objects["time_s"], objects["object"], objects["probability"], objects["members"], strict=True)
        for member in text.split()}  # fmt: skip
    assert len(held) == len(records)
    for t, source, row, number, p in zip(
        records["time_s"], records["source"], records["row"], records["object"], records["p_object"], strict=True
    ):
        assert held[t, f"{source}:{row}"] == (number, p)
    p_alone = np.asarray(records["p_alone"], float)
    assert ((p_alone >= 0.0) & (p_alone <= 1.0)).all()
    alone = {key for key, (n, p) in held.items() if p > 0.99}
    assert alone
    # Positions refer to lines of the files.
    with open(quay / "lidar.csv", newline="") as file:
        lines = [None, *csv.reader(file)]
    for row in records[records["source"] == "lidar"][:20]:
        assert float(lines[row["line"]][1]) == pytest.approx(row["x_m"], abs=2.5 * 4.0)


@pytest.mark.slow
def test_tracking_and_its_assumptions_are_reported(made, sameas, quay, tmp_path):
    shown, _ = made
    text = " ".join(shown.split())
    assert "no source identifies its objects: they are tracked from scan to scan" in text
    files = [quay / "lidar.csv", quay / "radar.csv"]
    alone = sameas("picture", *files, "-s", quay / "sensors.toml", "-o", tmp_path / "out", "--every", "20s",
                   "--no-memory", "--no-map", "--no-image")  # fmt: skip
    assert "lidar: plots without ids; objects that only they show are followed over scans" in alone.stdout
    assumed = sameas("picture", files[0], "-o", tmp_path / "assumed", "--at", str(START + 20.0), "--no-map",
                     "--no-image").stdout  # fmt: skip
    assert "resolution.split 0.1" in " ".join(assumed.split())


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_the_map_opens_and_explains(made):
    _, out = made
    with Browser(out / "map.html") as browser:
        assert not browser.errors and not [url for url in browser.requests if not url.startswith("file:")]
        assert browser.js("document.title").startswith("Picture of lidar and radar")


PIXELS = "[...document.getElementById('chart').getContext('2d').getImageData(0, 0, 900, 700).data]"


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs Chromium")
def test_a_map_shows_the_same_while_it_is_dragged_as_when_it_is_let_go(made):
    """While it is dragged, the objects are copied from a wider canvas, painted anew when that ends."""
    _, out = made
    with Browser(out / "map.html") as browser:
        mouse = {"button": "left", "clickCount": 1, "buttons": 1}
        browser.js("mapPage.view.scale *= 4; mapPage.paint()")
        browser.settle()
        at_first = np.array(browser.js(PIXELS), float)
        browser.do("Input.dispatchMouseEvent", type="mousePressed", x=500, y=400, **mouse)
        for x, y in ((520, 410), (560, 430), (800, 380)):
            browser.do("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=y, **mouse)
            browser.settle()
        dragged = np.array(browser.js(PIXELS), float)
        browser.do("Input.dispatchMouseEvent", type="mouseReleased", x=800, y=380, **mouse)
        browser.settle()
        released = np.array(browser.js(PIXELS), float)
        # Labels beyond the edges may take other places; a pixel that moved by less than one is slightly paler.
        assert np.mean(np.abs(dragged - released)) < 0.1 * np.mean(np.abs(dragged - at_first))
        hit = browser.js("mapPage.hits.find(hit => !hit.record)")
        left, top = browser.js("(b => [b.left, b.top])(document.getElementById('chart').getBoundingClientRect())")
        browser.click(left + hit["u"], top + hit["v"])
        browser.settle()
        assert browser.js("mapPage.picked") is not None and not browser.errors
