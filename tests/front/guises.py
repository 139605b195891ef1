"""One small field of two surveys, in every container type that can hold positions."""

import numpy as np
import pytest
from astropy import units as u
from astropy.coordinates import SkyCoord
from astropy.table import QTable, Table
from astropy.time import Time


class Field:
    """Columns of two surveys of one field: the second has every star of the first, 16 years earlier, shuffled."""

    def __init__(self):
        rng = np.random.default_rng(5)
        n = 120
        self.ra, self.dec = 10.0 + 0.2 * rng.uniform(size=n), 41.0 + 0.2 * rng.uniform(size=n)
        self.pm = rng.normal(0.0, 100.0, (n, 2))
        self.order = rng.permutation(n)
        moved = -16.0 * 1e-3 / 3600.0 * self.pm + 0.05 / 3600.0 * rng.standard_normal((n, 2))
        cos = np.cos(np.radians(self.dec))
        self.then = (self.ra + moved[:, 0] / cos)[self.order], (self.dec + moved[:, 1])[self.order]

    @property
    def first(self):
        """The first survey as columns: positions of 2016 with proper motions."""
        return {"ra": self.ra, "dec": self.dec, "pmra": self.pm[:, 0], "pmdec": self.pm[:, 1],
                "ref_epoch": np.full(len(self.ra), 2016.0)}  # fmt: skip

    @property
    def second(self):
        """The second survey as columns: positions of 2000."""
        return {"ra": self.then[0], "dec": self.then[1], "epoch": np.full(len(self.ra), 2000.0)}

    def partner(self):
        """Row in the second survey of each row of the first."""
        return np.argsort(self.order)


def as_skycoord(columns):
    epoch = columns.get("ref_epoch", columns.get("epoch"))
    motion = {}
    if "pmra" in columns:
        motion = {"pm_ra_cosdec": columns["pmra"] * u.mas / u.yr, "pm_dec": columns["pmdec"] * u.mas / u.yr}
    return SkyCoord(columns["ra"] * u.deg, columns["dec"] * u.deg, obstime=Time(epoch[0], format="jyear"), **motion)


def as_qtable(columns):
    units = {"ra": u.deg, "dec": u.deg, "pmra": u.mas / u.yr, "pmdec": u.mas / u.yr}
    return QTable({name: values * units[name] if name in units else values for name, values in columns.items()})


def as_array(columns):
    array = np.zeros(len(columns["ra"]), [(name, float) for name in columns])
    for name, values in columns.items():
        array[name] = values
    return array


def as_arrow(columns):
    import pyarrow as pa

    return pa.table(columns)


def as_pandas(columns):
    return pytest.importorskip("pandas").DataFrame(columns)


def as_polars(columns):
    return pytest.importorskip("polars").DataFrame(columns)


def as_lazy(columns):
    return pytest.importorskip("polars").LazyFrame(columns)


GUISES = {
    "dict": dict, "table": Table, "qtable": as_qtable, "skycoord": as_skycoord,
    "skycoord column": lambda columns: QTable({"name": np.arange(120) + 7, "where": as_skycoord(columns)}),
    "array": as_array, "arrow": as_arrow, "pandas": as_pandas, "polars": as_polars, "lazy polars": as_lazy,
}  # fmt: skip
