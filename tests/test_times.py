"""Astropy times download nothing, however old the installed tables are."""

import subprocess
import sys

import numpy as np
import pytest

_OLD = """
from astropy.utils import iers
from astropy.utils.iers import iers as module

asked = []
def refused(*arguments, **_):
    asked.append(arguments)
    raise OSError("no network")
module.download_file = refused
today = module.LeapSeconds._today
module.LeapSeconds._today = classmethod(lambda cls: today() + module.TimeDelta(4000.0, format="jd"))
from {room} import Time
print(round(Time(57000.0, format="mjd", scale="utc").tai.mjd % 1 * 86400), len(asked))
"""


@pytest.mark.slow
@pytest.mark.parametrize(("room", "fetches"), [("sameas.sky.times", False), ("astropy.time", True)])
def test_old_leap_seconds_cause_no_download(room, fetches):
    run = subprocess.run([sys.executable, "-W", "ignore", "-c", _OLD.format(room=room)], capture_output=True, text=True)
    assert run.returncode == 0, run.stderr
    seconds, asked = map(int, run.stdout.split())
    assert seconds == 35 and (asked > 0) == fetches


@pytest.mark.slow
def test_a_position_on_the_earth_needs_no_network(monkeypatch):
    from astropy.coordinates import EarthLocation
    from astropy.time import Time
    from astropy.utils import iers

    from sameas.sky.movers.orbits import geocentric_km

    mjd = np.array([58000.0, 59000.5])
    with iers.earth_orientation_table.set(iers.IERS_B.open()):
        expected = EarthLocation.from_geodetic(-71.5, 42.6, 100.0).get_gcrs_posvel(Time(mjd, format="mjd"))[0].xyz
    monkeypatch.setattr(iers.IERS_Auto, "open", classmethod(lambda cls: pytest.fail("it may load another table")))
    np.testing.assert_allclose(geocentric_km(42.6, -71.5, 100.0, mjd), expected.to_value("km").T, atol=0.02)
    # Beyond the table, positions are still right to half a kilometre.
    far = geocentric_km(42.6, -71.5, 100.0, np.array([41000.0, 80000.0]))
    np.testing.assert_allclose(np.linalg.norm(far, axis=1), 6368.0, atol=10.0)
