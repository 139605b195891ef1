"""A simulated harbour: ships on straight courses, radars with known biases, AIS."""

from dataclasses import dataclass

import numpy as np

from sameas.tracks import BiasPrior, Description, MissRate, Motion, Reports, Scene, SensorErrors, Site, Timing

WALK = Motion(0.01, 8.0)
SITES = ((0.0, -10e3), (9e3, -9e3))


@dataclass(frozen=True)
class Harbour:
    """Ships (n, 2) m and m/s; each source with its reports and the ship of each report (−1: none)."""

    start: np.ndarray
    velocity: np.ndarray
    sources: tuple[tuple[Description, Reports], ...]
    owners: tuple[np.ndarray, ...]

    @property
    def scene(self):
        return Scene.of(self.sources)


def harbour(seed, ships=40, *, biases=((50.0, 1.0, 3.0),), sigma=25.0, q=0.2, until_s=400.0, ais=True):
    """biases : for each radar range (m), azimuth (deg), lateness of time stamps (s)."""
    rng = np.random.default_rng(seed)
    start = rng.uniform(-1.0, 1.0, (ships, 2)) * [12e3, 9e3]
    course, speed = rng.uniform(0.0, 2.0 * np.pi, ships), rng.uniform(1.0, 10.0, ships)
    velocity = speed[:, None] * np.column_stack([np.sin(course), np.cos(course)])
    made = [
        _radar(rng, f"radar {k + 1}", SITES[k], bias, start, velocity, sigma, q, until_s)
        for k, bias in enumerate(biases)
    ]
    made += [_ais(rng, start, velocity, until_s)] if ais else []
    return Harbour(start, velocity, tuple(source for source, _ in made), tuple(owner for _, owner in made))


def _radar(rng, name, site, bias, start, velocity, sigma, q, until_s):
    turns = []
    for t in np.arange(0.0, until_s, 3.0):
        seen = np.flatnonzero(rng.random(len(start)) > q)
        false = rng.uniform(-12e3, 12e3, (rng.poisson(2.0), 2))
        arm = np.concatenate([start[seen] + t * velocity[seen], false]) - site
        owner = np.concatenate([seen, np.full(len(false), -1)])
        distance = np.hypot(*arm.T)
        bearing = np.degrees(np.arctan2(arm[:, 0], arm[:, 1]) + sigma / 12e3 * rng.standard_normal(len(arm)))
        read = distance + bias[0] + sigma * rng.standard_normal(len(arm))
        turns.append(np.column_stack([np.full(len(arm), t + bias[2]), read, bearing + bias[1], owner]))
    time_s, distance, bearing, owner = np.concatenate(turns).T
    description = Description(
        name, "marine radar", site=Site(east_m=site[0], north_m=site[1]), misses=MissRate(q), motion=WALK,
        errors=SensorErrors(sigma, 0.0, np.degrees(sigma / 12e3), extent_m=5.0), timing=Timing(3.0, None, 0.2),
        bias=BiasPrior(50.0, 1.0, 0.0, 3.0),
    )  # fmt: skip
    columns = {"time_s": time_s, "range_m": distance, "bearing_deg": bearing}
    return (description, Reports.of(name, "table", columns)), owner.astype(int)


def _ais(rng, start, velocity, until_s):
    rows = []
    for k in np.flatnonzero(rng.random(len(start)) > 0.15):
        for t in np.cumsum(rng.uniform(5.0, 60.0, 60)):
            if t < until_s:
                at = start[k] + t * velocity[k] + 8.0 * rng.standard_normal(2)
                rows.append([t, *at, *(velocity[k] + 0.2 * rng.standard_normal(2)), k])
    time_s, x, y, vx, vy, owner = np.array(rows).T
    description = Description(
        "ais", "ais", motion=WALK, errors=SensorErrors(position_m=10.0, extent_m=5.0), timing=Timing(10.0, 0.0, 0.5)
    )
    columns = {"time_s": time_s, "x_m": x, "y_m": y, "vx_m_per_s": vx, "vy_m_per_s": vy}
    columns["mmsi"] = np.array([f"{int(k):09d}" for k in owner], object)
    return (description, Reports.of("ais", "ais", columns)), owner.astype(int)
