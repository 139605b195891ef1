"""Magnitudes as evidence between two catalogues: by default, by named bands, or switched off; and their report."""

import numpy as np
import pytest
from benchmarks.exposures import Sky, exposure

from sameas import InputError, plots
from sameas.report import match as report
from sameas.score.pairs import is_true_pair
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import MatchOptions, match
from sameas.sky.evidence_columns import magnitudes_of


def catalogue(records, magnitudes, bands):
    """A table such as a user has."""
    ra, dec = records.features.T
    xx, xy, yy = records.covariance.T
    table = {"ra": ra, "dec": dec, "ra_error": np.sqrt(xx), "dec_error": np.sqrt(yy), "corr": xy / np.sqrt(xx * yy)}
    for k, band in enumerate(bands):
        table[band] = np.where(np.isnan(magnitudes.values[:, k]), 99.0, magnitudes.values[:, k])
        table[f"e_{band}"] = magnitudes.sigma[:, k]
    options = CatalogueOptions(sigma="ra_error,dec_error", sigma_unit="arcsec", correlation="corr")
    return Catalogue.of(table, records.source, options=options)


@pytest.fixture(scope="module")
def made():
    return exposure(np.random.default_rng(1), Sky(stars_per_deg2=400_000.0), side_deg=0.1, missing=0.02)


@pytest.fixture(scope="module")
def sides(made):
    first = catalogue(made.scene.first, made.brightness[0], ("mag",))
    return first, catalogue(made.scene.second, made.brightness[1], ("Vmag", "Imag"))


def wrong(found, made):
    claimed = found.result.matches.rows_1, found.result.matches.rows_2
    return int((~is_true_pair(claimed, made.scene.true_pairs())).sum())


@pytest.fixture(scope="module")
def found(sides):
    first, second = sides
    return match(first, second)


def test_magnitudes_are_used_unless_switched_off(sides, found, made):
    first, second = sides
    off = match(first, second, MatchOptions(magnitudes="off"))
    assert off.estimate.photometry is None and "brightness" not in off.result.evidence.terms
    assert found.estimate.photometry is not None and wrong(found, made) < 0.5 * wrong(off, made)


@pytest.mark.slow
def test_bands_can_be_named(sides, made):
    first, second = sides
    found = match(first, second, MatchOptions(magnitudes="mag:vmag, Imag"))
    assert found.estimate.photometry.names == (("mag",), ("Vmag", "Imag"))
    colour = found.estimate.quantities["colour_Imag"]
    assert colour.value == pytest.approx(-made.sky.colour_term, abs=5 * colour.standard_error)
    assert np.nanmax(found.estimate.photometry.sides[1].measured.variance) > 0.0


def test_99_is_a_missing_magnitude(sides):
    first, second = sides
    one, two = magnitudes_of(first, second, "mag:Vmag")
    assert np.isnan(one.values).any() and np.nanmax(one.values) < 30.0 and np.nanmax(two.values) < 30.0


def test_without_magnitudes_only_positions_are_used(sides):
    bare = Catalogue.of({"ra": [10.0], "dec": [0.0]}, "bare", options=CatalogueOptions(sigma=0.1))
    assert magnitudes_of(bare, sides[1]) is None and magnitudes_of(sides[0], sides[1], "off") is None


@pytest.mark.parametrize(
    "wanted, words",
    [
        ("mag:K", "catalogue: no column 'K' of magnitudes; it has ra, dec"),
        ("mag", 'give "auto", "off", or columns of both catalogues'),
        ("mag:", 'give "auto", "off", or columns of both catalogues'),
    ],
)
def test_missing_bands_are_refused_with_a_clear_message(sides, wanted, words):
    first, second = sides
    with pytest.raises(InputError, match=words):
        magnitudes_of(first, second, wanted)


def test_the_report_states_the_effect_of_magnitudes(found):
    lines = report.estimate_lines(found)
    text = " ".join(" ".join(lines).split())
    for words in (
        "brightness mag − Vmag is 0.", "scatter 0.", "of the pairs are off the relation",
        "of catalogue frame shows", "at Vmag 1", "half as many at 1", "what decides", "answers", "by catalogue", "± ",
    ):  # fmt: skip
        assert words in text, words
    assert all(len(line) <= 100 for line in lines)


def test_the_picture_shows_completeness_densities_and_relation(found, sides):
    pytest.importorskip("matplotlib")
    figure = plots.brightness(found)
    left, middle, right = figure.axes
    assert len(left.containers) == 2 and left.get_ylim() == (0.0, 105.0)
    assert middle.get_ylabel() == "per square degree and magnitude"
    drawn = np.concatenate([line.get_ydata() for line in middle.lines])
    curves = found.estimate.detection_1, found.estimate.detection_2
    seen = np.concatenate([c.density[c.density > c.density_error] for c in curves if c is not None]) * 3600.0**2
    assert np.isin(np.round(seen, 6), np.round(drawn, 6)).all() and len(seen)
    assert "Vmag of catalogue" in right.get_xlabel() and len(right.lines) == 2
    first, second = sides
    with pytest.raises(InputError, match="no magnitudes were used"):
        plots.brightness(match(first, second, MatchOptions(magnitudes="off")))
