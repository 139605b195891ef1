"""Reports keep the values of a source; missing values stay missing."""

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.tracks.reports import Damaged, Reports, of_rows


def reports(**columns):
    base = {"time_s": [0.0, 10.0, 5.0], "lat_deg": [50.0, 51.0, 52.0], "lon_deg": [179.0, 181.0, -190.0]}
    return Reports.of("radar", "table", base | columns)


def test_longitudes_and_directions_are_normalised():
    made = reports(course_deg=[-10.0, 370.0, np.nan])
    np.testing.assert_allclose(made.lon_deg, [179.0, -179.0, 170.0])
    np.testing.assert_allclose(made.course_deg, [350.0, 10.0, np.nan])


def test_empty_columns_are_missing_and_unknown_columns_are_extra():
    made = reports(speed_m_per_s=[np.nan] * 3, name=[None] * 3, nac_p=[9, 8, 7], mmsi=[235, None, "002"])
    assert made.speed_m_per_s is None and made.name is None
    assert made.extra["nac_p"].tolist() == [9, 8, 7]
    assert made.mmsi.tolist() == ["235", None, "002"]
    assert set(made.columns()) == {"time_s", "line", "lat_deg", "lon_deg", "mmsi", "nac_p"}


@pytest.mark.parametrize(
    ("columns", "kind"),
    [
        ({"lat_deg": [1.0], "lon_deg": [2.0], "range_m": [1.0], "bearing_deg": [1.0]}, "geodetic"),
        ({"x_m": [1.0], "y_m": [2.0]}, "local"),
        ({"range_m": [1.0], "bearing_deg": [1.0]}, "polar"),
        ({"bearing_deg": [1.0]}, "bearing"),
    ],
)
def test_the_kind_of_position_follows_from_the_columns(columns, kind):
    assert Reports.of("a", "table", {"time_s": [0.0], **columns}).position == kind


def test_velocity_is_east_and_north_and_known_at_zero_speed():
    made = reports(speed_m_per_s=[10.0, 0.0, 5.0], course_deg=[90.0, np.nan, np.nan])
    np.testing.assert_allclose(made.velocity_m_per_s(), [[10.0, 0.0], [0.0, 0.0], [np.nan, np.nan]], atol=1e-12)
    made = reports(vx_m_per_s=[1.0, 2.0, 3.0], vy_m_per_s=[4.0, 5.0, 6.0])
    np.testing.assert_allclose(made.velocity_m_per_s()[1], [2.0, 5.0])
    assert reports().velocity_m_per_s() is None


def test_selecting_and_sorting_rows_keeps_all_columns_together():
    made = reports(covariance_m2=np.arange(9.0).reshape(3, 3), track_id=["a", "b", "c"], rank=np.arange(3))
    ordered = made.in_time_order()
    assert ordered.track_id.tolist() == ["a", "c", "b"] and ordered.extra["rank"].tolist() == [0, 2, 1]
    assert ordered.covariance_m2[1].tolist() == [6.0, 7.0, 8.0]
    assert made.where(made.time_s > 1.0).line.tolist() == [2, 3]


def test_damage_is_reported_by_reason_and_count():
    damaged = Damaged.of([(9, "no time"), (2, "wrong checksum"), (7, "no time")])
    assert damaged.counts() == {"no time": 2, "wrong checksum": 1}
    assert damaged.sentences() == ["2 lines damaged: no time (lines 7, 9)", "1 line damaged: wrong checksum (line 2)"]
    assert reports().damaged.sentences() == []


def test_lone_surrogates_can_be_written():
    """JSON may contain lone surrogates and text files may not, so a picture with such a name could not be written."""
    halves = ["\ud83d\ude80a", "\ud800", "é", None]
    columns = {"time_s": range(4), "lat_deg": np.zeros(4), "lon_deg": np.zeros(4), "name": halves}
    made = Reports.of("adsb", "ads-b", columns | {"owner": np.array([*halves[:3], "x"])})
    assert made.name.tolist() == ["🚀a", "�", "é", None] and made.extra["owner"].tolist() == ["🚀a", "�", "é", "x"]


def test_rows_become_columns_with_missing_values():
    columns = of_rows([{"time_s": 1.0, "name": "A"}, {"time_s": 2.0, "covariance_m2": (1.0, 0.0, 1.0)}])
    assert columns["name"].tolist() == ["A", None]
    assert np.isnan(columns["covariance_m2"][0]).all() and columns["covariance_m2"][1].tolist() == [1.0, 0.0, 1.0]


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"lat_deg": [1.0], "lon_deg": [1.0]}, "radar: no time; give a column time_s"),
        ({"time_s": [1.0], "lat_deg": [1.0]}, "radar: has lat_deg, but no lon_deg; give both"),
        ({"time_s": [1.0], "speed_m_per_s": [1.0]}, "radar: no position; give lat and lon, x and y"),
        ({"time_s": [1.0], "lat_deg": [-118.2], "lon_deg": [33.9]}, "latitude and longitude swapped"),
        ({"time_s": [1.0], "lat_deg": [1.0, 2.0], "lon_deg": [1.0, 2.0]}, "lat_deg has 2 values for 1 times"),
    ],
)
def test_refusals_say_what_is_missing(columns, words):
    with pytest.raises(InputError, match=words.replace("(", r"\(")):
        Reports.of("radar", "table", columns)


def test_a_negative_range_is_set_aside_and_other_rows_are_kept():
    columns = {"time_s": [0.0, 1.0, 2.0], "range_m": [100.0, -5.0, 120.0], "bearing_deg": [10.0, 20.0, 30.0]}
    reports = Reports.of("radar", "table", columns)
    assert reports.range_m.tolist() == [100.0, 120.0] and reports.damaged.counts() == {"a distance below 0": 1}
    with pytest.raises(InputError, match="all ranges are negative"):
        Reports.of("radar", "table", columns | {"range_m": [-1.0, -2.0, -3.0]})


def test_a_ship_at_rest_without_a_course_has_a_velocity():
    given = {"time_s": [0.0] * 4, "x_m": [0.0] * 4, "y_m": [0.0] * 4, "speed_m_per_s": [0.0, 0.1, 3.0, 0.1],
             "course_deg": [np.nan, np.nan, np.nan, 90.0]}  # fmt: skip
    velocity = Reports.of("ais", "ais", given).velocity_m_per_s()
    assert velocity is not None
    np.testing.assert_allclose(velocity, [[0.0, 0.0], [0.0, 0.0], [np.nan, np.nan], [0.1, 0.0]], atol=1e-12)
