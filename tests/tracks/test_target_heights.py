"""Heights of targets without a reported one are those that the sources of the scene report."""

import numpy as np
import pytest

from sameas.tracks import Description, Reports, Scene, Site
from sameas.tracks.source import Targets

SITE = Site(lat_deg=51.0, lon_deg=1.0, height_m=60.0)


def scene(*, n=60, targets=None):
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
    sources = [(Description("adsb", "ads-b"), adsb), (Description("radar", "air radar", site=SITE, **given), radar)]
    return next(feed.description for feed in Scene.of(sources).feeds if feed.description.name == "radar")


def test_assumed_heights_are_those_that_other_sources_report():
    description = scene()
    assert description.targets.height_m == pytest.approx(900.0, abs=50.0)
    assert description.targets.height_sigma_m == pytest.approx(450.0, abs=25.0)
    line = next(line for line in description.assumed if line.name == "targets.height_m")
    assert "60 heights" in line.why and line.value == description.targets.height_m


def test_given_heights_and_few_reports_change_nothing():
    assert scene(targets=Targets(height_m=2000.0, height_sigma_m=100.0)).targets.height_m == 2000.0
    assert scene(n=20).targets.height_m == 5000.0
