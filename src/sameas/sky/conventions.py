"""Conventions: what a catalogue's columns are called. A :class:`Convention` and the usual names of any table.

Data only; :mod:`sameas.sky.columns` uses them, :mod:`sameas.sky.surveys` has those of known catalogues. Parameters are
numbered 0 right ascension (times cos δ), 1 declination, 2 parallax, 3 proper motion in right ascension (times cos δ),
4 proper motion in declination, 5 radial velocity.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass, replace
from typing import Literal

Correlations = tuple[tuple[int, int, str], ...]
ErrorKind = Literal["circle", "axes", "ellipse", "variances", "inverse variances"]
#: Frame of longitude and latitude; "B1950" is that of the FK4 with the equinox B1950.
SkyFrame = Literal["icrs", "galactic", "ecliptic", "B1950"]


@dataclass(frozen=True)
class ErrorNames:
    """Columns of one position error: "circle" (σ), "axes" (σ east, σ north), "ellipse" (a, b, angle in degrees),
    "variances" (east, north), "inverse variances" (of right ascension, without cos δ, and of declination).

    unit : assumed unit, "" for none; unit_of_ra : that of right ascension, if it is another one.
    covariance : columns of the covariance of east and north, the first found.
    co_sigma : column of its root with its sign, s in V = s·|s|. angle_from : zero point of the ellipse angle, which
    increases towards the other axis. containment : probability that the position lies within the circle or ellipse of
    this size; 0 if the sizes are standard deviations per axis.
    """

    kind: ErrorKind
    names: tuple[str, ...]
    unit: str = ""
    covariance: tuple[str, ...] = ()
    angle_from: Literal["north", "east"] = "north"
    containment: float = 0.0
    co_sigma: str = ""
    unit_of_ra: str = ""


@dataclass(frozen=True)
class MotionNames:
    """Columns of parallax, proper motion in right ascension (times cos δ) and declination, radial velocity, and of
    their errors; in ``unit`` (mas), ``unit``/yr, km/s. "" for none."""

    names: tuple[str, str, str, str]
    errors: tuple[str, str, str, str]
    unit: str = "mas"


@dataclass(frozen=True)
class Convention:
    """The column names of one catalogue.

    marks : at least one of these columns is required too; () if the position's names are sufficient.
    without : with one of these columns it is another catalogue.
    over : right ascension columns superseded by that of this convention.
    unit_of_ra : of right ascension, if it is another one.
    epoch_jyr : epoch of the whole catalogue; only_epoch : columns named epoch do not state that of the positions.
    one_campaign : rows without an epoch are of the median one; they have none in the band of the column.
    releases : (pattern in the table's texts, epoch).
    release_columns : (column of one release only, epoch).
    weights : prefix of the columns of the triangular weight matrix of hip2.
    measured : a column that is empty in rows without a measurement. frame : of the position and its errors.
    parts : columns of hours, minutes and seconds, and of sign, degrees, minutes and seconds, if the position is split;
        the last ones may be absent.
    """

    title: str
    position: tuple[str, str]
    unit: str = "deg"
    unit_of_ra: str = ""
    marks: tuple[str, ...] = ()
    without: tuple[str, ...] = ()
    ids: tuple[str, ...] = ()
    errors: tuple[ErrorNames, ...] = ()
    motions: tuple[MotionNames, ...] = ()
    correlations: Correlations = ()
    epochs: tuple[str, ...] = ()
    epoch_jyr: float | None = None
    only_epoch: bool = False
    one_campaign: bool = False
    releases: tuple[tuple[str, float], ...] = ()
    release_columns: tuple[tuple[str, float], ...] = ()
    magnitudes: tuple[tuple[str, str], ...] = ()
    over: tuple[str, ...] = ()
    weights: str = ""
    measured: str = ""
    frame: SkyFrame = "icrs"
    parts: tuple[tuple[str, ...], ...] = ()


def correlations_of(pattern: str, names: tuple[str, ...]) -> Correlations:
    """The columns of the correlations of the parameters 0, 1, … by name. pattern : of a column, as "{a}_{b}_corr"."""
    n = len(names)
    return tuple((i, j, pattern.format(a=names[i], b=names[j])) for i in range(n) for j in range(i + 1, n))


def own_axes(ra: str, dec: str) -> tuple[ErrorNames, ...]:
    """The usual names of the errors of the columns ``ra`` and ``dec``."""
    patterns = ("e_{}", "{}_error", "{}_err", "{}err", "{}Err", "sigma_{}", "{}_sigma", "err_{}", "{}_std", "{}_unc",
                "rms{}", "sig{}", "sigma{}")  # fmt: skip
    stems = [(pattern.format(ra), pattern.format(dec)) for pattern in patterns]
    suffixed = [(a + s, b + s) for a, b in stems for s in ("_arcsec", "_mas", "_deg")]
    return tuple(ErrorNames("axes", pair) for pair in stems + suffixed)


GAIA_MOTION = MotionNames(
    ("parallax", "pmra", "pmdec", "radial_velocity"),
    ("parallax_error", "pmra_error", "pmdec_error", "radial_velocity_error"),
)
VIZIER_MOTION = MotionNames(("Plx", "pmRA", "pmDE", "RV"), ("e_Plx", "e_pmRA", "e_pmDE", "e_RV"))
_ASTROPY_MOTION = MotionNames(
    ("parallax", "pm_ra_cosdec", "pm_dec", "radial_velocity"),
    ("parallax_error", "pm_ra_cosdec_error", "pm_dec_error", "radial_velocity_error"),
)
_STAR_MOTION = MotionNames(
    ("parallax", "mu_alpha_star", "mu_delta", "radial_velocity"),
    ("parallax_error", "mu_alpha_star_error", "mu_delta_error", "radial_velocity_error"),
)
PLAIN_MOTIONS = (GAIA_MOTION, VIZIER_MOTION, _ASTROPY_MOTION, _STAR_MOTION)

TWOMASS_MAGNITUDES = (("j_m", "j_msigcom"), ("Jmag", "e_Jmag"), ("ks_m", ""), ("k_m", "k_msigcom"), ("Kmag", "e_Kmag"))
SEXTRACTOR_MAGNITUDES = (
    ("MAG_AUTO", "MAGERR_AUTO"),
    ("MAG_PSF", "MAGERR_PSF"),
    ("MAG_ISO", "MAGERR_ISO"),
    ("MAG_APER", "MAGERR_APER"),
)
PLAIN_MAGNITUDES = (
    ("phot_g_mean_mag", "phot_g_mean_mag_error"), ("Gmag", "e_Gmag"), ("Vmag", "e_Vmag"), ("VTmag", "e_VTmag"),
    ("Hpmag", "e_Hpmag"), ("rmag", "e_rmag"), *SEXTRACTOR_MAGNITUDES, *TWOMASS_MAGNITUDES, ("Tmag", "e_Tmag"),
    ("ksAperMag3", "ksAperMag3Err"), ("kAperMag3", "kAperMag3Err"), ("jAperMag3", "jAperMag3Err"), ("Ksap3", "e_Ksap3"),
    ("Jap3", "e_Jap3"), ("r_psf", "e_r_psf"), ("g_psf", "e_g_psf"), ("MAG_PSF_R", "MAGERR_PSF_R"),
    ("MAG_PSF_G", "MAGERR_PSF_G"), ("r_psfMag", "r_psfMagErr"), ("i_psfMag", "i_psfMagErr"),
    ("i_psfflux_mag", "i_psfflux_magerr"), ("magpsf", "sigmapsf"), ("medianmag", ""), ("mag", "magerr"),
    ("mag", "mag_err"), ("mag", "merr"), ("mag1", "merr1"), ("mag", "e_mag"), ("magnitude", "magnitude_error"),
    ("aper_total_abmag", "aper_total_abmag_err"), ("isophotal_abmag", "isophotal_abmag_err"),
    ("auto_mag", "auto_mag_err"), ("mag_w1_vg", ""), ("kepmag", ""), ("Kpmag", ""),
)  # fmt: skip
#: Bands by which columns are named that say their unit to be mag; without it the letters may be anything.
BANDS = (
    "G", "V", "VT", "Hp", "R", "Rc", "r", "I", "Ic", "i", "g", "B", "BT", "z", "y", "u", "U", "J", "H", "K", "Ks", "W1",
)  # fmt: skip
#: Names of a magnitude by its band or filter: ``MAG_I``, ``i_mag``, ``zmag``, ``F606W_mag``, ``F475W_VEGA``.
BAND_MAGNITUDE = re.compile(
    r"(?:mag(?:nitude)?[_ ]?{band}|{band}[_ ]?mag(?:nitude)?|F\d{{3,4}}[WMN]_(?:VEGA|AB|ST)(?:MAG)?)".format(
        band=rf"(?:{'|'.join(BANDS)}|L|BP|RP|W[2-4]|[NF]UV|F\d{{3,4}}[WMN])"
    ),
    re.IGNORECASE,
)
#: Fluxes of stars and galaxies in visible light, of which tables without magnitudes get them.
PLAIN_FLUXES = (
    "flux_r", "flux_i", "flux_g", "flux_z", "r_psfFlux", "i_psfFlux", "g_psfFlux", "psfFlux", "FLUX_AUTO", "FLUX_PSF",
    "FLUX_ISO", "FLUX_APER", "kron_flux", "segment_flux", "flux_fit", "aperture_sum", "aperture_sum_bkgsub",
    "FLUX_VIS_PSF", "FLUX_DETECTION_TOTAL",
)  # fmt: skip
PLAIN_IDS = (
    "id", "source_id", "designation", "name", "obj_id", "objid", "objectId", "number", "_2MASS", "HIP", "object_id",
    "sourceID", "source_name", "component_name", "IAUNAME", "main_id", "MatchID", "obsid", "KIC", "EPIC", "TIC",
    "label",
)  # fmt: skip
PLAIN_EPOCHS = (
    "ref_epoch", "epoch", "epoch_jyr", "mean_epoch", "mean_jd", "mean_mjd", "mjd", "obs_mjd", "obsmjd", "mjd_obs", "jd",
    "obs_jd", "obsjd", "epoch_mjd", "epoch_jd", "obs_date", "date_obs", "obstime", "Date",
)  # fmt: skip
#: At the Sun or the barycentre: minutes are nothing to an epoch.
SOLAR_EPOCHS = ("bjd_tdb", "bjd_utc", "bjd", "hjd_utc", "hjd")
PLAIN_CIRCLES = tuple(
    ErrorNames("circle", (stem + suffix,))
    for stem in ("sigma", "pos_err", "poserr", "e_pos", "ePos", "pos_error", "pos_sigma", "positional_error", "err",
                 "error")
    for suffix in ("", "_arcsec", "_mas", "_deg")
)  # fmt: skip

#: Ellipses of position errors in tables of no known survey.
PLAIN_ELLIPSES = tuple(
    ErrorNames("ellipse", (stem + a, stem + b, stem + angle))
    for stem in ("err_", "err", "error_", "pos_err_", "poserr_", "sigma_", "err_ellipse_", "error_ellipse_")
    for a, b in (("maj", "min"), ("major", "minor"), ("a", "b"))
    for angle in ("pa", "ang", "angle", "posang")
)
#: Containment of the radius √(σ_east² + σ_north²), which emldetect (XMM-Newton, eROSITA) calls the 1σ radial error.
RADIAL_CONTAINMENT = 1.0 - math.exp(-1.0)
#: Names of radii around the position that say what they contain in percent, in lower case: ``err90``, ``pos_err_95``,
#: ``error_radius_68``, ``error50 [arcmin]``.
CONFIDENCE_RADIUS = re.compile(
    r"(?:pos(?:ition(?:al)?)?_?)?err(?:or)?(?:_?r(?:ad(?:ius)?)?)?_?(?P<percent>50|68|90|95|99)"
    r"(?:_(?:arcsec|arcmin|mas|deg)|[ _]*[\[(][^\])]*[\])])?|pos_?r(?:ad(?:ius)?)?_?(?P<of_pos>50|68|90|95|99)"
)
RADEC_ERR = ErrorNames("circle", ("radec_err",), "arcsec", containment=RADIAL_CONTAINMENT)
#: A percentage in the name of a column that is said to be a position error: ``XRT 90% radius``, ``Conf_95_SemiMajor``.
NAMED_PERCENTAGE = re.compile(
    r"(?<![\d.])(?P<percent>50|6[38]|9[059])\s*(?:%|per ?cent)"
    r"|(?:err(?:or)?|rad(?:ius)?|conf(?:idence)?|unc|ellipse|(?<![a-z])r)[a-z]*[ _]*(?P<behind>50|68|9[059])(?!\d)"
    r"|(?<!\d)(?P<before>50|68|9[059])_?(?:err|rad|conf|cl(?![a-z]))",
    re.IGNORECASE,
)

#: Bare names of such radii; of galaxies r50 and r90 contain light, so these count only without radii of another kind.
BARE_RADII = tuple(
    ErrorNames("circle", (f"{stem}{percent}",), "arcsec", containment=percent / 100.0)
    for percent in (90, 95, 68)
    for stem in ("r", "r_", "radius", "radius_")
)
#: Radii that contain a share of a galaxy's light.
LIGHT_RADII = ("r50", "r_50", "r25", "r20", "r80", "r_80", "r50_r", "petroR50_r", "radius50", "radius_50")

# Header keywords for the time of observation, and that of a VOTable's COOSYS. Not EPOCH: in FITS it is the equinox.
HEADER_EPOCHS = (
    "REF_EPOCH", "REFEPOCH", "epoch_jyr", "COOSYS_EPOCH", "MJD-AVG", "MJD-MID", "DATE-AVG", "MJD-OBS", "DATE-OBS",
    "JD-OBS", "MJD", "JD",
)  # fmt: skip

# Columns that VizieR computes in addition to the catalogue's own.
VIZIER_COMPUTED = ("_RAJ2000", "_RA", "_RA_icrs", "_RA.icrs", "_RAB1950")


def plain(position: tuple[str, str], title: str = "plain names", frame: SkyFrame = "icrs") -> Convention:
    """The convention of a position with any other names, with the usual names of the other columns."""
    ra, dec = position
    return Convention(
        frame=frame,
        title=title,
        position=position,
        ids=PLAIN_IDS,
        errors=own_axes(ra, dec),
        motions=PLAIN_MOTIONS,
        correlations=((0, 1, "RADEcor"), (0, 1, f"{ra}_{dec}_corr"), (0, 1, f"{ra}_{dec}_cor"), (0, 1, "rmsCorr")),
        epochs=PLAIN_EPOCHS,
        magnitudes=PLAIN_MAGNITUDES,
    )


def of_b1950(convention: Convention) -> Convention:
    """The convention with positions of the equinox B1950, without motions: those of the FK4 contain its rotation."""
    return replace(convention, frame="B1950", motions=(), correlations=())
