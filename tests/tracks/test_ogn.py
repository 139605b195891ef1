"""APRS of the Open Glider Network: aircraft with FLARM and other trackers."""

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
