"""Columns of one source as evidence: learned jointly from the pairs without overfitting; given priors."""

import numpy as np
import pytest
from astropy.table import Table
from typer.testing import CliRunner

import sameas
from sameas import InputError, Records
from sameas.cli.app import app
from sameas.estimate.columns import ColumnEvidence
from sameas.estimate.coverage import Coverage
from sameas.estimate.match import match
from sameas.estimate.sample import Setting
from sameas.evidence import Column, Errors, OddsTable, Related
from sameas.gate import Radius
from sameas.score.pairs import is_true_pair
from sameas.simulate import counterparts
from sameas.sky import Catalogue, CatalogueOptions
from sameas.sky.evidence_columns import columns_of

MADE = counterparts(np.random.default_rng(3), sources=500, records=30_000)
MAG = Column(2, MADE.magnitude, name="MAG")


def counts(answer, made=MADE):
    """(true matches, false matches, expected false matches, its standard deviation)."""
    right = is_true_pair((answer.matches.rows_1, answer.matches.rows_2), made.scene.true_pairs())
    p = answer.matches.p_match
    return int(right.sum()), int((~right).sum()), answer.expected_wrong, float(np.sqrt(max((p * (1 - p)).sum(), 1.0)))


@pytest.fixture(scope="module")
def found():
    return match(MADE.scene.first, MADE.scene.second, evidence=[MAG])


@pytest.fixture(scope="module")
def by_position():
    return match(MADE.scene.first, MADE.scene.second)


@pytest.mark.slow
def test_a_magnitude_of_one_source_gives_more_true_and_fewer_false_matches(found, by_position):
    (more, fewer, expected, spread), (less, many, _, _) = counts(found[0]), counts(by_position[0])
    assert more > less and fewer < 0.7 * many
    assert abs(fewer - expected) < 2.0 * spread


@pytest.mark.slow
def test_the_learned_curve_is_the_ratio_of_the_true_densities(found):
    """q(m)/n(m) of Sutherland & Saunders, known from the simulation."""
    from scipy.stats import norm

    steep, width = 0.3 * np.log(10.0), np.hypot(1.3, 1.8 * 0.6)
    m = MADE.magnitude
    true = norm.logpdf(m, 21.5, width) - np.log(steep) - steep * (m - 26.0)
    inner = (m > 19.0) & (m < 24.5)
    learned = found[1].columns.log_ratio[1]
    assert np.abs(learned - true)[inner].max() < 0.8
    assert np.sqrt(np.mean((learned - true)[inner] ** 2)) < 0.3


@pytest.mark.slow
@pytest.mark.long
def test_numbers_of_partners_and_of_false_matches_are_as_expected():
    """No pair supports itself: local densities and column evidence exclude its own records."""
    too_many, wrong, expected, variance = [], 0, 0.0, 0.0
    for number in range(40):
        made = counterparts(np.random.default_rng([17, number]), sources=300, records=6_000, chance=0.6)
        evidence = [Column(2, made.magnitude, name="MAG")]
        answer, estimate = match(made.scene.first, made.scene.second, errors=Errors(), evidence=evidence)
        too_many.append(estimate.common - len(made.scene.true_pairs()[0]))
        _, mine, expected_wrong, spread = counts(answer, made)
        wrong, expected, variance = wrong + mine, expected + expected_wrong, variance + spread**2
    assert abs(np.mean(too_many)) < 3.0 * np.std(too_many) / np.sqrt(len(too_many))
    assert abs(wrong - expected) < 2.0 * np.sqrt(variance)


@pytest.mark.slow
def test_the_fit_of_a_column_converges_where_every_source_has_several_candidates():
    """Candidates of one source are rivals; fitted each by itself, they went to and fro between two answers."""
    made = counterparts(np.random.default_rng([19, 0]), sources=800, records=30_000, chance=3.0)
    answer, estimate = match(made.scene.first, made.scene.second, evidence=[Column(2, made.magnitude, name="MAG")])
    right, wrong, expected, spread = counts(answer, made)
    assert estimate.converged and estimate.iterations < 20
    assert right > 610 and abs(wrong - expected) < 2.0 * spread


def test_the_curve_breaks_at_the_limit_of_the_catalogue():
    """Beyond 26 mag the catalogue has counterparts only, and hardly any in the fifth of its records before."""
    made = counterparts(np.random.default_rng([16, 1]))
    _, estimate = match(made.scene.first, made.scene.second, evidence=[Column(2, made.magnitude, name="MAG")])
    learned, m = estimate.columns.log_ratio[1], made.magnitude
    assert learned[m > 26.3].min() > learned[(m > 25.7) & (m < 25.95)].max() + 3.0


def test_the_fit_of_a_category_column_is_the_ratio_of_counts():
    """ln of the share of partners over that of the others, of which a sample is fitted to."""
    first, second = MADE.scene.first, MADE.scene.second
    evidence = ColumnEvidence.of(first, second, [Column(2, MADE.kind)])
    setting = Setting.whole(Radius(3.0)(first, second), Coverage.of(first, second))
    p = np.zeros(len(second))
    p[MADE.scene.true_pairs()[1]] = 1.0
    seen = np.ones(len(first), bool), np.ones(len(second), bool)
    mean = np.log(p.mean() / (1 - p.mean()))
    offset = np.zeros(len(first)), np.full(len(second), mean)
    partner = np.zeros(len(first)), p
    evidence = evidence.in_folds(setting).fitted(setting.pairs, np.zeros(len(setting.pairs)), partner, offset, seen)
    fold = evidence.folds[1]
    for k in range(4):
        for kind in ("point", "extended"):
            taught = fold != k
            here = MADE.kind == kind
            partners, others = p[taught & here].sum() / p[taught].sum(), (1 - p[taught & here]).sum()
            # From the training records of this fold, with the offset of all records.
            logit = np.log(p[taught & here].sum() / others) - mean
            got = evidence.log_ratio[1][(fold == k) & here]
            assert partners > 0 and np.allclose(got, logit, atol=0.05)


@pytest.mark.slow
def test_an_uninformative_column_is_reported_and_changes_nothing(by_position):
    answer, estimate = match(MADE.scene.first, MADE.scene.second, evidence=[Column(2, MADE.noise, name="noise")])
    (finding,) = estimate.columns.findings
    assert not finding.used and finding.name == "noise"
    assert estimate.changed_by_columns == 0
    assert abs(counts(answer)[1] - counts(by_position[0])[1]) <= 2


@pytest.mark.slow
def test_redundant_columns_are_not_counted_twice(found):
    again = Column(2, 3.0 * MADE.magnitude + 1.0, name="flux")
    _, estimate = match(MADE.scene.first, MADE.scene.second, evidence=[MAG, again])
    both, once = estimate.columns.log_ratio[1], found[1].columns.log_ratio[1]
    likely = MADE.scene.true_pairs()[1]
    assert np.median(np.abs(both - once)[likely]) < 0.15
    assert [one.used for one in estimate.columns.findings].count(True) == 1


@pytest.mark.slow
def test_every_informative_column_improves_the_result(found):
    more = [Column(2, MADE.colour, name="colour"), Column(2, MADE.kind, name="kind")]
    answer, estimate = match(MADE.scene.first, MADE.scene.second, evidence=[MAG, *more])
    assert all(one.used for one in estimate.columns.findings)
    (more, fewer, expected, spread), (less, many, _, _) = counts(answer), counts(found[0])
    assert more >= less and fewer < many
    assert abs(fewer - expected) < 2.0 * spread


@pytest.mark.slow
def test_related_columns_are_evidence_of_pairs(found):
    related = Related(MADE.flux, MADE.magnitude, ("flux", "MAG"))
    answer, estimate = match(MADE.scene.first, MADE.scene.second, evidence=[related])
    used = {(one.name, one.other): one.used for one in estimate.columns.findings}
    assert used == {("flux", ""): False, ("MAG", ""): True, ("flux", "MAG"): True}
    assert counts(answer)[0] >= counts(found[0])[0]
    unrelated = Related(np.random.default_rng(1).permutation(MADE.flux), MADE.magnitude, ("flux", "MAG"))
    _, estimate = match(MADE.scene.first, MADE.scene.second, evidence=[unrelated])
    assert [one.used for one in estimate.columns.findings if one.other] == [False]


@pytest.mark.slow
def test_swapping_the_sources_transposes_the_result(found):
    answer, _ = match(MADE.scene.second, MADE.scene.first, evidence=[Column(1, MADE.magnitude, name="MAG")])
    one = dict(zip(found[0].matches.rows_1.tolist(), found[0].matches.rows_2.tolist(), strict=True))
    other = dict(zip(answer.matches.rows_2.tolist(), answer.matches.rows_1.tolist(), strict=True))
    assert sum(one.get(key) != value for key, value in other.items()) <= 2


@pytest.mark.slow
def test_missing_values_are_a_category():
    gone = np.random.default_rng(2).uniform(size=len(MADE.magnitude)) < 0.2
    column = Column(2, np.where(gone, np.nan, MADE.magnitude), name="MAG")
    answer, estimate = match(MADE.scene.first, MADE.scene.second, evidence=[column])
    assert np.abs(estimate.columns.log_ratio[1][gone]).max() < 0.7
    _, wrong, expected, spread = counts(answer)
    assert abs(wrong - expected) < 2.0 * spread


def test_a_column_of_words_that_are_all_missing_is_uninformative():
    """An index error: no word had a basis function."""
    rng = np.random.default_rng(5)
    objects = rng.uniform(0.0, 100.0, (100, 2))
    one, two = (Records.of(objects + 0.1 * rng.standard_normal(objects.shape), sigma=0.1) for _ in range(2))
    empty = np.full(100, "")
    for evidence in (Column(2, empty, name="type"), Related(empty, np.arange(100.0), ("type", "MAG"))):
        _, estimate = match(one, two, evidence=[evidence])
        assert not any(finding.used for finding in estimate.columns.findings if finding.name == "type")


def test_tables_of_related_columns_are_those_of_the_same_columns_among_other_records():
    """Where a relation had too few pairs for a table, the next one's table was read with its columns."""
    first, second = MADE.scene.first, MADE.scene.second
    few = np.full(len(first), np.nan)
    few[:3] = 1.0
    sparse, related = Related(few, MADE.noise, ("few", "noise")), Related(MADE.flux, MADE.magnitude, ("flux", "MAG"))
    columns = ColumnEvidence.of(first, second, [sparse, related])
    setting = Setting.whole(Radius(3.0)(first, second), Coverage.of(first, second))
    true = is_true_pair((setting.pairs.i, setting.pairs.j), MADE.scene.true_pairs()).astype(float)
    none = np.zeros(len(first)), np.zeros(len(second))
    covered = np.ones(len(first), bool), np.ones(len(second), bool)
    fitted = columns.in_folds(setting).fitted(setting.pairs, true, none, none, covered)
    others = fitted.for_setting(setting, columns)
    assert np.array_equal(others.rule()(setting.pairs).log_ratio, fitted.rule()(setting.pairs).log_ratio)
    assert fitted.rule()(setting.pairs).log_ratio[true > 0.0].mean() > 0.1


def test_given_odds_are_used():
    odds = OddsTable([(0.0, 22.0, 4.0), (22.0, 30.0, 0.5)])
    answer, _ = match(MADE.scene.first, MADE.scene.second, evidence=[Column(2, MADE.magnitude, odds)])
    expected = np.where(MADE.magnitude < 22.0, np.log(4.0), np.log(0.5))[answer.pairs.j]
    expected = np.where((MADE.magnitude < 0.0)[answer.pairs.j], 0.0, expected)
    np.testing.assert_allclose(answer.evidence.terms["prior odds"], expected)


def test_too_few_pairs_are_not_learned_from():
    made = counterparts(np.random.default_rng(8), sources=20, records=1_000)
    _, estimate = match(made.scene.first, made.scene.second, evidence=[Column(2, made.magnitude, name="MAG")])
    assert estimate.columns.log_ratio is None and estimate.columns.findings == ()


@pytest.mark.parametrize(
    ("odds", "words"),
    [
        ([(1.0, 2.0, -1.0)], "odds of -1.0"),
        ([(2.0, 1.0, 3.0)], "from 2.0 to 1.0"),
        ([(1.0,)], "has 1 cells"),
        ([(14.0, 17.0, 3.0), (5.0, 14.5, 8.0)], "from 5 to 14.5 and from 14 overlap"),
    ],
)
def test_invalid_tables_of_odds_are_refused(odds, words):
    with pytest.raises(InputError, match=words):
        OddsTable(odds)


def test_invalid_columns_are_refused_by_their_names():
    with pytest.raises(InputError, match="give 1 or 2"):
        Column(3, "MAG")
    with pytest.raises(InputError, match="one value for every row"):
        match(MADE.scene.first, MADE.scene.second, evidence=[Column(2, [1.0, 2.0], name="MAG")])
    with pytest.raises(InputError, match="evidence holds 'MAG'"):
        sameas.match(*tables(), evidence=["MAG"])
    with pytest.raises(InputError, match="no column 'mags' to be evidence"):
        sameas.match(*tables(), evidence=Column(2, "mags"))


def tables():
    """Both as tables, as people have them."""
    one, two = MADE.scene.first, MADE.scene.second
    return (
        Table({"ra": one.features[:, 0], "dec": one.features[:, 1], "pos_err": np.sqrt(one.covariance[:, 0])}),
        Table({
            "ra": two.features[:, 0], "dec": two.features[:, 1], "pos_err": np.sqrt(two.covariance[:, 0]),
            "MAG_I": MADE.magnitude, "kind": MADE.kind,
        }),
    )  # fmt: skip


@pytest.mark.slow
def test_the_command_accepts_columns_and_priors_and_explains_them(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name, table in zip(("x.fits", "o.fits"), tables(), strict=True):
        table.write(name)
    (tmp_path / "prior.csv").write_text("low,high,odds\n10,22,4\n22,30,0.5\n")
    # As NWAY has it: low, high, selected, others.
    (tmp_path / "prior.txt").write_text("10 22 0.4 0.1\n22 30 0.05 0.1\n")
    run = CliRunner().invoke

    def report_with(*options):
        result = run(app, ["match", "x.fits", "o.fits", "-o", "out.fits", *options])
        assert result.exit_code == 0, result.output
        return " ".join(result.output.split())

    learned = report_with("--column2", "mag_i", "--column2", "kind")
    assert "MAG_I of o: ln odds of a partner" in learned and "kind of o" in learned
    assert "MAG_I of o: ln odds of a partner" in report_with("--magnitude2", "MAG_I")
    outputs = [
        (report_with("--column2", f"MAG_I={name}"), Table.read("out.fits"))[1] for name in ("prior.csv", "prior.txt")
    ]
    one, other = (np.ma.filled(table["p_match"], -1.0) for table in outputs)
    np.testing.assert_allclose(one, other)
    explained = run(app, ["explain", "out.fits", "3", "--row", "--again"])
    assert explained.exit_code == 0 and "prior odds" in explained.output


@pytest.mark.slow
def test_the_magnitude_of_one_catalogue_is_evidence_without_being_asked_for():
    by_default, by_position = (sameas.match(*tables(), magnitudes=choice) for choice in ("auto", "off"))
    asked = sameas.match(*tables(), magnitudes="off", evidence=Column(2, "MAG_I"))
    assert counts(by_default.identification) == counts(asked.identification)
    assert by_default.expected_wrong < 0.8 * by_position.expected_wrong
    assert "MAG_I of" in by_default.report() and "MAG_I of" not in by_position.report()
    assert "further magnitudes" not in by_default.report()


def test_further_magnitudes_of_the_catalogue_are_named():
    first, second = tables()
    second["i_mag"], second["e_i_mag"] = second["MAG_I"] + 0.1, np.full(len(second), 0.1)
    second["i_mag"].unit = second["e_i_mag"].unit = "mag"
    assert "i_mag of" in (report := sameas.match(first, second).report()) and "further magnitudes may be" in report
    assert "e_i_mag" not in report.split("iterations")[0].split("Estimated")[1]


def test_large_numbers_of_a_column_are_no_placeholders():
    two = tables()[1]
    flux, magnitude = 10.0 ** (-0.4 * (two["MAG_I"] - 30.0)), two["MAG_I"].copy()
    magnitude[5] = 99.0
    two["flux"], two["other"] = flux, magnitude
    source = Catalogue.of(two, "o", options=CatalogueOptions(sigma=0.1))
    found = columns_of(source, source, [Column(2, "flux"), Column(2, "other")])
    read = [one.values for one in found if isinstance(one, Column)]
    assert flux.max() > 90.0 and not np.ma.getmaskarray(read[0]).any()
    assert np.flatnonzero(np.ma.getmaskarray(read[1])).tolist() == [5]


@pytest.mark.slow
def test_magnitudes_that_tell_nothing_are_not_used():
    one, two = tables()
    two["MAG_I"] = np.random.default_rng(2).permutation(two["MAG_I"])
    by_default, by_position = (sameas.match(one, two, magnitudes=choice) for choice in ("auto", "off"))
    assert counts(by_default.identification) == counts(by_position.identification)
    words = " ".join(by_default.report().split())
    assert "is not informative, and is not used" in words
    assert "they change" not in words and "columns 0.0" not in words


@pytest.mark.slow
def test_python_accepts_the_same(found):
    one = sameas.match(*tables(), evidence=Column(2, "MAG_I"))
    assert counts(one.identification)[:2] == counts(found[0])[:2]
    assert "MAG_I" in str(one.report())
