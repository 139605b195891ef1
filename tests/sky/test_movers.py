"""Movers: tracklets are correct, complete, calibrated, and independent of the row order."""

from dataclasses import replace
from itertools import combinations, product

import numpy as np
import pytest
from astropy.coordinates import EarthLocation, SkyCoord
from astropy.table import Column, Table
from astropy.utils import iers
from moving import night

from sameas import InputError
from sameas.report.movers import excluded_lines
from sameas.sky import Catalogue, CatalogueOptions, Detections, MotionModel, find_movers, learn_motion
from sameas.sky.movers import stationary
from sameas.sky.movers.detections import detections_of
from sameas.sky.movers.known import near_earth_scores
from sameas.sky.movers.links import candidate_links, link_probabilities
from sameas.sky.movers.model import Surroundings, Tuning
from sameas.sky.movers.rates import EclipticAxes, RateDensity, reference_rate, sun_longitude_deg
from sameas.sky.movers.search import detection_probability
from sameas.sky.movers.stationary import MOST_TRIED, fixed_on_chip
from sameas.sky.movers.tracks import Tracks, compete, grow
from sameas.sky.times import Time


def named(found, truth):
    """For each tracklet: whether it is of one mover, and whether it has all detections of it."""
    pure, whole = [], []
    for row in found.members:
        names = truth[row[row >= 0]]
        pure.append(bool((names == names[0]).all() and names[0] >= 0))
        whole.append(pure[-1] and len(names) == int((truth == names[0]).sum()))
    return np.array(pure), np.array(whole)


def test_movers_of_a_crowded_night_are_found_with_all_detections():
    detections, truth = night(1)
    found = find_movers(detections, least=3)
    pure, whole = named(found, truth)
    there = sum((truth == k).sum() >= 3 for k in range(40))
    assert pure.mean() > 0.97 and whole.sum() >= 0.93 * there


@pytest.mark.slow
def test_probabilities_are_calibrated():
    p, right = [], []
    for seed in range(30, 44):
        detections, truth = night(seed, times_min=(0, 30, 75), false=150, p_detect=0.7)
        found = find_movers(detections, min_probability=0.0)
        p.append(found.p_exact)
        right.append(named(found, truth)[1])
    p, right = np.concatenate(p), np.concatenate(right)
    for low, high in ((0.3, 0.7), (0.7, 0.9), (0.9, 1.01)):
        here = (p >= low) & (p < high)
        spread = np.sqrt(max((p[here] * (1 - p[here])).sum(), 1.0))
        assert abs(right[here].sum() - p[here].sum()) < 4.0 * spread + 0.05 * here.sum()


def test_the_order_of_the_rows_changes_nothing():
    detections, _ = night(2)
    turned = np.random.default_rng(0).permutation(len(detections))
    one, other = find_movers(detections, least=3), find_movers(detections.some(turned), least=3)
    back = [sorted(turned[row[row >= 0]].tolist()) for row in other.members]
    assert sorted(back) == sorted(sorted(row[row >= 0].tolist()) for row in one.members)


def test_a_detection_belongs_to_one_tracklet_at_most():
    found = find_movers(night(3, false=300)[0], min_probability=0.0)
    rows = found.members[found.members >= 0]
    assert len(rows) == len(np.unique(rows)) and len(found) > 5


def test_false_detections_alone_give_hardly_any_tracklet():
    detections, _ = night(4, movers=0, false=200)
    found = find_movers(detections, least=3, model=MotionModel())
    assert found.p_tracklet.sum() <= 3 and len(found) <= 3


def test_fast_movers_are_found_by_their_straight_line():
    rate = np.array([[20.0, -11.0], [-5.0, 6.0], [0.0, 3.0]])
    detections, truth = night(5, movers=3, false=20, times_min=(0, 4, 8, 12, 16), rate=rate, p_detect=1.0)
    pure, whole = named(found := find_movers(detections, least=4), truth)
    assert pure.all() and whole.sum() == 3
    speeds = sorted(np.hypot(*found.rate_arcsec_per_min.T))
    np.testing.assert_allclose(speeds, sorted(np.hypot(*rate.T)), rtol=0.02)


def test_rates_and_residuals_are_those_of_a_straight_line():
    rate = np.array([[-0.6, 0.1]])
    detections, _ = night(6, movers=1, false=0, rate=rate, p_detect=1.0, sigma=0.05)
    found = find_movers(detections)
    np.testing.assert_allclose(found.rate_arcsec_per_min, rate, atol=0.005)
    assert found.size.tolist() == [4] and found.scatter_arcsec[0] < 0.15
    assert np.nanmax(np.abs(found.residual_arcsec)) < 0.2
    assert len(found.table()) == 1 and len(found.detection_table()) == 4
    assert found.table()["tracklet"][0] == "sa00001"


def test_rates_are_learned_without_known_names():
    detections, _ = night(7, movers=300, side_deg=4.0)
    model = learn_motion(detections)
    top = model.rates.covariance[model.rates.share > 0.1]
    assert 0.75 < model.p_detect < 0.95 and np.sqrt(top[:, 0, 0]).max() < 0.3


def test_linked_detections_are_one_to_one():
    detections, _ = night(8, false=200)
    around = Surroundings.of(detections)
    links = candidate_links(around, MotionModel().for_bands(detections.bands))
    p = link_probabilities(links, len(detections))
    assert np.bincount(links.i, p).max() <= 1 + 1e-9 and np.bincount(links.j, p).max() <= 1 + 1e-9
    assert (detections.frame[links.i] < detections.frame[links.j]).all()


def test_links_of_a_long_series_agree_with_those_among_all_pairs(monkeypatch):
    detections, _ = night(8, movers=8, false=20, times_min=tuple(range(0, 90, 3)))
    around, n = Surroundings.of(detections), len(detections)
    model = MotionModel().for_bands(detections.bands)
    quick = candidate_links(around, model)
    every = np.column_stack(np.triu_indices(n, 1))
    monkeypatch.setattr("sameas.sky.movers.links._pairs", lambda *_: every)
    monkeypatch.setattr("sameas.sky.movers.links.Reach.__call__", lambda _, minutes: np.full(len(minutes), 1e9))
    slow = candidate_links(replace(around, tuning=Tuning(pairs_at_once=10_000)), model)
    assert len(quick) > 100 and (set(zip(quick.i, quick.j, strict=True)) == set(zip(slow.i, slow.j, strict=True)))


def test_competing_tracks_are_summed_over_all_choices():
    rng = np.random.default_rng(9)
    members = [(0, 1), (1, 2), (0, 2), (0, 1, 2), (2, 3), (4, 5)]
    weight = rng.normal(1.0, 2.0, len(members))
    made = chain(members, weight)
    found = compete(made, 6, Tuning(certain_gain=np.inf, min_competing=-np.inf))
    total, share, best = 0.0, np.zeros(len(members)), (-np.inf, ())
    for size in range(len(members) + 1):
        for choice in combinations(range(len(members)), size):
            used = [d for k in choice for d in members[k]]
            if len(used) == len(set(used)):
                w = float(weight[list(choice)].sum())
                total += np.exp(w)
                share[list(choice)] += np.exp(w)
                best = max(best, (w, choice))
    by = {tuple(row[row >= 0]): k for k, row in enumerate(found.members)}
    at = [by[m] for m in members]
    np.testing.assert_allclose(found.p_track[at], share / total, atol=1e-9)
    assert tuple(np.flatnonzero(found.chosen[at])) == best[1]


def chain(members, weight):
    """Tracks with these detections; tracks of three have a track of two as parent."""
    n = len(members)
    parent = np.array([members.index(m[:-1]) if len(m) > 2 else -1 for m in members])
    first, last = np.array([m[0] for m in members]), np.array([m[-1] for m in members])
    size = np.array([len(m) for m in members])
    return Tracks(first, last, parent, size, weight, weight, size, np.zeros(n), np.zeros((n, 6)))


def test_long_tracks_are_not_split():
    detections, truth = night(
        10, movers=2, false=30, times_min=tuple(range(0, 300, 5)), rate=np.array([[0.5, 0.3], [-0.6, 0.0]])
    )
    found = find_movers(detections, least=20)
    pure, _ = named(found, truth)
    assert len(found) == 2 and pure.all()
    assert (found.size > 0.95 * np.bincount(truth[truth >= 0])).all()


def test_a_track_is_the_least_squares_fit_of_its_detections():
    detections, _ = night(11, movers=1, false=0, p_detect=1.0)
    around, model = Surroundings.of(detections), MotionModel().for_bands(detections.bands)
    tracks = grow(around, candidate_links(around, model), model)
    whole = int(np.argmax(tracks.size))
    rows = tracks.members(np.array([whole]))[0]
    t = (detections.mjd_utc[rows] - detections.mjd_utc[rows[0]]) * 1440.0
    place = around.axes.offsets(np.full(len(rows), rows[0]), rows)
    line = np.polyfit(t, place, 1)
    np.testing.assert_allclose(tracks.state[whole, 2:4], line[0], atol=0.01)


def test_the_rate_density_integrates_to_one_and_widens_with_errors():
    mixture = RateDensity.of([0.7, 0.3], [(0.0, 0.0), (0.1, 0.0)], [(0.1, 0.2), (0.5, 0.5)])
    grid = np.stack(np.meshgrid(*[np.linspace(-4, 4, 321)] * 2), -1).reshape(-1, 2)
    for error in (0.0, 0.3):
        spread = np.broadcast_to(error**2 * np.eye(2), (len(grid), 2, 2))
        assert abs(np.exp(mixture.log_density(grid, spread)).sum() * (8 / 320) ** 2 - 1) < 1e-3


def test_the_reference_rate_is_retrograde_at_opposition_only():
    assert reference_rate(np.array([180.0]))[0] == pytest.approx(-0.567, abs=0.01)
    assert reference_rate(np.array([10.0]))[0] > 0.5


def test_the_position_of_the_sun_agrees_with_astropy():
    from astropy.coordinates import GeocentricMeanEcliptic, get_sun
    from astropy.time import Time

    when = Time([51600.0, 58409.1, 60000.0], format="mjd")
    there = get_sun(when).transform_to(GeocentricMeanEcliptic(equinox="J2000"))
    assert np.abs((sun_longitude_deg(when.mjd) - there.lon.deg + 180) % 360 - 180).max() < 0.4


def test_covariances_rotate_to_ecliptic_axes_and_back():
    axes = EclipticAxes.of(np.array([100.0, 250.0]), np.array([40.0, -20.0]))
    both = axes.rotated(np.array([[4.0, 0.5, 1.0], [1.0, 0.0, 1.0]]))
    np.testing.assert_allclose(np.trace(both, axis1=1, axis2=2), [5.0, 2.0])
    np.testing.assert_allclose(both[1], np.eye(2), atol=1e-12)
    there = axes.to_equator(np.array([0]), np.array([[3.0, 4.0]]))
    assert np.hypot(*there[0]) == pytest.approx(5.0)


@pytest.mark.slow
def test_fast_tracklets_score_as_near_earth_objects():
    pytest.importorskip("digest2", reason="scores need the package digest2")
    rates = np.array([[-0.5, 0.21], [4.0, -3.0]])
    detections, truth = night(3, movers=2, false=0, rate=rates, p_detect=1.0)
    found = find_movers(detections, least=3)
    scores = near_earth_scores(found, site=(42.61, -71.485, 100.0))
    slow, fast = (int(np.flatnonzero(truth[found.members[:, 0]] == k)[0]) for k in (0, 1))
    assert scores[fast] > 90 and scores[slow] < 50
    table = replace(found, near_earth=scores).only(np.array([fast])).table()
    assert table["digest2_neo"][0] == scores[fast]


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"sigma_arcsec": None}, "error of the positions is not known"),
        ({"sigma_arcsec": 0.0}, "3 position errors are not positive"),
        ({"mjd_utc": [2460000.5] * 3}, "not an MJD between 1890 and 2150"),
        ({"mjd_utc": [60000.0] * 3}, "all of one exposure"),
        ({"dec_deg": [1.0, 2.0]}, "2 values of dec for 3 rows"),
        ({"ra_deg": ["a", "b", "c"]}, "ra is not a column of numbers"),
    ],
)
def test_invalid_detections_are_refused(change, words):
    given = {"ra_deg": [1.0, 2.0, 3.0], "dec_deg": [1.0, 2.0, 3.0], "mjd_utc": [60000.0, 60000.1, 60000.2]}
    with pytest.raises(InputError, match=words):
        Detections.of(**{**given, "sigma_arcsec": 0.1, **change})


def test_the_least_number_of_detections_is_at_least_two():
    with pytest.raises(InputError, match="two detections or more; give least=N"):
        find_movers(night(1)[0], least=1)


def test_doubtful_rows_are_set_aside_with_the_reason():
    seen = Detections.of(
        [1.0, 1.0, np.nan, 1.2, 1.3], [1.0, 1.0, 1.0, 1.0, 1.0], [6e4, 6e4, 6e4, 6e4 + 0.1, np.nan], sigma_arcsec=0.1
    )
    assert len(seen) == 2 and seen.rows.tolist() == [0, 3]
    assert seen.set_aside.counts() == {
        "no position": 1, "no time": 1, "the same place in the same exposure as another row": 1
    }  # fmt: skip


def test_a_few_impossible_times_are_set_aside_and_those_of_tai_become_utc():
    seen = Detections.of([1.0, 1.1, 1.2], [1.0, 1.0, 1.0], [6e4, 6e4 + 0.1, -1.0], sigma_arcsec=0.1)
    assert seen.set_aside.counts() == {"a time that is no MJD between 1890 and 2150": 1}
    table = {"ra": [10.0, 10.01], "dec": [5.0, 5.0], "midpointMjdTai": [60000.0, 60000.02]}
    seen, lines = detections_of([Catalogue.of(table, "night", options=CatalogueOptions(sigma=0.2))])
    np.testing.assert_allclose((60000.0 - seen.mjd_utc[0]) * 86400.0, 37.0, atol=1e-3)
    assert "time midpointMjdTai (MJD of TAI, turned into UTC)" in lines[0]


@pytest.mark.parametrize("trouble", [{}, {"larger": 2.5}, {"apart": 0.4}, {"times_min": (0, 30)}])
def test_a_stationary_source_is_no_mover(trouble):
    """Stars with errors larger than quoted on offset exposures; movers are still found."""
    detections, truth = night(21, movers=10, false=20, stars=150, p_detect=1.0, **trouble)
    found = find_movers(detections, min_probability=0.9)
    pure, _ = named(found, truth)
    assert pure.all() and len(found) >= 9
    assert not truth[found.stationary.rows].max() >= 0 and 100 <= found.stationary.places <= 150
    assert abs(found.stationary.error_scale - trouble.get("larger", 1.0)) < 0.3
    off = np.abs(found.stationary.offset_arcsec).max()
    assert off > 0.2 if "apart" in trouble else off < 0.15


def test_two_stars_closer_than_their_errors_are_no_movers():
    """The assignment of detections to the two stars is ambiguous, but both are stationary."""
    rng = np.random.default_rng(4)
    place = np.concatenate([rng.uniform(-900, 900, (30, 2)), [[100.0, 100.0], [100.3, 100.0]]])
    t = np.repeat([0.0, 14.0, 31.0, 50.0], len(place))
    place = np.tile(place, (4, 1)) + 0.2 * rng.standard_normal((4 * len(place), 2))
    dec = 5.0 + place[:, 1] / 3600.0
    seen = Detections.of(
        190.0 + place[:, 0] / 3600.0 / np.cos(np.radians(dec)), dec, 59300.0 + t / 1440.0, sigma_arcsec=0.2
    )
    found = find_movers(seen)
    assert len(found) == 0 and found.stationary.rows.all()


@pytest.mark.slow
@pytest.mark.parametrize("seed", [14, 19])
def test_a_chance_track_does_not_support_itself_through_learning(seed):
    """Chance lines of three once raised the learned frequency of their own rate, and were stated 0.97 and 0.92."""
    detections, _ = night(seed, movers=0, false=300, side_deg=0.5)
    assert len(find_movers(detections, least=3)) == 0


@pytest.mark.slow
def test_stars_with_a_nearby_false_detection_are_no_slow_movers():
    """Among 800 stars with errors 2.5 times those quoted, a star was once a candidate of 0.73."""
    detections, truth = night(3, movers=3, false=100, stars=800, larger=2.5, p_detect=1.0)
    found = find_movers(detections, least=3)
    pure, _ = named(found, truth)
    assert pure.all() and len(found) == 3


def dithered(seed, dithers, *, pixels=400):
    """A night of three movers, and hot pixels fixed on the chip; dithers (f, 2) arcsec of the field."""
    detections, truth = night(seed, movers=3, false=50, stars=50, side_deg=0.5, p_detect=1.0)
    rng = np.random.default_rng(seed)
    at = rng.uniform(-900.0, 900.0, (pixels, 2))
    place = np.concatenate([at + one for one in dithers]) + 0.2 * rng.standard_normal((4 * pixels, 2))
    frame = np.repeat(np.arange(4), pixels)
    dec = np.concatenate([detections.dec_deg, -4.0 + place[:, 1] / 3600.0])
    ra = 190.0 + place[:, 0] / 3600.0 / np.cos(np.radians(dec[len(detections) :]))
    seen = Detections.of(
        np.concatenate([detections.ra_deg, ra]), dec,
        np.concatenate([detections.mjd_utc, detections.frame_mjd[frame]]), sigma_arcsec=0.2,
        frame=np.concatenate([detections.frame, frame]),
    )  # fmt: skip
    return seen, np.concatenate([truth, np.full(len(place), -1)])


def test_pixels_under_a_dithered_telescope_are_no_movers():
    """Many fixed pixels form lines of three by chance; a night of 2 000 once had 39 candidates."""
    seen, truth = dithered(1, [(0.0, 0.0), (15.0, -8.0), (-11.0, 4.0), (6.0, 17.0)])
    found = find_movers(seen, least=3)
    pure, _ = named(found, truth)
    assert pure.all() and len(found) == 3 and 1590 < found.fixed < 1650
    assert any("fixed on the chip" in line for line in excluded_lines(found))


def test_a_crowd_at_one_place_is_searched_for_a_dither_by_few_of_its_vectors():
    """A thousand detections at one place on two exposures are a million vectors, of which all were tried: 25 s."""
    rng = np.random.default_rng(2)
    at = np.concatenate([rng.normal(0.0, 0.2, (300, 2)), rng.uniform(-900.0, 900.0, (40, 2))])
    steps = (at[:, None] + [15.0, -8.0] + 0.2 * rng.standard_normal((340, 340, 2)) - at).reshape(-1, 2)
    tried = stationary.thinned(steps, 0.4, MOST_TRIED)
    assert (np.diff(tried) > 0).all() and len(tried) < 0.3 * len(steps)
    # Where vectors are sparse, all are tried.
    sparse = steps[np.hypot(*(steps - [15.0, -8.0]).T) > 100.0]
    assert len(stationary.thinned(sparse, 0.4, MOST_TRIED)) == len(sparse) > 1000
    dithers = [(0.0, 0.0), (15.0, -8.0), (-11.0, 4.0), (6.0, 17.0)]
    seen, _ = dithered(1, dithers, pixels=200)
    assert fixed_on_chip(seen)[-800:].mean() > 0.95


def test_movers_of_one_rate_are_not_taken_for_fixed_pixels():
    """Dithers proportional to the time differences look like motion of objects."""
    minutes = np.array([0.0, 20.0, 45.0, 70.0])[:, None]
    seen, _ = dithered(1, minutes * [[0.4, -0.2]])
    assert not fixed_on_chip(seen).any()


def test_a_mover_hardly_faster_than_its_errors_is_no_star():
    """0.03″/min for 70 minutes are eleven σ of 0.2″; a tenth of that is one σ and no mover."""
    for rate, movers in ((0.03, 5), (0.003, 0)):
        detections, truth = night(
            22, movers=5, stars=100, p_detect=1.0, rate=np.full((5, 2), rate), times_min=(0, 25, 50, 70)
        )
        pure, _ = named(find_movers(detections, least=3, min_probability=0.9), truth)
        assert pure.all() and len(pure) == movers


def test_fast_movers_of_a_table_are_found():
    """4 to 20″/min in any direction, without trails, in a table where chance links at these rates are rare."""
    rate = np.array([[9.0, -4.0], [-10.0, 2.0], [3.0, 3.0], [5.0, 15.0]])
    detections, truth = night(12, movers=4, false=100, times_min=(0, 12, 24, 36), side_deg=0.5, rate=rate, p_detect=1.0)
    pure, whole = named(find_movers(detections, least=3), truth)
    assert pure.all() and whole.sum() >= 3


@pytest.mark.slow
def test_fast_movers_among_many_false_detections_are_found():
    """More chance links at such rates than are tried; a third exposure in line supports the true ones."""
    rate = np.array([[9.0, -4.0], [-10.0, 2.0], [1.2, 0.9]])
    detections, truth = night(
        12, movers=3, false=400, times_min=(0, 12, 24, 36, 48), side_deg=0.3, rate=rate, p_detect=1.0
    )
    tuning = Tuning(min_log_ratio=-14.0)
    found = find_movers(detections, model=learn_motion(detections, counts=300, tuning=tuning), least=3, tuning=tuning)
    pure, whole = named(found, truth)
    assert pure.all() and whole.sum() == 3


def test_probabilities_of_exposure_patterns_sum_to_one():
    model = MotionModel(p_detect=0.8)
    p = [np.exp(model.log_pattern(np.array([sum(one)]), np.array([4])))[0] for one in product((0, 1), repeat=4)]
    assert abs(sum(p) - 1.0) < 1e-12
    three = sum(v for v, one in zip(p, product((0, 1), repeat=4), strict=True) if sum(one) >= 3)
    assert abs(model.tracked(np.array([4]))[0] - three) < 1e-12
    both = np.exp(model.log_pattern(np.array([2]), np.array([2])))[0]
    assert abs(model.tracked(np.array([2]))[0] - both) < 1e-12


@pytest.mark.parametrize("p", [0.5, 0.9])
def test_the_detection_probability_is_learned_from_movers_with_three_detections(p):
    rng = np.random.default_rng(5)
    shown = rng.binomial(5, p, 4_000)
    shown = shown[shown >= 3]
    assert abs(detection_probability(np.ones(len(shown)), shown, np.full(len(shown), 5), 0.7) - p) < 0.02


@pytest.mark.slow
def test_clustered_false_detections_are_no_movers():
    """Halos of bright stars give many false detections on every exposure, without more movers."""
    for seed in (41, 42):
        detections, truth = night(seed, movers=5, false=150, p_detect=1.0, crowds=40)
        pure, _ = named(find_movers(detections, least=3), truth)
        assert pure.all() and len(pure) == 5


def test_drifting_warm_pixels_are_no_movers():
    """Fifty warm pixels under a steady drift share one rate, unlike asteroids; five asteroids are still found."""
    rate = np.concatenate([np.array([[-0.5, 0.21]]) + np.linspace(-0.2, 0.2, 5)[:, None], np.full((50, 2), 0.3)])
    detections, truth = night(50, movers=55, rate=rate, p_detect=1.0)
    found = find_movers(detections, least=3)
    assert found.same_rate >= 48
    assert sorted(truth[found.members[:, 0]].tolist()) == [0, 1, 2, 3, 4]


MJD = 57388.625 + np.array([0.0, 0.01])  # 2016-01-01T15:00


def at(table, sigma=0.2, **keywords):
    """The times read from a table of two detections, and the line on how."""
    columns = Table({"ra": [10.0, 10.0], "dec": [5.0, 5.0], **table}, meta=keywords)
    seen, lines = detections_of([Catalogue.of(columns, "night", options=CatalogueOptions(sigma=sigma))])
    return seen.mjd_utc, lines[0]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"date_obs": ["2016-01-01"] * 2, "UT": 24.0 * (MJD % 1.0)}, "date_obs (dates and UT [h], UTC)"),
        ({"date": ["2016-01-01"] * 2, "time": ["15:00:00", "15:14:24"]}, "date (dates and time [h], UTC)"),
        ({"mjd": [57388, 57388], "utc": 86400.0 * (MJD % 1.0)}, "mjd (MJD and utc [s], UTC)"),
        ({"jd": MJD + 0.5}, "jd (JD − 2400000, UTC)"),
        ({"JD-2450000": MJD - 49999.5}, "JD-2450000 (days since JD 2450000, UTC)"),
        ({"MJD-50000": MJD - 50000.0}, "MJD-50000 (days since JD 2450000.5, UTC)"),
    ],
)
def test_a_date_with_a_clock_beside_it_is_a_time(table, words):
    """Both were taken for one exposure, or refused; the last was read as MJD, twelve hours late."""
    mjd, line = at(table)
    np.testing.assert_allclose(mjd, MJD, atol=1e-9)
    assert words in line


def test_days_without_a_time_of_day_are_refused():
    with pytest.raises(InputError, match="holds days without a time of day") as refused:
        at({"date_obs": ["2016-01-01", "2016-01-02"]})
    assert "time" in str(refused.value)


@pytest.mark.parametrize("unit", ["s", None])
def test_times_of_event_files_count_from_the_zero_of_the_header(unit):
    seconds = Column((MJD - 50814.0) * 86400.0, unit=unit)
    mjd, line = at({"TIME": seconds}, MJDREF=50814.0, TIMESYS="TT", TIMEUNIT="s")
    np.testing.assert_allclose((MJD - mjd) * 86400.0, 68.184, atol=1e-3)
    assert "elapsed times since MJDREF of TT, turned into UTC" in line


def test_the_scale_of_the_header_is_kept():
    """Times of TAI were read as UTC."""
    mjd, line = at({"mjd": MJD}, TIMESYS="TAI")
    np.testing.assert_allclose((MJD - mjd) * 86400.0, 36.0, atol=1e-3)
    assert "MJD of TAI, turned into UTC" in line


@pytest.mark.parametrize(("name", "kind"), [("HJD", "heliocentric"), ("BJD_TDB", "barycentric")])
def test_times_at_the_sun_become_those_at_the_earth(name, kind):
    """Checked with astropy's light travel time."""
    place = EarthLocation.from_geocentric(0.0, 0.0, 0.0, unit="m")
    time = Time(MJD, format="mjd", scale="utc", location=place)
    with iers.conf.set_temp("auto_download", False):  # the rotation of the Earth does not matter at its centre
        later = time.light_travel_time(SkyCoord(10.0, 5.0, unit="deg"), kind, ephemeris="builtin")
    there = time + later if kind == "heliocentric" else time.tdb + later
    mjd, line = at({name: there.jd})
    assert np.abs(later.sec).min() > 5.0
    np.testing.assert_allclose((mjd - MJD) * 86400.0, 0.0, atol=0.05)
    assert "turned into UTC at the Earth" in line
