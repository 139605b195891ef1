"""Tables: columns are recognised by name, and damage is confined to single lines."""

import json
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest
from astropy.table import Table
from pyarrow import parquet

from sameas.errors import InputError
from sameas.io.sensors import ReadOptions, read_reports
from sameas.io.sensors.sources import read_source_options, read_sources
from sameas.io.sensors.table_cells import PackedTexts, cells_of_csv, cells_of_json
from sameas.io.sensors.table_columns import choose
from sameas.io.sensors.tables import read
from sameas.tracks.reports import Reports

DATA = Path(__file__).parents[2] / ".." / "shared" / "data" / "stonesoup_demos"
KNOT = 1852.0 / 3600.0


def table(text, start_s=None, columns=None, units=None):
    options = ReadOptions(start=start_s, columns=columns, units=units)
    return read(cells_of_csv(text.strip().split("\n"), "radar.csv"), "radar.csv", options)


def understood(*names):
    return {column: choice.name for column, choice in choose(names, "radar.csv").items()}


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("Time", "MMSI", "Latitude_degrees", "Longitude_degrees", "COG_degrees", "SOG_knots"),
         {"time_s": "Time", "mmsi": "MMSI", "lat_deg": "Latitude_degrees", "lon_deg": "Longitude_degrees",
          "course_deg": "COG_degrees", "speed_m_per_s": "SOG_knots"}),
        (("timestamp", "icao24", "callsign", "latitude", "longitude", "altitude", "groundspeed", "track",
          "vertical_rate"),
         {"time_s": "timestamp", "icao": "icao24", "callsign": "callsign", "lat_deg": "latitude",
          "lon_deg": "longitude", "alt_m": "altitude", "speed_m_per_s": "groundspeed", "course_deg": "track",
          "climb_m_per_s": "vertical_rate"}),
        (("t", "range (NM)", "bearing [deg]", "track", "sigma_range_m"),
         {"time_s": "t", "range_m": "range (NM)", "bearing_deg": "bearing [deg]", "track_id": "track",
          "sigma_range_m": "sigma_range_m"}),
        # A radar's table with "track" beside a course, or velocities: the number of the track.
        (("time", "track", "range_nm", "bearing_deg", "speed_kn", "course_deg"),
         {"time_s": "time", "track_id": "track", "range_m": "range_nm", "bearing_deg": "bearing_deg",
          "speed_m_per_s": "speed_kn", "course_deg": "course_deg"}),
        (("time", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s", "Track"),
         {"time_s": "time", "x_m": "x_m", "y_m": "y_m", "vx_m_per_s": "vx_m_per_s", "vy_m_per_s": "vy_m_per_s",
          "track_id": "Track"}),
        (("utc", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s", "cov_xx", "cov_xy", "cov_yy", "id"),
         {"time_s": "utc", "x_m": "x_m", "y_m": "y_m", "vx_m_per_s": "vx_m_per_s", "vy_m_per_s": "vy_m_per_s",
          "cov_xx": "cov_xx", "cov_xy": "cov_xy", "cov_yy": "cov_yy", "track_id": "id"}),
        (("BaseDateTime", "LAT", "LON", "VesselName", "VesselType", "Length", "Width", "IMO"),
         {"time_s": "BaseDateTime", "lat_deg": "LAT", "lon_deg": "LON", "name": "VesselName", "type": "VesselType",
          "length_m": "Length", "width_m": "Width", "imo": "IMO"}),
        (("UTC", "Tgt No", "Range (NM)", "Brg (T)"),
         {"time_s": "UTC", "track_id": "Tgt No", "range_m": "Range (NM)", "bearing_deg": "Brg (T)"}),
        (("UTC", "Target number", "Range", "Bearing (deg T)", "Bearing (R)"),
         {"time_s": "UTC", "track_id": "Target number", "range_m": "Range", "bearing_deg": "Bearing (deg T)"}),
        (("UTC", "Trk no.", "Rng (NM)", "True bearing"),
         {"time_s": "UTC", "track_id": "Trk no.", "range_m": "Rng (NM)", "bearing_deg": "True bearing"}),
    ],
)  # fmt: skip
def test_common_column_names_are_recognised(names, expected):
    assert understood(*names) == expected


@pytest.mark.parametrize("delimiter", [" ", ","])
def test_ecsv_of_astropy_is_read_like_csv(delimiter, tmp_path):
    written = Table({"time": ["2020-06-30T00:00:00Z"] * 2, "mmsi": [211000000, 212000000], "lat": [40.5, 40.6],
                     "lon": [-74.0, -74.1], "name": ["GENESIS VIGILANT", ""], "sog_kn": [np.nan, 3.5]})  # fmt: skip
    written.write(tmp_path / "ais.csv")
    written.write(tmp_path / "ais.ecsv", delimiter=delimiter)
    (one,), (two,) = (read_reports(tmp_path / f"ais.{ending}") for ending in ("csv", "ecsv"))
    for name, column in one.columns().items():
        if name not in ("line", "source"):
            np.testing.assert_array_equal(two.columns()[name], column, err_msg=name)


@pytest.mark.parametrize(
    ("quantity", "names", "cell"),
    [
        ("mode_a", ("SSR code", "mode_3a_code", "Mode A Code"), "1234"),
        ("callsign", ("target_identification", "ACID"), "DLH12"),
        ("icao", ("aircraft_address", "mode_s_code"), "3c4b26"),
        ("track_id", ("trk_num", "TN", "system_track_number"), "17"),
        ("mmsi", ("UserID", "vessel_mmsi"), "211000000"),
    ],
)
def test_names_in_tables_of_centres_and_receivers(quantity, names, cell):
    for name in names:
        made = table(f"time,range_nm,azimuth_deg,{name}\n0,20,40,{cell}\n")
        assert getattr(made, quantity).tolist() == [cell]


@pytest.mark.parametrize(
    ("name", "cell", "metres"),
    [
        *(("flight_level", "350", 10668.0), ("FL", "98.5", 3002.28), ("flight_level_ft", "35000", 10668.0)),
        *(("Mode C", "350", 10668.0), ("mode_c_ft", "35000", 10668.0), ("mode_c_code", "35000", 10668.0)),
    ],
)
def test_flight_levels_and_mode_c_are_hundreds_of_feet_unless_a_unit_is_stated(name, cell, metres):
    made = table(f"time,range_nm,azimuth_deg,{name}\n0,20,40,{cell}\n")
    assert made.pressure_alt_m == pytest.approx([metres])


def test_units_in_names_are_used_and_usual_ones_assumed():
    made = table("time,lat,lon,sog,alt_ft,course_rad\n0,50,1,10,1000,1.5707963\n")
    assert made.speed_m_per_s[0] == pytest.approx(10 * KNOT) and made.alt_m[0] == pytest.approx(304.8)
    assert made.course_deg[0] == pytest.approx(90.0, abs=1e-5)
    made = table("time,icao24,lat,lon,altitude,groundspeed,vertical_rate\n0,4ca7a8,50,1,36000,450,-600\n")
    assert made.alt_m[0] == pytest.approx(36000 * 0.3048) and made.speed_m_per_s[0] == pytest.approx(450 * KNOT)
    assert made.climb_m_per_s[0] == pytest.approx(-600 * 0.3048 / 60)
    assert "radar.csv: altitude is read in ft: altitudes are feet" in made.notes
    made = table("time,lat,lon,speed_kmh\n0,50,1,36\n")
    assert made.speed_m_per_s[0] == pytest.approx(10.0)


def test_a_track_that_may_be_a_number_is_named_where_it_is_read_as_a_course():
    made = table("time,track,range_nm,bearing,speed_kn\n0,7,2.5,45,10\n")
    assert made.course_deg[0] == 7.0 and made.track_id is None
    [note] = [note for note in made.notes if "track" in note]
    assert "track is read as the course of the speeds" in note and "track_id" in note
    made = table("time,icao24,lat,lon,groundspeed,track\n0,4ca7a8,50,1,450,90\n")
    assert not any("track" in note for note in made.notes)


def test_assumed_units_are_reported():
    made = table("time,range,bearing\n0,1500,45\n")
    assert "radar.csv: range is read in m: its name states no unit" in made.notes
    made = table("time,range,bearing\n0,1.5,45\n", units={"range": "km"})
    assert made.range_m[0] == 1500.0 and "radar.csv: range is in km, as said" in made.notes


def test_options_of_the_user_override():
    made = table(
        "when,phi,lam,lat,lon\n0,10,20,30,40\n", columns={"time_s": "when", "lat_deg": "phi", "lon_deg": "lam"}
    )
    assert (made.lat_deg[0], made.lon_deg[0]) == (10.0, 20.0)


@pytest.mark.parametrize(("lat", "lon", "expected"), [
    ("53° 56,656' N", "008° 42,000' E", (53.0 + 56.656 / 60.0, 8.7)),
    ("53°56'39.36\"N", "8 42 0 E", (53.9442667, 8.7)),
    ("S 33 51.5", "W070:30:00", (-33.8583333, -70.5)),
    ("33.8583333 S", "-70 30", (-33.8583333, -70.5)),
])  # fmt: skip
def test_positions_in_degrees_and_minutes_are_read(lat, lon, expected):
    made = table(f"time;lat;lon\n0;{lat};{lon}\n1;50;1")
    np.testing.assert_allclose((made.lat_deg[0], made.lon_deg[0]), expected, atol=1e-7)


@pytest.mark.parametrize("lat", ["53° 61' N", "-53° 10' N", "53.5° 10' N", "N 53 10 S", "53 10 20 30"])
def test_positions_that_are_no_degrees_and_minutes_are_damaged(lat):
    made = table(f"time;lat;lon\n0;{lat};8\n1;50;1")
    assert list(made.damaged.reasons) == ["lat is no number"]


def test_the_zone_that_times_state_is_named():
    made = table("time,lat,lon\n2024-05-01T12:00:00+02:00,1,2")
    assert made.time_s[0] == datetime(2024, 5, 1, 10, tzinfo=UTC).timestamp()
    assert "radar.csv: time is read as the time of its stated zone" in made.notes
    assert "radar.csv: time is read as UTC" in table("time,lat,lon\n2024-05-01T12:00:00Z,1,2").notes


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("lat,lon\n1,2", r"no column of time among: lat, lon; give columns=\{'time_s': NAME\}"),
        ("time,lat\n1,2", r"no column of lon_deg among: time, lat; give columns=\{'lon_deg': NAME\}"),
        ("time,speed\n1,2", "no columns of a position among: time, speed"),
        ("time,lat,Lat,lon\n1,2,3,4", r"2 columns may be lat_deg: 'lat', 'Lat'; give columns=\{'lat_deg': NAME\}"),
        ("time,lat,lat,lon\n1,2,3,4", "two columns are called lat; rename one"),
        ("time,lat,lon\n0,-118.2,33.9\n1,-118.3,33.8", "2 latitudes lie beyond ±90°.*swapped"),
        ("time,lat,lon\nx,1,2", "no time can be read in column 'time' .first: 'x'.; write ISO 8601"),
        ("time,lat,lon\n1,x,2", "no row can be used: 1 line damaged: lat is no number .line 2."),
        (
            "time,lat,lon\n01/02/2024 12:00:00,1,2",
            "dates like .* in two ways; give start, .*, or write them as 2024-01-13",
        ),
        ("nothing", "no format of sensors fits; as a table, its line 1 does not"),
    ],
)
def test_refusals_say_what_to_do(text, words):
    with pytest.raises(InputError, match=f"radar.csv: {words}"):
        table(text)


def test_a_wrong_option_is_refused_with_the_valid_ones():
    text = "time,lat,lon\n0,1,2"
    with pytest.raises(InputError, match="'latt' is not a quantity; did you mean lat_deg"):
        table(text, columns={"latt": "lat"})
    with pytest.raises(InputError, match="no column 'Y' among: time, lat, lon"):
        table(text, columns={"lat_deg": "Y"})
    with pytest.raises(InputError, match="column 'lat': unit 'furlong' is none of deg"):
        table(text, units={"lat": "furlong"})


def test_damaged_lines_are_counted_by_number_and_the_rest_is_read():
    made = table(
        """
# made by hand
time,lat,lon,speed_m_s
0,50.0,1.0,3
1,50.0
2,fifty,1.0,3
,50.0,1.0,3
4,,,3
5,95.0,1.0,3
6,50.6,1.0,
7,50.7,1.0,NA
"""
    )
    assert made.line.tolist() == [3, 9, 10] and made.lat_deg.tolist() == [50.0, 50.6, 50.7]
    assert dict(zip(made.damaged.lines.tolist(), made.damaged.reasons, strict=True)) == {
        4: "has not 4 cells",
        5: "lat is no number",
        6: "no time",
        7: "no position",
        8: "latitude beyond ±90°",
    }
    assert np.isnan(made.speed_m_per_s[1:]).all()


@pytest.mark.parametrize(
    "cell",
    ["1452603731.5", "1452603731500", "1452603731500000", "2016-01-12T13:02:11.5Z", "2016-01-12 13:02:11.500",
     "2016-01-12T14:02:11.5+01:00"],
)  # fmt: skip
def test_common_time_formats_are_read(cell):
    assert table(f"timestamp,lat,lon\n{cell},1,2").time_s[0] == 1452603731.5


def test_day_and_month_are_distinguished_by_their_values():
    made = table("# Timestamp,Latitude,Longitude\n13/01/2016 13:02:11,1,2\n05/01/2016 00:00:00,1,2")
    assert made.time_s.tolist() == [datetime(2016, 1, 13, 13, 2, 11, tzinfo=UTC).timestamp(),
                                    datetime(2016, 1, 5, tzinfo=UTC).timestamp()]  # fmt: skip
    made = table("time,lat,lon\n1/13/2016 13:02:11,1,2")
    assert made.time_s[0] == datetime(2016, 1, 13, 13, 2, 11, tzinfo=UTC).timestamp()


def test_the_start_shows_which_number_of_a_date_is_the_day():
    text = "time,lat,lon\n01/02/2024 12:00:00,1,2"
    for day, start in ((1, datetime(2024, 2, 1, tzinfo=UTC)), (2, datetime(2024, 1, 2, tzinfo=UTC))):
        made = table(text, start_s=start.timestamp())
        assert made.time_s[0] == start.timestamp() + 43_200.0, day
    # With points the day is first, as nobody writes the month so.
    assert table("time,lat,lon\n01.05.2024 12:00:00,1,2").time_s[0] == datetime(2024, 5, 1, 12, tzinfo=UTC).timestamp()
    assert table("time,lat,lon\n05/05/2024 12:00:00,1,2").time_s[0] == datetime(2024, 5, 5, 12, tzinfo=UTC).timestamp()


def test_decimal_commas_are_read_where_columns_are_not_separated_by_commas():
    made = table("time;track_id;range_nm;bearing\n0;7;3,742;45,5\n3;7;;-0,5\n")
    np.testing.assert_allclose(made.range_m, [3.742 * 1852.0, np.nan])
    np.testing.assert_allclose(made.bearing_deg, [45.5, 359.5])
    # Where the table has decimal points, a comma may separate thousands: no number is guessed.
    made = table("time;range;bearing\n0;3,742;45.5\n3;900;45.6\n")
    assert made.range_m.tolist() == [900.0] and "range is no number" in "".join(made.damaged.sentences())


def test_columns_that_are_not_used_are_reported():
    made = table("time,lat,lon,snr,gain\n0,1,2,3,4\n")
    assert "radar.csv: columns not used: snr, gain" in made.notes
    assert not any("not used" in note for note in table("date,time,lat,lon\n2016-01-12,13:02:11,1,2").notes)


def test_dates_and_times_in_two_columns_and_times_of_day_are_read():
    made = table("date,time,lat,lon\n2016-01-12,13:02:11,1,2")
    assert made.time_s[0] == 1452603731.0
    with pytest.raises(InputError, match="has the time of day only; give start"):
        table("time,lat,lon\n23:59:59,1,2")
    made = table("time,lat,lon\n23:59:59,1,2\n00:00:01.5,1,2", start_s=1452556800.0)
    assert (made.time_s - 1452556800.0).tolist() == [86399.0, 86401.5]


def test_seconds_from_an_arbitrary_start_are_reported():
    assert "seconds from an origin of its own" in table("t,x,y\n0.0,1,2\n1.0,2,3").notes[0]


def test_errors_of_all_notations_become_covariances():
    circle = table("t,x,y,sigma_m\n0,1,2,3")
    axes = table("t,x,y,sigma_x,sigma_y\n0,1,2,3,4")
    full = table("t,x,y,cov_xx,cov_xy,cov_yy,sigma\n0,1,2,9,-2,16,100")
    assert circle.covariance_m2.tolist() == [[9.0, 0.0, 9.0]]
    assert axes.covariance_m2.tolist() == [[9.0, 0.0, 16.0]]
    assert full.covariance_m2.tolist() == [[9.0, -2.0, 16.0]]
    polar = table("t,range_km,bearing,sigma_range_m,sigma_bearing_mrad\n0,1,2,30,10")
    assert (polar.sigma_range_m[0], polar.sigma_bearing_deg[0]) == pytest.approx((30.0, np.degrees(0.01)))
    moving = table("t,x,y,vx,vy,sigma_vx,sigma_vy\n0,1,2,3,4,0.5,2")
    assert moving.velocity_covariance_m2_per_s2.tolist() == [[0.25, 0.0, 4.0]]


def test_bearings_alone_are_a_source():
    made = table("time,bearing_rad,id\n0,-1.5707963,7\n")
    assert made.position == "bearing" and made.bearing_deg[0] == pytest.approx(270.0, abs=1e-5)
    assert made.track_id.tolist() == ["7"]


@pytest.mark.parametrize(
    ("name", "value"),
    [("frequency_hz", "156800000"), ("freq_mhz", "156.8"), ("Frequency (GHz)", "0.1568"), ("frequency", "156.8"),
     ("freq", "156800"), ("rf", "156800000")],
)  # fmt: skip
def test_frequencies_of_directions_are_read_in_their_unit(name, value):
    assert table(f"time,bearing,{name}\n0,10,{value}\n").frequency_hz[0] == pytest.approx(156.8e6)


@pytest.mark.parametrize("names", ["lat,lon,lob_deg,freq_hz", "latitude,longitude,DoA,Frequency (MHz)"])
def test_the_place_in_the_log_of_a_direction_finder_is_its_own(names):
    made = table(f"time,{names}\n0,50.7,-1.1,45,156.8\n1,50.8,-1.1,46,156.8\n")
    assert made.position == "bearing" and made.bearing_deg.tolist() == [45.0, 46.0] and made.lat_deg is None
    assert made.station_lat_deg.tolist() == [50.7, 50.8] and made.station_lon_deg.tolist() == [-1.1, -1.1]
    assert any("read as the place of the direction finder" in note for note in made.notes)
    # AIS with the bearing from own ship is not.
    of_ais = table("time,mmsi,lat,lon,bearing\n0,211000001,50.7,-1.1,45\n")
    assert of_ais.position == "geodetic"


def test_the_log_of_a_german_direction_finder_is_read():
    made = table("Datum;Uhrzeit;Frequenz MHz;Peilwinkel;Güte\n01.05.2024;10:40:00;156,800;45,5;80\n")
    assert (made.frequency_hz[0], made.bearing_deg[0]) == pytest.approx((156.8e6, 45.5))


def test_points_of_geojson_are_read_with_their_properties(tmp_path):
    features = [
        {"type": "Feature", "geometry": {"type": "Point", "coordinates": [10.5 + k, 55.5, 20.0]},
         "properties": {"mmsi": 219000001, "timestamp": f"2024-05-01T10:40:0{k}Z", "sog": 12.0, "cog": 90.0}}
        for k in range(3)
    ]  # fmt: skip
    (tmp_path / "points.geojson").write_text(json.dumps({"type": "FeatureCollection", "features": features}))
    [made] = read_reports(tmp_path / "points.geojson")
    assert made.lat_deg.tolist() == [55.5] * 3 and made.lon_deg.tolist() == [10.5, 11.5, 12.5]
    assert made.mmsi.tolist() == ["219000001"] * 3 and made.speed_m_per_s[0] == pytest.approx(12.0 * 1852 / 3600)


def test_lists_of_virtual_radar_server_are_read(tmp_path):
    plane = {"Icao": "3C6444", "Lat": 50.0, "Long": 8.0, "Alt": 35000, "Spd": 450.0, "Trak": 45.0, "Call": "DLH123",
             "Sqk": "4521", "PosTime": 1714560000000, "Vsi": -1200, "Cos": [1.0, 2.0]}  # fmt: skip
    (tmp_path / "list.json").write_text(json.dumps({"src": 1, "acList": [plane]}))
    [made] = read_reports(tmp_path / "list.json")
    assert (made.time_s[0], made.icao[0], made.callsign[0], made.mode_a[0]) == (
        1714560000.0,
        "3c6444",
        "DLH123",
        "4521",
    )
    assert made.pressure_alt_m[0] == pytest.approx(10668.0) and made.climb_m_per_s[0] == pytest.approx(-6.096)
    assert made.speed_m_per_s[0] == pytest.approx(231.5)


def test_a_table_without_names_of_columns_is_told_so():
    with pytest.raises(InputError, match="line 1 has values, not the names of columns; give the table a first line"):
        table(
            "1714560000000,87,25.3,148524000,UCA,43.2,-80.1,0,0\n1714560001000,88,25.3,148524000,UCA,43.2,-80.1,0,0\n"
        )


def test_xml_that_is_not_read_is_told_from_a_table(tmp_path):
    (tmp_path / "track.kml").write_text('<?xml version="1.0"?>\n<kml><Document/></kml>\n')
    with pytest.raises(InputError, match="is XML of no format that is read; give its positions as CSV or GeoJSON"):
        read_reports(tmp_path / "track.kml")


def test_identities_are_read_as_text():
    made = table("time,lat,lon,mmsi,icao24,squawk\n0,1,2,2350070,4CA7A8,17\n1,1,2,2350070.0,,1000.0")
    assert made.mmsi.tolist() == ["002350070"] * 2 and made.icao.tolist() == ["4ca7a8", None]
    assert made.mode_a.tolist() == ["0017", "1000"] and made.track_id.tolist() == ["002350070"] * 2


@pytest.mark.parametrize(
    "text",
    [
        # Danish AIS with damage, quotes over two lines, comments, missing cells and the flag of accuracy.
        """# Timestamp,Type of mobile,MMSI,Latitude,Longitude,SOG,Name,Navigational status,Accuracy
01/05/2024 12:00:01,Class A,211000001,55.1,12.1,5.5,"NORD, ÅSE",Moored,1
# a comment
01/05/2024 12:00:02,Class A,211000002,55.2,12.2,unknown,TWO,Moored,0
01/05/2024 12:00:03,Class A,211000001,55.3
01/05/2024 12:00:03,Class B,211000003,55.3,12.3,fast,,,0

01/05/2024 12:00:04,Class A,211000001,55 06.6 N,12.1,5.6,"NORD,
ÅSE",Under way using engine,1
01/05/2024 12:00:04,Class A,211000001,55 06.6 N,12.1,5.6,ÅSE,Under way using engine,1
01/05/2024 12:00:05,Base Station,002190000,55.4,12.4,,STATION,,1
01/05/2024 12:00:06,Class A,211000002,91.5,12.2,7,TWO,Moored,""",
        """time;mmsi;lat;lon;sog_kn
2024-05-01T12:00:01Z;211000001;55,1;12,1;5,5
2024-05-01T12:00:02Z;211000002;55,2;;6
2024-05-01T12:00:03Z;211000002;55,3;12;nan
2024-05-01T12:00:04Z;211000002;55,4;12,4;6""",
    ],
)
@pytest.mark.parametrize("rows_of_part", [1, 2, 3])
def test_a_long_table_is_read_in_parts_to_the_same_reports(text, rows_of_part):
    whole, packed = (cells_of_csv(text.splitlines(keepends=True), "ais", rows) for rows in (len(text), rows_of_part))
    assert all(isinstance(column, PackedTexts) for column in packed.columns.values())
    for name, column in whole.columns.items():
        assert list(packed.columns[name]) == list(column) and len(packed.columns[name]) == len(column)
        assert packed.columns[name][-1] == column[-1] and packed.columns[name][1:3] == list(column[1:3])
    one, two = read(whole, "ais"), read(packed, "ais")
    assert len(one) and one.summary() == two.summary()
    assert one.columns().keys() == two.columns().keys()
    for name, column in one.columns().items():
        np.testing.assert_array_equal(two.columns()[name], column)


def test_reports_of_unknown_objects_are_no_repetitions():
    made = table("time,x_m,y_m,track_id\n1,0,0,\n1,0,0,\n1,0,0,7\n1,-0,0,7\n2,0,0,7")
    assert made.line.tolist() == [2, 3, 4, 6] and made.passed_over == {"position repeated": 1}


def test_repeated_rows_are_ignored():
    made = table("time,lat,lon,mmsi\n0,1,2,9\n0,1,2,9\n0,1,2,8\n1,1,2,9")
    assert made.line.tolist() == [2, 4, 5] and made.passed_over == {"position repeated": 1}


@pytest.mark.slow
def test_json_lines_lists_and_parquet_agree(tmp_path):
    rows = [{"time": "2016-01-12T13:02:11Z", "position": {"lat": 50.0, "lon": -1.0}, "mmsi": 235070762},
            {"time": "2016-01-12T13:02:21Z", "position": {"lat": 50.1, "lon": -1.1}, "mmsi": 235070762}]  # fmt: skip
    (tmp_path / "a.jsonl").write_text("\n".join([json.dumps(rows[0]), "{", "7", json.dumps(rows[1])]))
    (tmp_path / "a.json").write_text(json.dumps(rows, indent=1))
    stamps = pa.array(
        [datetime(2016, 1, 12, 13, 2, second, tzinfo=UTC) for second in (11, 21)], pa.timestamp("ns", "UTC")
    )
    columns = {"time": stamps, "lat": [50.0, 50.1], "lon": [-1.0, -1.1], "mmsi": [235070762] * 2}
    parquet.write_table(pa.table(columns), tmp_path / "a.parquet")
    found = [read_reports(tmp_path / name)[0] for name in ("a.jsonl", "a.json", "a.parquet")]
    for made in found:
        assert made.time_s.tolist() == [1452603731.0, 1452603741.0] and made.lat_deg.tolist() == [50.0, 50.1]
        assert made.mmsi.tolist() == ["235070762"] * 2
    assert found[0].damaged.sentences() == [
        "1 line damaged: no JSON (line 2)",
        "1 line damaged: no JSON object (line 3)",
    ]


@pytest.mark.slow
@pytest.mark.skipif(not DATA.exists(), reason="the shared data sets are not here")
def test_the_solent_file_is_read():
    [made] = read_reports(DATA / "SolentAIS_20160112_130211.csv")
    assert len(made) + sum(made.passed_over.values()) == 18623 and len(made.damaged) == 0
    assert len(set(made.mmsi)) == 91 and made.speed_m_per_s[0] == pytest.approx(5.9 * KNOT)
    assert (np.abs(made.lat_deg - 50.75) < 0.75).all() and made.time_s[0] == pytest.approx(1452603731.218)


@pytest.mark.skipif(not DATA.exists(), reason="the shared data sets are not here")
def test_states_of_opensky_are_read_at_the_time_of_their_positions():
    [made] = read_reports(DATA / "OpenSky_Plane_States.csv", ReadOptions(source="opensky"))
    assert len(set(made.icao)) == 84 and made.passed_over["position repeated"] > 0
    assert made.time_s[0] == 1626098398.996 and made.heading_deg is None
    velocity = made.velocity_m_per_s()
    speed = made.speed_m_per_s
    np.testing.assert_allclose(np.hypot(*velocity.T), speed, rtol=0.01, atol=0.5)
    assert made.alt_m[0] == 10843.26 and made.pressure_alt_m[0] == 10668.0


def test_times_with_the_name_of_their_zone_are_read():
    reports = table("time,lat,lon,id\n2024-05-01 12:00:00 UTC,55.0,12.0,1\n2024-05-01 12:00:10 GMT,55.0,12.0,1")
    assert reports.time_s.tolist() == [1714564800.0, 1714564810.0]


def test_unknown_is_no_identity():
    """Danish AIS writes it for ships without a number of IMO: all of these would be one ship."""
    reports = table(
        "time,mmsi,lat,lon,imo,callsign\n1e9,219000001,55.0,12.0,Unknown,OXYZ\n1e9,219000002,56.0,12.0,Unknown,Undefined"
    )
    assert reports.imo is None
    assert list(reports.callsign) == ["OXYZ", None]


def test_numbers_without_the_check_digit_are_no_imo_numbers():
    # 500 ships with one made-up number would be one identity at 500 places.
    rows = [
        f"1e9,21900000{k},55.{k},12.0,{imo}" for k, imo in enumerate((9134270, 9123456, 0, "IMO 9074729", 9074729.0))
    ]
    reports = table("time,mmsi,lat,lon,imo\n" + "\n".join(rows))
    assert list(reports.imo) == ["9134270", None, None, "9074729", "9074729"]
    assert any("imo: 1 value of 9123456 not used: no IMO number" in line for line in reports.summary())


def test_danish_ais_has_the_day_first():
    lines = "# Timestamp,Type of mobile,MMSI,Latitude,Longitude\n01/05/2024 12:00:00,Class A,219000001,55.0,12.0"
    assert table(lines).time_s.tolist() == [1714564800.0]
    assert datetime.fromtimestamp(table(lines, start_s=1704456000.0).time_s[0], UTC).month == 5


def test_names_of_public_ais_tables_are_known():
    brest = ("sourcemmsi", "speedoverground", "courseoverground", "trueheading", "lon", "lat", "t")
    assert understood(*brest)["mmsi"] == "sourcemmsi"
    assert understood("t", "shipid", "lon", "lat", "heading", "course", "speed")["track_id"] == "shipid"
    assert understood("t", "vessel_id", "lon", "lat", "heading", "course", "speed")["track_id"] == "vessel_id"


@pytest.mark.parametrize(("name", "kind"), [("ais", None), ("harbour", "ais")])
def test_speeds_of_ais_are_knots_whatever_their_column_is_called(tmp_path, name, kind):
    (tmp_path / f"{name}.csv").write_text("t,shipid,lat,lon,speed,course\n1e9,7,55.0,12.0,10,90\n")
    (tmp_path / "sensors.toml").write_text(
        f'[sources.{name}]\nfile = "{name}.csv"\n' + f'kind = "{kind}"\n' * bool(kind)
    )
    (described,) = read_sources([], read_source_options(tmp_path / "sensors.toml"))
    assert described.reports.speed_m_per_s[0] == pytest.approx(10 * KNOT)
    if kind is None:
        (guessed,) = read_sources([tmp_path / f"{name}.csv"])
        assert guessed.reports.speed_m_per_s[0] == pytest.approx(10 * KNOT)


def test_a_position_in_one_cell_is_read():
    """As in the tables of flightradar24."""
    reports = table(
        'Timestamp,UTC,Callsign,Position,Altitude,Speed,Direction\n1714564800,2024-05-01T12:00:00Z,SAS1,"55.5,12.25",'
        '10000,400,90\n1714564810,2024-05-01T12:00:10Z,SAS1,"55.5,far",10000,400,90'
    )
    assert (reports.lat_deg.tolist(), reports.lon_deg.tolist()) == ([55.5], [12.25])
    assert reports.course_deg.tolist() == [90.0]
    assert reports.damaged.reasons.tolist() == ["longitude is no number"]


@pytest.mark.parametrize("before", ["[", '[{"ERROR": false, "RECORDS": 2}, [', '{"status": "ok", "data": ['])
def test_the_records_of_a_json_document_are_found_where_they_are(before):
    after = {"[": "]", "[{": "]]"}.get(before[:2].strip(), "]}") if before[0] == "[" else "]}"
    rows = [
        {"MMSI": 219000001 + k, "TIME": "2024-05-01 12:00:00 GMT", "LATITUDE": 55.0, "LONGITUDE": 12.0} for k in (0, 1)
    ]
    text = before + ", ".join(map(json.dumps, rows)) + after
    reports = read(cells_of_json(text.split("\n"), "aishub"), "aishub")
    assert list(reports.mmsi) == ["219000001", "219000002"]


def test_the_accuracy_of_ais_is_a_flag_and_no_error():
    """1 is an error below 10 m and 0 one above: as metres, they would be the best positions there are."""
    reports = table("time,mmsi,lat,lon,accuracy\n1e9,219000001,55.0,12.0,0\n1e9,219000002,56.0,12.0,1")
    assert reports.covariance_m2[:, 0].tolist() == [225.0, 25.0]
    assert any("accuracy is the accuracy flag of AIS" in note for note in reports.notes)
    reports = table("time,mmsi,lat,lon,accuracy\n1e9,219000001,55.0,12.0,12\n1e9,219000002,56.0,12.0,1")
    assert reports.covariance_m2[0, 0] == 144.0
    # As Spire writes it.
    reports = table("time,mmsi,lat,lon,accuracy\n1e9,219000001,55.0,12.0,LOW\n1e9,219000002,56.0,12.0,HIGH")
    assert reports.covariance_m2[:, 0].tolist() == [225.0, 25.0]


def test_the_number_of_a_row_is_no_track_where_every_row_has_an_mmsi():
    """Exports of databases number their rows: every report would be a track of its own."""
    rows = "1,1e9,219000001,55.0,12.0\n2,1000000010,219000001,55.0,12.0\n3,1e9,219000002,55.0,12.0"
    reports = table(f"id,time,mmsi,lat,lon\n{rows}")
    assert reports.track_id.tolist() == ["219000001", "219000001", "219000002"]
    assert any("columns not used: id" in note for note in reports.notes)
    reports = table(f"id,time,mmsi,lat,lon\n{rows}\n4,1e9,,55.0,12.0")
    assert reports.track_id.tolist() == ["1", "2", "3", "4"]


def test_speeds_of_marinetraffic_are_tenths_of_a_knot():
    names = "MMSI,SHIP_ID,LAT,LON,SPEED,HEADING,COURSE,STATUS,TIMESTAMP,DSRC"
    reports = table(f"{names}\n219000001,1,55.0,12.0,123,511,90,0,2026-06-01T12:00:00,TER")
    np.testing.assert_allclose(reports.speed_m_per_s, 12.3 * 1852 / 3600)
    assert any("tenths of a knot" in note for note in reports.notes)


def test_records_of_barentswatch_are_read():
    record = {"mmsi": 257000001, "msgtime": "2026-06-01T12:00:00+00:00", "latitude": 60.0, "longitude": 5.0,
              "speedOverGround": 10.0, "courseOverGround": 90.0, "trueHeading": None, "name": "EXAMPLE"}  # fmt: skip
    reports = read(cells_of_json([json.dumps([record])], "latest"), "latest")
    assert reports.time_s.tolist() == [1780315200.0] and reports.name.tolist() == ["EXAMPLE"]
    np.testing.assert_allclose(reports.speed_m_per_s, 10.0 * 1852 / 3600)


def test_messages_of_aisstream_have_their_content_under_their_type():
    """A message without a position comes with an old one, at the time of the message: it is not used."""
    place = {"Latitude": 55.5, "Longitude": 12.5}
    motion = {"Sog": 10.0, "Cog": 90.0, "TrueHeading": 511, "Timestamp": 17, "UserID": 219000001}

    def message(kind, content):
        about = {"MMSI": 219000001, "ShipName": "EXAMPLE    ", "latitude": 55.0, "longitude": 12.0,
                 "time_utc": "2026-06-01 12:00:00.123456789 +0000 UTC"}  # fmt: skip
        return json.dumps({"Message": {kind: content}, "MessageType": kind, "MetaData": about})

    lines = [message("PositionReport", place | motion), message("ShipStaticData", {"CallSign": "ABCD"})]
    reports = read(cells_of_json(lines, "stream"), "stream")
    assert (reports.lat_deg.tolist(), reports.lon_deg.tolist()) == ([55.5], [12.5])
    assert (reports.mmsi[0], reports.name[0]) == ("219000001", "EXAMPLE")
    assert reports.course_deg[0] == 90.0 and reports.heading_deg is None
    np.testing.assert_allclose(reports.speed_m_per_s, 10.0 * 1852 / 3600)
    np.testing.assert_allclose(reports.time_s, 1780315200.123457, atol=1e-6)


def test_tables_of_ais_give_the_middle_of_the_hull():
    """A ship of 300 m bound north, its antenna 40 m before the stern; one of unknown antenna; one of unknown size."""
    reports = table(
        "time,MMSI,lat,lon,SOG,COG,Heading,Length,Width,A,B,C,D\n"
        "1e9,219000001,55.0,12.0,10,0,511,300,40,260,40,30,10\n"
        "1e9,219000002,56.0,12.0,10,0,0,300,,,,,\n"
        "1e9,219000003,57.0,12.0,10,0,0,,,,,,"
    )
    north_m = (reports.lat_deg - [55.0, 56.0, 57.0]) * 111_300.0
    assert north_m == pytest.approx([110.0, 0.0, 0.0], abs=0.5)
    # C and D are port and starboard in ITU-R M.1371, and the reverse in tables of Danish AIS: neither is believed.
    assert reports.lon_deg.tolist() == pytest.approx([12.0, 12.0, 12.0], abs=1e-7)
    along = 225.0 + np.array([300.0**2 / 12.0, 300.0**2 / 6.0])
    assert reports.covariance_m2[:2, 2] == pytest.approx(along)
    assert np.isnan(reports.covariance_m2[2]).all()
    assert any("middle of the hull" in note for note in reports.notes)


def test_letters_of_other_tables_are_no_antenna():
    assert "to_bow_m" not in understood("time", "x", "y", "A", "B", "C", "D")


def test_base_stations_and_buoys_are_no_ships():
    """They are passed over in AIS sentences too; a coast station of number 002190001 is 2190001 as a number."""
    reports = table(
        "time,MMSI,lat,lon\n1e9,219000001,55.0,12.0\n1e9,2190001,56.0,12.0\n1e9,992190001,56.1,12.0\n1e9,0,56.2,12.0"
    )
    assert list(reports.mmsi) == ["219000001", "000000000"]
    assert reports.passed_over == {"base station or aid to navigation": 2}


ZONED = """time,lat,lon,mmsi
2024-07-01T14:00:00,54.1,8.0,211000001
2024-01-01T13:00:00,54.1,8.0,211000001
2024-07-01T14:00:00+03:00,54.1,8.0,211000002
2024-07-01T14:00:00Z,54.1,8.0,211000003
2024-07-01 14:00:00 UTC,54.1,8.0,211000005
1719842400,54.1,8.0,211000004
"""


@pytest.mark.parametrize(
    ("zone", "hours", "words"),
    [
        (None, [14, 13, 11, 14, 14, 14], "the others as UTC"),
        ("Europe/Berlin", [12, 12, 11, 14, 14, 14], "the others as the time of Europe/Berlin"),
        ("+02:00", [12, 11, 11, 14, 14, 14], "the others as the time of +02:00"),
        ("UTC-3", [17, 16, 11, 14, 14, 14], "the others as the time of UTC-3"),
    ],
)
def test_times_without_a_zone_are_of_the_given_one_and_each_row_states_its_own(zone, hours, words, tmp_path):
    (tmp_path / "coast.csv").write_text(ZONED)
    [made] = read_reports(tmp_path / "coast.csv", ReadOptions(time_zone=zone))
    assert (made.time_s / 3600.0 % 24.0).tolist() == hours
    assert f"coast.csv: time is read as the time of the zone that 1 of 6 rows state, {words}" in made.notes


def test_times_of_day_are_of_the_given_zone(tmp_path):
    (tmp_path / "coast.csv").write_text("time,lat,lon,mmsi\n23:59:00,54.1,8.0,211000001\n00:01:00,54.1,8.0,211000001\n")
    [made] = read_reports(tmp_path / "coast.csv", ReadOptions(start="2024-07-01T21:59Z", time_zone="Europe/Berlin"))
    assert (made.time_s - datetime(2024, 7, 1, 21, 59, tzinfo=UTC).timestamp()).tolist() == [0.0, 120.0]


@pytest.mark.parametrize("zone", ["Berlin", "MEZ", "+99:00", "../etc/passwd", ""])
def test_an_unknown_zone_is_refused(zone):
    with pytest.raises(InputError, match=r"is not known on this machine; give a name such as Europe/Berlin"):
        ReadOptions(time_zone=zone)


def test_formats_in_utc_have_no_zone(tmp_path):
    (tmp_path / "a.json").write_text('{"now": 1719842400, "aircraft": [{"hex": "3c0001", "lat": 54.0, "lon": 8.0}]}')
    with pytest.raises(InputError, match="the times of aircraft have no time_zone: they are UTC; leave it out"):
        read_reports(tmp_path / "a.json", ReadOptions(time_zone="+02:00"))


def test_a_single_report_with_a_list_in_it_is_one_report():
    """A stream may bring one line at a time; its list of tracks was read in its place."""
    row = {"time": 1e9, "lat": 55.0, "lon": 12.0, "mmsi": 219000001, "tracks": [{"time": 1e9, "lat": 1.0, "lon": 2.0}]}
    for lines in ([json.dumps(row)], [json.dumps(row)] * 2):
        reports = read(cells_of_json(lines, "other"), "other")
        assert set(reports.lat_deg.tolist()) == {55.0}


def test_tables_in_memory_are_read_like_files_of_their_name(tmp_path):
    from sameas.front.picture import sensor_sources

    columns = {"t": [1e9], "shipid": [7], "lat": [55.0], "lon": [12.0], "speed": [10.0], "course": [90.0]}
    (tmp_path / "ais.csv").write_text("t,shipid,lat,lon,speed,course\n1e9,7,55.0,12.0,10,90\n")
    for sources in ([tmp_path / "ais.csv"], {"ais": columns}):
        (source,) = sensor_sources(sources, {}, None)
        assert source.reports.speed_m_per_s[0] == pytest.approx(10 * KNOT)


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        ("Zeit;Breite;Länge;Kurs;Geschwindigkeit [kn];Schiffsname",
         "time_s lat_deg lon_deg course_deg speed_m_per_s name"),
        ("Datum;Uhrzeit;MMSI;geogr. Breite;geogr. Länge;Kurs über Grund;Fahrt",
         "time_s mmsi lat_deg lon_deg course_deg speed_m_per_s"),
        ("Uhrzeit;Ziel;Peilung (°);Entfernung (sm);Kurs;Fahrt (kn)",
         "time_s track_id bearing_deg range_m course_deg speed_m_per_s"),
        ("Horodatage;MMSI;Latitude;Longitude;Vitesse (noeuds);Cap;Longueur;Nom du navire",
         "time_s mmsi lat_deg lon_deg speed_m_per_s heading_deg length_m name"),
        ("Fecha y hora;Latitud;Longitud;Rumbo;Velocidad en nudos;Nombre del buque",
         "time_s lat_deg lon_deg course_deg speed_m_per_s name"),
        ("Tidspunkt;Breddegrad;Lengdegrad;Kurs;Fart;Skipsnavn", "time_s lat_deg lon_deg course_deg speed_m_per_s name"),
        ("tid;bredde;længde;kurs;hastighed", "time_s lat_deg lon_deg course_deg speed_m_per_s"),
        ("ora;latitudine;longitudine;rotta;velocità", "time_s lat_deg lon_deg course_deg speed_m_per_s"),
        ("Data/Hora;Latitude;Longitude;Rumo;Velocidade (nós)", "time_s lat_deg lon_deg course_deg speed_m_per_s"),
        ("tijd;breedtegraad;lengtegraad;koers;snelheid", "time_s lat_deg lon_deg course_deg speed_m_per_s"),
        # A width and a length where there is a position.
        ("time;lat;lon;mmsi;Breite;Länge", "time_s lat_deg lon_deg mmsi width_m length_m"),
        ("time;x;y;Länge;Breite", "time_s x_m y_m length_m width_m"),
        # The number of a target, in English.
        ("time;tid;x;y", "time_s x_m y_m"),
        ("date;tid;x;y", "time_s x_m y_m"),
        # The geodetic datum.
        ("tod;lat;lon;datum", "day_s lat_deg lon_deg"),
    ],
)  # fmt: skip
def test_names_in_other_languages_are_recognised_where_they_are_certain(names, expected):
    columns, expected = names.split(";"), expected.split()
    found = sorted(understood(*columns).items(), key=lambda one: columns.index(one[1]))
    assert [column for column, _ in found if column in expected] == expected
    assert {column for column, _ in found} == set(expected)


def test_a_table_of_a_german_excel_is_read(tmp_path):
    """Semicolons, decimal commas, dates with points beside the time, letters of Windows; knots, as it is AIS."""
    text = "Datum;Zeit;MMSI;Breite;Länge;Kurs;Geschwindigkeit;Schiffsname\n"
    text += "01.05.2024;12:00:10;211000001;54,5;10,25;90,0;10,0;MÜNCHEN\n"
    path = tmp_path / "ais.csv"
    for encoding in ("utf-8", "cp1252", "utf-8-sig"):
        path.write_bytes(text.replace("\n", "\r\n").encode(encoding))
        [made] = read_reports(path)
        assert (made.lat_deg[0], made.lon_deg[0], made.name[0]) == (54.5, 10.25, "MÜNCHEN")
        assert made.speed_m_per_s[0] == pytest.approx(10 * KNOT)
        assert made.time_s[0] == datetime(2024, 5, 1, 12, 0, 10, tzinfo=UTC).timestamp()
    assert any("Breite as lat_deg, Länge as lon_deg" in note for note in made.notes)


def test_breite_and_laenge_beside_ranges_are_a_place_where_they_cannot_be_sizes(tmp_path):
    """They were taken for the width and the length of the targets, of 52 m and 4 m."""
    rows = [
        f"2024-06-01T10:00:{3 * k:02d}Z;51,98{k:02d};4,00{k:02d};{2000 + 800 * (k % 3)};{45 + 90 * (k % 4)}"
        for k in range(9)
    ]
    (tmp_path / "radar.csv").write_text(
        "Zeit;Breite;Länge;Entfernung;Peilung\n" + "\n".join(rows) + "\n", encoding="utf-8"
    )
    [made] = read_reports(tmp_path / "radar.csv")
    assert made.width_m is None and made.lat_deg is None and made.station_lat_deg[:2].tolist() == [51.98, 51.9801]
    assert made.station_lon_deg[:2].tolist() == [4.0, 4.0001]
    sizes = [row.replace("51,98", "2").replace(";4,00", ";12") for row in rows]
    (tmp_path / "radar.csv").write_text(
        "Zeit;Breite;Länge;Entfernung;Peilung\n" + "\n".join(sizes) + "\n", encoding="utf-8"
    )
    [made] = read_reports(tmp_path / "radar.csv")
    assert made.station_lat_deg is None and made.width_m[0] == 200.0 and made.length_m[0] == 1200.0


def test_dates_of_other_languages_have_the_day_first():
    made = table("Fecha;Hora;Latitud;Longitud;MMSI\n01/05/2024;12:00:10;54,5;10,25;211000001\n")
    assert made.time_s[0] == datetime(2024, 5, 1, 12, 0, 10, tzinfo=UTC).timestamp()
    made = table("Tijdstip;Breedte;Lengte;MMSI\n01-05-2024 12:00:10;54,5;10,25;211000001\n")
    assert made.time_s[0] == datetime(2024, 5, 1, 12, 0, 10, tzinfo=UTC).timestamp()


def test_all_missing_columns_are_named_at_once():
    with pytest.raises(InputError) as refusal:
        table("foo,bar\n1,2\n")
    assert str(refusal.value) == (
        "radar.csv: no columns of time and a position among: foo, bar; give columns={'time_s': NAME, 'lat_deg': NAME, "
        "'lon_deg': NAME}, or those of x_m and y_m, range_m and bearing_deg"
    )


def test_a_length_without_the_place_of_the_antenna_moves_nothing_and_says_so():
    made = table("time,mmsi,lat,lon,cog,sog,length,width\n0,211000001,54.5,10.25,0,10,120,20\n")
    assert (made.lat_deg[0], made.lon_deg[0]) == (54.5, 10.25) and made.covariance_m2[0, 2] > 15.0**2
    [note] = [note for note in made.notes if "hull" in note]
    assert "are not moved" in note and "middle of the hull" not in note


def test_values_that_mean_not_available_are_no_bearings_speeds_or_heights(tmp_path):
    rows = [
        "0,235000001,50.0,-1.0,10.0,90.0,91,20,",  # good
        "1,235000001,50.0,-1.0,102.3,360.0,511,20,",  # of AIS
        "2,235000001,91.0,181.0,10.0,90.0,91,20,",
        "3,235000001,50.0,-1.0,1023,3600,-999,-9999,",
        "4,235000001,50.0,-999,10.0,90.0,91,99999999,",
        "5,235000001,50.0,-1.0,-1,9999,999,20,",
    ]
    (tmp_path / "ais.csv").write_text("time,mmsi,lat,lon,sog_kn,cog,heading,alt_m,length\n" + "\n".join(rows) + "\n")
    [found] = read_reports(tmp_path / "ais.csv")
    assert dict(zip(found.damaged.lines, found.damaged.reasons, strict=True)) == {4: "no position", 6: "no position"}
    np.testing.assert_allclose(found.speed_m_per_s / 0.514444, [10.0, np.nan, np.nan, np.nan], rtol=1e-5)
    np.testing.assert_array_equal(found.course_deg, [90.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(found.heading_deg, [91.0, np.nan, np.nan, np.nan])
    np.testing.assert_array_equal(found.alt_m, [20.0, 20.0, np.nan, 20.0])
    assert "ais.csv: heading: 3 values of -999, 511, 999 not used: missing" in found.notes


def test_bearings_and_ranges_that_mean_not_available_are_no_plots(tmp_path):
    good = [f"{t},{4000 + t},{(40 + t) % 360}" for t in range(20)]
    bad = ["20,4100,-999", "21,4200,511", "22,-999,40", "23,9999,40", "24,9999,41", "25,9999,42", "26,4300,3600"]
    (tmp_path / "radar.csv").write_text("time,range_m,bearing_deg\n" + "\n".join([*good, *bad]) + "\n")
    [found] = read_reports(tmp_path / "radar.csv")
    assert found.damaged.counts() == {"no position": 3, "a distance below 0": 1}
    assert found.range_m is not None and np.isnan(found.range_m).tolist() == [False] * 20 + [True] * 3
    assert "radar.csv: range_m: 3 values of 9999 not used: missing" in found.notes
    # One of 9999 m among many distances is a distance.
    (tmp_path / "radar.csv").write_text("time,range_m,bearing_deg\n" + "\n".join([*good, bad[3]]) + "\n")
    [found] = read_reports(tmp_path / "radar.csv")
    assert len(found) == 21


@pytest.mark.parametrize(
    ("heights", "kept"), [("0", 0), ("99999", 0), ("-9999", 0), ("5000", 12), ("", 0), ("250000", 0)]
)
def test_heights_that_a_source_does_not_measure_are_none(heights, kept, tmp_path):
    rows = "".join(f"{t},4ca7a8,50.0,-1.0,{heights}\n" for t in range(0, 36, 3))
    (tmp_path / "adsb.csv").write_text("time,icao,lat,lon,alt_m\n" + rows)
    [found] = read_reports(tmp_path / "adsb.csv")
    assert (0 if found.alt_m is None else int(np.isfinite(found.alt_m).sum())) == kept


def test_angles_a_little_beyond_a_turn_are_angles():
    made = Reports.of("radar", "table", {"time_s": [0.0] * 5, "range_m": [9.0] * 5,
                                         "bearing_deg": [-170.0, 361.5, -0.5, 700.0, 511.0]})  # fmt: skip
    assert made.bearing_deg is not None and made.bearing_deg.tolist() == [190.0, 1.5, 359.5]
    assert made.damaged.counts() == {"no position": 2}


BOW = "time_s,rel_brg,range_m,{}\n0,350,1000,20\n1,10,1000,355\n2,10,1000,\n"


@pytest.mark.parametrize("name", ["own_heading", "HDG (deg)", "Ownship Heading"])
def test_bearings_from_the_bow_are_turned_by_the_heading_beside_them(name):
    reports = table(BOW.format(name))
    assert reports.bearing_deg.tolist() == [10.0, 5.0] and reports.relative_bearing_deg is None
    assert reports.station_heading_deg.tolist() == [20.0, 355.0] and reports.heading_deg is None
    assert reports.damaged.sentences() == ["1 line damaged: no heading of the vessel with the sensor (line 4)"]
    why = f"rel_brg is relative to the bow of the vessel with the sensor; the heading, {name}, is added"
    assert any(why in note for note in reports.notes)


def test_bearings_from_the_bow_without_a_heading_wait_for_that_of_another_source():
    reports = table("time_s,Relative bearing,range_m\n0,350,1000\n1,-10,1000\n")
    assert reports.bearing_deg is None and reports.relative_bearing_deg.tolist() == [350.0, 350.0]
    why = "Relative bearing is relative to the bow of the vessel with the sensor; no column has the heading"
    assert any(why in note for note in reports.notes)


def test_true_bearings_take_precedence_over_those_from_the_bow():
    reports = table("time_s,bearing,rel_bearing,range_m,heading\n0,10,350,1000,20\n")
    assert reports.bearing_deg.tolist() == [10.0] and reports.heading_deg.tolist() == [20.0]
    assert any("columns not used: rel_bearing" in note for note in reports.notes)


def test_answers_of_opensky_are_read(tmp_path):
    """The states are lists in a fixed order, at the time of their positions, in metres and metres a second."""
    state = ["a1b2c3", "AFR123  ", "France", 1655683198, 1655683199, 2.5, 48.5, 9144.0, False, 210.5, 90.0, -3.25, [7],
             9448.8, "1000", False, 0]  # fmt: skip
    unknown = ["a1b2c4", None, "France", None, 1655683199, None, None, None, True, None, None, None, None, None, None,
               False, 0]  # fmt: skip
    answers = [{"time": 1655683200, "states": [state, unknown]}, {"time": 1655683210, "states": None}]
    file = tmp_path / "adsb.jsonl"
    file.write_text("".join(json.dumps(answer) + "\n" for answer in answers))
    [made] = read_reports(file)
    assert made.time_s.tolist() == [1655683198.0] and made.callsign.tolist() == ["AFR123"]
    assert (made.lat_deg[0], made.lon_deg[0], made.speed_m_per_s[0], made.course_deg[0]) == (48.5, 2.5, 210.5, 90.0)
    assert (made.pressure_alt_m[0], made.alt_m[0], made.climb_m_per_s[0]) == (9144.0, 9448.8, -3.25)
    assert made.damaged.sentences() == ["1 state damaged: no time (state 2)"]


@pytest.mark.parametrize("orient", ["columns", "index", "split", "records"])
def test_tables_of_pandas_in_json_are_read_in_each_form(orient, tmp_path):
    """Columns of cells by row were taken for a table of 12 columns, and refused where there were many rows."""
    pandas = pytest.importorskip("pandas")
    table = pandas.DataFrame({"timestamp": [1.7e12 + 1e3 * k for k in range(4)], "icao24": ["39d300"] * 4,
                              "latitude": [48.0, 48.1, None, 48.3], "longitude": [2.0, 2.1, 2.2, 2.3]})  # fmt: skip
    file = tmp_path / "adsb.json"
    table.to_json(file, orient=orient)
    [made] = read_reports(file)
    assert made.lat_deg.tolist() == [48.0, 48.1, 48.3] and made.time_s[1] == 1.7e9 + 1
    assert made.damaged.sentences() == ["1 record damaged: no position (record 3)"]


@pytest.mark.parametrize("text", [
    '{"columns": ["time", "lat", "lon"], "data": [[1, 2], 3]}', '{"columns": 4, "data": [[1]]}',
    '{"time": 1655683200, "states": 7}', '{"a": {"0": 1}, "b": {"0": [1]}}', '{"time": null, "states": [[], 5]}',
])  # fmt: skip
def test_broken_documents_are_refused_in_words(text, tmp_path):
    (tmp_path / "adsb.json").write_text(text)
    with pytest.raises(InputError, match=r"no columns? of|no row can be used|no JSON object"):
        read_reports(tmp_path / "adsb.json")


def test_the_navigational_status_of_ais_is_read_as_number_or_text_and_that_of_others_is_not():
    """Live, a ship that says she is moored is berthed; of tables nobody was."""
    rows = ["Moored", "At anchor", "Under way using engine", "5", "1.0", "15", ""]
    lines = [f"2024-05-01T12:0{k}:00Z,235000001,50.0,-1.{k},{text}" for k, text in enumerate(rows)]
    ais = table("time,mmsi,lat,lon,Navigational status\n" + "\n".join(lines) + "\n")
    assert np.array_equal(ais.extra["nav_status"], [5.0, 1.0, np.nan, 5.0, 1.0, np.nan, np.nan], equal_nan=True)
    plots = "time,range_m,bearing_deg,status\n2024-05-01T12:00:00Z,500,20,5\n2024-05-01T12:00:03Z,510,20,1\n"
    radar = table(plots)
    assert "nav_status" not in radar.extra and "columns not used: status" in " ".join(radar.notes)


def plots_of_a_boat(names, *, own=True):
    """Ten scans of three buoys from a boat that goes north at 5 m/s; places of the boat, or of the buoys."""
    buoys, rows = np.array([[900.0, 400.0], [-1500.0, 2000.0], [300.0, -2500.0]]), []
    for k in range(10):
        for x, y in buoys - [0.0, 12.5 * k]:
            north, east = (12.5 * k, 0.0) if own else (y + 12.5 * k, x)
            rows.append(
                f"{2.5 * k},{np.hypot(x, y):.1f},{np.degrees(np.arctan2(x, y)) - 5.0:.1f},"
                f"{50.0 + north / 111200.0:.6f},{-1.0 + east / 71480.0:.6f},5,9.7,{10 + k % 2}"
            )
    return table("\n".join([names, *rows]), start_s="2024-05-01T10:00:00Z")


@pytest.mark.parametrize("bearing", ["RelBearing_deg", "bearing_deg"])
def test_places_beside_plots_that_jump_are_those_of_the_boat(bearing):
    """They were those of the plots: all stood at the boat, and the ranges were not used."""
    found = plots_of_a_boat(f"time,range_m,{bearing},lat,lon,heading,SOG,COG")
    assert found.position == "polar" and np.ptp(found.station_lat_deg) > 0.001 and found.speed_m_per_s is None
    assert found.station_heading_deg.tolist() == [5.0] * 30 and found.heading_deg is None
    expected = np.degrees(np.arctan2(900.0, 400.0)) - (5.0 if bearing == "bearing_deg" else 0.0)
    assert found.bearing_deg[0] == pytest.approx(expected, abs=0.06)
    assert "radar.csv: lat, lon, heading, SOG, COG: read as those of the vessel with the sensor" in found.notes


def test_places_beside_plots_that_jump_with_them_are_those_of_the_plots():
    found = plots_of_a_boat("time,range_m,RelBearing_deg,lat,lon,heading,SOG,COG", own=False)
    assert found.position == "geodetic" and found.station_lat_deg is None and found.relative_bearing_deg is None
    assert found.speed_m_per_s[0] == pytest.approx(9.7 * KNOT) and found.heading_deg[0] == 5.0


def test_speeds_that_stay_while_plots_jump_are_the_boats():
    found = plots_of_a_boat("time,range_m,bearing_deg,own_lat,own_lon,own_heading,SOG,COG")
    assert found.station_heading_deg[0] == 5.0 and found.speed_m_per_s is None and found.course_deg is None


def test_static_data_of_ships_in_rows_of_their_own_are_read_and_are_no_damage():
    found = table("""
time,mmsi,lat,lon,shipname,to_bow,to_stern,to_port,to_starboard
2024-05-01T10:00:00Z,235000111,50.0,-1.0,,,,,
2024-05-01T10:00:01Z,235000111,,,FERRY,40,60,8,8
2024-05-01T10:00:02Z,235000222,50.1,-1.0,,,,,
2024-05-01T10:00:03Z,235000222,,,,,,,
2024-05-01T10:00:04Z,235000222,,-1.0,PILOT,,,,
""")
    assert found.passed_over == {"static data of ships, without a position": 1}
    assert found.damaged.counts() == {"no position": 2}
    assert found.name.tolist() == ["FERRY", None] and found.covariance_m2[0, 0] > 100.0


def scans(scans, **more):
    """Rows of JSON lines, of scans with a list of plots each."""
    return [json.dumps({"t": 1714557600.0 + 2.5 * k, "own_lat": 50.0, "own_lon": -1.0, "plots": plots} | more)
            for k, plots in enumerate(scans)]  # fmt: skip


def test_plots_in_a_list_of_each_scan_are_reports_of_its_time():
    """Such a file had no columns of a position."""
    plots = [{"range": 900.0, "azimuth": 12.5}, {"range": 400.0, "azimuth": 300.0}]
    found = read(cells_of_json(scans([plots, [], plots[:1]]), "radar"), "radar")
    assert found.range_m.tolist() == [900.0, 400.0, 900.0] and found.bearing_deg.tolist() == [12.5, 300.0, 12.5]
    assert (found.time_s - found.time_s[0]).tolist() == [0.0, 0.0, 5.0] and found.line.tolist() == [1, 1, 3]
    assert found.station_lat_deg.tolist() == [50.0] * 3 and not found.damaged.counts()
    # The list beside a report's own position is not of other reports.
    found = read(cells_of_json(scans([plots], lat=51.0, lon=-1.0), "radar"), "radar", ReadOptions(kind="ais"))
    assert len(found) == 1 and found.lat_deg.tolist() == [51.0]


def test_a_radars_topic_of_ros_in_radians_is_read():
    rng = np.random.default_rng(1)
    angle = rng.uniform(0.0, 2.0 * np.pi, 60)
    rows = [f"{1714557600000000000 + k},{k},radar,{900.0 + k},{one:.5f}" for k, one in enumerate(angle)]
    found = table("\n".join(["%time,field.header.seq,field.header.frame_id,field.range,field.azimuth", *rows]))
    assert np.allclose(found.bearing_deg, np.degrees(angle), atol=1e-3) and found.range_m[1] == 901.0
    assert "radar.csv: azimuth is read in rad, by its size: its name states no unit" in found.notes


@pytest.mark.parametrize(
    ("name", "angle"),
    [("azimuth_deg", np.arange(60) * 2.5 % 6.28), ("azimuth", np.linspace(0.0, 6.2, 60)),
     ("azimuth", np.linspace(0.0, 3.0, 60)), ("azimuth", np.linspace(0.0, 359.0, 60))],
)  # fmt: skip
def test_degrees_are_no_radians(name, angle):
    """By their name; since they follow each other, as of one object; over half a turn; beyond one."""
    rows = [f"2024-05-01T10:{k:02d}:00Z,900,{one}" for k, one in enumerate(angle)]
    assert np.allclose(table("\n".join([f"time,range_m,{name}", *rows])).bearing_deg, angle)


def test_steps_of_an_antenna_are_refused_without_their_number_and_read_with_it():
    """Those above 450 were missing bearings, and the others were degrees."""
    rows = "\n".join(["time,range_m,azimuth", *(f"2024-05-01T10:00:{k % 60:02d}Z,900,{k * 64}" for k in range(64))])
    with pytest.raises(InputError, match="azimuth goes to 4032, which no bearing in degrees does; give units="):
        table(rows)
    found = table(rows, units={"azimuth": "4096 per turn"})
    assert found.bearing_deg.tolist() == [k * 64 * 360.0 / 4096.0 for k in range(64)]


@pytest.mark.parametrize(
    ("names", "columns"),
    [
        (("Date", "Time", "Range_m", "Azimuth_deg_true", "OwnLatitude", "OwnLongitude", "Ship Heading"),
         {"bearing_deg": "Azimuth_deg_true", "station_lat_deg": "OwnLatitude", "station_lon_deg": "OwnLongitude",
          "station_heading_deg": "Ship Heading"}),
        (("ts", "rng", "brg_rel", "vessel_lat", "vessel_lng"),
         {"time_s": "ts", "relative_bearing_deg": "brg_rel", "station_lat_deg": "vessel_lat"}),
        (("epoch", "range_meters", "angle_deg", "ship_latitude", "ship_longitude"),
         {"range_m": "range_meters", "bearing_deg": "angle_deg", "station_lat_deg": "ship_latitude"}),
    ],
)  # fmt: skip
def test_columns_of_radars_on_boats(names, columns):
    assert columns.items() <= understood(*names).items()


def test_comments_above_the_names_are_no_names():
    """A comment with a comma was."""
    found = table("""
# RV Callista, radar plots
# radar: DRS4D, range 4 nm, gain 60, sea 20
time,range_m,azimuth
2024-05-01T10:00:00Z,900,10
""")
    assert found.bearing_deg.tolist() == [10.0]
    commented = "# made by a logger, version 3\n# time,range_m,azimuth\n2024-05-01T10:00:00Z,900,10"
    assert table(commented).bearing_deg.tolist() == [10.0]


def test_seconds_from_zero_count_from_the_start_that_is_given():
    """It was not used, and without a word."""
    found = table("t_s,range_m,azimuth\n0.0,900,10\n2.5,900,12", start_s="2024-05-01T10:00:00Z")
    assert (found.time_s - 1714557600.0).tolist() == [0.0, 2.5]
    assert found.notes[0] == "radar.csv: times are read as seconds since the start"
