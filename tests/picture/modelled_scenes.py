"""Small scenes with known truth: named tracks with autocorrelated errors, plots without names, directions."""

import numpy as np

from sameas.picture import LivePicture
from sameas.tracks.reports import Reports
from sameas.tracks.scene import Scene
from sameas.tracks.source import Clutter, Description, MissRate, Motion, SensorCoverage, SensorErrors, Site, Timing

WALK = Motion(0.01, 8.0)


def describe(name, kind, sigma_m=20.0, period_s=10.0, clutter_per_km2=0.0, q=0.1):
    return Description(
        name, kind, site=Site(east_m=0.0, north_m=0.0), coverage=SensorCoverage(range_m=1e5),
        misses=MissRate(q), motion=WALK, clutter=Clutter(clutter_per_km2), timing=Timing(period_s, 0.0, 0.0),
        errors=SensorErrors(position_m=sigma_m, speed_m_per_s=0.3, course_deg=3.0, extent_m=0.0),
    )  # fmt: skip


def wandering(rng, n, looks, every_s, tau_s, sigma_m):
    """(n, looks, 2) errors with correlation time tau_s."""
    error = sigma_m * rng.standard_normal((n, looks, 2))
    rho = np.exp(-every_s / tau_s) if tau_s > 0.0 else 0.0
    for k in range(1, looks):
        error[:, k] = rho * error[:, k - 1] + np.sqrt(1.0 - rho**2) * error[:, k]
    return error


def feed(rng, description, times_s, position, velocity, tau_s, names=None, extra=None, sigma_m=None):
    """A description with reports of objects (n, k, 2) at times (k,), with its errors; ``names`` (n,) of their tracks.
    sigma_m : 1σ of the position errors if it differs from the described one."""
    n, scans = position.shape[:2]
    sigma = description.errors.position_m if sigma_m is None else sigma_m
    every = times_s[1] - times_s[0] if len(times_s) > 1 else 1.0
    x = position + wandering(rng, n, scans, every, tau_s, sigma)
    v = velocity + description.errors.speed_m_per_s * rng.standard_normal(velocity.shape)
    columns = {"time_s": np.tile(times_s, n), "x_m": x[..., 0].ravel(), "y_m": x[..., 1].ravel()}
    columns |= {"vx_m_per_s": v[..., 0].ravel(), "vy_m_per_s": v[..., 1].ravel()}
    if names is not None:
        columns["track_id"] = np.repeat(np.asarray(names, object), scans)
    for name, values in (extra or {}).items():
        columns[name] = np.repeat(np.asarray(values, object), scans)
    return description, Reports.of(description.name, "table", columns)


def straight(start, velocity, times_s):
    """(n, k, 2) positions and velocities of objects on straight courses."""
    start, velocity = np.asarray(start, float), np.asarray(velocity, float)
    position = start[:, None] + times_s[None, :, None] * velocity[:, None]
    return position, np.broadcast_to(velocity[:, None], position.shape)


def two_meet(seed, gap_m, side_by_side=False, swap_s=None, tau_s=60.0):
    """Two objects on opposite or parallel courses, observed by a tracking radar every 10 s and AIS every 30 s."""
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, 301.0, 10.0)
    course = [[4.0, 0.0], [4.0 if side_by_side else -4.0, 0.0]]
    start = [[-600.0, gap_m / 2.0], [-600.0 if side_by_side else 600.0, -gap_m / 2.0]]
    x, v = straight(start, course, times)
    radar, ais = describe("radar", "tracks"), describe("ais", "ais", period_s=30.0)
    x_radar, v_radar = x.copy(), v.copy()
    if swap_s is not None:
        late = times >= swap_s
        x_radar[:, late], v_radar[:, late] = x[::-1, late], v[::-1, late]
    sources = [
        feed(rng, radar, times, x_radar, v_radar, tau_s, ["r0", "r1"]),
        feed(rng, ais, times[::3], x[:, ::3], v[:, ::3], 600.0, ["a0", "a1"], {"mmsi": ["235000000", "235000001"]}),
    ]
    return Scene.of(sources), times


def beside(seed, gap_m, sigma_m=(30.0, 8.0), stated_m=(30.0, 8.0), radar_sees_it=False, others=5, minutes=18.0):
    """A ship "a0" that AIS names; the radar sees another, silent one beside it ("r1"), or the ship itself. Both sources
    see ``others``, far off. sigma_m, stated_m : 1σ of the radar's errors, which last 20 s, and of AIS, 300 s."""
    rng = np.random.default_rng(seed)
    times, n = np.arange(0.0, 60.0 * minutes, 3.0), others + 2
    angle = rng.uniform(0.0, 2.0 * np.pi, n)
    start, course = rng.uniform(-4e3, 4e3, (n, 2)), 4.0 * np.column_stack([np.cos(angle), np.sin(angle)])
    start[0], course[:2] = [-2000.0, 3000.0], [4.0, 0.0]
    start[1] = start[0] if radar_sees_it else start[0] + [0.0, gap_m]
    x, v = straight(start, course, times)
    radar, ais = describe("radar", "tracks", stated_m[0], 3.0), describe("ais", "ais", stated_m[1], 10.0)
    by_radar, by_ais = np.arange(1, n), np.delete(np.arange(n), 1)
    names, mmsi = [[f"{letter}{k}" for k in by] for letter, by in (("r", by_radar), ("a", by_ais))], by_ais + 235000000
    return Scene.of([
        feed(rng, radar, times, x[by_radar], v[by_radar], 20.0, names[0], sigma_m=sigma_m[0]),
        feed(rng, ais, times[::3], x[by_ais, ::3], v[by_ais, ::3], 300.0, names[1], {"mmsi": mmsi.astype(str)},
             sigma_m=sigma_m[1]),
    ])  # fmt: skip


def watched_live(sources, times_s):
    """The live picture after instants ten seconds apart, which takes the reports between them as they come."""
    live = LivePicture([description for description, _ in sources])
    for now_s in times_s:
        for description, reports in sources:
            live.add(description.name, reports.where((reports.time_s > now_s - 10.0) & (reports.time_s <= now_s)))
        live.advance(now_s)
    return live
