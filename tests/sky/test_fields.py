"""Catalogues of disjoint fields raise a doubt that names columns possibly misread."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from astropy.table import Table

from sameas.sky.catalogue import Catalogue
from sameas.sky.crossmatch import match


def _field(n: int = 200) -> dict[str, Any]:
    rng = np.random.default_rng(4)
    return {
        "ra": 20.0 + rng.uniform(0.0, 0.5, n),
        "dec": 41.0 + rng.uniform(0.0, 0.4, n),
        "sigma_arcsec": np.full(n, 0.1),
    }


@pytest.mark.parametrize(
    ("misread", "words"),
    [
        (lambda ra, dec: (ra / 15.0, dec), "in hours, ra of two would lie in the field of one: give the column"),
        (lambda ra, dec: (np.radians(ra), np.radians(dec)), "in radians, ra and dec of two would lie in the field"),
        (lambda ra, dec: (dec, ra), "exchanged, ra and dec of two would lie in the field of one: give ra2=dec dec2=ra"),
        (lambda ra, dec: (ra, -dec), "with the other sign, dec of two would lie in the field of one: were its signs"),
        (lambda ra, dec: (ra + 3.0, dec), "do they show the same part of the sky?"),
    ],
)
def test_disjoint_fields_raise_a_doubt_with_possible_misreadings(misread: Any, words: str) -> None:
    first = _field()
    ra, dec = misread(first["ra"], first["dec"])
    second = {**first, "ra": ra, "dec": dec}
    for swapped in (False, True):
        tables = (second, first) if swapped else (first, second)
        names = ("two", "one") if swapped else ("one", "two")
        one, two = (Catalogue.of(table, name) for table, name in zip(tables, names, strict=True))
        found = match(one, two)
        doubts = [line for line in map(str, found.doubts) if line.startswith("the fields lie apart: ")]
        assert len(doubts) == 1 and not any("offset='find'" in str(line) for line in found.doubts)
        wanted = words.partition(",")[0] if swapped else words
        assert wanted in doubts[0] or (swapped and "do they show" in doubts[0])


@pytest.mark.slow
def test_a_common_field_without_common_objects_is_not_reported_as_disjoint() -> None:
    first, second = _field(), _field()
    second["ra"] = second["ra"] + 0.01
    assert not any(
        "lie apart" in line for line in match(Catalogue.of(first, "one"), Catalogue.of(second, "two")).doubts
    )


@pytest.mark.parametrize("name", ["ra_h", "ra_hr", "RA_HRS", "ra_hours", "RA [h]", "RA (hours)"])
def test_a_column_named_hours_is_in_hours(name: str) -> None:
    table = Table({name: [1.0, 23.0], "dec": [1.0, 2.0], "sigma_arcsec": [0.1, 0.1]})
    np.testing.assert_allclose(Catalogue.of(table, "one").astrometry.ra_deg, [15.0, 345.0])
