"""The Gaia archive: stars of a cone, asked once and kept on disk.

The question goes to the archive's TAP service as a job (small answers only come without one), through ``pyvo``. What
came is kept as Parquet, one file a field, named by the release with its epoch, the field and the depth; a later frame
whose field lies within a kept one asks nothing.
"""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from sameas.errors import InputError
from sameas.io.tables import read_table, write_table
from sameas.sky.frame.field import Cone

if TYPE_CHECKING:
    from astropy.table import Table

GAIA_TAP = "https://gea.esac.esa.int/tap-server/tap"
_PARAMETERS = ("ra", "dec", "parallax", "pmra", "pmdec")
COLUMNS = (
    "source_id", "ref_epoch", *_PARAMETERS, *(f"{name}_error" for name in _PARAMETERS),
    "ra_dec_corr", "ra_parallax_corr", "ra_pmra_corr", "ra_pmdec_corr", "dec_parallax_corr", "dec_pmra_corr",
    "dec_pmdec_corr", "parallax_pmra_corr", "parallax_pmdec_corr", "pmra_pmdec_corr", "radial_velocity",
    "phot_g_mean_mag", "bp_rp",
)  # fmt: skip
#: Fields are asked for on a grid of this step and a little larger, so that neighbouring frames share one.
STEP_DEG = 0.1


@dataclass(frozen=True)
class GaiaArchive:
    """Gaia's stars, online.

    url : of the TAP service. table, release, epoch_jyr : what is asked. folder : where fields are kept; None for
    the user's cache. timeout_s : patience with a job.
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
        """The stars of a cone down to a magnitude, kept or asked for.

        Raises
        ------
        InputError : pyvo is missing; the archive does not answer, or refuses.
        """
        kept = self._kept(cone, faintest)
        if kept is not None:
            return read_table(kept)
        field = rounded(cone)
        progress(f"asking the Gaia archive for {field.radius_deg:.2f}° about {field.ra_deg:.2f} {field.dec_deg:+.2f}")
        stars = self._asked(field, faintest)
        path = self._folder() / f"{self._name(field, faintest)}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        facts = {"cone": json.dumps([field.ra_deg, field.dec_deg, field.radius_deg]), "faintest": faintest}
        write_table(stars, path, provenance={"url": self.url, "table": self.table, **facts})
        return read_table(path)

    def query(self, cone: Cone, faintest: float) -> str:
        """The question in ADQL."""
        where = f"CIRCLE('ICRS', {cone.ra_deg:.6f}, {cone.dec_deg:.6f}, {cone.radius_deg:.6f})"
        return (
            f"SELECT {', '.join(COLUMNS)} FROM {self.table} "
            f"WHERE 1 = CONTAINS(POINT('ICRS', ra, dec), {where}) AND phot_g_mean_mag < {faintest:g}"
        )

    def _asked(self, cone: Cone, faintest: float) -> Table:
        try:
            import pyvo
        except ImportError as error:
            raise InputError(
                f"asking the Gaia archive needs pyvo: pip install 'sameas[archive]'; {_offline()}"
            ) from error
        try:
            answer = pyvo.dal.TAPService(self.url).run_async(self.query(cone, faintest), timeout=self.timeout_s)
            stars = answer.to_table()
        except pyvo.dal.DALQueryError as error:
            raise InputError(f"{self.url}: the archive refuses the question ({_short(error)})") from error
        except Exception as error:  # whatever the network, the server or its XML may do
            raise InputError(f"{self.url}: the archive does not answer ({_short(error)}); {_offline()}") from error
        if not len(stars):
            raise InputError(f"{self.url}: the archive has no stars brighter than {faintest:g} in this field")
        stars.meta.clear()
        return stars

    def _folder(self) -> Path:
        return cache_folder() / "fields" if self.folder is None else self.folder

    def _name(self, cone: Cone, faintest: float) -> str:
        place = f"{cone.ra_deg:08.4f}{cone.dec_deg:+08.4f}r{cone.radius_deg:.3f}"
        return f"{self.release}-{self.epoch_jyr:.1f}-{place}-g{faintest:g}"

    def _kept(self, cone: Cone, faintest: float) -> Path | None:
        """A kept field that holds all of a cone, to this depth or deeper."""
        for path in sorted(self._folder().glob(f"{self.release}-{self.epoch_jyr:.1f}-*.parquet")):
            place, _, depth = path.stem.removeprefix(f"{self.release}-{self.epoch_jyr:.1f}-").rpartition("-g")
            try:
                head, radius = place.split("r")
                kept = Cone(float(head[:8]), float(head[8:]), float(radius))
            except ValueError:
                continue
            if kept.holds(cone) and float(depth) >= faintest:
                return path
        return None


def rounded(cone: Cone) -> Cone:
    """A cone of round numbers about another."""
    dec = round(cone.dec_deg / STEP_DEG) * STEP_DEG
    step = STEP_DEG / max(math.cos(math.radians(dec)), 1e-3)
    ra = round(cone.ra_deg / step) * step % 360.0
    # Half a step along either axis, and some room for stars that have moved.
    radius = math.ceil((cone.radius_deg + 0.75 * STEP_DEG) / STEP_DEG) * STEP_DEG
    return Cone(round(ra, 4), round(dec, 4), min(round(radius, 3), 180.0))


def cache_folder() -> Path:
    """Where things are kept: $SAMEAS_CACHE, else sameas in $XDG_CACHE_HOME or ~/.cache."""
    said = os.environ.get("SAMEAS_CACHE")
    if said:
        return Path(said)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "sameas"


def _offline() -> str:
    return "without it: --catalog bright (G < 10, whole sky), or a file or folder of your own"


def _short(error: BaseException) -> str:
    cause = error.__cause__ or error.__context__ or error
    words = " ".join(str(cause or error).split())
    return words if len(words) < 160 else words[:157] + "…"
