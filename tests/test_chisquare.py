"""The closed forms of χ² are the distribution."""

import numpy as np
import pytest
from scipy.stats import chi2

from sameas.gate.chisquare import quantile, share_within, upper_quantile


@pytest.mark.parametrize("d", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("share", [1e-12, 0.01, 0.5, 0.99])
def test_quantiles_and_shares_are_those_of_the_distribution(d, share):
    assert quantile(share, d) == pytest.approx(chi2.ppf(share, d), rel=1e-9)
    assert upper_quantile(share, d) == pytest.approx(chi2.isf(share, d), rel=1e-9)
    for square in np.geomspace(1e-3, 60.0, 7):
        assert share_within(square, d) == pytest.approx(chi2.cdf(square, d), rel=1e-9)
