"""Objects that only plots without track numbers show: what is scored, of a picture and of Stone Soup's tracker."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta

import numpy as np

from sameas.picture import Picture, instants
from sameas.tracks.scene import Scene

#: The numbers (n,) and the places (n, 2) of the confirmed objects at a time.
Shown = Callable[[float], tuple[np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class Scoring:
    """What is scored.

    times : of the instants. true : places (k, 2) of all real objects at a time, of which the last ``scored`` count.
    near_m, far_m : metres within which an object is of a real one, and beyond which it is of none.
    """

    times: np.ndarray
    true: Callable[[float], np.ndarray]
    scored: int
    near_m: float
    far_m: float

    def __call__(self, shown: Shown) -> tuple[float, float, float]:
        """Percent of the scored objects shown, numbers an object, and false objects an instant."""
        found, false, n = np.zeros(self.scored), 0, len(self.times)
        used: list[set[int]] = [set() for _ in range(self.scored)]
        for t in self.times.tolist():
            number, place = shown(t)
            off = np.linalg.norm(place[:, None] - self.true(t), axis=2)
            false += int((off > self.far_m).all(axis=1).sum())
            near = off[:, -self.scored :] < self.near_m
            found += near.any(axis=0)
            for k in range(self.scored):
                used[k].update(number[near[:, k]].tolist())
        return 100.0 * float(found.mean()) / n, float(np.mean([len(each) for each in used])), false / n


def of_picture(scene: Scene, every_s: float) -> Shown:
    """The objects of the picture of a scene."""
    objects = Picture.of(scene, instants(scene.span_s, every_s=every_s)).objects
    confirmed = np.isin(objects["stage"], ("confirmed", "coasting"))
    time_s, number = np.asarray(objects["time_s"]), np.asarray(objects["object"])
    place = np.column_stack([objects["x_m"], objects["y_m"]])

    def shown(t: float) -> tuple[np.ndarray, np.ndarray]:
        here = np.flatnonzero((time_s == t) & confirmed)
        return number[here], place[here]

    return shown


@dataclass(frozen=True)
class StoneSoup:
    """Stone Soup's tracker of plots: global nearest neighbour, tracks of three plots or more.

    walk, speed_m_per_s : power density of the velocity walk, m²/s³, and 1σ of velocities. sigma_m : of plots at the
    begin of a track. gate_sigmas : of the gate. scans : without a plot after which a track ends.
    """

    walk: float
    speed_m_per_s: float
    sigma_m: float
    gate_sigmas: float
    scans: int

    def __call__(
        self, scans: Iterable[tuple[float, np.ndarray, np.ndarray]]
    ) -> list[tuple[float, np.ndarray, np.ndarray]]:
        """Times, numbers (n,) and states (n, 4: east, its speed, north, its speed) of the tracks after each of scans:
        times, places (m, 2) and covariances (m, 2, 2) of plots."""
        from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
        from stonesoup.deleter.time import UpdateTimeStepsDeleter
        from stonesoup.hypothesiser.distance import DistanceHypothesiser
        from stonesoup.initiator.simple import MultiMeasurementInitiator
        from stonesoup.measures import Mahalanobis
        from stonesoup.models.measurement.linear import LinearGaussian
        from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
        from stonesoup.predictor.kalman import KalmanPredictor
        from stonesoup.tracker.simple import MultiTargetTracker
        from stonesoup.types.detection import Detection
        from stonesoup.types.state import GaussianState
        from stonesoup.updater.kalman import KalmanUpdater

        began = datetime(2026, 1, 1)
        model = LinearGaussian(4, (0, 2), self.sigma_m**2 * np.eye(2))
        predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(self.walk)] * 2))
        updater, missed = KalmanUpdater(model), self.gate_sigmas
        associator = GNNWith2DAssignment(
            DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=missed)
        )
        deleter, variance = UpdateTimeStepsDeleter(self.scans), self.speed_m_per_s**2
        prior = GaussianState(np.zeros((4, 1)), np.diag([0.0, variance, 0.0, variance]), timestamp=began)
        initiator = MultiMeasurementInitiator(prior, deleter, associator, updater, model, min_points=3)

        def detections() -> Iterator[tuple[datetime, set[Detection]]]:
            for t, places, covariances in scans:
                now = began + timedelta(seconds=t)
                yield (
                    now,
                    {
                        Detection(
                            place[:, None], timestamp=now, measurement_model=LinearGaussian(4, (0, 2), covariance)
                        )
                        for place, covariance in zip(places, covariances, strict=True)
                    },
                )

        out, numbers = [], dict[str, int]()
        for now, tracks in MultiTargetTracker(initiator, deleter, detections(), associator, updater):
            ordered = sorted(tracks, key=lambda track: track.id)
            number = np.array([numbers.setdefault(track.id, len(numbers)) for track in ordered], np.int64)
            state = np.array([track.state_vector[:, 0] for track in ordered], np.float64).reshape(-1, 4)
            out.append(((now - began).total_seconds(), number, state))
        return out
