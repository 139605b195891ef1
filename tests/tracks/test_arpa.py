"""ARPA: measured ranges and true bearings for any flags."""

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import arpa, read_reports
from sameas.io.sensors.format import OWN_SHIP
from sameas.io.sensors.nmea import checksum, latitude, log_of, longitude

DAY = 1452556800.0  # 2016-01-12
ZDA = "GPZDA,130211.00,12,01,2016,00,00"
RMC = "GPRMC,130212.00,A,5046.380,N,00105.576,W,10.0,157.8,120116,,,A"


def reports(*bodies, **options):
    return arpa.read(log_of([f"${body}*{checksum(body):02X}" for body in bodies]), "bridge", **options)


def ttm(number="01", distance="2.50", bearing="13.6", flag="T", speed="7.0", course="20.0", course_flag="T", unit="N",
        status="T", time="130215.50"):  # fmt: skip
    return (
        f"RATTM,{number},{distance},{bearing},{flag},{speed},{course},{course_flag},0.0,0.0,{unit},,{status},,{time},A"
    )


def test_a_target_with_true_bearing_is_read_unchanged():
    made = reports(ZDA, RMC, ttm())
    assert made.position == "polar" and made.track_id.tolist() == ["01"]
    assert made.range_m[0] == pytest.approx(2.5 * 1852.0) and made.bearing_deg[0] == 13.6
    assert made.speed_m_per_s[0] == pytest.approx(7.0 * 1852 / 3600) and made.course_deg[0] == 20.0
    assert made.station_lat_deg[0] == pytest.approx(50 + 46.380 / 60)
    assert made.station_lon_deg[0] == pytest.approx(-(1 + 5.576 / 60))
    # The target's own time of day, on the date of ZDA.
    assert made.time_s[0] == DAY + 13 * 3600 + 2 * 60 + 15.5


def test_relative_bearings_are_corrected_by_the_latest_heading():
    made = reports(ZDA, "HEHDT,350.0,T", ttm(flag="R", course_flag="R"), "IIOSD,100.0,A,101.0,P,8.0,P,,,N",
                   ttm(number="02", flag="R", course="90.0", course_flag="T"))  # fmt: skip
    np.testing.assert_allclose(made.bearing_deg, [3.6, 113.6])
    np.testing.assert_allclose(made.course_deg, [10.0, 90.0])
    made = reports(ZDA, "HEHDT,350.0,T", "IIOSD,100.0,V,101.0,P,8.0,P,,,N", ttm(flag="R"))
    assert made.bearing_deg[0] == pytest.approx(3.6)


def test_a_compass_serves_where_no_gyro_gives_the_heading():
    relative = ttm(flag="R", bearing="10.0")
    # Deviation 0.5° W, variation 2.5° E, as in the sentence; then the last one, with a heading of HDM.
    made = reports(ZDA, "HCHDG,20.0,0.5,W,2.5,E", relative, "HCHDM,30.0,M", relative)
    np.testing.assert_allclose(made.bearing_deg, [32.0, 42.5])
    west = "GPRMC,130212.00,A,5046.380,N,00105.576,W,10.0,157.8,120116,3.0,W,A"
    made = reports("HCHDM,1.0,M", west, relative, "HCHDG,1.0,,,,", relative, "HEHDT,350.0,T", "HCHDM,90.0,M", relative)
    np.testing.assert_allclose(made.bearing_deg, [8.0, 8.0, 0.0])
    np.testing.assert_allclose(made.station_heading_deg, [358.0, 358.0, 350.0])


def test_what_opencpn_and_its_radar_write_is_read():
    """Blanks, an empty flag, a checksum of one digit, and a compass that is called HDT."""
    body = "RATTM, 1,1.033854,237.500000,,5.76,176.3,T, , ,N,ARPA 1,T, "
    lines = [f"15:35:17 (virtual) ${one}*{checksum(one):x}<0x0D><0x0A>" for one in (ZDA, body, "HCHDT,10.0,M")]
    assert lines[2].endswith("M*1<0x0D><0x0A>")
    log = log_of(lines)
    assert not log.damaged
    made = arpa.read(log, "radar_pi")
    assert (made.track_id[0], made.bearing_deg[0], made.name[0]) == ("1", 237.5, "ARPA 1")
    made = reports(RMC.replace(",,,A", ",2.0,W,A"), "GPHDT,356.7,M", ttm(flag="R", bearing="10.0"))
    np.testing.assert_allclose(made.bearing_deg, [4.7])


def test_a_compass_without_variation_is_no_heading():
    with pytest.raises(InputError, match="HDG with a variation"):
        reports(ZDA, "HCHDM,30.0,M", ttm(flag="R"))


def test_a_relative_bearing_without_heading_is_missing():
    made = reports(ZDA, ttm(flag="R"), ttm(number="02", course_flag="R"))
    assert made.track_id.tolist() == ["02"] and made.course_deg is None
    assert made.damaged.sentences() == [
        "1 line damaged: direction from the bow before the first heading (OSD, HDT, THS, or HDG with a variation)"
        " (line 2)"
    ]


@pytest.mark.parametrize(
    ("unit", "metres", "speed"), [("N", 1852.0, 0.514444), ("K", 1000.0, 1 / 3.6), ("S", 1609.344, 0.44704)]
)
def test_units_are_those_of_the_sentence(unit, metres, speed):
    made = reports(ZDA, ttm(distance="1.0", speed="1.0", unit=unit))
    assert (made.range_m[0], made.speed_m_per_s[0]) == (metres, pytest.approx(speed, rel=1e-5))


def test_lost_targets_are_ignored_and_broken_ones_counted():
    made = reports(ZDA, ttm(status="L"), ttm(status="X"), ttm(distance=""), ttm(distance="0.0"), ttm(unit="Q"),
                   ttm(bearing="abc"), ttm(flag="M"), ttm(number="09", status="Q"))  # fmt: skip
    assert made.passed_over == {"target lost by the radar": 1}
    assert made.damaged.lines.tolist() == [3, 4, 5, 6, 7, 8]
    assert made.track_id.tolist() == ["09"] and made.extra["tracked"].tolist() == [0.0]


def test_positions_computed_by_the_radar_are_used_if_there_is_nothing_else():
    # The example TLL sentence in the sources of chart plotters.
    tll = "RATLL,01,5603.370,N,01859.976,E,ALPHA,015200.36,T,"
    made = reports(ZDA, tll)
    assert made.position == "geodetic" and made.name.tolist() == ["ALPHA"]
    assert (made.lat_deg[0], made.lon_deg[0]) == pytest.approx((56 + 3.370 / 60, 18 + 59.976 / 60))
    assert made.time_s[0] == pytest.approx(DAY + 3600 + 52 * 60 + 0.36)
    both = reports(ZDA, tll, ttm())
    assert both.position == "polar" and both.passed_over == {"TLL of targets that TTM reports too": 1}
    words = "TLL of targets that no TTM reports, without own ship's position"
    assert reports(ZDA, tll, ttm(number="02")).passed_over == {words: 1}


def tll(number="02", lat="5048.380,N", lon="00105.576,W", time="130215.50"):
    return f"RATLL,{number},{lat},{lon},,{time},T,"


def test_targets_of_ttm_and_others_of_tll_in_one_log_are_all_read():
    # Two minutes of arc north of own ship.
    made = reports(ZDA, RMC, ttm(), tll("01"), tll(), ttm(time="130218.50"), tll(time="130218.50"))
    assert made.position == "polar" and made.track_id.tolist() == ["01", "02", "01", "02"]
    assert made.passed_over == {"TLL of targets that TTM reports too": 1}
    assert made.range_m[1] == pytest.approx(2 * 1854.07, abs=0.2)
    assert made.bearing_deg[1] == pytest.approx(0.0, abs=1e-6)
    assert made.speed_m_per_s[0] > 3.0 and np.isnan(made.speed_m_per_s[1])


def test_a_stream_remembers_which_targets_ttm_reports():
    ship = arpa.ArpaState()
    reports(ZDA, RMC, ttm(), ship=ship)
    assert reports(RMC, tll("01"), tll(), ship=ship).track_id.tolist() == ["02"]
    assert reports(RMC, tll("01"), tll(), ship=ship).track_id.tolist() == ["02"]
    # After two minutes without TTM its number may be that of another target.
    later = "GPRMC,130512.00,A,5046.380,N,00105.576,W,10.0,157.8,120116,,,A"
    assert reports(later, tll("01", time="130512.00"), ship=ship).track_id.tolist() == ["01/2"]


def test_own_position_may_come_from_several_satellite_systems():
    gns = "GNGNS,130211.00,5046.380,N,00105.576,W,{},14,0.7,12.0,45.0,,"
    made = reports(ZDA, gns.format("NNN"), ttm(), gns.format("DAN"), ttm())
    assert np.isnan(made.station_lat_deg[0]) and made.station_lat_deg[1] == pytest.approx(50 + 46.38 / 60)


def test_own_position_may_come_from_own_ais():
    pyais = pytest.importorskip("pyais")
    [sentence] = pyais.encode_dict({"type": 1, "mmsi": 235000001, "lat": 50.9, "lon": -1.4, "heading": 30,
                                    "speed": 10.0, "course": 20.0})  # fmt: skip
    own = sentence[1:].split("*")[0].replace("VDM", "VDO")
    ship = arpa.ArpaState()
    made = reports(ZDA, own, ttm(flag="R"), ship=ship)
    assert (ship.speed, ship.course) == pytest.approx((5.144, 20.0), abs=1e-3)
    assert made.station_lat_deg[0] == pytest.approx(50.9) and made.station_lon_deg[0] == pytest.approx(-1.4)
    assert made.bearing_deg[0] == pytest.approx(43.6)
    assert "bridge: own ship's place from 1 AIS sentences of her own (VDO) too" in made.notes
    tll = "RATLL,03,5046.0,N,00105.0,W,X,015200.36,T,"
    # Positions computed by the radar were measured from own ship, at the same place.
    assert reports(ZDA, RMC, tll).station_lat_deg[0] == pytest.approx(50 + 46.380 / 60)
    assert reports(ZDA, tll, RMC, tll).station_lat_deg is None


def test_times_of_day_cross_midnight_with_the_date_nearest_to_the_clock():
    late, early = "GPZDA,235959.00,12,01,2016,00,00", "GPZDA,000001.00,13,01,2016,00,00"
    made = reports(late, ttm(time="235958.00"), ttm(time="000000.50"), early, ttm(time="235959.50"))
    assert (made.time_s - DAY - 86400.0).tolist() == [-2.0, 0.5, -0.5]


def test_without_a_date_the_user_must_give_the_start():
    with pytest.raises(
        InputError, match="bridge: no time: the sentences have the time of day, but no date; give start"
    ):
        reports(ttm())
    made = reports(ttm(time="235959.00"), ttm(time="000001.00"), start_s=DAY)
    assert (made.time_s - DAY).tolist() == [86399.0, 86401.0]
    with pytest.raises(InputError, match="no line has a time, no ZDA and no RMC"):
        reports(ttm(time=""), start_s=DAY)


def test_targets_without_time_use_the_clock_of_the_log():
    assert reports(ZDA, ttm(time="")).time_s[0] == DAY + 13 * 3600 + 2 * 60 + 11


def test_a_missing_own_position_is_not_invented():
    made = reports(ZDA, ttm())
    assert made.station_lat_deg is None and "lacks own ship's position" in made.notes[-1]
    made = reports(
        ZDA, "GPGGA,130211,5046.380,N,00105.576,W,0,00,,,M,,M,,", ttm(), "GPGLL,5000.000,S,00000.000,E,130213,A", ttm()
    )
    assert np.isnan(made.station_lat_deg[0]) and made.station_lat_deg[1] == -50.0


@pytest.mark.parametrize(
    ("text", "side"), [("9100.0", "N"), ("5061.0", "N"), ("50xx.0", "N"), ("5000.0", "E"), ("", "N")]
)
def test_an_invalid_latitude_is_refused(text, side):
    with pytest.raises(ValueError):
        latitude(text, side)
    assert longitude("17959.99", "W") == pytest.approx(-179.99983, abs=1e-5)


def test_a_log_of_ais_and_radar_is_two_sources(tmp_path):
    lines = [f"${ZDA}*{checksum(ZDA):02X}", "!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C",
             f"${ttm()}*{checksum(ttm()):02X}", "rubbish"]  # fmt: skip
    (tmp_path / "log.nmea").write_text("\r\n".join(lines))
    ships, radar = read_reports(tmp_path / "log.nmea")
    assert (ships.source, ships.kind, radar.source, radar.kind) == ("log.nmea:ais", "ais", "log.nmea:arpa", "arpa")
    assert ships.damaged.lines.tolist() == [4] and len(radar.damaged) == 0


def test_both_sources_of_a_log_say_where_own_ship_was(tmp_path):
    """Reports of AIS have no range and bearing from her; a replay shows her, and watches her approaches, by these."""
    body = [ZDA, RMC, "HEHDT,350.0,T"]
    lines = [*(f"${one}*{checksum(one):02X}" for one in body), "!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C"]
    (tmp_path / "log.nmea").write_text("\n".join([*lines, f"${ttm()}*{checksum(ttm()):02X}"]))
    for found in read_reports(tmp_path / "log.nmea"):
        own = [found.extra[column][0] for column in OWN_SHIP.values()]
        np.testing.assert_allclose(own, [50 + 46.38 / 60, -(1 + 5.576 / 60), 350.0, 10.0 * 1852 / 3600, 157.8])
    (tmp_path / "log.nmea").write_text("\n".join([lines[0], lines[3]]))
    [found] = read_reports(tmp_path / "log.nmea")
    assert not set(OWN_SHIP.values()) & set(found.extra)


def test_a_number_used_again_is_another_target():
    lost = reports(ZDA, ttm(), ttm(time="130216.00"), ttm(status="L", time="130217.00"), ttm(time="130218.00"))
    assert lost.track_id.tolist() == ["01", "01", "01/2"]
    jumped = reports(ZDA, ttm(), ttm(distance="4.50", time="130218.00"), ttm(distance="4.51", time="130221.00"))
    assert jumped.track_id.tolist() == ["01", "01/2", "01/2"]
    acquired = reports(ZDA, ttm(status="Q"), ttm(time="130218.00"), ttm(status="Q", time="130221.00"))
    assert acquired.track_id.tolist() == ["01", "01", "01/2"]
    silent = reports(ZDA, ttm(), ttm(time="130915.50"))
    assert silent.track_id.tolist() == ["01", "01/2"]


def test_a_target_keeps_its_number_across_the_180th_meridian():
    tll = "RATLL,04,5200.0000,N,{},,1302{:02d}.00,T,"
    sides = ("17959.9900,E", "17959.9980,E", "17959.9940,W", "17959.9860,W")
    lines = [tll.format(side, 15 + 3 * k) for k, side in enumerate(sides)]
    assert reports(ZDA, *lines).track_id.tolist() == ["04"] * 4
    jumped = reports(ZDA, *lines[:2], tll.format("17930.0000,W", 21))
    assert jumped.track_id.tolist() == ["04", "04", "04/2"]


def test_a_fast_target_keeps_its_number():
    # 40 kn across the bow at 0.3 nm, and a far one that scatters.
    near = [ttm(distance="0.30", bearing=f"{b}", time=f"1302{15 + k}.00") for k, b in enumerate((330, 350, 10, 30))]
    far = [ttm("02", distance="20.0", bearing=f"{90 + 0.5 * (k % 2)}", time=f"1302{15 + k}.00") for k in range(4)]
    assert set(reports(ZDA, *near, *far).track_id) == {"01", "02"}


def test_a_stream_remembers_the_numbers_that_were_lost():
    ship = arpa.ArpaState()
    first = reports(ZDA, ttm(), ship=ship)
    with pytest.raises(InputError):
        reports(ZDA, ttm(status="L", time="130217.00"), ship=ship)
    assert [*first.track_id, *reports(ZDA, ttm(time="130218.00"), ship=ship).track_id] == ["01", "01/2"]
