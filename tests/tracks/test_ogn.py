"""APRS of the Open Glider Network: aircraft with FLARM and other trackers."""

import numpy as np
import pytest

from sameas.errors import InputError
from sameas.io.sensors import ReadOptions, read_reports
from sameas.io.sensors.sources import read_sources

LINES = (
    "EGHL>OGNSDR,TCPIP*,qAC,GLIDERN1:/074546h5111.14NI00101.81W&/A=000574",
    "FLRDDE626>APRS,qAS,EGHL:/074548h5111.32N/00102.04W'086/007/A=000607 !W83! id0ADDE626 -019fpm +0.0rot gps2x3",
    "ICA406A42>OGFLR,qAS,EGHL:/074550h5112.32S\\00102.04E^186/107/A=002607 id05406A42 +200fpm",
    "ICA406A42>OGFLR,qAS,EGHL:/074551h9912.32N\\00102.04W^186/107/A=002607 id05406A42",
    "EGHL>OGNSDR,TCPIP*,qAC,GLIDERN1:>074546h v0.2.8 CPU:0.5",
)
SERVER = "# aprsc 2.1.4-g408ed49 22 May 2024 07:45:00 GMT GLIDERN1 37.187.40.234:14580"


def written(tmp_path, *lines):
    (tmp_path / "ogn.log").write_text("\n".join(lines) + "\n")
    return tmp_path / "ogn.log"


@pytest.mark.parametrize("start", [None, "2024-05-22"])
def test_positions_of_gliders_are_read(start, tmp_path):
    """They were refused as a table without names of columns."""
    path = written(tmp_path, *([SERVER] if start is None else []), *LINES)
    [found] = read_reports(path, ReadOptions("ogn", start=start))
    assert (found.time_s - 1_716_336_000.0).tolist() == [7 * 3600 + 45 * 60 + 48.0, 7 * 3600 + 45 * 60 + 50.0]
    assert found.lat_deg == pytest.approx([51.0 + 11.328 / 60.0, -51.0 - 12.32 / 60.0])
    assert found.lon_deg == pytest.approx([-1.0 - 2.043 / 60.0, 1.0 + 2.04 / 60.0])
    assert found.track_id.tolist() == ["dde626", "406a42"] and found.icao.tolist() == [None, "406a42"]
    assert found.alt_m == pytest.approx([185.0, 794.6], abs=0.1) and found.course_deg.tolist() == [86.0, 186.0]
    assert found.covariance_m2[:, 0] == pytest.approx([4.0, 128.6], abs=0.1)
    assert found.passed_over == {"position of a receiver or another station": 1, "line without a position": 1}
    assert found.damaged.counts() == {"position outside the earth": 1}
    [source] = read_sources([path], start=start)
    assert source.description.kind == "ads-b"


def test_what_has_no_date_or_no_aircraft_is_refused(tmp_path):
    with pytest.raises(InputError, match="APRS has the time of day only; give start"):
        read_reports(written(tmp_path, *LINES))
    with pytest.raises(InputError, match="no position of an aircraft"):
        read_reports(written(tmp_path, LINES[0]))


#: As the servers of other systems send them: hang gliders, an airliner, a weather station.
OTHERS = (
    "FMT924469>OGFLYM,qAS,FLYMASTER:/155232h3720.70N/00557.97W^222/092/A=000029 !W52!",
    "ICA3E7540>OGSPOT,qAS,SPOT:/155233h1448.35S/04610.86W'000/000/A=008677 id0-2860357 SPOT3 GOOD",
    "OGN8A0749>OGINRE,qAS,INREACH:/155234h0448.38N/07600.74W'000/000/A=004583 id300434060496190 inReac True",
    "NAV042121>OGNAVI,qAS,NAVITER:/155235h4550.36N/01314.85E'090/152/A=001086 !W47! id0440042121 +000fpm",
    "ICA4CA4EB>OGNAVI,qAS,NAVITER:/155235h4550.36N/01314.85E'090/152/A=001086 !W47! id04104CA4EB +000fpm",
    "ICA346303>OGADSB,qAS,LEMDadsb:/155236h4116.57N\\00208.92W^034/370/A=034000 id25346303 +000fpm  0.0rot fnIBE34LM",
    "FNT010203>OGNFNT,qAS,FNB1103CE:/155237h5057.94N/00801.00E_355/002g001t050 h50b10130",
)


def test_trackers_of_other_systems_are_read(tmp_path):
    """A club with hang gliders saw none of them: Flymaster, SPOT, inReach and Naviter were taken for receivers."""
    [found] = read_reports(written(tmp_path, *OTHERS), ReadOptions("ogn", start="2024-05-22"))
    assert found.track_id.tolist() == ["FMT924469", "3e7540", "8a0749", "042121", "4ca4eb", "346303"]
    assert found.icao.tolist() == [None, "3e7540", None, None, "4ca4eb", "346303"]
    assert found.callsign.tolist()[4:] == [None, "IBE34LM"]
    # A tracker that sends neither course nor speed is not at rest.
    assert np.isnan(found.speed_m_per_s).tolist() == [False, True, True, False, False, False]
    # The heights of ADS-B are pressure heights.
    assert found.pressure_alt_m[5] == pytest.approx(10_363.2) and np.isnan(found.alt_m).tolist() == 5 * [False] + [True]
    assert found.passed_over == {"position of a receiver or another station": 1}
