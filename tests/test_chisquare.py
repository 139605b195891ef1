"""The closed forms of χ² quantiles agree with SciPy."""

import pytest
from scipy.stats import chi2

from sameas.gate.gate import quantile, upper_quantile


@pytest.mark.parametrize("d", [1, 2, 3, 4, 6])
@pytest.mark.parametrize("share", [1e-12, 0.01, 0.5, 0.99])
def test_quantiles_are_those_of_the_distribution(d, share):
    assert quantile(share, d) == pytest.approx(chi2.ppf(share, d), rel=1e-9)
    assert upper_quantile(share, d) == pytest.approx(chi2.isf(share, d), rel=1e-9)
