"""Header keywords of many observatories; every assumption is reported."""

import numpy as np
import pytest
from astropy.io import fits
from astropy.time import Time

from sameas.errors import InputError
from sameas.sky.frame.cards import Card
from sameas.sky.frame.keywords import Facts, Given, plateau


def facts(given=None, comments=None, **cards):
    header = fits.Header()
    for name, value in cards.items():
        name = name.replace("_", "-")
        header[name] = (value, (comments or {}).get(name, ""))
    return Facts.of(header, given)


MIDDLE = "2018-10-18T03:03:53.784"


@pytest.mark.parametrize(
    "cards",
    [
        {"DATE_OBS": "2018-10-18T03:01:53.784", "EXPTIME": 240.0},
        {"DATE_OBS": "2018-10-18", "TIME_OBS": "03:01:53.784", "EXPOSURE": "240.0"},
        {"DATE_OBS": "2018/10/18", "UT": "03 01 53.784", "EXPTIME": 240},
        {"DATE_OBS": "18/10/2018", "UT": "03:01:53.784", "EXPTIME": 240},
        {"MJD_OBS": Time("2018-10-18T03:01:53.784").mjd, "EXPTIME": 240.0},
        {"JD": Time("2018-10-18T03:01:53.784").jd, "EXPTIME": 240.0},
        {"DATE_OBS": "2018-10-18T03:01:53.784", "DATE_END": "2018-10-18T03:05:53.784"},
        {"DATE_OBS": "2018-10-17T20:01:53.784-0700", "DATE_END": "2018-10-17T20:05:53.784-0700"},
        {"DATE_OBS": "2018-10-18T05:01:53.784+02:00", "EXPTIME": 240.0},
        {"DATE_OBS": "2018-10-18T03:01:53.784Z", "EXPTIME": 240.0},
        {"DATE_AVG": MIDDLE, "DATE_OBS": "2018-10-18T03:00:00", "EXPTIME": 1.0},
        {"DATE_OBS": "18/10/18", "UT": "03:01:53.784", "EXPTIME": 240},
        {"DATE_OBS": "10/18/2018", "UT": "03:01:53.784", "EXPTIME": 240},
        {"DATE_OBS": "2018-10-18", "TIME_OBS": "03:01:53.784 AM", "EXPTIME": 240},
        {"DATE_OBS": "18-Oct-2018 03:01:53.784", "EXPTIME": 240},
        {"DATE_OBS": "20181018T030153.784", "EXPTIME": 240},
        {"DATE_OBS": "2018.10.18 03:01:53.784", "EXPTIME": 240},
    ],
)
def test_mid_exposure_is_computed(cards):
    time = facts(**cards).time()
    assert abs((time - Time(MIDDLE)).sec) < 1e-3
    assert time.scale == "utc"


@pytest.mark.parametrize("name", ["IM_SCALE", "PIXSCALE", "SECPIX", "PIXELSCL", "SECPPIX"])
def test_the_pixel_scale_is_read_under_its_many_names(name):
    header = fits.Header()
    header[name] = 5.21
    assert Facts.of(header).scale_arcsec_per_px == 5.21


def test_a_pixel_scale_in_degrees_is_read():
    assert facts(PIXSCALE=0.0014472, comments={"PIXSCALE": "[deg/px]"}).scale_arcsec_per_px == pytest.approx(
        5.21, abs=1e-3
    )


def test_the_time_scale_is_that_of_the_header():
    assert facts(DATE_OBS="2018-10-18T03:01:53", TIMESYS="TDB", EXPTIME=2).time().scale == "tdb"
    assert "assumed: times are UTC (no TIMESYS)" in facts(DATE_OBS="2018-10-18T03:01:53", EXPTIME=2).lines


@pytest.mark.parametrize(("scale", "shift_s"), [("GPS", -18.0), ("UTC(NIST)", 0.0), ("IAT", -37.0)])
def test_the_time_scales_of_the_fits_standard_are_known(scale, shift_s):
    read = facts(DATE_OBS="2018-10-18T03:01:53.784", TIMESYS=scale, EXPTIME=240.0)
    assert abs((read.time() - Time(MIDDLE)).sec - shift_s) < 1e-3
    assert not any(line.startswith("doubt") for line in read.lines)


@pytest.mark.parametrize(
    ("cards", "doubt"),
    [
        ({"DATE_OBS": "18. Oct 2018"}, "doubt: DATE-OBS = '18. Oct 2018' is no time; MJD-OBS is used"),
        ({"DATE_OBS": "2018-13-45T03:01:53"}, "doubt: DATE-OBS = '2018-13-45T03:01:53' is no time; MJD-OBS is used"),
        ({"DATE_AVG": "now"}, "doubt: DATE-AVG = 'now' is no time; MJD-OBS is used"),
        ({"DATE_OBS": "2017-10-18"}, "doubt: DATE-OBS = '2017-10-18' is not the day of MJD-OBS; MJD-OBS is used"),
        ({"DATE_OBS": "2018-10-18"}, ""),
        ({"UTSTART": "03:01:53"}, ""),
    ],
)
def test_a_time_that_cannot_be_read_is_named_where_another_is_used(cards, doubt):
    read = facts(MJD_OBS=Time("2018-10-18T03:01:53.784").mjd, EXPTIME=240.0, **cards)
    assert abs((read.time() - Time(MIDDLE)).sec) < 1e-3
    assert [line for line in read.lines if line.startswith("doubt")] == ([doubt] if doubt else [])


def test_a_time_that_cannot_be_read_is_named_where_there_is_no_other():
    lines = facts(DATE_OBS="yesterday", EXPTIME=2).lines
    assert "doubt: DATE-OBS = 'yesterday' is no time" in lines
    assert "doubt: the header has no time (DATE-OBS, MJD-OBS, JD); motion and movers need one" in lines


def test_local_time_and_years_of_two_digits_are_named():
    lines = facts(DATE_OBS="2018-10-18T03:01:53", TIMESYS="LOCAL", EXPTIME=2).lines
    assert "doubt: TIMESYS = 'LOCAL' is no known time scale; times are taken as UTC" in lines
    for clock in ({"UT": "03:01:53"}, {}):
        lines = facts(DATE_OBS="18/10/25", EXPTIME=2, PLATEID="07HH", **clock).lines
        assert "assumed: DATE-OBS = '18/10/25' is of 1925, as in FITS before 2000" in lines
        lines = facts(DATE_OBS="18/10/25", EXPTIME=2, **clock).lines
        assert "assumed: DATE-OBS = '18/10/25' is of 2025, as there were no such detectors in 1925" in lines
    assert not any("before 2000" in line for line in facts(DATE_OBS="18/10/2018", EXPTIME=2).lines)


def test_universal_time_of_an_old_plate_is_converted_to_tt():
    plate = facts(comments={"EXPOSURE": "Exposure time minutes"}, DATE_OBS="29/11/51", UT="12:07:00.00", EXPOSURE=50.0)
    assert plate.exposure_s == 3000
    assert plate.time().scale == "tt"
    assert plate.time().jyear == pytest.approx(1951.910, abs=2e-3)
    assert any("there was no UTC before 1960" in line for line in plate.lines)


def test_a_date_without_time_means_noon_and_disagreeing_clocks_are_reported():
    assert any(line.startswith("assumed: 12:00") for line in facts(DATE_OBS="2018-10-18", EXPTIME=0.0).lines)
    lines = facts(DATE_OBS="2018-10-18T03:01:53", MJD_OBS=58409.5, EXPTIME=10).lines
    assert any(line.startswith("doubt: MJD-OBS differs from DATE-OBS by") for line in lines)


def test_an_afternoon_is_not_taken_for_a_morning():
    assert facts(DATE_OBS="2018-10-17", TIME_OBS="11:01:53 PM", EXPTIME=0.0).time().isot == "2018-10-17T23:01:53.000"
    assert facts(DATE_OBS="2018-10-17", TIME_OBS="12:01:53 a.m.", EXPTIME=0.0).time().isot == "2018-10-17T00:01:53.000"


@pytest.mark.parametrize(
    ("cards", "middle", "doubt"),
    [
        ({"LIVETIME": 1200.0, "STACKCNT": 20}, "20:10:00", "a stack of 1200 s (LIVETIME) without the time of its end"),
        ({"NCOMBINE": 20}, "20:00:30", "a stack of 20 frames (NCOMBINE) without the time of its end: its middle may"),
        ({"LIVETIME": 1200.0, "DATE-END": "2024-02-24T20:30:00"}, "20:15:00", None),
        ({"LIVETIME": 59.0, "NCOMBINE": 1}, "20:00:30", None),
    ],
)
def test_the_middle_of_a_stack_is_that_of_all_its_frames(cards, middle, doubt):
    """It was the middle of the first frame, without a word."""
    found = facts(**{"DATE-OBS": "2024-02-24T20:00:00", "EXPTIME": 60.0}, **cards)
    assert found.mid_time.isot.startswith(f"2024-02-24T{middle}")
    assert [doubt in line for line in found.lines if "stack" in line and "doubt" in line] == ([True] if doubt else [])


def test_the_end_of_an_exposure_is_recognised_by_its_comment():
    read = facts(comments={"DATE-OBS": "UTC at end of exposure"}, DATE_OBS="2018-10-18T03:05:53.784", EXPTIME=240.0)
    assert abs((read.time() - Time(MIDDLE)).sec) < 1e-3


@pytest.mark.parametrize(
    ("cards", "doubt"),
    [
        (
            {"DATE_OBS": "2018-10-17T23:01:53", "UT": "03:01:53"},
            "doubt: UT differs from DATE-OBS by 4 h (is DATE-OBS local time?); DATE-OBS is used",
        ),
        ({"DATE_OBS": "2018-10-18T03:01:53", "UT": "03:01:53"}, ""),
        ({"DATE_OBS": "2018-10-18T23:59:59", "UT": "00:00:03"}, ""),
        (
            {"DATE_OBS": "2018-10-19T03:01:53", "MJD_OBS": Time("2018-10-18T03:01:53").mjd},
            "doubt: MJD-OBS differs from DATE-OBS by 1 d; DATE-OBS is used",
        ),
        ({"DATE_OBS": "1970-01-01T00:00:00"}, "doubt: DATE-OBS = '1970-01-01T00:00:00' is where a clock starts that"),
        ({"DATE_OBS": "2018-10-18T03:01:53", "EXPTIME": 60000.0}, "doubt: an exposure of 16.7 h: is EXPTIME in milli"),
        (
            {"DATE_OBS": "2018-10-18T03:01:53", "DATE_END": "2018-10-18T03:02:03", "EXPTIME": 60.0},
            "doubt: the exposure of 60 s is longer than the 10 s until DATE-END",
        ),
    ],
)
def test_clocks_that_contradict_each_other_are_doubted(cards, doubt):
    doubts = [line for line in facts(**{"EXPTIME": 10.0} | cards).lines if line.startswith("doubt")]
    assert [line[: len(doubt)] for line in doubts] == ([doubt] if doubt else [])


def test_local_time_by_its_comment_is_used_only_where_nothing_else_is():
    local = {"DATE_OBS": "2018-10-17T23:01:53.784", "EXPTIME": 240.0, "comments": {"DATE-OBS": "Start, local time"}}
    assert abs((facts(**local, JD=Time("2018-10-18T03:01:53.784").jd).time() - Time(MIDDLE)).sec) < 1e-3
    assert any("DATE-OBS is local time by its comment" in line for line in facts(**local).lines)
    zoned = local | {"DATE_OBS": "2018-10-17T23:01:53.784-0400"}
    assert abs((facts(**zoned).time() - Time(MIDDLE)).sec) < 1e-3


def test_a_sidereal_time_that_fits_neither_sign_of_the_longitude_is_a_doubt():
    site = {"SITELAT": "42 36 36", "SITELONG": "-71 29 06", "EXPTIME": 0.0}
    right = facts(**site, DATE_OBS="2018-10-18T03:01:53", LST="00:02:10.1")
    local = facts(**site, DATE_OBS="2018-10-17T23:01:53", LST="00:02:10.1")
    assert not any("sidereal" in line or "LST = " in line for line in right.lines)
    assert any(line.startswith("doubt: LST = 00:02:10.1 is 4.0 h ahead of the time") for line in local.lines)


@pytest.mark.parametrize(
    ("cards", "comments", "how"),
    [
        ({"SITELONG": "+71 29 06", "LST": "00:02:10.1"}, {}, "west positive by LST"),
        ({"SITELONG": "-71 29 06", "LST": "00:02:10.1"}, {}, "east positive by LST"),
        ({"LONGITUD": "71:29:06 W"}, {}, "its letter"),
        ({"LONGITUD": 71.485}, {"LONGITUD": "[deg] longitude, west positive"}, "west positive by its comment"),
        ({"GEOLON": -71.485}, {}, "assumed: east positive"),
        ({"SITELONG": "+71 29 06", "SWCREATE": "TheSkyX Version 10.5.0"}, {}, "west positive as TheSkyX"),
        ({"GEOLON": 288.515}, {}, "east positive"),
    ],
)
def test_longitudes_of_either_sign_convention_are_read(cards, comments, how):
    found = facts(
        comments=comments, DATE_OBS="2018-10-18T03:01:53", EXPTIME=240, SITELAT="+42 36 36", GEOLAT=42.61, **cards
    )
    assert found.station.lon_deg == pytest.approx(-71.485, abs=1e-3)
    assert found.station.lat_deg == pytest.approx(42.61, abs=1e-3)
    assert any(how in line for line in found.lines)


@pytest.mark.parametrize(("longitude", "how"), [(110.88, "west"), (-110.88, "east")])
def test_the_sign_of_a_longitude_follows_from_the_time_zone(longitude, how):
    """MicroObservatory writes longitudes west positive, and sidereal times that fit neither sign."""
    cards = {"SITELAT": 31.68, "SITELONG": longitude, "LST_OBS": "17:04:23", "EXPTIME": 60.0}
    found = facts(DATE_OBS="2017-12-19T18:33:43.317-0700", **cards)
    assert found.station.lon_deg == pytest.approx(-110.88)
    assert any(f"{how} positive by the time zone of DATE-OBS" in line for line in found.lines)


def test_the_observatory_code_is_found():
    site = facts(SITELAT="42 36 36", SITELONG="288 30 54", ORIGIN="MIT Wallace Astrophysical Observatory (810)").station
    assert site.code == "810"


@pytest.mark.parametrize(
    "cards",
    [
        {"OBJCTRA": "04 10 08.801", "OBJCTDEC": "-22 50 22.5"},
        {"RA": "04:10:08.801", "DEC": "-22:50:22.5"},
        {"RA": 62.53667, "DEC": -22.83958},
    ],
)
def test_aims_in_hours_and_in_degrees_are_read(cards):
    assert facts(**cards).aim_deg == pytest.approx((62.53667, -22.83958), abs=1e-4)


@pytest.mark.parametrize(
    ("ra", "dec", "comment"),
    [
        (4.1691113, -22.83958, "[h] right ascension"),
        (4.1691113, -22.83958, "RA (hours)"),
        ("4.1691113 h", "-22.83958", ""),
        ("62:32:12.0", "-22:50:22.5", ""),
        ("04:10:08.801", "-22:50:22.5", "hh:mm:ss"),
        ("04:10.14668", "-22:50.375", ""),
        (1.0914707, -0.3986258, "[rad]"),
        ("62.53667 deg", "-22.83958 deg", ""),
    ],
)
def test_the_unit_of_an_aim_is_found(ra, dec, comment):
    read = facts(RA=ra, DEC=dec, comments={"RA": comment})
    assert read.aim_deg == pytest.approx((62.53667, -22.83958), abs=1e-4)
    assert read.other_aims_deg == ()


def test_a_number_without_unit_may_be_hours_and_other_keywords_come_after_the_first():
    read = facts(RA=4.1691113, DEC=-22.83958, TELRA="10:00:00", TELDEC="+10:00:00", CRVAL1=4.17, CRVAL2=-22.84)
    assert read.aim_deg == pytest.approx((4.1691113, -22.83958))
    assert np.array(read.other_aims_deg) == pytest.approx(np.array([[150.0, 10.0], [62.53667, -22.83958]]))
    assert sum(line.startswith("also possible") for line in read.lines) == 2


def test_an_aim_that_cannot_be_or_was_not_set_is_doubted():
    read = facts(OBJCTRA="00 00 00", OBJCTDEC="+00 00 00", RA=62.5, DEC=-22.8, TELRA="62,5", TELDEC="-22,8")
    assert read.aim_deg == (62.5, -22.8) and read.other_aims_deg == ()
    assert "doubt: OBJCTRA and OBJCTDEC are 0, as of a mount that was not set; not used" in read.lines
    assert "doubt: TELRA = 62,5, TELDEC = -22,8 are no direction; not used" in read.lines


def test_an_aim_of_another_equinox_is_precessed():
    ra, dec = facts(RA="04:10:08.8", DEC="+22:50:22.5", EQUINOX=1950.0).aim_deg
    assert (ra, dec) == pytest.approx((63.283, 22.967), abs=3e-3)


def test_camera_gain_settings_are_ignored_and_electrons_used():
    assert np.isnan(facts(GAIN=100).gain_e_per_adu)
    assert facts(GAIN=100, EGAIN=0.8).gain_e_per_adu == 0.8
    assert facts(BUNIT="electrons").gain_e_per_adu == 1.0
    assert facts(BUNIT="ELECTRONS/S", EXPTIME=30.0).gain_e_per_adu == 30.0


def test_given_values_override_the_header_and_are_checked():
    found = facts(Given(gain_e_per_adu=2.5, exposure_s=10.0), EGAIN=0.8, EXPTIME=5.0)
    assert (found.gain_e_per_adu, found.exposure_s) == (2.5, 10.0)
    assert "gain 2.5 (given)" in found.lines
    with pytest.raises(InputError, match=r"gain_e_per_adu is -1; give a number above zero"):
        Given(gain_e_per_adu=-1.0)


def test_angles_keep_the_sign_of_a_zero_degree():
    assert Card("DEC", "-00 30 00").angle() == (-0.5, True)
    assert np.isnan(Card("DEC", "-00 75 00").angle()[0])
    assert Card("EXPTIME", "1.5D2 s").number() == 150.0


def test_saturation_is_recognised_by_a_pile_up_of_bright_pixels():
    rng = np.random.default_rng(3)
    falling = 1000 + 60_000 * rng.power(0.15, 40_000)[:20_000] ** 3
    assert plateau(1000 + rng.exponential(2000.0, 100_000)) == np.inf
    piled = np.minimum(1000 + rng.exponential(9000.0, 100_000), 30_000)
    assert 29_000 < plateau(piled) <= 30_000
    assert plateau(falling) > 55_000


@pytest.mark.parametrize(
    ("cards", "comments", "start"),
    [
        ({"UT": 3.5}, {}, "03:30:00"),
        ({"UT": "3.5"}, {}, "03:30:00"),
        ({"TIME_OBS": 3.5}, {}, "03:30:00"),
        ({"UTC_OBS": 12600.0}, {}, "03:30:00"),
        ({"UT": 20.0}, {"UT": "[s] start"}, "00:00:20"),
    ],
)
def test_a_time_of_day_in_numbers_is_read_and_its_unit_reported(cards, comments, start):
    """It was ignored, and noon was taken."""
    read = facts(DATE_OBS="2018-10-18", EXPTIME=0.0, comments=comments, **cards)
    assert abs((read.time() - Time(f"2018-10-18T{start}")).sec) < 1e-3
    assert any("of the day" in line for line in read.lines) and not any("12:00" in line for line in read.lines)


def test_a_julian_date_without_its_first_digits_is_no_mjd():
    """It was read as an MJD, twelve hours late."""
    assert abs((facts(JD=57389.25, EXPTIME=0.0).time() - Time(2457389.25, format="jd")).sec) < 1e-3


def test_the_zero_of_an_event_file_and_times_at_the_sun_are_used_if_there_is_no_other():
    cards = {"MJDREFI": 51910, "MJDREFF": 7.428703703703703e-04, "TIMESYS": "TT", "TSTART": 1e8, "TSTOP": 1e8 + 200.0}
    # Chandra's zero is 1998-01-01 TT, Fermi's and Swift's 2001-01-01 UTC: 64.184 s of TT less UTC then.
    expected = Time("2001-01-01T00:01:04.184", scale="tt").mjd + (1e8 + 100.0) / 86400.0
    assert abs(facts(**cards).time().tt.mjd - expected) * 86400.0 < 1e-3
    solar = facts(HJD=2457389.25, EXPTIME=60.0)
    assert abs(solar.time().jd - 2457389.25) < 1e-6
    assert any("HJD is a time at the Sun" in line for line in solar.lines)
