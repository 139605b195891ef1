"""A flood of reports leaves no memory behind: a live feed gives its rows back, and all tracks stay the same."""

import numpy as np

from sameas.tracks import Description
from sameas.tracks.live_feed import LiveFeed, LiveTuning
from sameas.tracks.reports import Reports

SHIPS = np.array([[500.0 * k, 0.0] for k in range(5)])


def reports(t, names, place):
    columns = {"time_s": np.full(len(names), t), "x_m": place[:, 0], "y_m": place[:, 1], "mmsi": names}
    columns |= {"vx_m_per_s": np.full(len(names), 1.0), "vy_m_per_s": np.zeros(len(names))}
    return Reports.of("ais", "ais", columns)


def current(feed, t):
    """By the name of each track that has not ended, its row, time and state at an instant."""
    made = feed.feed(t)
    rows = made.succession.at(t)
    rows = rows[t - made.reports.time_s[rows] <= made.timeouts_s(rows)]
    feed.release()
    found = {}
    for row in rows.tolist():
        found[made.reports.track[row]] = (made.reports.time_s[row], *np.round(made.reports.state[row], 9).tolist())
    return found, dict(zip(made.reports.track[rows].tolist(), rows.tolist(), strict=True))


def test_a_flood_of_forged_ships_leaves_a_small_table_and_the_same_tracks():
    shrinks, grows = (LiveFeed(Description("ais", "ais"), live=LiveTuning(id_timeout_s=900.0, least_rows=least))
                      for least in (64, 1 << 30))  # fmt: skip
    rng, sizes, before = np.random.default_rng(2), [], ({}, {})
    forged = rng.uniform(-5e4, 5e4, (400, 2))
    for t in np.arange(0.0, 2200.0, 5.0):
        moved = np.array([t, 0.0])
        batch = [reports(t, [f"23500000{k}" for k in range(5)], SHIPS + moved + rng.normal(0.0, 2.0, (5, 2)))]
        if 50.0 <= t < 80.0:
            batch.append(reports(t, [f"9{k:08d}" for k in range(400)], forged + moved))
        if t == 800.0:
            # One of them comes back after its track has ended: its filter goes on from its last report.
            batch.append(reports(t, ["900000007"], forged[7:8] + moved))
        for one in batch:
            shrinks.add(one)
            grows.add(one)
        (found, rows), (expected, _) = current(shrinks, t), current(grows, t)
        assert found == expected
        # A report that stays current keeps its row, and no track has the row of another one at the next instant.
        known, held = before
        assert all(rows[name] == held[name] for name in rows if name in held and found[name] == known[name])
        owner = {row: name for name, row in held.items()}
        assert all(owner.get(row, name) == name for name, row in rows.items())
        before = found, rows
        sizes.append(len(shrinks._rows))
    assert max(sizes) > 1000 and sizes[-1] <= 128 < len(grows._rows)
    assert shrinks.counts == grows.counts
