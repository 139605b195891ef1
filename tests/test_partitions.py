"""Partitioned catalogues give the result of one machine for any partitioning, also after killed processes."""

import os
import re
import shutil
import subprocess
import sys
import time
from contextlib import closing
from dataclasses import replace

import numpy as np
import pytest
from astropy.table import Table

import naive
import sameas
from sameas import InputError

pytest.importorskip("cdshealpix", reason="catalogues in partitions need cdshealpix: pip install 'sameas[hats]'")

from typer.testing import CliRunner

from sameas.cli.app import app
from sameas.estimate.places import CellCounts, Places
from sameas.io import read_table
from sameas.io.atomic import held
from sameas.partitions import healpix, run
from sameas.partitions.hats import CELL, Cell, HatsCatalogue, is_hats, partition_file, write_hats
from sameas.partitions.part import FINER, Halo, Patch

EVERYTHING = np.array([[0, 12 << 58]], np.int64)


def sky(middle, n, crowding, seed, holes=0):
    """Two catalogues of n objects about (ra, dec); ``crowding``: chance candidates within 3σ; the second has holes."""
    rng = np.random.default_rng(seed)
    sigma = np.exp(rng.uniform(np.log(0.05), np.log(0.5), (2, n)))
    density = crowding / (9.0 * np.pi * 2.0 * np.mean(sigma**2))
    radius = np.sqrt(n / density / np.pi) / 206264.8
    r, angle = radius * np.sqrt(rng.uniform(size=n)), rng.uniform(0.0, 2.0 * np.pi, n)
    place = np.column_stack([r * np.cos(angle), r * np.sin(angle)])
    east, north, up = axes(*middle)
    kind = rng.choice(3, n, p=[0.8, 0.1, 0.1])
    hidden = np.zeros(n, bool)
    for hole in rng.choice(n, holes, replace=False):
        hidden |= np.hypot(*(place - place[hole]).T) < np.sqrt(60.0 / density / np.pi) / 206264.8
    magnitude, tables = rng.normal(20.0, 1.5, n), []
    for side in (1, 2):
        some = rng.permutation(np.flatnonzero(((kind == 0) | (kind == side)) & ~(hidden & (side == 2))))
        at = place[some] + rng.normal(size=(len(some), 2)) * sigma[side - 1, some, None] / 206264.8
        v = up + at[:, :1] * east + at[:, 1:] * north
        v /= np.linalg.norm(v, axis=1)[:, None]
        tables.append(Table({
            "id": 2 * some + side, "ra": np.degrees(np.arctan2(v[:, 1], v[:, 0])) % 360.0,
            "dec": np.degrees(np.arcsin(v[:, 2])), "pos_err": sigma[side - 1, some],
            "mag": magnitude[some] + rng.normal(0.0, 0.2, len(some)),
        }))  # fmt: skip
    return tables


def axes(ra, dec):
    a, d = np.radians([ra, dec])
    up = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
    east = np.array([-np.sin(a), np.cos(a), 0.0])
    return east, np.cross(up, east), up


def stored(folder, tables, most):
    """Paths of both as catalogues of at most so many rows a partition.

    One partition of all rows is a cell of order 0, whose halo takes seconds.
    """
    for name, table, rows in zip("ab", tables, most, strict=True):
        write_hats(table, folder / name, max_rows=rows)
    return folder / "a", folder / "b"


def matched(folder, paths, join="all1", out="out", piece_rows=800, **options):
    found = sameas.match(*paths, sigma="pos_err", sigma_unit="arcsec", join=join, **options)
    return found, found.write(folder / out, workers=1, piece_rows=piece_rows)


def table_of(folder):
    catalogue = HatsCatalogue.open(folder)
    rows = catalogue.rows(EVERYTHING)
    return {name: rows.column(name).to_pandas().to_numpy() for name in rows.column_names}


def on_one_machine(found):
    """The result of one machine with all rows and the same estimates: partner and probabilities by id."""
    work = found.estimated.work
    one, two = (work.read(side, EVERYTHING, np.array([0.0, 0.0, 1.0, 1e9])) for side in (1, 2))
    result = work.identified(one, two)
    ids_1, ids_2 = result.first.ids, result.second.ids
    partner = dict(zip(ids_1[result.matches.rows_1], ids_2[result.matches.rows_2], strict=True))
    return partner, dict(zip(ids_1, np.ma.getdata(result.answers_1.p_none), strict=True))


def partners_as_on_one_machine(folder, found):
    """The partners that the pieces in ``folder`` give: those of one machine, which has their probabilities to 1e-6."""
    partner, p_none = on_one_machine(found)
    joined = table_of(folder / "out")
    assert {i: j for i, j in zip(joined["id_1"], joined["id_2"], strict=True) if not np.isnan(j)} == partner
    assert max(abs(p_none[i] - p) for i, p in zip(joined["id_1"], joined["p_none"], strict=True)) < 1e-6
    return partner


@pytest.mark.slow
@pytest.mark.parametrize("crowding", [0.4, 2.0])
@pytest.mark.long_after(1)
def test_estimates_do_not_depend_on_the_partitioning(tmp_path, crowding):
    """Partitions much larger and much smaller than the field; cells were once as coarse as the partitions, and counted
    as empty beyond the field."""
    tables, estimates = sky((0.0, 0.0), 4_000, crowding, seed=6), []
    for most in ((20_000, 20_000), (1_000, 500), (60, 90)):
        found = sameas.match(*stored(tmp_path, tables, most), sigma="pos_err", sigma_unit="arcsec")
        estimates.append(found.estimated)
        for name in ("a", "b"):
            shutil.rmtree(tmp_path / name)
    whole, *others = estimates
    for other in others:
        assert all(
            np.array_equal(getattr(whole.counts, name), getattr(other.counts, name)) for name in ("cells", "numbers")
        )
        for name in ("cells", "density", "seen", "share"):
            assert np.array_equal(getattr(whole.learned.places, name), getattr(other.learned.places, name)), name
        assert whole.learned.means == other.learned.means and whole.work.halo_arcsec == other.work.halo_arcsec
        assert whole.learned.estimate.quantities == other.learned.estimate.quantities
        assert whole.rows_with_halo(10**6) == other.rows_with_halo(10**6)
    one = sameas.match(*tables, sigma="pos_err", sigma_unit="arcsec").estimate.quantities
    for name in ("common", "share_1", "share_2", "error_scale"):
        quantity, of_one = whole.learned.estimate.quantities[name], one[name]
        assert abs(quantity.value - of_one.value) < np.hypot(quantity.standard_error, of_one.standard_error), name
    # The piece size is the number of rows whose candidates, with the halo, reach the limit: check for a square.
    answer, halo, pairs = whole.learned.estimate.answer, whole.work.halo_arcsec, 10**6
    density = sum(whole.sample) / whole.learned.estimate.coverage.volume
    with_halo = density * (np.sqrt(whole.rows_with_halo(pairs) / density) + 2.0 * halo) ** 2
    assert with_halo * len(answer.pairs) / sum(whole.sample) == pytest.approx(pairs, rel=0.01)
    # Record densities are those simulated, without the record itself.
    density = crowding / (9.0 * np.pi * 2.0 * np.mean([np.mean(np.square(table["pos_err"])) for table in tables])) * 0.9
    places, numbers = whole.learned.places, whole.counts.numbers
    at = places.at(whole.counts.cells)
    for k in range(2):
        assert np.average(places.density[at, k, 0], weights=numbers[:, k]) == pytest.approx(density, rel=0.05)


PLACES = {"over the pole": (10.0, 90.0), "across RA 0": (0.0, 0.0), "southern": (200.0, -89.9)}


@pytest.mark.slow
@pytest.mark.parametrize(
    ("place", "most", "piece_rows"),
    [
        ("across RA 0", (20_000, 20_000), 700),
        *((place, (250, 150), 900) for place in PLACES),
        *(pytest.param(place, (40, 60), 90, marks=pytest.mark.long) for place in PLACES),
    ],
)
@pytest.mark.long_after(1)
def test_the_result_is_that_of_one_machine_for_any_partitioning(tmp_path, place, most, piece_rows):
    tables = sky(PLACES[place], 2_500, 0.4, seed=5, holes=3)
    found, written = matched(tmp_path, stored(tmp_path, tables, most), piece_rows=piece_rows)
    paired = partners_as_on_one_machine(tmp_path, found)
    assert len(set(paired.values())) == len(paired) == written.pairs > 1_500
    ids = table_of(tmp_path / "out")["id_1"]
    assert len(ids) == len(tables[0]) and len(set(ids)) == len(tables[0])
    assert written.doubtful == 0


@pytest.mark.long
def test_in_a_crowd_pairs_are_equal_and_probabilities_nearly_equal(tmp_path):
    """Percolating groups are summed approximately, in an order independent of the partitioning."""
    tables = sky((0.0, 0.0), 3_500, 2.0, seed=6)
    found, _ = matched(tmp_path, stored(tmp_path, tables, (1_500, 900)))
    partners_as_on_one_machine(tmp_path, found)


@pytest.mark.slow
@pytest.mark.long
def test_probabilities_of_percolating_groups_do_not_depend_on_the_halo_boundary(tmp_path):
    """Whether a group is summed exactly must depend on the whole group, not only on its part in the halo."""
    tables = sky((0.0, 0.0), 12_000, 2.2, seed=2)
    work = sameas.match(
        *stored(tmp_path, tables, (50_000, 50_000)), sigma="pos_err", sigma_unit="arcsec"
    ).estimated.work
    one, two = (work.read(side, EVERYTHING, np.array([0.0, 0.0, 1.0, 1e9])) for side in (1, 2))
    everything = work.identified(one, two)
    truth = {(i, j): p for i, j, p in zip(*ids_of(one, two, everything), everything.p_pair, strict=True)}

    def error(part, result):
        own = part.own[0][result.rows_1] | part.own[1][result.rows_2]
        ids_1, ids_2 = ids_of(part.one, part.two, result)
        stated = zip(ids_1[own], ids_2[own], result.p_pair[own], strict=True)
        return max((abs(p - truth[i, j]) for i, j, p in stated), default=0.0)

    numbers, rows = np.unique(one.stored >> 2 * (29 - 13), return_counts=True)

    def first_differs(cell):
        first = work.decide_patch(Patch(cell.order, np.array([cell.number])), work.halo_arcsec)
        return first.n_doubtful > 0 and error(first, work.identified(first.one, first.two)) > 1e-6

    busiest = [Cell(13, int(number)) for number in numbers[np.argsort(-rows)]]
    parts = work.decide([next(filter(first_differs, busiest[:12]))])
    assert max(error(part, part.result) for part in parts) < 1e-9 and parts[-1].n_doubtful == 0


def ids_of(one, two, result):
    return one.catalogue.ids[result.rows_1], two.catalogue.ids[result.rows_2]


@pytest.mark.slow
@pytest.mark.parametrize("order, number", [(6, 0), (6, 4095), (6, 4096 * 12 - 1), (9, 777_777), (12, 5), (7, 99_000)])
@pytest.mark.parametrize("width", [0.7, 19.7, 64.4, 900.0])
def test_a_halo_holds_all_rows_within_its_width_and_few_others(order, number, width):
    """At corners where three cells meet, on the equator, and where the halo is wider than the cell."""
    patch, rng = Patch(order, np.array([number])), np.random.default_rng(number)
    halo = Halo.around(patch, width, FINER)
    assert width <= halo.width_arcsec <= 1.34 * width
    shift = 2 * (healpix.FINEST - order)
    inside = (number << shift) + rng.integers(0, 1 << shift, 2_000)
    # The cell's corners and edges among them: runs of equal digits in nested numbering.
    runs = [((1 << shift) - 1) // 3 * k >> 2 * j << 2 * j for k in range(4) for j in range(16)]
    inside[:64] = (number << shift) + np.array(runs)
    from_here = healpix.centres(inside, healpix.FINEST)
    along = np.cross(from_here, rng.normal(size=from_here.shape))
    along /= np.linalg.norm(along, axis=1)[:, None]
    turn = rng.choice([1.0, 0.999, 0.5], len(along))[:, None] * (halo.width_arcsec / 206264.80625)
    at = from_here * np.cos(turn) + along * np.sin(turn)
    lon_lat = np.degrees(np.column_stack([np.arctan2(at[:, 1], at[:, 0]), np.arcsin(np.clip(at[:, 2], -1.0, 1.0))]))
    assert healpix.within(halo.stretch, healpix.cells_of(lon_lat, healpix.FINEST)).all()
    assert np.all(halo.edge_arcsec(from_here, np.full(len(at), 4.0 * width)) >= 0.0)


@pytest.mark.slow
def test_a_halo_that_is_too_narrow_is_detected(tmp_path):
    tables = sky((0.0, 0.0), 3_000, 0.5, seed=7)
    found = sameas.match(*stored(tmp_path, tables, (300, 300)), sigma="pos_err", sigma_unit="arcsec")
    work = found.estimated.work
    cell = run.output_cells(work)[3]
    narrow = work.decide_patch(Patch(cell.order, np.array([cell.number])), 1.0)
    first, *again = replace(work, halo_arcsec=1.0).decide([cell])
    assert (
        narrow.n_doubtful > 0 == first.n_doubtful == again[-1].n_doubtful and again[-1].halo_arcsec > first.halo_arcsec
    )
    # Every row of the cell is in exactly one part.
    enough = work.decide([cell])
    for parts in ([first, *again], enough):
        own = np.concatenate([part.first.ids[part.own[0]] for part in parts])
        assert sorted(own) == sorted(narrow.first.ids[narrow.own[0]])
    partner = [{i: j for part in parts for i, j in pairs_of(part).items()} for parts in ([first, *again], enough)]
    assert partner[0] == partner[1]


def pairs_of(part):
    found = part.result.matches
    own = part.own[0][found.rows_1]
    return dict(zip(part.first.ids[found.rows_1[own]], part.second.ids[found.rows_2[own]], strict=True))


@pytest.mark.slow
def test_outer_joins_write_every_row_once(tmp_path):
    tables = sky((0.0, 0.0), 3_000, 0.3, seed=8)
    tables[0] = tables[0][tables[0]["dec"] > -0.02]  # the second extends beyond the first
    found, written = matched(tmp_path, stored(tmp_path, tables, (300, 500)), join="1or2")
    joined = table_of(tmp_path / "out")
    for table, name in zip(tables, ("id_1", "id_2"), strict=True):
        there = joined[name][~np.isnan(joined[name])]
        assert sorted(there) == sorted(table["id"])
    assert np.isfinite(joined["_ra"]).all() and len(joined["_ra"]) == written.rows
    assert set(on_one_machine(found)[0].items()) <= set(zip(joined["id_1"], joined["id_2"], strict=True))


@pytest.mark.slow
def test_pandas_reads_whole_numbers_of_every_partition_as_such(tmp_path):
    """Rows without a partner have no id of it; as a float a long id would be rounded."""
    pandas = pytest.importorskip("pandas")
    tables = sky((0.0, 0.0), 600, 0.3, seed=8)
    tables[1] = tables[1][tables[1]["dec"] > 0.0]
    tables[1]["id"] += 4_295_806_720_000_000_001
    matched(tmp_path, stored(tmp_path, tables, (300, 500)), join="all1")
    files = sorted((tmp_path / "out" / "out" / "dataset").rglob("Npix=*.parquet"))
    read = [pandas.read_parquet(file) for file in files]
    assert len(read) > 1 and {str(frame["id_2"].dtype) for frame in read} == {"Int64"}
    both = pandas.concat(read)["id_2"]
    assert both.isna().any() and set(both.dropna()) <= set(tables[1]["id"].tolist())


@pytest.mark.slow
def test_hats_and_lsdb_read_the_output_collection(tmp_path):
    hats = pytest.importorskip("hats", reason="hats is not installed")
    validation = pytest.importorskip("hats.io.validation")
    _, written = matched(tmp_path, stored(tmp_path, sky((0.0, 0.0), 2_000, 0.3, seed=9), (300, 500)))
    read = hats.read_hats(tmp_path / "out")
    assert read.main_catalog.catalog_info.total_rows == written.rows == len(table_of(tmp_path / "out")["id_1"])
    assert len(read.main_catalog.get_healpix_pixels()) == written.partitions
    assert validation.is_valid_catalog(tmp_path / "out" / "out", strict=False)
    margin = HatsCatalogue.open(tmp_path / "out" / "out_10arcs")
    for cell in margin.cells:
        rows = np.asarray(margin.rows(EVERYTHING).column(CELL))
        assert len(rows)
        inside = read_table(partition_file(margin.path, cell))[CELL]
        assert not healpix.within(cell.stretch, np.asarray(inside)).any()


@pytest.mark.slow
def test_stars_that_move_across_a_border_are_matched(tmp_path):
    """A fast star is stored in one partition and observed, years later, in another."""
    tables = sky((0.0, 0.0), 2_000, 0.05, seed=10)
    first, second = tables
    for table, epoch in ((first, 2000.0), (second, 2016.0)):
        table["epoch"] = np.full(len(table), epoch)
    first["pmra"], first["pmdec"] = np.zeros(len(first)), np.zeros(len(first))
    first["pmra_error"] = first["pmdec_error"] = np.full(len(first), 0.01)
    star = {"id": -1, "ra": 359.999, "dec": 0.001, "pos_err": 0.05, "mag": 20.0}
    first.add_row({**star, "epoch": 2000.0, "pmra": 900.0, "pmdec": 0.0, "pmra_error": 0.01, "pmdec_error": 0.01})
    second.add_row({**star, "id": -2, "ra": (359.999 + 14.4 / 3600.0) % 360.0, "epoch": 2016.0})
    found, _ = matched(tmp_path, stored(tmp_path, tables, (200, 200)))
    joined = table_of(tmp_path / "out")
    assert joined["id_2"][list(joined["id_1"]).index(-1)] == -2
    assert len(found.estimated.work.sides[0].far) == 1


@pytest.mark.slow
def test_partitions_without_rows_of_the_other_catalogue_need_no_epoch_of_it(tmp_path):
    """The epoch of a part is that of its rows; a part without any was refused for an unknown epoch."""
    tables = sky((0.0, 0.0), 2_000, 0.05, seed=10)
    for table, epoch in zip(tables, (2000.0, 2016.0), strict=True):
        table["epoch"] = np.full(len(table), epoch)
    tables[0]["pmra"], tables[0]["pmdec"] = np.zeros(len(tables[0])), np.zeros(len(tables[0]))
    tables[0]["pmra_error"] = tables[0]["pmdec_error"] = np.full(len(tables[0]), 0.01)
    north = tables[1][np.asarray(tables[1]["dec"]) > 0.0]
    _, written = matched(tmp_path, stored(tmp_path, (tables[0], north), (200, 200)), piece_rows=100)
    assert written.rows == len(tables[0]) and written.pairs > 0.9 * written.expected_common
    assert written.decided > 10


@pytest.mark.slow
@pytest.mark.parametrize("errors", [True, False])
def test_an_unknown_epoch_is_assumed_as_for_tables_with_or_without_errors(tmp_path, errors):
    tables = sky((40.0, 10.0), 1_000, 0.05, 4)
    tables[0]["pmra"], tables[0]["pmdec"] = 1.0, -1.0
    tables[0]["ref_epoch"] = 2016.0
    if not errors:
        for table in tables:
            table.remove_column("pos_err")
    options = {"sigma": "pos_err", "sigma_unit": "arcsec"} if errors else {}
    found = sameas.match(*stored(tmp_path, tables, (400, 400)), pm_sigma1=0.1, **options)
    assumed = "b: its epoch is not known; 2016 was assumed, so its positions are not moved; give epoch2=YEAR"
    assert [doubt for doubt in found.doubts if "epoch" in doubt] == [assumed]
    assert found.estimated.moved == "both catalogues are of epoch 2016.00"


def test_doubts_about_the_columns_of_partitions_are_reported(tmp_path):
    """Motions without errors, and rows without one, are doubted as in tables."""
    ra, dec = np.random.default_rng(3).uniform([40.0, 0.0], [40.2, 0.2], (2000, 2)).T
    error = np.where(np.arange(2000) % 50, 0.1, 0.0)
    one = Table({"ra": ra, "dec": dec, "ra_error": error, "dec_error": error, "pmra": 0 * ra, "pmdec": 0 * ra})
    one["ref_epoch"] = 2016.0
    two = Table({"ra": ra, "dec": dec, "epoch": np.full(2000, 2000.0)})
    paths = stored(tmp_path, (one, two), (500, 500))
    found = sameas.match(*paths, sigma_unit1="arcsec", sigma2=0.1)
    rows, motion = sorted(found.doubts)
    assert rows.startswith("a, in its first rows: ") and "or a positive error and are set aside; " in rows
    assert motion.startswith("a, in its first rows: pmra has no column of errors") and "pm_sigma1" in motion
    assert "pmra has no column of errors" in found.report()
    # Notes count these rows: "27 of 81 rows have no proper motion" was told of a catalogue of 2 500.
    assert found.report().count("the first rows of some partitions, which are those that notes count") == 2


@pytest.mark.slow
def test_a_broken_partition_is_named_and_finished_ones_are_kept(tmp_path):
    tables = sky((0.0, 0.0), 3_000, 0.3, seed=11)
    a, b = stored(tmp_path, tables, (400, 400))
    found = sameas.match(a, b, sigma="pos_err", sigma_unit="arcsec")
    _ = found.estimated
    cell = found.catalogues[1].cells[-1]
    file = partition_file(b, cell)
    whole = file.read_bytes()
    file.write_bytes(whole[:2_000])
    with pytest.raises(InputError, match=f"Norder={cell.order}, Npix={cell.number} cannot be read"):
        found.write(tmp_path / "out", workers=1, piece_rows=800)
    done = list((tmp_path / "out" / "out" / "dataset").rglob("*.parquet"))
    assert done and not is_hats(tmp_path / "out")


@pytest.mark.slow
def test_an_interrupted_run_resumes_with_the_same_bytes(tmp_path, monkeypatch):
    paths = stored(tmp_path, sky((0.0, 0.0), 2_000, 0.3, seed=12), (250, 250))
    found, whole = matched(tmp_path, paths, out="one/out")
    work, n = run.decide_partition, [0]

    def dying(folder, task):
        n[0] += 1
        if n[0] > 3:
            raise KeyboardInterrupt
        return work(folder, task)

    monkeypatch.setattr(run, "decide_partition", dying)
    with pytest.raises(KeyboardInterrupt):
        found.write(tmp_path / "two" / "out", workers=1, piece_rows=800)
    monkeypatch.undo()
    with pytest.raises(InputError, match="was begun with other catalogues or options"):
        found.write(tmp_path / "two" / "out", workers=1)
    # The remains of a worker killed while writing.
    beside = next((tmp_path / "two" / "out" / "out" / "dataset").rglob("*.parquet"))
    beside.with_name(f".{beside.name}.1.part").write_bytes(b"PAR1")
    again = found.write(tmp_path / "two" / "out", workers=1, piece_rows=800)
    assert again.decided == whole.decided - 3 and replace(
        again, path=whole.path, decided=0, cpu_seconds=0.0
    ) == replace(whole, decided=0, cpu_seconds=0.0)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    with pytest.raises(InputError, match="exists already"):
        found.write(tmp_path / "two" / "out", workers=1, piece_rows=800)


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


SCRIPT = """
import sys, sameas
found = sameas.match({a!r}, {b!r}, sigma="pos_err", sigma_unit="arcsec")
print("written", found.write({out!r}, workers=2, piece_rows=100).pairs, flush=True)
"""


def workers_of(pid):
    """Worker processes of a client: the children of its fork server, or its own spawned children."""
    processes = subprocess.run(["ps", "-ww", "-eo", "pid=,ppid=,args="], capture_output=True, text=True).stdout
    lines = [(int(line.split()[0]), int(line.split()[1]), line) for line in processes.splitlines()]
    servers = [one for one, parent, line in lines if parent == pid and "forkserver" in line]
    return [one for one, parent, line in lines if parent in servers or (parent == pid and "spawn_main" in line)]


@pytest.mark.long
@pytest.mark.skipif(sys.platform == "win32", reason="kills processes as POSIX does")
@pytest.mark.parametrize("victim", ["worker", "client"])
def test_a_killed_worker_is_replaced_and_a_killed_client_resumes_with_the_same_bytes(tmp_path, victim):
    """The script has no __main__ guard, and workers do not run it again."""
    a, b = stored(tmp_path, sky((0.0, 0.0), 3_000, 0.3, seed=13), (60, 60))
    runs = {out: [sys.executable, "-c", SCRIPT.format(a=str(a), b=str(b), out=str(tmp_path / out / "out"))]
            for out in ("one", "two")}  # fmt: skip
    subprocess.run(runs["one"], check=True, capture_output=True)
    process = subprocess.Popen(runs["two"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    done = tmp_path / "two" / "out" / ".sameas-run" / "done"
    until = time.monotonic() + 240.0
    while len(list(done.glob("*.json"))) < 3 and time.monotonic() < until:
        assert process.poll() is None, process.stderr.read().decode()
        time.sleep(0.01)
    workers = workers_of(process.pid)
    os.kill(workers[0] if victim == "worker" and workers else process.pid, 9)
    process.communicate(timeout=300)
    assert workers
    if victim == "client":
        assert process.returncode != 0 and not (tmp_path / "two" / "out" / "collection.properties").exists()
        subprocess.run(runs["two"], check=True, capture_output=True)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")


@pytest.mark.slow
def test_a_folder_is_locked_by_one_run_and_unlocked_after_a_kill(tmp_path):
    found, _ = matched(tmp_path, stored(tmp_path, sky((40.0, 10.0), 300, 0.1, seed=12), (200, 200)), out="one/out")
    out = tmp_path / "two" / "out"
    (out / ".sameas-run").mkdir(parents=True)
    with closing(held(out / ".sameas-run")), pytest.raises(InputError, match="another run writes there; give another"):
        found.write(out, workers=1, piece_rows=800)
    # A run killed before it wrote its description once left a folder that was refused for ever.
    found.write(out, workers=1, piece_rows=800)
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    (out / ".sameas-run").mkdir()
    with pytest.raises(InputError, match="exists already"):
        found.write(out, workers=1, piece_rows=800)
    assert contents(tmp_path / "one") == contents(tmp_path / "two") and not (out / ".sameas-run").exists()


@pytest.mark.slow
def test_no_folder_name_adds_a_property(tmp_path):
    name = "out\nhats_col_ra=x<script>"
    found, _ = matched(tmp_path, stored(tmp_path, sky((40.0, 10.0), 300, 0.1, seed=12), (200, 200)), out="plain")
    found.write(tmp_path / name, workers=1)
    properties = (tmp_path / name / "collection.properties").read_text(encoding="utf-8")
    assert "obs_collection=out\\u000ahats_col_ra=x<script>\n" in properties
    assert len(HatsCatalogue.open(tmp_path / name).cells) == len(HatsCatalogue.open(tmp_path / "plain").cells)


@pytest.mark.slow
@pytest.mark.parametrize("what", ["files no larger than 2 kB", "a folder that disappears"])
def test_a_disk_error_is_one_line_and_no_internal_error(what, tmp_path, monkeypatch):
    resource = pytest.importorskip("resource")
    found, _ = matched(tmp_path, stored(tmp_path, sky((40.0, 10.0), 300, 0.1, seed=12), (200, 200)), out="one/out")
    limits, out = resource.getrlimit(resource.RLIMIT_FSIZE), tmp_path / "two" / "out"
    work = run.decide_partition

    def gone(folder, task):
        shutil.rmtree(out)
        return work(folder, task)

    if what == "a folder that disappears":
        monkeypatch.setattr(run, "decide_partition", gone)
    else:
        resource.setrlimit(resource.RLIMIT_FSIZE, (2048, limits[1]))
    try:
        with pytest.raises(InputError, match=f"cannot write {re.escape(str(out))}: the f.*; finished parts are kept"):
            found.write(out, workers=1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="mounts a file system of bounded size")
def test_a_full_disk_is_reported_and_finished_partitions_are_kept(tmp_path):
    paths = stored(tmp_path, sky((0.0, 0.0), 3_000, 0.3, seed=18), (100, 100))
    found, whole = matched(tmp_path, paths, out="one/out", piece_rows=200)
    room = sum(map(len, contents(tmp_path / "one").values())) * 3 // 10
    small = tmp_path / "two"
    small.mkdir()
    if subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={room}", "tmpfs", small], capture_output=True).returncode:
        pytest.skip("no right to mount")
    try:
        with pytest.raises(InputError, match="the disk is full; finished parts are kept"):
            found.write(small / "out", workers=1, piece_rows=200)
        subprocess.run(["mount", "-o", "remount,size=100m", small], check=True)
        again = found.write(small / "out", workers=1, piece_rows=200)
        assert 0 < again.decided < whole.decided
        assert contents(tmp_path / "one") == contents(small)
    finally:
        # Memory-mapped files are closed when their arrays are released.
        subprocess.run(["umount", "-l", small], check=True)


@pytest.mark.long
@pytest.mark.filterwarnings("ignore")  # Dask's own
@pytest.mark.skipif(sys.platform == "win32", reason="kills processes as POSIX does")
def test_a_killed_dask_worker_changes_no_byte(tmp_path):
    distributed = pytest.importorskip("distributed", reason="dask.distributed is not installed")
    paths = stored(tmp_path, sky((0.0, 0.0), 3_000, 0.3, seed=19), (100, 100))
    found, _ = matched(tmp_path, paths, out="one/out", piece_rows=100)
    killed = []

    def kill(stage):
        if stage.startswith("part 3 ") and not killed:
            killed.extend(list(client.run(os.getpid).values())[:1])
            os.kill(killed[0], 9)

    with (
        distributed.LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster,
        distributed.Client(cluster) as client,
    ):
        replace(found, progress=kill).write(tmp_path / "two" / "out", executor=client.get_executor(), piece_rows=100)
    assert killed and contents(tmp_path / "one") == contents(tmp_path / "two")


def test_neighbouring_cells_contain_all_points_within_the_width():
    rng = np.random.default_rng(1)
    for cell in (Cell(3, 0), Cell(3, 255), Cell(5, 7_000), Cell(0, 4)):
        width = 40.0
        order = healpix.order_of_width(width)
        ring = healpix.stretches(healpix.ring(np.array([cell.number]), cell.order, order), order)
        # Points of the edge, moved by less than the width.
        edge = healpix.ring(np.array([cell.number]), cell.order, min(cell.order + 8, 20))
        at = healpix.centres(rng.choice(edge, 200), min(cell.order + 8, 20))
        inner = healpix.centres(np.array([cell.number]), cell.order)
        near = at + 1e-12 * inner
        lon, lat = np.degrees(np.arctan2(near[:, 1], near[:, 0])), np.degrees(np.arcsin(near[:, 2]))
        side = healpix.SIDE_ARCSEC / 2.0 ** min(cell.order + 8, 20)
        if side < width:
            found = healpix.cells_of(np.column_stack([lon, lat]), healpix.FINEST)
            assert healpix.within(np.concatenate([cell.stretch, ring])[np.argsort(
                np.concatenate([cell.stretch, ring])[:, 0])], found).all()  # fmt: skip
    assert healpix.width_arcsec(healpix.order_of_width(40.0)) >= 40.0


def test_a_hats_catalogue_and_a_table_are_refused_together(tmp_path):
    a, _ = stored(tmp_path, sky((40.0, 10.0), 300, 0.1, seed=14), (200, 200))
    with pytest.raises(InputError, match="a HATS catalogue is matched with another one"):
        sameas.match(a, {"ra": [1.0], "dec": [1.0]})


def test_a_catalogue_with_wrong_or_missing_properties_is_named(tmp_path):
    """A column that is not there was an unexpected KeyError; without properties the other catalogue was blamed."""
    a, b = stored(tmp_path, sky((40.0, 10.0), 300, 0.1, seed=14), (200, 200))
    properties = next(path for path in a.iterdir() if path.name.endswith("properties"))
    text = properties.read_text()
    properties.write_text(text.replace("hats_col_ra=ra", "hats_col_ra=RA_ICRS"))
    with pytest.raises(InputError, match="no column 'RA_ICRS', which hats_col_ra of its properties names"):
        sameas.match(a, b, sigma="pos_err").write(tmp_path / "one", workers=1)
    properties.unlink()
    for pair in ((a, b), (b, a)):
        with pytest.raises(InputError, match=f"{a.name}: has partitions, but no hats.properties"):
            sameas.match(*pair)


@pytest.mark.slow
def test_an_output_is_a_folder_whose_records_are_not_explained(tmp_path):
    paths = stored(tmp_path, sky((40.0, 10.0), 300, 0.1, seed=14), (200, 200))
    found = sameas.match(*paths, sigma="pos_err")
    for ending in (".fits", ".parquet"):
        with pytest.raises(InputError, match="is a folder of partitions, not one file"):
            found.write(tmp_path / f"out{ending}", workers=1)
    found.write(tmp_path / "out", workers=1)
    with pytest.raises(InputError, match="records of a HATS catalogue are not looked up"):
        sameas.explain(tmp_path / "out", 17)


def test_options_that_would_depend_on_the_partition_are_refused(tmp_path):
    paths = stored(tmp_path, sky((0.0, 0.0), 300, 0.1, seed=15), (300, 300))
    with pytest.raises(InputError, match="values for rows cannot be used over partitions"):
        _ = sameas.match(*paths, sigma="pos_err", evidence=sameas.evidence.Column(2, np.zeros(300))).estimated
    with pytest.raises(InputError, match="offsets are not fitted over partitions"):
        _ = sameas.match(*paths, sigma="pos_err", offset="find").estimated


def test_the_command_speaks_of_partitions_as_of_tables_and_refuses_before_it_reads(tmp_path):
    """A finished output was refused after the estimation, and options had no dashes."""
    sides = sky((40.0, 10.0), 600, 0.1, seed=17)
    a, b = stored(tmp_path, sides, (300, 300))
    out = tmp_path / "out"

    def run(*options: str) -> str:
        done = CliRunner().invoke(app, ["match", str(a), str(b), "-o", str(out), "--workers", "1", *options])
        return " ".join(done.output.split())

    assert "--sigma1; it has" in run("--sigma1", "nosuch")
    assert "--offset: offsets are not fitted over partitions" in run("--sigma", "pos_err", "--offset", "find")
    text = run("--sigma", "0.5")
    assert "First catalogue: " in text and " times those quoted" in text and "HATS collection" in text
    again = run("--sigma", "0.5")
    assert "exists already" in again and "First catalogue" not in again
    many = CliRunner().invoke(app, ["many", str(a), str(b), "-o", str(tmp_path / "many.fits")])
    assert many.exit_code == 1 and "is a HATS catalogue" in many.output


def test_options_that_need_the_whole_result_are_refused_over_partitions(tmp_path):
    a, b = stored(tmp_path, sky((0.0, 0.0), 100, 0.1, seed=16), (300, 300))
    for option in (("--certify",), ("--compare-nearest",), ("--pictures", "x"), ("--out-format", "csv")):
        result = CliRunner().invoke(app, ["match", str(a), str(b), "-o", str(tmp_path / "out"), *option])
        assert result.exit_code != 0 and f"{option[0]}: not over the partitions of HATS catalogues" in result.output
        assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_column_evidence_is_learned_once_and_coded_equally_in_all_partitions(tmp_path):
    tables = sky((0.0, 0.0), 4_000, 0.4, seed=17)
    rng, ids = np.random.default_rng(17), [(table["id"] - side) // 2 for side, table in enumerate(tables, 1)]
    shared = np.isin(ids[1], ids[0])
    # Most common objects are "disk"; "odd" occurs in few parts, so that per-part category codes would differ.
    names = np.where(rng.uniform(size=len(shared)) < np.where(shared, 0.9, 0.2), "disk", "spur")
    names[rng.choice(len(names), 20, replace=False)] = "odd"
    tables[1]["class"] = names
    tables[0]["code"] = rng.integers(0, 3, len(tables[0]))
    evidence = [sameas.evidence.Column(2, "class"), sameas.evidence.Column(1, "code")]
    paths = stored(tmp_path, tables, (400, 250))
    found, _ = matched(tmp_path, paths, evidence=evidence)
    partner = partners_as_on_one_machine(tmp_path, found)
    report = found.report()
    assert "class of b: ln odds of a partner" in report and "code of a: is not informative" in report
    # Records of the second source that look like common objects have partners.
    of_class = dict(zip(tables[1]["id"], names, strict=True))
    without, _ = matched(tmp_path, paths, out="without")
    plain, _ = on_one_machine(without)
    spurs = [sum(of_class[j] == "spur" for j in pairs.values()) for pairs in (partner, plain)]
    assert spurs[0] < spurs[1]
    with pytest.raises(InputError, match=r"no column 'kind' to be evidence; it has id, ra, dec, pos_err, mag, class"):
        _ = sameas.match(*paths, sigma="pos_err", evidence=sameas.evidence.Column(2, "kind")).estimated


@pytest.mark.parametrize("option", ["format1", "hdu2", "hdu"])
def test_formats_are_refused_over_partitions(tmp_path, option):
    paths = stored(tmp_path, sky((0.0, 0.0), 100, 0.1, seed=16), (300, 300))
    with pytest.raises(InputError, match=f"^{option}: HATS catalogues are Parquet files"):
        sameas.match(*paths, sigma="pos_err", **{option: "fits"})


@pytest.mark.slow
def test_an_interruption_in_the_last_step_leaves_no_scratch(tmp_path, monkeypatch, request):
    """The collection was once complete while the run folder stayed next to it."""
    import signal

    from sameas.partitions.hats import write_collection

    def interrupted(*given):
        write_collection(*given)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr("sameas.partitions.run.write_collection", interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # jobs in the background ignore it
    request.addfinalizer(lambda: signal.signal(signal.SIGINT, before))
    paths = stored(tmp_path, sky((40.0, 10.0), 300, 0.1, seed=12), (200, 200))
    with pytest.raises(KeyboardInterrupt):
        matched(tmp_path, paths)
    assert (tmp_path / "out" / "collection.properties").exists() and not (tmp_path / "out" / ".sameas-run").exists()


@pytest.mark.parametrize("part", [0.25, 0.5, 1.0])
def test_a_cell_counts_by_its_area_within_the_field(part):
    """Records in a part of 1 024 cells, eight per cell on average; the sparser source follows the denser."""
    rng, n = np.random.default_rng(2), 1_024
    rich, poor = (rng.integers(0, int(part * n), int(mean * part * n)) for mean in (8.0, 2.0))
    counts = CellCounts.of(rich, poor)
    places = Places.of(counts, 1.0)
    assert places.steps == 0 and places.within(counts, np.array([0]), 5) == pytest.approx(part * n, rel=0.03)
    at = places.at(rich)
    assert places.density[at, 0, 0].mean() == pytest.approx(8.0, rel=0.04)
    assert places.density[at, 1, 1].mean() == pytest.approx(2.0, rel=0.06)


def cells_of_two_sources(seed, n):
    """Cells of the records of two sources: a dense and a sparse region, and one region not covered by each."""
    rng = np.random.default_rng([5, seed])
    cells = [np.where(rng.uniform(size=n) < 0.5, rng.integers(0, n // 8, n), rng.integers(0, n, n)) for _ in "12"]
    cells[1] = cells[1][: n // 2]
    holes = (n // 2, 5 * n // 8), (3 * n // 4, 7 * n // 8)
    return [(4 << 20) + c[(c < low) | (c >= high)] for c, (low, high) in zip(cells, holes, strict=True)]


@pytest.mark.parametrize("n", [1, 3, 40, 160, 700])
@pytest.mark.parametrize("seed", range(3))
def test_densities_in_nested_cells_agree_with_the_definition(seed, n):
    one, two = cells_of_two_sources(seed, n) if n > 3 else (np.array([7] * n), np.array([7, 9]))
    counts = CellCounts.of(one, two)
    places = Places.of(counts, 0.3)
    counts = counts.coarser(places.steps)
    seen, density = naive.nested_densities(counts.cells, counts.numbers, places.levels, places.volume)
    assert np.array_equal(places.seen, seen)
    assert places.density == pytest.approx(density, rel=1e-12)
    if n > 100:
        assert not seen.all()


def test_a_sample_of_cells_determines_the_smoothing():
    """A uniform field with a dense cluster: one cell in twenty gives nearly the smoothing of all cells."""
    rng = np.random.default_rng(3)
    one, two = (np.concatenate([rng.integers(0, 1 << 14, 60_000), rng.integers(0, 1 << 10, 30_000)]) for _ in "12")
    every = Places.of(CellCounts.of(one, two), 1.0)
    some = Places.of(CellCounts.of(one, two), 1.0, smoothing_cells=len(every.cells) // 20)
    apart = np.log(some.density / every.density)
    assert 0.0 < float(np.sqrt(np.mean(apart**2))) < 0.03


def test_counts_of_a_partition_do_not_depend_on_the_block_size(tmp_path):
    one, two = sky((10.0, 20.0), 900, 0.4, 8)
    one["pos_err"][5] = 300.0  # large width
    found = sameas.match(*stored(tmp_path, (one, two), (5_000, 5_000)), sigma="pos_err", sigma_unit="arcsec")
    work = found.estimated.work
    for side in (1, 2):
        cell = work.sides[side - 1].stored.cells[0]
        whole, pieces = (work.count(side, cell, most) for most in (9_999, 7))
        assert np.array_equal(whole.counts.cells, pieces.counts.cells)
        assert np.array_equal(whole.counts.numbers, pieces.counts.numbers)
        assert whole.rows == pieces.rows == [len(one), len(two)][side - 1]
        assert np.array_equal(whole.far, pieces.far) and len(whole.far) == (side == 1)


@pytest.mark.parametrize("written", ["in order", "in another order", "in two files", "without cells"])
def test_blocks_of_rows_together_are_the_whole_partition(tmp_path, written):
    """For every layout of a partition: sorted and unsorted groups of 50 rows, a folder of files, and by
    positions only."""
    from pyarrow import parquet

    table, _ = sky((10.0, 20.0), 500, 0.4, 9)
    write_hats(table, tmp_path / "a", max_rows=5_000)
    catalogue = HatsCatalogue.open(tmp_path / "a")
    (cell,) = catalogue.cells
    rows, file = parquet.read_table(catalogue.file(cell)), catalogue.file(cell)
    if written == "in another order":
        rows = rows.take(np.random.default_rng(1).permutation(len(rows)))
    if written == "without cells":
        rows = rows.drop_columns([CELL])
    file.unlink()
    if written == "in two files":
        stated = tmp_path / "a/hats.properties"
        stated.write_text(stated.read_text() + "\nhats_npix_suffix=/\n")
        folder = file.with_suffix("")
        folder.mkdir()
        parquet.write_table(rows.slice(0, 200), folder / "2.parquet", row_group_size=50)
        parquet.write_table(rows.slice(200), folder / "1.parquet", row_group_size=50)
    else:
        parquet.write_table(rows, file, row_group_size=50)
    catalogue = HatsCatalogue.open(tmp_path / "a")
    every = catalogue.rows(EVERYTHING, ["id", "ra"])
    assert every.num_rows == len(table) and catalogue.rows(EVERYTHING, []).num_rows == len(table)
    places = np.asarray(every[CELL])
    assert np.all(places[1:] >= places[:-1])
    for chunk, begin in zip(
        catalogue.chunks(3, 120, ["id", "ra"]), (len(table) * k // 6 - 60 for k in (1, 3, 5)), strict=True
    ):
        assert chunk.equals(every.slice(begin, 120))
    pieces = [piece for cell in catalogue.cells for piece in catalogue.pieces(cell, ["id"], 33)]
    assert sorted(i for piece in pieces for i in piece["id"].to_pylist()) == sorted(every["id"].to_pylist())
    assert max(piece.num_rows for piece in pieces) <= 33
    some = np.array([[places[20], places[90]], [places[300], places[301] + 1]])
    inside = every.filter(healpix.within(some, places))
    assert catalogue.rows(some, ["id", "ra"]).equals(inside)
