"""LSDB crossmatch with one-to-one decisions: the pairs of our own run; invalid joins are refused."""

import importlib.util

import numpy as np
import pytest

if importlib.util.find_spec("lsdb") is None:
    pytest.skip("LSDB is not installed: pip install 'sameas[lsdb]'", allow_module_level=True)

from tests.test_partitions import sky, stored, table_of

import sameas
from sameas import InputError


def one_to_one(found):
    from sameas.adapters.lsdb import OneToOne  # LSDB takes seconds to import, so not where tests are collected

    return OneToOne(found)


# Dask's and pandas' own.
pytestmark = [pytest.mark.slow, pytest.mark.filterwarnings("ignore")]


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    import dask

    folder = tmp_path_factory.mktemp("lsdb")
    tables = sky((0.0, 0.0), 2_000, 0.3, seed=21)
    paths = stored(folder, tables, (400, 300))
    found = sameas.match(*paths, sigma="pos_err", sigma_unit="arcsec")
    found.write(folder / "out", workers=1)
    frames = [table.to_pandas() for table in tables]
    with dask.config.set(scheduler="synchronous"):
        yield found, frames, table_of(folder / "out")


def opened(frame, margin, order):
    import lsdb

    return lsdb.from_dataframe(
        frame, ra_column="ra", dec_column="dec", lowest_order=order, highest_order=order, margin_threshold=margin
    )


def test_lsdb_gives_the_pairs_and_probabilities_of_match(both):
    found, (a, b), table = both
    algorithm = one_to_one(found)
    margin = np.ceil(algorithm.halo_arcsec)
    left, right = opened(a, margin, 9), opened(b, margin, 8)
    joined = left.crossmatch(right, algorithm=algorithm, how="outer", suffixes=("_1", "_2")).compute()
    pairs = joined.dropna(subset=["id_1", "id_2"])
    mine = {
        i: (j, p) for i, j, p in zip(table["id_1"], table["id_2"], table["p_match"], strict=True) if not np.isnan(j)
    }
    assert dict(zip(pairs["id_1"], pairs["id_2"], strict=True)) == {i: j for i, (j, _) in mine.items()}
    assert not pairs["id_2"].duplicated().any() and len(pairs) > 1_000
    assert max(abs(p - mine[i][1]) for i, p in zip(pairs["id_1"], pairs["p_match"], strict=True)) < 1e-6


def test_joins_and_margins_that_would_be_wrong_are_refused(both):
    found, (a, b), _ = both
    algorithm = one_to_one(found)
    wide = np.ceil(algorithm.halo_arcsec)
    with pytest.raises(InputError, match=r"has a margin of 1 arcsec; .*margin_threshold="):
        opened(a, 1.0, 9).crossmatch(opened(b, wide, 8), algorithm=algorithm, how="outer")
    with pytest.raises(InputError, match="how='inner': LSDB brings what competes"):
        opened(a, wide, 9).crossmatch(opened(b, wide, 8), algorithm=algorithm, how="inner").compute()
