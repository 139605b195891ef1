"""Heights of targets without a reported one are those that the sources of the scene report."""

import numpy as np
import pytest

from sameas.picture.live import LivePicture
from sameas.tracks import Description, Reports, Scene, Site
from sameas.tracks.source import Targets

SITE = Site(lat_deg=51.0, lon_deg=1.0, height_m=60.0)


def sources(*, n=60, targets=None):
    rng = np.random.default_rng(1)
    time_s, alt_m = np.arange(float(n)), 900.0 + 100.0 * rng.standard_normal(n)
    adsb = Reports.of("adsb", "table", {
        "time_s": time_s, "lat_deg": np.full(n, 51.1), "lon_deg": np.full(n, 1.1), "alt_m": alt_m,
        "track_id": np.full(n, "a"),
    })  # fmt: skip
    radar = Reports.of("radar", "table", {
        "time_s": time_s, "range_m": np.full(n, 15_000.0), "bearing_deg": np.full(n, 33.0), "track_id": np.full(n, "7"),
    })  # fmt: skip
    given = {} if targets is None else {"targets": targets}
    return [(Description("adsb", "ads-b"), adsb), (Description("radar", "air radar", site=SITE, **given), radar)]


def of_radar(**given):
    """The description of the radar in a scene of both."""
    return next(feed.description for feed in Scene.of(sources(**given)).feeds if feed.description.name == "radar")


def test_assumed_heights_are_those_that_other_sources_report():
    description = of_radar()
    assert description.targets.height_m == pytest.approx(900.0, abs=50.0)
    assert description.targets.height_sigma_m == pytest.approx(450.0, abs=25.0)
    line = next(line for line in description.assumed if line.name == "targets.height_m")
    assert "60 heights" in line.why and line.value == description.targets.height_m


def test_given_heights_and_few_reports_change_nothing():
    assert of_radar(targets=Targets(height_m=2000.0, height_sigma_m=100.0)).targets.height_m == 2000.0
    assert of_radar(n=20).targets.height_m == 5000.0


def test_live_the_heights_are_those_with_which_the_offsets_hold():
    adsb, radar = sources()
    picture = LivePicture([adsb[0], radar[0]], lag_s=1.0)
    for description, reports in (adsb, radar):
        picture.add(description.name, reports)
    picture.advance(59.0)
    picture.register()
    (again,) = (description for description, _ in picture.recent() if description.name == "radar")
    assert again.targets.height_m == pytest.approx(900.0, abs=50.0)
    assert again.is_assumed("targets.height_m")
