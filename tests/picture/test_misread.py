"""Sources that a doubt says are read wrongly: what only they show is not confirmed."""

import numpy as np
import pytest

import sameas

N, SPAN_S = 8, 240.0


def sources_of(seed, wrong):
    """Ships with AIS, and a radar's plots of them, and of one boat more; wrong : with angles from the east."""
    rng = np.random.default_rng(seed)
    start, velocity = rng.uniform(-4000.0, 4000.0, (N + 1, 2)), rng.normal(0.0, 4.0, (N + 1, 2))
    ais, radar = [], []
    for t in np.arange(0.0, SPAN_S, 3.0):
        place = start + velocity * t
        for k in np.flatnonzero(rng.random(N + 1) < 0.9).tolist():
            bearing = np.degrees(np.arctan2(*place[k])) + 0.3 * rng.normal()
            radar.append((t, np.hypot(*place[k]) + 15.0 * rng.normal(), (90.0 - bearing if wrong else bearing) % 360.0))
        for k in range(N) if t % 9.0 == 0.0 else ():
            ais.append((t + 0.3 * k, f"23500000{k}", *(place[k] + 5.0 * rng.normal(size=2)), *velocity[k]))
    columns = zip(*ais, strict=True)
    named = dict(zip(("time_s", "mmsi", "x_m", "y_m", "vx_m_per_s", "vy_m_per_s"), map(list, columns), strict=True))
    plots = dict(zip(("time_s", "range_m", "bearing_deg"), np.array(radar).T, strict=True))
    return {"ais": named, "radar": plots}


@pytest.mark.slow
@pytest.mark.parametrize("wrong", [True, False])
def test_what_only_a_misread_radar_shows_is_not_confirmed(wrong, tmp_path):
    """A radar whose bearings were angles from the east showed nine confirmed objects beside the doubt that says so."""
    toml = tmp_path / "sensors.toml"
    toml.write_text('[sources.radar]\nkind = "marine radar"\nsite = { east_m = 0, north_m = 0 }\n')
    found = sameas.match_picture(sources_of(1, wrong), sensors=toml, every=15.0, registration=False)
    assert any("look exchanged" in doubt and "unless it is radar" in doubt for doubt in found.doubts) == wrong
    objects = found.table
    late = objects[objects["time_s"] == objects["time_s"].max()]
    alone = late[late["sources"] == "radar"]
    assert int(np.isin(alone["stage"], ("confirmed", "coasting")).sum()) == (0 if wrong else 1)
    assert len(alone) >= 8 if wrong else len(alone) >= 1
    assert int((late["stage"] == "confirmed").sum()) == N + (not wrong)
