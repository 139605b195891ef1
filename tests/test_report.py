"""Text reports of a match."""

import re

import numpy as np
import pytest
from astropy.table import Table

from sameas.errors import InputError
from sameas.report import prose
from sameas.report.match import _bins, catalogue_lines, estimate_lines, nearest_lines, summary_lines
from sameas.representation import count
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import MatchOptions, match


def catalogue(name, ra, dec, *, sigma=0.1, seed=0, **columns):
    noise = np.random.default_rng(seed).normal(0, sigma / 3600, (2, len(ra)))
    table = Table({"ra": ra + noise[0], "dec": dec + noise[1], **columns})
    return Catalogue.of(table, name, options=CatalogueOptions(sigma=sigma))


@pytest.fixture(scope="module")
def found():
    rng = np.random.default_rng(5)
    ra, dec = rng.uniform(20, 20.5, 400), rng.uniform(-0.25, 0.25, 400)
    mag = np.sort(rng.uniform(9.5, 20.5, 400))
    first = catalogue("left", ra, dec, seed=1, mag=mag)
    return match(first, catalogue("right", ra[:300], dec[:300], seed=2))


def report(match):
    parts = catalogue_lines(match.first, 1), catalogue_lines(match.second, 2), estimate_lines(match)
    return "\n".join([*(line for lines in parts for line in (*lines, "")), *summary_lines(match)])


def lines_of(text, label):
    return [line for line in text.splitlines() if line.strip().startswith(label)]


def test_the_report_holds_the_numbers_of_the_match(found):
    text = report(found)
    assert lines_of(text, "identified ")[0].split() == ["identified", "300", "300"]
    assert lines_of(text, "without a partner")[0].split()[-2:] == ["100", "0"]
    assert f"{found.result.expected_wrong:.1f} of the identified" in text
    rms = np.sqrt(np.mean(found.result.matches.residual**2, axis=0))
    assert lines_of(text, "at the common epoch")[0].split()[5:9:2] == [f"{rms[0]:.4f}", f"{rms[1]:.4f}"]


def test_counts_of_rows_add_up(found):
    for side in (0, 1):

        def number(label, side=side):
            return int(lines_of("\n".join(summary_lines(found)), label)[0].split()[-2 + side])

        assert number("used") == number("not covered") + number("without") + number("identified ")


def test_lines_stay_within_the_width_except_doubts(found):
    for line in report(found).splitlines():
        assert len(line) <= prose.WIDTH or line.startswith(prose.DOUBT)


def test_shares_by_magnitude_count_every_measured_row(found):
    text = "\n".join(summary_lines(found))
    rows = lines_of(text, "rows")[-1].split()[1:]
    assert sum(map(int, rows)) == 400
    shares = lines_of(text, "identified, %")[0].split()[2:]
    assert shares[0] == "100.0" and shares[-1] == "0.0"


def test_nearest_neighbours_claims_are_counted():
    first = catalogue("left", np.array([10.0, 10.0005, 10.1]), np.zeros(3), sigma=1e-3)
    second = catalogue("right", np.array([10.0, 10.2]), np.zeros(2), sigma=1e-3, seed=3)
    lines = nearest_lines(match(first, second, MatchOptions(error_scale=1.0)))
    assert re.search(r"right: claimed more than once \(within 5 arcsec\) +1 +1 +0$", lines[1])
    assert re.search(r"left: not identified, but one is within 5 arcsec +1 +1 +–$", lines[4])


def test_a_match_without_common_objects_is_reported():
    first = catalogue("left", np.array([10.0, 11.0]), np.zeros(2))
    second = catalogue("right", np.array([50.0, 51.0]), np.zeros(2))
    text = report(match(first, second))
    assert "Residuals: no pair was identified" in text and "the fields lie apart" in text


def test_a_later_note_replaces_an_earlier_one_on_the_same_subject():
    ra = np.array([10.0, 11.0])
    lines = catalogue_lines(catalogue("left", ra, 0 * ra, id=np.array([7, 7])), 1)
    assert [line.split(maxsplit=1) for line in lines if line.startswith("  id")] == [
        ["id", "id is not unique, so rows are numbered"]
    ]


def test_a_frame_reports_its_catalogue_as_a_match_does():
    # A note with a colon was printed without the colon.
    from sameas.report.frame import understood_lines

    note = "856 of 6179 rows have no proper motion: 0 ± 10 mas/yr on each axis is assumed"
    told = ["id: source_id", note, "id: name"]
    lines = understood_lines({"catalogue": "gaia", "understood": told})
    assert lines[0] == "Catalogue: gaia" and [line.split() for line in lines[3:]] == [["id", "name"], []]
    assert " ".join(" ".join(lines[1:3]).split()) == f"note {note}"


def test_notes_from_reading_the_file_are_reported():
    left = catalogue("left", np.array([10.0]), np.zeros(1))
    left.table.meta["sameas_notes"] = ["the file has 2 tables; the first was read"]
    assert "  file                  the file has 2 tables; the first was read" in catalogue_lines(left, 1)


@pytest.mark.parametrize(
    ("share", "words"),
    [(0.5, "50.0 %"), (1.0, "100.0 %"), (0.9996, "99.960 %"), (0.001, "0.100 %"), (float("nan"), "–")],
)
def test_shares_have_enough_decimals(share, words):
    assert prose.percent(share) == words


def test_counts_have_thousands_separators():
    assert count(117955) == "117 955"


def printed_report(rng, quoted, outliers=0.0):
    """Report of two catalogues whose errors are ``quoted`` times too small, with some outliers."""
    ra, dec = rng.uniform(20, 20.5, 3000), rng.uniform(-0.25, 0.25, 3000)
    far = (rng.uniform(size=3000) < outliers) / 3600.0
    given_errors = CatalogueOptions(sigma=0.1 / quoted)
    noise = rng.normal(0, 0.1 / 3600, (2, 2, 3000))
    places = np.array([[ra, dec + far], [ra, dec]]) + noise
    first, second = (
        Catalogue.of(Table(list(place), names=("ra", "dec")), name, options=given_errors)
        for place, name in zip(places, ("left", "right"), strict=True)
    )
    return report(match(first, second))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("quoted", "verdict"),
    [(1.0, "as quoted"), (1.7, r"quoted 1\.[67]\d+ ± 0\.0\d+ times too small"), (0.5, "quoted too large")],
)
def test_the_quoted_errors_are_assessed_in_plain_words(quoted, verdict):
    text = printed_report(np.random.default_rng(6), quoted)
    assert re.search(rf"errors +{verdict}", text) and "a tail" not in text


@pytest.mark.slow
def test_outliers_are_reported_as_a_tail_only():
    text = " ".join(printed_report(np.random.default_rng(7), 1.0, outliers=0.02).split())
    assert re.search(r"errors as quoted .* a tail: [12]\.\d+ ± 0\.\d+ % of the pairs have errors about [5-9]\.", text)


def test_columns_of_one_name_are_distinguished():
    rng = np.random.default_rng(8)
    ra, dec, mag = rng.uniform(20, 20.5, 400), rng.uniform(-0.25, 0.25, 400), rng.uniform(9.5, 20.5, 400)
    pair = [catalogue(name, ra, dec, seed=k, mag=mag + 0.3 * k) for k, name in enumerate(("left", "right"))]
    assert "mag of left − mag of right is" in " ".join(report(match(*pair)).split())


def test_chance_pairs_alone_are_reported_as_hardly_any():
    rng = np.random.default_rng(9)
    pair = [
        catalogue(n, rng.uniform(20, 20.3, 2000), rng.uniform(-0.15, 0.15, 2000), sigma=0.2) for n in ("left", "right")
    ]
    found = match(*pair)
    assert 0.5 < found.estimate.common < 10.0
    assert "left and right have hardly any objects in common" in report(found)


def test_a_single_record_per_source_suggests_no_offset():
    found = match(catalogue("left", np.array([10.0]), np.zeros(1)), catalogue("right", np.array([10.0]), np.zeros(1)))
    assert len(found.result.matches) == 1 and "offset=" not in report(found)


def test_zero_errors_are_refused_with_the_remedy():
    table = Table({"ra": [10.0, 10.1, np.nan], "dec": [0.0, 0.1, 0.2], "sigma_arcsec": [0.0, 0.0, 0.1]})
    with pytest.raises(
        InputError, match=r"no error \(2\), no position \(1\); an error of 0 or less counts as none: give sigma=ARCSEC"
    ):
        match(Catalogue.of(table, "left"), Catalogue.of(table, "right"))


def test_numbers_of_millions_of_rows_do_not_run_together():
    """Cells of nine characters touched each other in columns of eight."""
    magnitude = np.repeat([10.5, 11.5, 12.5, 13.5], 1_200_000)
    lines = _bins("left, mag", magnitude, np.ones(len(magnitude), np.bool_))
    assert lines[2].count("1 200 000") == 4 and len(re.findall(r"  1 200 000", lines[2])) == 4
    assert len({len(line) for line in lines[1:]}) == 1
