"""One small field of two surveys."""

import pytest
from guises import Field


@pytest.fixture(scope="session")
def stars():
    """The field of two surveys."""
    return Field()


@pytest.fixture(scope="session")
def in_memory(stars):
    """A match of two dicts."""
    import sameas

    return sameas.match(stars.first, stars.second, sigma=0.05)
