"""Added columns have UCDs of the IVOA vocabulary, kept in files and recognised when read again."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.io.votable.ucd import check_ucd
from astropy.table import Table

import sameas
from sameas.io import read_table, write_table
from sameas.sky.output_columns import UCDS


@pytest.mark.parametrize("name", UCDS)
def test_ucds_are_in_the_ivoa_vocabulary(name: str) -> None:
    assert check_ucd(UCDS[name], check_controlled_vocabulary=True, has_colon=False), UCDS[name]


@pytest.fixture(scope="module")
def match():
    rng = np.random.default_rng(3)
    ra, dec = 80.0 + 0.1 * rng.random(60), 10.0 + 0.1 * rng.random(60)
    one, two = (
        Table({"id": np.arange(60), "ra": ra + 3e-5 * rng.normal(size=60), "dec": dec + 3e-5 * rng.normal(size=60)})
        for _ in range(2)
    )
    return sameas.match(one, two, sigma=0.1, sigma_unit="arcsec")


def test_every_added_column_has_a_ucd(match) -> None:
    own = {"id", "ra", "dec"}
    for table in (match.table, match.pairs):
        for name in table.colnames:
            if name.rsplit("_", 1)[0] not in own:
                assert table[name].meta.get("ucd"), name


@pytest.mark.parametrize("ending", ["fits", "vot", "ecsv", "parquet"])
def test_files_keep_ucds(match, tmp_path, ending: str) -> None:
    path = tmp_path / f"out.{ending}"
    match.write(path)
    assert read_table(path)["p_match"].meta["ucd"] == "stat.probability"
    write_table(read_table(path), tmp_path / f"again.{ending}", provenance={})
    assert read_table(tmp_path / f"again.{ending}")["sep_arcsec"].meta["ucd"] == "pos.angDistance"
