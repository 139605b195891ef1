"""How long errors last is learned from a source's own tracks, however restless its objects are said to be."""

import numpy as np
import pytest
from modelled_scenes import describe, straight, told

from sameas.picture import Past
from sameas.picture.scan import Scan
from sameas.picture.tuning import Tuning
from sameas.tracks.scene import Scene


def learned(tau_s, kind="tracks", seed=1, looks=25, every_s=10.0, given=None):
    """ρ at the looks' interval, as learned of 40 tracks whose errors last for tau_s."""
    rng = np.random.default_rng(seed)
    times = np.arange(looks) * every_s
    x, v = straight(rng.uniform(-9e3, 9e3, (40, 2)), 4.0 * rng.standard_normal((40, 2)), times)
    scene = Scene.of([told(rng, describe("one", kind), times, x, v, tau_s, [str(k) for k in range(40)])])
    past = Past(correlation_s=given or {})
    for time_s in times:
        past = past.on(Scan.of(scene.at(time_s)))
    return float(past.tracks.error_correlation.rho(np.zeros(1, np.int64), np.array([every_s]))[0])


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["tracks", "ais"])
@pytest.mark.parametrize("tau_s", [0.0, 12.0, 180.0])
def test_it_is_found_whatever_the_kind_is_believed_to_do(kind, tau_s):
    true = np.exp(-10.0 / tau_s) if tau_s else 0.0
    assert abs(learned(tau_s, kind) - true) < 0.12


def test_what_the_user_says_is_not_learned():
    assert learned(180.0, given={"one": 0.0}) == 0.0
    assert learned(0.0, given={"one": 30.0}) == pytest.approx(np.exp(-1.0 / 3.0))


def test_before_any_look_the_kind_decides():
    rng = np.random.default_rng(2)
    x, v = straight([[0.0, 0.0]], [[4.0, 0.0]], np.zeros(1))
    scene = Scene.of([told(rng, describe(name, name), np.zeros(1), x, v, 0.0, ["7"]) for name in ("ais", "air radar")])
    lasting = Past().on(Scan.of(scene.at(0.0))).tracks.error_correlation
    ais, radar = (lasting.rho(np.array([lasting.names.index(n)]), np.array([10.0]))[0] for n in ("ais", "air radar"))
    assert lasting.log_probable.shape == (2, len(Tuning().correlation_s)) and ais > 0.75 and radar < ais - 0.2
