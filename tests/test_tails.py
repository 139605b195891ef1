"""The tail of the errors: none if all errors are too small by one factor, otherwise its share within its error."""

import numpy as np
import pytest

from sameas import Records
from sameas.estimate.error_model import tail
from sameas.estimate.match import match
from sameas.simulate.scenes import poisson_field


def found(seed, *, share, times, quoted=1.0):
    """The estimated tail if a ``share`` of the first source's records has errors larger than quoted by a factor."""
    rng = np.random.default_rng(seed)
    scene = poisson_field(rng, density=2e-4, extent=(4500.0, 4500.0), q1=0.1, q2=0.1, sigma_1=0.5, sigma_2=0.05)
    far = rng.uniform(size=len(scene.first)) < share
    more = np.sqrt(times**2 - 1.0) * 0.5 * rng.standard_normal((len(far), 2)) * far[:, None]
    first = Records.of(scene.first.features + more, sigma=0.5 / quoted, source="first")
    second = Records.of(scene.second.features, sigma=0.05 / quoted, source="second")
    answer, estimate = match(first, second)
    return tail(answer, estimate.errors)


@pytest.mark.parametrize("quoted", [0.6, 1.0, 1.7])
def test_errors_all_wrong_by_one_factor_have_no_tail(quoted):
    beyond = found(1, share=0.0, times=1.0, quoted=quoted)
    assert beyond is None or beyond.share.value < 0.002


@pytest.mark.slow
def test_the_share_of_the_tail_is_found_within_its_standard_error():
    tails = [found(seed, share=0.04, times=6.0) for seed in range(40)]
    pull = np.array([(one.share.value - 0.04) / one.share.standard_error for one in tails])
    assert abs(pull.mean()) < 0.8 and 0.75 < np.std(pull) < 1.3
    assert 5.0 < np.mean([one.factor for one in tails]) < 7.5


@pytest.mark.slow
def test_a_tail_is_found_on_top_of_errors_that_are_too_small():
    beyond = found(3, share=0.05, times=6.0, quoted=1.7)
    assert abs(beyond.share.value - 0.05) < 4.0 * beyond.share.standard_error
    assert 8.0 < beyond.factor < 13.0
