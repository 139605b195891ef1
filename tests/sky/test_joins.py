"""The joined table: rows of each join, contents and UCDs of the added columns."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest
from astropy.io.votable.ucd import check_ucd
from astropy.table import Table

import sameas
from sameas.errors import InputError
from sameas.front.match import Match
from sameas.io import read_table, write_table
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import MatchOptions, by_position, match
from sameas.sky.joins import JoinedTable, joined
from sameas.sky.output_columns import JOINS, UCDS

ARCSEC = 1.0 / 3600.0


@pytest.fixture(scope="module")
def matched():
    """Ten stars: 0–5 in both, 6–7 only in the first (one of them without a position), 8–9 only in the second;
    star 0 of the first has a second candidate."""
    rng = np.random.default_rng(3)
    place = np.column_stack([10 + rng.uniform(0, 60, 10) * ARCSEC, 20 + np.arange(10) * 30 * ARCSEC])
    place[8] = place[0] + [0.0, 0.35 * ARCSEC]
    ra = place[:8, 0].copy()
    ra[7] = np.nan
    first = {"id": [f"a{k}" for k in range(8)], "ra": ra, "dec": place[:8, 1], "note": np.arange(8)}
    both = [0, 1, 2, 3, 4, 5, 8, 9]
    second = {
        "id": [f"b{k}" for k in both],
        "ra": place[both, 0],
        "dec": place[both, 1] + 0.02 * ARCSEC,
        "mag": np.arange(8.0),
    }
    options = CatalogueOptions(sigma=0.1, epoch=2000.0)
    one, two = (Catalogue.of(t, n, options=options) for t, n in ((first, "one"), (second, "two")))
    return match(one, two, MatchOptions(error_scale=1.0))


def test_each_join_has_its_rows(matched):
    count = {name: len(joined(matched, name)) for name in JOINS}
    assert count == {
        "1and2": 6, "1or2": 10, "all1": 8, "all2": 8, "1not2": 2, "2not1": 2, "1xor2": 4,
        "pairs": len(matched.result.pairs) + 8,
    }  # fmt: skip


def test_only_columns_in_both_tables_get_suffixes(matched):
    names = joined(matched, "1and2").colnames
    assert names[:7] == ["id_1", "ra_1", "dec_1", "note", "id_2", "ra_2", "dec_2"] and "mag" in names


def test_partners_and_probabilities(matched):
    table = joined(matched, "all1")
    assert list(table["id_2"][:6]) == [f"b{k}" for k in range(6)]
    assert np.all(table["match_flag"] == [1, 1, 1, 1, 1, 1, 0, 0])
    np.testing.assert_allclose(table["sep_arcsec"][:6], 0.02, atol=1e-6)
    np.testing.assert_allclose(table["dy_arcsec"][:6], -0.02, atol=1e-6)
    assert table["id_second"][0] == "b8" and 0 < table["p_second"][0] < table["p_match"][0]
    assert table["n_within"][0] == 2 and table["group_size"][0] == 3
    whole = table["p_match"][0] + table["p_second"][0] + table["p_none"][0]
    assert whole == pytest.approx(1.0, abs=1e-12)


def test_rows_without_position_are_neither_matched_nor_without_partner(matched):
    row = joined(matched, "all1")[7]
    assert all(np.ma.is_masked(row[name]) for name in ("id_2", "p_match", "p_none", "group_id", "covered"))
    assert row["match_flag"] == 0


def test_all_candidates_and_no_partner_are_listed_and_the_best_flagged(matched):
    table = joined(matched, "pairs")
    for name in (f"a{k}" for k in range(7)):
        mine = table[table["id_1"] == name]
        alone = np.ma.getmaskarray(mine["id_2"])
        assert alone.sum() == 1 and (mine["match_flag"] == 1).sum() == 1
        p = np.ma.filled(mine["p_match"], 0.0).sum() + mine["p_none"][0]
        assert p == pytest.approx(1.0, abs=1e-12)
    assert table["match_flag"][table["id_1"] == "a6"][0] == 1


def test_nway_column_names_on_request(matched):
    table = joined(matched, "1and2", nway_columns=True)
    np.testing.assert_allclose(table["p_any"], 1.0 - table["p_none"])
    np.testing.assert_allclose(table["p_i"], table["p_match"] / table["p_any"])
    np.testing.assert_allclose(table["dist_bayesfactor"], table["log_odds"] / np.log(10.0))


def test_an_unknown_join_names_the_known_ones(matched):
    with pytest.raises(InputError, match="join '1in2' is not known; choose one of all1, 1and2"):
        joined(matched, "1in2")


def in_internal_order(catalogue: Catalogue) -> Catalogue:
    """The catalogue with its rows in the order in which they are matched."""
    placed = by_position(catalogue.records(2000.0)).rows
    return catalogue.with_rows(catalogue.table[np.append(placed, np.setdiff1d(np.arange(len(catalogue)), placed))])


def by_ids(table: Table) -> Table:
    ids = [np.ma.filled(table[name].astype(str), "") for name in ("id_2", "id_1")]
    return table[np.lexsort(ids)]


@pytest.mark.slow
@pytest.mark.parametrize("seam", [10.0, 359.99])
def test_the_internal_order_of_records_does_not_matter(seam):
    """Sorted by position or in table order: equal joined table, blends and explanations."""
    rng = np.random.default_rng(8)
    place = np.column_stack([seam + rng.uniform(0.0, 0.03, 150), 20.0 + rng.uniform(0.0, 0.02, 150)])
    tables: list[dict[str, Any]] = []
    for some in (rng.permutation(150)[:120], rng.permutation(150)[:130]):
        at = place[some] + rng.normal(0.0, 0.5, (len(some), 2)) * ARCSEC
        at[5, 0] = np.nan
        tables.append({"id": [f"n{k}" for k in some], "ra": at[:, 0] % 360.0, "dec": at[:, 1]})
    options = CatalogueOptions(sigma=0.5, epoch=2000.0)
    one, two = (Catalogue.of(table, name, options=options) for table, name in zip(tables, ("one", "two"), strict=True))
    by_row, by_place = match(in_internal_order(one), in_internal_order(two)), match(one, two)
    assert (np.diff(by_place.result.first.rows) < 0).any() and (np.diff(by_row.result.first.rows) > 0).all()
    for join in ("all1", "1or2", "pairs"):
        expected, found = (by_ids(joined(each, join)) for each in (by_row, by_place))
        assert found.colnames == expected.colnames
        for name in set(found.colnames) - {"group_id", "row_1", "row_2"}:  # groups are numbered in order of occurrence
            values, due = (np.ma.asarray(table[name]) for table in (found, expected))
            assert np.array_equal(np.ma.getmaskarray(values), np.ma.getmaskarray(due)), name
            if due.dtype.kind == "f":
                np.testing.assert_allclose(values.filled(0.0), due.filled(0.0), rtol=1e-9, atol=1e-12, err_msg=name)
            else:
                assert (values == due).all(), name
    for record in (tables[0]["id"][0], tables[0]["id"][5]):
        lines, due = (re.sub(r"row \d+", "row", str(each.result.explain(record))) for each in (by_place, by_row))
        assert lines == due
    doubled, due = (Match(each.result, each.estimate, each).blends(1.0) for each in (by_place, by_row))
    assert list(doubled["row_1"]) == sorted(doubled["row_1"])
    for table in (doubled, due):
        table.sort("id_1")
    assert (doubled["id_1"] == due["id_1"]).all()
    np.testing.assert_allclose(doubled["p_blend"], due["p_blend"], rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("magnitudes", ["auto", pytest.param("off", marks=pytest.mark.slow)])
def test_the_row_order_of_the_tables_does_not_matter(magnitudes):
    """The pairs sampled for learning are the same for sorted and shuffled tables."""
    rng = np.random.default_rng(9)
    n = 3000
    place = np.column_stack([150.0 + rng.uniform(0.0, 0.3, n), 2.0 + rng.uniform(0.0, 0.3, n)])
    bright = np.sort(rng.uniform(12.0, 20.0, n))
    tables = []
    for least in (0.2, 0.6):
        some = np.flatnonzero(rng.random(n) < 0.8)
        sigma = least * 10 ** (0.1 * (bright[some] - 16.0))
        at = place[some] + rng.normal(size=(len(some), 2)) * sigma[:, None] * ARCSEC
        columns = {"id": some, "ra": at[:, 0], "dec": at[:, 1], "sigma_arcsec": sigma}
        tables.append(Table({**columns, "mag": bright[some] + rng.normal(0.0, 0.2, len(some))}))
    shuffled = [table[rng.permutation(len(table))] for table in tables]
    pairs = []
    for one, two in (tables, shuffled):
        found = match(Catalogue.of(one, "one"), Catalogue.of(two, "two"), MatchOptions(magnitudes=magnitudes))
        matches = found.result.matches
        ids = zip(one["id"][matches.rows_1].tolist(), two["id"][matches.rows_2].tolist(), strict=True)
        pairs.append(dict(zip(ids, matches.p_match.tolist(), strict=True)))
    assert pairs[0].keys() == pairs[1].keys() and len(pairs[0]) > 1500
    assert max(abs(p - pairs[1][pair]) for pair, p in pairs[0].items()) < 1e-9


def test_the_nearest_record_of_every_row_is_given_at_its_row():
    rng = np.random.default_rng(3)
    ra, dec = rng.uniform(10.0, 10.1, 60), rng.uniform(-0.05, 0.05, 60)
    dec[7] = np.nan
    order = rng.permutation(60)
    tables = {"one": (ra, dec), "two": (ra[order], dec[order])}
    options = CatalogueOptions(sigma=0.5, epoch=2000.0)
    one, two = (Catalogue.of({"ra": a, "dec": d}, name, options=options) for name, (a, d) in tables.items())
    near = match(one, two).nearest(moved=True)
    usable = np.isfinite(dec)
    assert (near.rows.mask == ~usable).all() and (near.separation_arcsec.mask == ~usable).all()
    assert (order[near.rows[usable]] == np.flatnonzero(usable)).all() and (near.separation_arcsec[usable] < 1e-6).all()


def test_the_nearest_of_no_records_is_masked():
    from sameas import Records, Sphere
    from sameas.sky.sky_match import nearest

    one, none = (Records.of(at, sigma=0.3, space=Sphere()) for at in ([[150.0, 2.0]], np.empty((0, 2))))
    near = nearest(one, none)
    assert near.rows.mask.all() and near.separation_arcsec.mask.all() and len(near.rows) == 1


@pytest.mark.parametrize("join", JOINS)
@pytest.mark.parametrize("ending", [".parquet", ".csv"])
def test_a_table_is_written_in_pieces_as_it_is_written_whole(matched, join, ending, tmp_path):
    from sameas.io import read_table, write_table

    whole, pieces = (tmp_path / f"{name}{ending}" for name in ("whole", "pieces"))
    write_table(joined(matched, join), whole, provenance={"n": 1})
    lazy = JoinedTable(matched, join, piece_rows=3)
    write_table(lazy, pieces, provenance={"n": 1})
    expected, read = read_table(whole), read_table(pieces)
    assert len(lazy) == len(expected) and lazy.colnames == expected.colnames
    assert repr(read) == repr(expected) and read.meta == expected.meta
    for name in expected.colnames:
        assert read[name].dtype == expected[name].dtype and read[name].attrs_equal(expected[name])
        assert np.all(np.ma.getmaskarray(read[name]) == np.ma.getmaskarray(expected[name]))
    if ending == ".parquet":
        from pyarrow import parquet

        assert parquet.ParquetFile(pieces).schema_arrow.equals(parquet.ParquetFile(whole).schema_arrow, True)
        in_pieces = join in ("1and2", "all1", "pairs")  # the others have at most three rows, or rows of the second only
        assert (parquet.ParquetFile(pieces).num_row_groups > 1) == in_pieces


@pytest.mark.parametrize("kind", ["objects", "times"])
def test_columns_that_are_no_plain_arrays_are_written_whole(kind, tmp_path):
    """Their type in a file depends on all rows."""
    from astropy.time import Time

    from sameas.io import read_table, write_table

    table = Table({"ra": 10.0 + 0.1 * np.arange(5), "dec": np.zeros(5)})
    table["note"] = (
        np.array([None, None, None, "a", "b"], object)
        if kind == "objects"
        else Time(2015.5 + np.arange(5), format="jyear")
    )
    options = CatalogueOptions(sigma=0.1, epoch=2000.0)
    found = match(Catalogue.of(table, "one", options=options), Catalogue.of(table.copy(), "two", options=options))
    write_table(JoinedTable(found, piece_rows=2), tmp_path / "out.parquet", provenance={})
    expected = ["a", "b"] if kind == "objects" else list(table["note"][3:].isot)
    assert list(read_table(tmp_path / "out.parquet")["note_1"][3:]) == expected


@pytest.mark.parametrize("name", UCDS)
def test_ucds_are_in_the_ivoa_vocabulary(name: str) -> None:
    assert check_ucd(UCDS[name], check_controlled_vocabulary=True, has_colon=False), UCDS[name]


@pytest.fixture(scope="module")
def identified():
    rng = np.random.default_rng(3)
    ra, dec = 80.0 + 0.1 * rng.random(60), 10.0 + 0.1 * rng.random(60)
    one, two = (
        Table({"id": np.arange(60), "ra": ra + 3e-5 * rng.normal(size=60), "dec": dec + 3e-5 * rng.normal(size=60)})
        for _ in range(2)
    )
    return sameas.match(one, two, sigma=0.1, sigma_unit="arcsec")


def test_every_added_column_has_a_ucd(identified) -> None:
    own = {"id", "ra", "dec"}
    for table in (identified.table, identified.pairs):
        for name in table.colnames:
            if name.rsplit("_", 1)[0] not in own:
                assert table[name].meta.get("ucd"), name


@pytest.mark.parametrize("ending", ["fits", "vot", "ecsv", "parquet"])
def test_files_keep_ucds(identified, tmp_path, ending: str) -> None:
    path = tmp_path / f"out.{ending}"
    identified.write(path)
    assert read_table(path)["p_match"].meta["ucd"] == "stat.probability"
    write_table(read_table(path), tmp_path / f"again.{ending}", provenance={})
    assert read_table(tmp_path / f"again.{ending}")["sep_arcsec"].meta["ucd"] == "pos.angDistance"
