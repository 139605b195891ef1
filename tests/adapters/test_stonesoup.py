"""Stone Soup adapter: sets of tracks in, associations of identify_many out."""

from __future__ import annotations

import datetime

import numpy as np
import pytest

from sameas.errors import InputError

pytest.importorskip("stonesoup", reason="the extra sameas[stonesoup] is not installed")

from stonesoup.dataassociator.base import TrackToTrackAssociator
from stonesoup.dataassociator.tracktotrack import OneToOneTrackAssociator
from stonesoup.measures import Mahalanobis
from stonesoup.measures.base import TrackMeasure
from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
from stonesoup.predictor.kalman import KalmanPredictor
from stonesoup.types.state import GaussianState
from stonesoup.types.track import Track

from sameas.adapters.stonesoup import ProbableAssociation, SameasAssociator

START = datetime.datetime(2026, 1, 1)
MODEL = CombinedLinearGaussianTransitionModel([ConstantVelocity(0.01), ConstantVelocity(0.01)])


def tracks_of(rng, states, sigma, at_s, names):
    """A track of two states for each object; positions east and north in metres, velocities in metres per second."""
    covariance = np.diag([sigma**2, 0.04, sigma**2, 0.04])
    made = []
    for state, name in zip(states, names, strict=True):
        track = Track(id=name)
        for time_s in (at_s - 10.0, at_s):
            mean = state + np.array([state[1], 0.0, state[3], 0.0]) * time_s
            mean = mean + rng.multivariate_normal(np.zeros(4), covariance)
            stamp = START + datetime.timedelta(seconds=time_s)
            track.append(GaussianState(mean[:, None], covariance, timestamp=stamp))
        made.append(track)
    return made


def scene(seed, number=20):
    rng = np.random.default_rng(seed)
    states = np.column_stack([rng.uniform(0, 6000, number), rng.normal(0, 6, number),
                              rng.uniform(0, 6000, number), rng.normal(0, 6, number)])  # fmt: skip
    return rng, states


def names_of(associations):
    return {frozenset(track.id for track in one.objects) for one in associations}


@pytest.mark.slow
def test_tracks_of_different_times_are_aligned_by_the_predictor():
    rng, states = scene(1)
    radar = tracks_of(rng, states[:17], 25.0, 0.0, [f"r{k}" for k in range(17)])
    ais = tracks_of(rng, states[3:], 10.0, 7.5, [f"a{k}" for k in range(3, 20)])
    associator = SameasAssociator(mapping=[0, 2], predictor=KalmanPredictor(MODEL))
    assert isinstance(associator, TrackToTrackAssociator)
    found = associator.associate_tracks(set(radar), set(ais))
    assert names_of(found) == {frozenset((f"r{k}", f"a{k}")) for k in range(3, 17)}
    for one in found:
        assert isinstance(one, ProbableAssociation) and 0.5 < one.probability <= 1.0
        assert one.timestamp == START + datetime.timedelta(seconds=7.5)  # the latest state of all
    associated, (alone_radar, alone_ais) = associator.associated_and_unassociated_tracks(set(radar), set(ais))
    assert len(associated) == 14 and {track.id for track in alone_radar} == {"r0", "r1", "r2"}
    assert {track.id for track in alone_ais} == {"a17", "a18", "a19"}


def test_three_sets_are_associated_jointly_in_any_order():
    rng, states = scene(2, 12)
    sets = [
        tracks_of(rng, states[rows], sigma, 0.0, [f"{letter}{k}" for k in rows])
        for letter, sigma, rows in (("r", 30.0, range(10)), ("a", 10.0, range(2, 12)), ("l", 5.0, range(4, 8)))
    ]
    associator = SameasAssociator(mapping=[0, 2])
    found = {
        frozenset(track.id for track in one.objects): one.probability for one in associator.associate_tracks(*sets)
    }
    turned = associator.associate_tracks(*sets[::-1])
    assert {frozenset(track.id for track in one.objects): pytest.approx(one.probability) for one in turned} == found
    assert frozenset(("r5", "a5", "l5")) in found and frozenset(("r2", "a2")) in found


@pytest.mark.slow
def test_no_tuned_threshold_is_needed():
    """Their one-to-one associator within nine standard deviations, of the first track's covariance, and ours."""

    class LastMahalanobis(TrackMeasure):
        def __call__(self, one, other):
            return Mahalanobis(mapping=[0, 2])(other[-1], one[-1])

    ours, theirs = 0, 0
    for seed in range(20):
        rng, states = scene(100 + seed, 40)
        states[:, [0, 2]] *= 0.25  # crowded: neighbours about 120 m apart
        radar = tracks_of(rng, states[:34], 40.0, 0.0, [f"r{k}" for k in range(34)])
        ais = tracks_of(rng, states[6:], 10.0, 0.0, [f"a{k}" for k in range(6, 40)])
        right = {frozenset((f"r{k}", f"a{k}")) for k in range(6, 34)}
        here = names_of(SameasAssociator(mapping=[0, 2], missed=0.15).associate_tracks(radar, ais))
        there = OneToOneTrackAssociator(measure=LastMahalanobis(), association_threshold=9.0)
        others = names_of(there.associate_tracks(set(radar), set(ais)))
        ours += len(here ^ right)
        theirs += len(others ^ right)
    assert ours < theirs


def test_unsupported_input_is_refused():
    rng, states = scene(3, 6)
    radar, ais = (tracks_of(rng, states, 10.0, at, [f"{at}-{k}" for k in range(6)]) for at in (0.0, 5.0))
    with pytest.raises(InputError, match="give a predictor"):
        SameasAssociator(mapping=[0, 2]).associate_tracks(radar, ais)
    with pytest.raises(InputError, match="two sets of tracks or more"):
        SameasAssociator(mapping=[0, 2]).associate_tracks(radar)
    assert len(SameasAssociator(mapping=[0, 2]).associate_tracks(set(), set())) == 0
    assert len(SameasAssociator(mapping=[0, 2]).associate_tracks(radar, set())) == 0
