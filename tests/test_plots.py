"""Plots of an identification: all kinds, orientation of ellipses, missing matplotlib."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from astropy.table import Table

import sameas
from sameas.errors import InputError
from sameas.evidence import Errors
from sameas.sky.catalogue import Catalogue, CatalogueOptions
from sameas.sky.crossmatch import MatchOptions, match
from sameas.sky.sky_match import SkyMatch
from sameas.sky.table_astrometry import ellipse_covariance
from sameas.space import sphere_offset

pytest.importorskip("matplotlib", reason="plots need the extra sameas[plots]")

from sameas import plots
from sameas.plots.match import containment, rayleigh_mixture
from sameas.plots.sheet import TangentAxes, ellipse, nice_length

DEC = 40.0


@pytest.fixture(scope="module")
def stars() -> SkyMatch:
    """300 stars observed twice, 16 years apart, and one record of the first source with two equal candidates."""
    rng = np.random.default_rng(5)
    n, degrees = 300, 1.0 / 3600.0
    ra, dec = rng.uniform(10.0, 11.0, n), DEC + rng.uniform(-0.5, 0.5, n)
    ra[0], dec[0] = 12.0, DEC
    pm = rng.normal(0.0, 100.0, (n, 2))
    pm[0] = 0.0
    noise = rng.normal(0.0, 0.1, (2, n, 2))
    noise[:, 0] = 0.0
    later = 16e-3 * pm
    scale = degrees / np.cos(np.radians(dec))
    first = Table({"id": np.arange(n), "ra": ra + noise[0, :, 0] * scale, "dec": dec + noise[0, :, 1] * degrees})
    first["major"], first["minor"], first["angle"] = np.full(n, 0.12), np.full(n, 0.06), np.full(n, 30.0)
    first["pmra"], first["pmdec"], first["mag"] = pm[:, 0], pm[:, 1], rng.uniform(10, 15, n)
    east, north = noise[1, :, 0] + later[:, 0], noise[1, :, 1] + later[:, 1]
    second = Table({"id": np.arange(n + 1) + 1000})
    second["ra"] = np.append(ra + east * scale, ra[0] + 0.15 * scale[0])
    second["dec"] = np.append(dec + north * degrees, dec[0])
    second["ra"][0] -= 0.15 * scale[0]
    options = CatalogueOptions(ellipse="major,minor,angle", sigma_unit="arcsec", epoch=2000.0, pm_sigma_mas_per_yr=1.0)
    return match(
        Catalogue.of(first, "early", options=options),
        Catalogue.of(second, "late", options=CatalogueOptions(sigma=0.1, epoch=2016.0)),
    )


@pytest.fixture(scope="module")
def strangers() -> SkyMatch:
    """Two catalogues that have nothing in common."""
    one = Table({"ra": [10.0, 10.5, 10.7], "dec": [0.0, 0.1, 0.2]})
    two = Table({"ra": [10.2, 10.9], "dec": [0.3, 0.4]})
    options = CatalogueOptions(sigma=0.1)
    return match(Catalogue.of(one, "one", options=options), Catalogue.of(two, "two", options=options))


@pytest.mark.slow
@pytest.mark.parametrize("name", ["residuals", "normalised", "group", "certainty"])
def test_every_picture_is_drawn(stars: SkyMatch, tmp_path: Path, name: str) -> None:
    path = tmp_path / f"{name}.png"
    plots.save(getattr(plots, name)(stars), path)
    assert path.read_bytes().startswith(b"\x89PNG")
    assert path.stat().st_size > 20_000
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("name", ["residuals", "normalised", "scatter", "certainty"])
def test_a_result_without_matches_is_drawn(strangers: SkyMatch, tmp_path: Path, name: str) -> None:
    assert len(strangers.result.matches) == 0
    plots.save(getattr(plots, name)(strangers), tmp_path / "empty.png")


def test_titles_state_the_result(stars: SkyMatch) -> None:
    title = plots.residuals(stars).get_suptitle()
    assert title.startswith("Proper motion reduces the residuals: median distance 1.")


@pytest.fixture(scope="module")
def still() -> SkyMatch:
    """Two catalogues without proper motions whose names are long; the second covers half of the first."""
    rng = np.random.default_rng(3)
    ra, dec = rng.uniform([40.0, 0.0], [41.0, 0.5], (400, 2)).T
    ra[0], mag = 40.1, rng.uniform(12.0, 18.0, 400)
    west = ra < 40.5
    options = CatalogueOptions(sigma=0.1)
    names = "a_survey_of_the_northern_sky_release_3", "a_survey_of_the_southern_sky_release_2"
    one = Catalogue.of({"ra": ra, "dec": dec, "gmag": mag}, names[0], options=options)
    dec = dec + rng.normal(0.0, 2e-5, 400)
    two = Catalogue.of({"ra": ra[west], "dec": dec[west], "gmag": mag[west]}, names[1], options=options)
    return match(one, two)


def test_catalogues_without_motion_have_one_map_of_residuals(still: SkyMatch) -> None:
    """There were two maps that were the same, titled "Proper motion changes little"."""
    figure = plots.residuals(still)
    assert len(figure.axes) == 2 and figure.axes[1].get_ylabel() == "pairs per cell"
    assert figure.get_suptitle().strip() == "Half of the identified pairs lie within 51.4 mas"
    assert figure.axes[0].get_xlabel() == "east offset [arcsec]"


def test_residuals_of_few_pairs_are_points_without_a_colour_bar() -> None:
    """There were 200 single pixels, with a colour bar from 1 to 10 pairs."""
    rng = np.random.default_rng(4)
    ra, dec = rng.uniform([40.0, 0.0], [41.0, 1.0], (200, 2)).T
    off = rng.normal(0.0, 0.5 / 3600.0, (2, 200))
    one, two = (
        Catalogue.of({"ra": ra + x, "dec": dec + y}, name, options=CatalogueOptions(sigma=0.5 / np.sqrt(2.0)))
        for name, x, y in (("one", 0.0, 0.0), ("two", *off))
    )
    (axes,) = plots.residuals(match(one, two)).axes
    assert np.asarray(axes.lines[0].get_xdata()).size == 200


def test_an_offset_that_was_removed_is_not_called_motion() -> None:
    rng = np.random.default_rng(4)
    ra, dec = rng.uniform([40.0, 0.0], [40.5, 0.5], (300, 2)).T
    options = CatalogueOptions(sigma=0.1)
    one, two = (
        Catalogue.of({"ra": ra, "dec": dec + shift + rng.normal(0.0, 2e-5, 300)}, name, options=options)
        for name, shift in (("a", 0.0), ("b", 1e-3))
    )
    figure = plots.residuals(match(one, two, MatchOptions(offset="find")))
    assert figure.get_suptitle().startswith("The offset found reduces the residuals: median distance 3.")
    assert figure.axes[1].get_title(loc="left") == "offset removed"


@pytest.mark.parametrize("name", ["residuals", "normalised", "scatter", "certainty", "brightness"])
def test_long_names_are_neither_cut_off_nor_overlap(still: SkyMatch, name: str) -> None:
    figure = getattr(plots, name)(still)
    figure.draw_without_rendering()
    labels = [label for axes in figure.axes for label in (axes.xaxis.label, axes.yaxis.label) if label.get_text()]
    boxes = [label.get_window_extent() for label in labels]
    assert all(box.x0 >= 0 and box.y0 >= 0 and box.x1 <= figure.bbox.x1 and box.y1 <= figure.bbox.y1 for box in boxes)
    assert not any(one.overlaps(two) for k, one in enumerate(boxes) for two in boxes[:k])


def test_the_share_identified_is_of_the_rows_covered(still: SkyMatch) -> None:
    heights = [bar.get_window_extent().height for bar in plots.certainty(still).axes[1].patches]
    assert min(heights) > 0.9 * max(heights)


def test_logarithmic_axes_have_plain_numbers() -> None:
    """Counts of one decade were 2 × 10⁰, 3 × 10⁰ …"""
    rng = np.random.default_rng(2)
    ra, dec = rng.uniform([40.0, 0.0], [40.5, 0.5], (600, 2)).T
    options = CatalogueOptions(sigma=0.1, epoch=2000.0)
    one, two = (
        Catalogue.of({"ra": ra, "dec": dec + rng.normal(0.0, 2e-5, 600)}, name, options=options) for name in "ab"
    )
    figure = plots.residuals(match(one, two))
    bar = figure.axes[-1]
    assert bar.get_ylabel() == "pairs per cell" and bar.get_yscale() == "log"
    figure.canvas.draw()
    labels = [label.get_text() for label in bar.get_yticklabels(which="both")]
    assert any(labels) and not any("times" in label for label in labels), labels


def test_a_long_title_and_subtitle_wrap() -> None:
    """A long title was cut off at the right."""
    from sameas.plots.sheet import sheet

    for finding in ("A finding", "A finding of several sources with long names, " * 5):
        figure = sheet(finding, "its reasons, of which there are many, " * 5)
        figure.draw_without_rendering()
        assert all(text.get_window_extent().x1 <= figure.bbox.x1 for text in figure.texts)
        title, subtitle = (next(t for t in figure.texts if t.get_text().startswith(word)) for word in ("A f", "its"))
        lines = title.get_text().rstrip("\n").count("\n") + 1
        assert subtitle.get_window_extent().y1 < figure.bbox.y1 * 0.98 - lines * 14.0 * figure.dpi / 72.0


def test_catalogue_names_are_drawn_literally(stars: SkyMatch) -> None:
    assert any(" early moved from " in text.get_text() for text in plots.residuals(stars).texts)


def test_east_is_left_in_pictures_of_the_sky(stars: SkyMatch) -> None:
    for figure in (plots.residuals(stars), plots.group(stars)):
        left, right = figure.axes[0].get_xlim()
        low, high = figure.axes[0].get_ylim()
        assert left > right and low < high


def test_an_ellipse_is_drawn_along_its_position_angle(stars: SkyMatch) -> None:
    """In pixels: 30 degrees from up towards the left."""
    figure = plots.group(stars, record=0)
    figure.draw_without_rendering()
    axes = figure.axes[0]
    outlines = axes.transData.transform(axes.patches[0].get_path().vertices)
    middle = 0.5 * (outlines.min(axis=0) + outlines.max(axis=0))
    away = outlines - middle
    tip = away[np.argmax(np.hypot(*away.T))]
    tip *= np.sign(tip[1])
    assert np.degrees(np.arctan2(-tip[0], tip[1])) == pytest.approx(30.0, abs=2.0)


def test_the_outline_of_an_ellipse_reaches_its_axes() -> None:
    for angle in (0.0, 30.0, 90.0, 135.0):
        xx, yy, xy = ellipse_covariance(np.array(3.0), np.array(1.0), np.array(angle))
        outline = ellipse(np.array([5.0, -2.0]), np.array([[xx, xy], [xy, yy]]), 2.0, points=721)
        away = outline - np.array([5.0, -2.0])
        distance = np.hypot(*away.T)
        assert (distance.min(), distance.max()) == pytest.approx((2.0, 6.0), rel=1e-4)
        east, north = away[np.argmax(distance)]
        assert np.degrees(np.arctan2(east, north)) % 180.0 == pytest.approx(angle % 180.0, abs=0.5)


def test_the_most_ambiguous_group_has_two_equal_candidates(stars: SkyMatch) -> None:
    number = plots.most_ambiguous(stars)
    assert number == stars.result.explain(0).group
    assert stars.result.groups.sizes_1[number] == 1 and stars.result.groups.sizes_2[number] == 2


def test_a_group_is_drawn_from_either_side(stars: SkyMatch) -> None:
    words = [text.get_text() for text in plots.group(stars, record=1000, source=2).axes[0].texts]
    assert sum(text.endswith("%") for text in words) == 2
    assert {text.split("\n")[0] for text in words} >= {"0", "1000", "1300"}


@pytest.mark.slow
def test_impossible_plots_are_refused(stars: SkyMatch, strangers: SkyMatch, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="nothing to plot is ambiguous"):
        plots.group(strangers)
    with pytest.raises(InputError, match="0 has no candidates; nothing to plot"):
        plots.group(strangers, record=0)
    with pytest.raises(InputError, match=r"plots are written as .*png"):
        plots.save(plots.certainty(stars), tmp_path / "picture.fits")
    with pytest.raises(InputError, match="does not exist"):
        plots.save(plots.certainty(stars), tmp_path / "nowhere" / "picture.png")
    assert not list(tmp_path.iterdir())


def test_without_matplotlib_the_error_names_the_install_line(stars: SkyMatch, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in [name for name in sys.modules if name.split(".")[0] == "matplotlib"]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(InputError, match=r"pip install 'sameas\[plots\]'"):
        plots.residuals(stars)


def test_drawn_densities_and_radii_agree_with_the_mixture() -> None:
    errors = Errors((1.0, 4.0), (0.8, 0.2))
    x = np.linspace(0.0, 60.0, 60_001)
    density = rayleigh_mixture(x, errors)
    assert np.trapezoid(density, x) == pytest.approx(1.0, abs=1e-6)
    for share in (0.5, 0.9, 0.99):
        inside = x <= containment(errors, share)
        assert np.trapezoid(density[inside], x[inside]) == pytest.approx(share, abs=2e-3)
    assert containment(Errors(), 0.5) == pytest.approx(np.sqrt(2.0 * np.log(2.0)), abs=1e-3)


def test_the_projection_works_at_the_pole_and_across_the_meridian() -> None:
    for position in ([[10.0, 89.9999], [130.0, 89.9998]], [[359.9999, -30.0], [0.0002, -30.0001]]):
        at = np.array(position)
        place, axes = TangentAxes.about(at)(at)
        offset = sphere_offset(*at[:1].T, *at[1:].T)[0]
        assert np.hypot(*(place[0] - place[1])) == pytest.approx(np.hypot(*offset), rel=1e-6)
        assert np.allclose(axes @ axes.transpose(0, 2, 1), np.eye(2), atol=1e-5)
        # A small step north of a record follows its rotated axes.
        step = at - np.array([0.0, 1e-5])
        moved = TangentAxes.about(at)(step)[0] - place
        assert np.allclose(moved, axes @ np.array([0.0, -0.036]), atol=1e-5)


def test_scale_bars_have_round_lengths() -> None:
    assert [nice_length(x) for x in (0.3, 1.0, 4.9, 73.0)] == pytest.approx([0.2, 1.0, 2.0, 50.0])


@pytest.mark.slow
def test_the_drawn_scatter_is_the_simulated_one() -> None:
    rng = np.random.default_rng(8)
    n, sigma = 3000, np.exp(rng.uniform(np.log(0.05), np.log(0.5), 3000))
    ra, dec, mag = rng.uniform(10.0, 11.0, n), rng.uniform(-0.5, 0.5, n), 15.0 + np.log(sigma)
    off = rng.normal(size=(2, n)) * np.hypot(1.5 * sigma, 0.1) / 3600.0
    first = Table({"ra": ra + off[0], "dec": dec + off[1], "sigma_arcsec": sigma, "mag": mag})
    second = Table({"ra": ra, "dec": dec, "sigma_arcsec": np.full(n, 1e-3)})
    found = match(Catalogue.of(first, "plate"), Catalogue.of(second, "gaia"))
    left, right = plots.scatter(found).axes
    quoted = np.asarray(left.lines[0].get_xdata())
    seen = np.asarray(left.lines[2].get_ydata())
    np.testing.assert_allclose(np.asarray(left.lines[0].get_ydata()), quoted, rtol=1e-12)
    np.testing.assert_allclose(seen, np.hypot(1.5 * quoted, 0.1), rtol=0.2)
    assert len(np.asarray(right.lines[2].get_xdata())) == len(quoted)


def test_the_scatter_of_long_ellipses_of_unequal_size_is_the_quoted_one() -> None:
    """Their median separation is a fifth smaller than that of circles of the same rms."""
    rng = np.random.default_rng(8)
    n, major = 3000, np.exp(rng.uniform(np.log(0.5), np.log(8.0), 3000))
    dec, ra, angle = rng.uniform(-2.0, 2.0, n), rng.uniform(10.0, 14.0, n), rng.uniform(0.0, np.pi, n)
    along, across = major * rng.normal(size=n) / 3600.0, 0.2 * major * rng.normal(size=n) / 3600.0
    east, north = np.sin(angle) * along + np.cos(angle) * across, np.cos(angle) * along - np.sin(angle) * across
    first = Table({"ra": ra + east / np.cos(np.radians(dec)), "dec": dec + north, "mag": rng.uniform(15.0, 20.0, n)})
    first["major"], first["minor"], first["angle"] = major, 0.2 * major, np.degrees(angle)
    options = CatalogueOptions(ellipse="major,minor,angle", sigma_unit="arcsec")
    second = Table({"ra": ra, "dec": dec, "sigma_arcsec": np.full(n, 1e-3)})
    found = match(Catalogue.of(first, "radio", options=options), Catalogue.of(second, "gaia"))
    for axes in plots.scatter(found).axes:
        quoted, seen = (np.asarray(axes.lines[k].get_ydata()) for k in (0, 2))
        assert np.median(seen / quoted) == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
def test_all_possible_plots_are_drawn(stars: SkyMatch, strangers: SkyMatch) -> None:
    assert [name for name, _ in plots.every(stars)] == ["residuals", "normalised", "scatter", "certainty", "ambiguous"]
    assert "ambiguous" not in dict(plots.every(strangers)) and "scatter" in dict(plots.every(strangers))


def test_errors_of_an_ambiguous_group_are_given_from_the_smallest_to_the_largest() -> None:
    """It gave one typical error of two candidates, 0.11″, where one has 1 mas and the other 0.16″."""
    rng, n = np.random.default_rng(8), 60
    ra, dec = rng.uniform(10.0, 10.2, n), rng.uniform(0.0, 0.2, n)
    one = {"ra": ra, "dec": dec, "err_arcsec": np.full(n, 0.3)}
    near = {
        "ra": np.append(ra, ra[0] + 0.2 / 3600),
        "dec": np.append(dec, dec[0]),
        "err_arcsec": np.append(np.full(n, 0.05), 0.2),
    }
    figure = sameas.match(one, near).plot("ambiguous")
    words = [text.get_text() for axes in figure.axes if axes.get_legend() for text in axes.get_legend().get_texts()]
    assert any(word.endswith("error here 0.30″ on each axis") for word in words)
    assert any(word.endswith("error here 50 mas to 0.20″ on each axis") for word in words)
