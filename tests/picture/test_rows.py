"""The rows of a picture's tables, gathered over its instants."""

import numpy as np
import pytest
from numpy.typing import ArrayLike

from sameas.picture.rows import PACKED, GatheredRows, gathered


def rows_of(k):
    rng = np.random.default_rng(k)
    n = k % 4
    number = np.ma.MaskedArray(rng.normal(size=n), rng.random(n) < 0.5)
    label = np.array([f"Å {j}" * int(j) for j in rng.integers(0, 9, n)], dtype=np.str_)
    return {"time_s": np.full(n, float(k)), "x_m": number, "object": np.arange(n), "label": label}


@pytest.mark.parametrize("instants", [1, PACKED - 1, PACKED, 2 * PACKED + 3])
def test_gathered_rows_are_those_of_the_instants(instants):
    rows, parts = GatheredRows(), [rows_of(k) for k in range(2, instants + 2)]
    for part in parts:
        rows.add(dict(part))
    taken, expected = rows.taken(), gathered(parts)
    assert list(taken) == list(expected)
    for name, column in expected.items():
        assert taken[name].dtype.kind == column.dtype.kind
        np.testing.assert_array_equal(np.ma.getdata(taken[name]), np.ma.getdata(column))
        np.testing.assert_array_equal(np.ma.getmaskarray(taken[name]), np.ma.getmaskarray(column))
    assert rows.taken() == {}


def test_columns_do_not_keep_the_matrices_of_their_instant():
    from sameas.picture.picture import picture_states, record_columns
    from sameas.tracks.reports import Reports
    from sameas.tracks.scene import Scene
    from sameas.tracks.source import Description

    columns: dict[str, ArrayLike] = {
        "time_s": [0.0] * 3,
        "x_m": [0.0, 900.0, 50.0],
        "y_m": [0.0] * 3,
        "mmsi": ["1", "2", "3"],
    }
    scene = Scene.of([(Description("ais", "ais"), Reports.of("ais", "ais", columns))])
    [state] = picture_states(scene, [0.0])
    for name, column in record_columns(state).items():
        data = np.ma.getdata(column)
        while data.base is not None:
            data = data.base
        assert data.nbytes <= column.nbytes, name
