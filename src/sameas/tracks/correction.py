"""Correction: reports without the biases of their source, and with the uncertainty of what was taken off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from sameas.records import FloatArray
from sameas.tracks.alignment import States
from sameas.tracks.biases import AZIMUTH, BIASES, TIME, BiasModel
from sameas.tracks.placement import Directions

#: Of biases that are known.
CERTAIN = np.zeros((len(BIASES), len(BIASES)))


def corrected(
    reports: States | Directions, sensor_m: FloatArray | None, biases: FloatArray, covariance: FloatArray = CERTAIN
) -> States | Directions:
    """What the source would have reported without its biases.

    Covariances go along: what was certain along the line of sight is certain along the true one. The uncertainty of the
    biases is added to each report's; that it is the same for all reports of the source is not kept.

    Parameters
    ----------
    sensor_m : (n, 2) where the sensor was at each report; None for a source without a site, which has no range and
        azimuth biases.
    biases, covariance : (6,) and (6, 6), in the order of :data:`sameas.tracks.biases.BIASES`.
    """
    time_s = reports.time_s - biases[TIME]
    if isinstance(reports, Directions):
        sigma = np.hypot(reports.sigma_deg, np.sqrt(covariance[AZIMUTH, AZIMUTH]))
        bearing = (reports.bearing_deg - biases[AZIMUTH]) % 360.0
        return replace(reports, time_s=time_s, bearing_deg=bearing, sigma_deg=sigma)
    known = reports.usable
    state, spread = reports.state.copy(), reports.covariance.copy()
    model = BiasModel(None if sensor_m is None else sensor_m[known])
    # The stamps were put right: nothing is left for them to move.
    untimed = np.where(np.arange(len(BIASES)) == TIME, 0.0, biases)
    true = model.undone(state[known, :2], state[known, 2:], untimed)
    turn = np.zeros((len(true.place), 4, 4))
    turn[:, :2, :2] = turn[:, 2:, 2:] = true.by_place
    state[known] = np.einsum("nvw,nw->nv", turn, state[known])
    state[known, :2] = true.place
    grown = turn @ spread[known] @ turn.transpose(0, 2, 1)
    grown[:, :2, :2] += true.by_bias @ covariance @ true.by_bias.transpose(0, 2, 1)
    spread[known] = 0.5 * (grown + grown.transpose(0, 2, 1))
    return replace(reports, time_s=time_s, state=state, covariance=spread)
