"""Internal match: rows of one table gathered to objects."""

import functools
import itertools
import math

import numpy as np
import pytest
from astropy.table import Table
from scipy.special import gammaln, logsumexp
from typer.testing import CliRunner

import naive
import sameas
from sameas.cli.app import app
from sameas.errors import InputError
from sameas.kernels.internal import RowModel, partition

CIRCLE = 3600.0


def detections(seed, n, spacing, *, exposures=6, shown=0.8, factor=1.0, sigma=0.2):
    """Rows of n objects with this mean spacing, in σ, on some exposures, and the object of each row."""
    rng = np.random.default_rng(seed)
    side = math.sqrt(n) * spacing * sigma / CIRCLE
    place = rng.uniform(0.0, side, (n, 2))
    which, exposure = np.nonzero(rng.random((n, exposures)) < shown)
    order = rng.permutation(len(which))
    which, exposure = which[order], exposure[order]
    at = place[which] + factor * sigma / CIRCLE * rng.standard_normal((len(which), 2))
    dec = 20.0 + at[:, 1]
    columns = {"ra": 10.0 + at[:, 0] / np.cos(np.radians(dec)), "dec": dec, "err_arcsec": np.full(len(which), sigma)}
    return Table(columns | {"visit": exposure, "mag": 15.0 + which % 5}), which


def couples(labels):
    """The couples of rows of one object."""
    order = np.argsort(labels, kind="stable")
    bounds = np.flatnonzero(np.diff(labels[order], prepend=-1, append=-1))
    some = [order[a:b] for a, b in itertools.pairwise(bounds)]
    return {(i, j) for rows in some for i in rows for j in rows if i < j}


def solved(xy, variance, log_density, log_count, exposure=None):
    """The partition of one component by the kernel: labels, p_row, p_object."""
    n = len(xy)
    precision = np.column_stack([1.0 / variance, np.zeros(n), 1.0 / variance])
    number = np.full(n, -1) if exposure is None else np.asarray(exposure)
    label, p_row, p_object, place = np.zeros(n, np.int64), np.zeros(n), np.zeros(n), np.zeros((n, 5))
    alternative = np.zeros((n, 4))
    model = RowModel(log_count, np.ones(1), np.ones(1), math.log(1e-3))
    start, log_densities = np.array([0, n]), np.array([log_density])
    partition(0, 1, start, xy, precision, number, log_densities, model, label, p_row, p_object, place, alternative)
    return label, p_row, p_object


@pytest.mark.parametrize("seed", range(12))
def test_the_partition_is_the_most_probable_of_all(seed):
    """Of up to seven rows around two places, against all partitions."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 8))
    xy = rng.normal(0.0, 1.0, (n, 2)) + np.where(rng.random(n) < 0.5, 0.0, 4.0)[:, None] * np.array([1.0, 0.0])
    variance, log_density = rng.uniform(0.5, 1.5, n), math.log(0.002)
    log_count = np.append(0.0, -np.log(np.arange(1.0, n + 1)) + gammaln(np.arange(2.0, n + 2)))
    label, _, _ = solved(xy, variance, log_density, log_count)
    found = sum(
        naive.log_object(xy[label == k], variance[label == k], log_density, log_count) for k in range(label.max() + 1)
    )
    best = max(
        sum(naive.log_object(xy[rows], variance[rows], log_density, log_count) for rows in some)
        for some in naive.partitions_of(list(range(n)))
    )
    assert found == pytest.approx(best, abs=1e-9)


def test_an_object_is_as_probable_as_against_all_its_divisions():
    """Eight rows of two objects beside each other: 127 divisions, of which none weighs much."""
    log_density, n = math.log(0.02), 8
    log_count = np.append(0.0, np.log([1e-3, 1e-3, 1e-2, 0.8, 1e-2, 1e-3, 1e-3, 0.2]) + gammaln(np.arange(2.0, n + 2)))
    every = list(naive.partitions_of(list(range(n))))
    stated, exact = [], []
    for seed in range(10):
        xy = np.random.default_rng(seed).normal(0.0, 1.0, (n, 2))
        xy[4:, 0] += 1.5
        weigh = functools.cache(
            lambda rows, xy=xy: naive.log_object(xy[list(rows)], np.ones(len(rows)), log_density, log_count)
        )
        log_weights = np.array([sum(weigh(tuple(sorted(rows))) for rows in some) for some in every])
        label, _, p_object = solved(xy, np.ones(n), log_density, log_count)
        if label.max() == 0:
            one = log_weights[[len(some) == 1 for some in every]][0]
            exact.append(math.exp(one - logsumexp(log_weights)))
            stated.append(p_object[0])
    assert len(exact) >= 5
    assert np.mean(stated) == pytest.approx(np.mean(exact), abs=0.1)


@pytest.mark.parametrize("distance", [0.5, 3.0, 4.2, 6.0])
def test_probabilities_of_two_rows_are_exact(distance):
    xy, variance = np.array([[0.0, 0.0], [distance, 0.0]]), np.array([1.0, 2.0])
    log_density, log_count = math.log(0.01), np.array([0.0, math.log(0.3), math.log(0.7) + math.log(2.0)])
    apart = sum(naive.log_object(xy[[k]], variance[[k]], log_density, log_count) for k in (0, 1))
    together = naive.log_object(xy, variance, log_density, log_count)
    label, p_row, p_object = solved(xy, variance, log_density, log_count)
    p_together = 1.0 / (1.0 + math.exp(apart - together))
    assert (label[1] == label[0]) == (p_together > 0.5)
    assert p_row == pytest.approx(max(p_together, 1.0 - p_together), rel=1e-9)
    assert np.all(p_object <= p_row + 1e-12)


def test_an_exposure_shows_an_object_once():
    """Two rows of one exposure at one place are two objects, and each takes one of the other exposure."""
    xy, variance = np.array([[0.0, 0.0], [0.6, 0.0], [0.1, 0.1], [0.7, 0.1]]), np.full(4, 0.04)
    log_count = np.array([0.0, -1.0, -1.0, -3.0, -3.0])
    label, p_row, _ = solved(xy, variance, math.log(0.01), log_count, exposure=[0, 0, 1, 1])
    assert label.tolist() == [0, 1, 0, 1]
    free, _, _ = solved(np.array([[0.0, 0.0], [0.2, 0.0], [0.1, 0.1]]), np.full(3, 0.04), math.log(0.01), log_count)
    assert free.max() == 0 and np.all(p_row > 0.5)


@pytest.mark.parametrize("exposure", [None, "visit"])
def test_detections_of_well_separated_objects(exposure):
    table, which = detections(1, 300, 60.0)
    found = sameas.match_internal(table, exposure=exposure)
    true, given = couples(which), couples(found.sky.object[np.argsort(found.sky.records.rows)])
    assert len(true & given) > 0.995 * len(true) and len(given - true) < 0.01 * len(given)
    assert len(found) == pytest.approx(len(np.unique(which)), abs=2)
    # Places are the means of the rows, within their errors.
    objects = found.objects
    several = objects["object_rows"] > 1
    assert np.all(objects["ra_error_arcsec"][several] < 0.2)
    freedom = 2.0 * (objects["object_rows"] - 1).sum()
    assert float(objects["chi_sq"].sum()) == pytest.approx(freedom, rel=0.1)


def test_stated_probabilities_are_frequencies_in_a_crowd():
    right, stated = [], []
    for seed in range(4):
        table, which = detections(seed, 400, 14.0)
        sky = sameas.match_internal(table, exposure="visit").sky
        of_row = np.empty(len(table), np.int64)
        of_row[sky.records.rows] = sky.object
        both = np.unique(np.column_stack([of_row, which]), axis=0, return_inverse=True, return_counts=True)
        same = both[2][both[1].ravel()]
        exact = (same == np.bincount(of_row)[of_row]) & (same == np.bincount(which)[which])
        first = np.unique(of_row, return_index=True)[1]
        right.append(exact[first])
        stated.append(sky.p_object)
    right, stated = np.concatenate(right), np.concatenate(stated)
    assert np.mean(right) == pytest.approx(np.mean(stated), abs=0.04)
    sure = stated > 0.99
    assert np.count_nonzero(sure) > 500 and np.mean(right[sure]) > 0.98


def test_times_that_rows_share_are_exposures():
    table, _ = detections(2, 300, 25.0)
    by_visit = sameas.match_internal(table, exposure="visit").sky
    table["mjd"] = 60000.0 + table["visit"]
    table.remove_column("visit")
    by_time = sameas.match_internal(table)
    assert by_time.sky.exposures == 6 and np.array_equal(by_time.sky.object, by_visit.object)
    assert "6; each shows an object once" in by_time.report()
    # Of a list that has objects twice at one time, it is the time of the list.
    table["mjd"] = np.where(np.arange(len(table)) % 2, 60000.0, 60001.0)
    assert sameas.match_internal(table).sky.exposures == 0
    table["mjd"] = 60000.0 + np.arange(len(table))
    assert sameas.match_internal(table).sky.exposures == 0


@pytest.mark.parametrize("factor", [0.5, 1.0, 3.0])
def test_errors_are_estimated_from_the_rows(factor):
    table, which = detections(3, 200, 80.0, factor=factor)
    for options in ({}, {"sigma": None}):
        if options:
            table.remove_column("err_arcsec")
        found = sameas.match_internal(table)
        sigma = float(np.sqrt(np.median(found.sky.records.variances)))
        assert sigma == pytest.approx(factor * 0.2, rel=0.1)
        assert len(found) == pytest.approx(len(np.unique(which)), abs=4)


def test_the_order_of_the_rows_does_not_matter():
    table, _ = detections(5, 150, 20.0)
    order = np.random.default_rng(6).permutation(len(table))
    one, two = sameas.match_internal(table), sameas.match_internal(table[order])
    of_one = np.empty(len(table), np.int64)
    of_one[one.sky.records.rows] = one.sky.object
    of_two = np.empty(len(table), np.int64)
    of_two[order[two.sky.records.rows]] = two.sky.object
    assert couples(of_one) == couples(of_two)


def test_objects_are_numbered_and_ranked_by_row():
    table, _ = detections(7, 60, 60.0)
    table["err_arcsec"][3] = np.nan
    rows = sameas.match_internal(table).table
    assert rows["object_id"][3] is np.ma.masked and rows["object_id"][0] == 1
    used = rows[~np.ma.getmaskarray(rows["object_id"])]
    first = np.unique(used["object_id"], return_index=True)[1]
    assert np.all(np.diff(first) > 0)
    assert np.count_nonzero(used["object_rank"] == 1) == used["object_id"].max()
    assert np.all(np.bincount(used["object_id"])[used["object_id"]] == used["object_rows"])


def test_a_table_without_repeated_objects():
    rng = np.random.default_rng(8)
    table = {"ra": 10.0 + rng.uniform(0, 0.2, 400), "dec": 20.0 + rng.uniform(0, 0.2, 400)}
    found = sameas.match_internal(table, sigma=0.1)
    assert len(found) == 400 and any("do not exceed what chance gives" in doubt for doubt in found.doubts)
    one = sameas.match_internal({"ra": [10.0], "dec": [20.0]}, sigma=0.1)
    assert len(one) == 1 and one.table["p_object"][0] == 1.0


def test_double_stars_are_two_objects():
    """Gaia quotes errors below a milliarcsecond; companions arcseconds away are no rows of one star."""
    rng = np.random.default_rng(16)
    place = rng.uniform(0.0, 0.5, (2000, 2))
    place = np.concatenate([place, place[:60] + rng.normal(0.0, 1.0 / CIRCLE, (60, 2))])
    found = sameas.match_internal({"ra": 10.0 + place[:, 0], "dec": 20.0 + place[:, 1]}, sigma=0.0005)
    assert len(found) == 2060 and found.sky.errors.factor_1 == 1.0
    assert any("taken for two objects each" in doubt for doubt in found.doubts)
    # Many rows that scatter a hundred times more than quoted are those of repeated objects.
    table, which = detections(17, 200, 60.0)
    table["err_arcsec"] = 0.002
    assert len(sameas.match_internal(table, exposure="visit")) == pytest.approx(len(np.unique(which)), abs=3)


def test_copies_of_rows_are_one_object_each():
    """They tell nothing of the errors."""
    rng = np.random.default_rng(13)
    ra, dec = 10.0 + rng.uniform(0, 0.2, 300), 20.0 + rng.uniform(0, 0.2, 300)
    twice = rng.integers(0, 300, 40)
    found = sameas.match_internal({"ra": np.append(ra, ra[twice]), "dec": np.append(dec, dec[twice])}, sigma=0.1)
    assert len(found) == 300 and found.sky.errors.factor_1 == 1.0
    assert np.all(found.table["object_id"][300:] == twice + 1)


def test_objects_of_thousands_of_rows():
    table, which = detections(15, 8, 60.0, exposures=4000)
    found = sameas.match_internal(table)
    assert len(found) == 8 and found.sky.errors.factor_1 == pytest.approx(1.0, abs=0.05)
    assert couples(found.sky.object[np.argsort(found.sky.records.rows)][::50]) == couples(which[::50])


def test_errors_quoted_far_too_large():
    table, which = detections(14, 200, 60.0)
    table["err_arcsec"] = 5.0
    found = sameas.match_internal(table, exposure="visit")
    assert float(np.sqrt(np.median(found.sky.records.variances))) == pytest.approx(0.2, rel=0.15)
    assert len(found) == pytest.approx(len(np.unique(which)), abs=3)


def test_places_across_zero_and_at_a_pole():
    rng = np.random.default_rng(9)
    for lon, lat in ((0.0, 0.0), (120.0, 89.9999)):
        offset = rng.uniform(-40.0, 40.0, (50, 2)).repeat(4, axis=0) + rng.normal(0.0, 0.1, (200, 2))
        ra, dec = sameas.space.displaced(np.full((200, 2), [lon, lat]), offset).T
        found = sameas.match_internal({"ra": ra, "dec": dec}, sigma=0.1)
        assert len(found) == pytest.approx(50, abs=2)
        assert float(found.table["object_sep_arcsec"].max()) < 0.6


def test_the_objects_are_a_catalogue_for_a_match(tmp_path):
    """Rows of many exposures against a catalogue: every row gets its star by way of its object."""
    table, which = detections(10, 200, 60.0)
    place = np.array([[table["ra"][which == k].mean(), table["dec"][which == k].mean()] for k in np.unique(which)])
    catalogue = Table({"star": np.unique(which), "ra": place[:, 0], "dec": place[:, 1]})
    catalogue["sigma_arcsec"] = 0.02
    table.write(tmp_path / "rows.csv")
    catalogue.write(tmp_path / "stars.csv")
    run = CliRunner().invoke(app, ["internal", str(tmp_path / "rows.csv"), "--objects", "-o", str(tmp_path / "o.csv")])
    assert run.exit_code == 0 and "Catalogue: rows, " in run.output and "objects" in run.output
    matched = sameas.match(tmp_path / "o.csv", tmp_path / "stars.csv")
    assert matched.sky.first.magnitude_name == "mag"
    assert len(matched) > 0.98 * len(catalogue) and matched.expected_wrong < 2.0


def test_the_command_writes_rows_with_provenance(tmp_path):
    table, _ = detections(11, 60, 60.0)
    table.write(tmp_path / "rows.ecsv")
    out = tmp_path / "out.ecsv"
    run = CliRunner().invoke(app, ["internal", str(tmp_path / "rows.ecsv"), "--exposure", "visit", "-o", str(out)])
    assert run.exit_code == 0 and "expected wrong" in run.output
    written = Table.read(out)
    assert written["object_sep_arcsec"].unit == "arcsec" and len(written) == len(table)
    provenance = str(written.meta)
    assert "options_match" in provenance and "visit" in provenance and "sha256_1" in provenance


def test_refusals(tmp_path):
    table, _ = detections(12, 30, 60.0)
    with pytest.raises(InputError, match="there is no column 'night'; its columns are ra, dec"):
        sameas.match_internal(table, exposure="night")
    with pytest.raises(InputError, match="error scale is 'big'"):
        sameas.match_internal(table, error_scale="big")
    with pytest.raises(InputError, match="has no option 'radius'"):
        sameas.match_internal(table, radius=1.0)
    with pytest.raises(InputError, match="none of its 2 rows can be used"):
        sameas.match_internal({"ra": [np.nan, np.nan], "dec": [0.0, 1.0]}, sigma=0.1)
    table.write(tmp_path / "rows.csv")
    same = CliRunner().invoke(app, ["internal", str(tmp_path / "rows.csv"), "-o", str(tmp_path / "rows.csv")])
    assert same.exit_code == 1 and "is also an input" in same.output


def test_the_column_of_the_exposures_is_found_whatever_its_case():
    table, _ = detections(4, 30, 200.0)
    found = [sameas.match_internal(table, exposure=name).table["object_id"] for name in ("visit", " VISIT ")]
    assert (found[0] == found[1]).all()


def test_rows_and_objects_are_explained_from_the_tables(tmp_path):
    table, _ = detections(4, 30, 200.0)
    table["name"] = [f"r{k}" for k in range(len(table))]
    found = sameas.match_internal(table, exposure="visit", id="name", name="night")
    found.write(tmp_path / "rows.fits")
    found.write(tmp_path / "objects.csv", objects=True)
    row = int(np.flatnonzero(found.table["object_rows"] > 2)[0])
    number, n_rows = found.table["object_id"][row], found.table["object_rows"][row]
    text = str(sameas.explain(tmp_path / "rows.fits", f"r{row}"))
    assert text.startswith(f"night r{row} is of object {number} of {n_rows} rows, probability that exactly these rows")
    of_object = found.table["name"][found.table["object_id"] == number]
    assert text.count("arcsec from the mean place") == n_rows and all(name in text for name in of_object)
    assert text == str(sameas.explain(tmp_path / "rows.fits", row=row))
    assert f"object {number} of {n_rows} rows" in str(sameas.explain(tmp_path / "objects.csv", number))
    with pytest.raises(InputError, match="has no object 99 in the output"):
        sameas.explain(tmp_path / "objects.csv", 99)
