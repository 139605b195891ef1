"""Provenance is stored in files and round-trips."""

import hashlib
import os
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table
from hypothesis import HealthCheck, find, given, settings
from hypothesis import strategies as st

from sameas.errors import InputError
from sameas.io import checksum, read_provenance, read_table, write_table

with warnings.catch_warnings():
    # Hypothesis writes its character table on first use; two workers doing so at once leave a file open.
    warnings.simplefilter("ignore", ResourceWarning)
    find(st.text(), lambda text: True)

ENDINGS = [".fits", ".vot", ".ecsv", ".csv", ".parquet", ".fits.gz", ".vot.gz", ".ecsv.gz", ".csv.gz"]
FACTS = {
    "software": "sameas 0.1.0",
    "command line": "sameas match a.fits 'b c.csv' --prior \"q\" & more",
    "Ångström": "naïve 星 🌟",
    "long": "x y " * 500,
    "empty": "",
    "digits": "12",
    "truth as text": "true",
    "lines": "one\ntwo\ttabbed",
    "pairs": 2**62,
    "log_odds": -1.25e-300,
    "found": True,
    "none": None,
    "inputs": ["a.fits", "b.csv"],
    "sums": [1, 2.5, False],
}


@pytest.mark.parametrize("ending", ENDINGS)
def test_provenance_round_trips_separately_from_the_table(ending, tmp_path):
    path = tmp_path / f"t{ending}"
    write_table(Table({"x": [1, 2]}), path, provenance=FACTS)
    again = read_provenance(path)
    assert again == FACTS and all(type(again[key]) is type(FACTS[key]) for key in FACTS)
    assert not any("sameas" in str(key).lower() for key in read_table(path).meta)


plain = st.one_of(st.text(max_size=120), st.integers(), st.floats(allow_nan=False), st.booleans())


@pytest.mark.slow
@pytest.mark.parametrize("ending", [".fits", ".vot", ".ecsv", ".csv", ".parquet"])
@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    facts=st.dictionaries(
        st.from_regex(r"[a-z][a-z_.]{0,30}", fullmatch=True), st.one_of(plain, st.lists(plain, max_size=3)), max_size=4
    )
)
def test_any_provenance_round_trips(ending, tmp_path, facts):
    text = "".join(
        v for value in facts.values() for v in (value if isinstance(value, list) else [value]) if isinstance(v, str)
    )
    if any(0xD800 <= ord(letter) < 0xE000 for letter in text):
        return
    path = tmp_path / f"t{ending}"
    write_table(Table({"x": [1]}), path, provenance=facts)
    assert read_provenance(path) == facts


def test_numpy_values_and_paths_become_plain_values(tmp_path):
    facts = {"n": np.int64(3), "q": np.float64(0.5), "yes": np.bool_(True), "of": Path("a.fits"), "v": np.arange(2)}
    write_table(Table({"x": [1]}), tmp_path / "t.parquet", provenance=facts)
    assert read_provenance(tmp_path / "t.parquet") == {"n": 3, "q": 0.5, "yes": True, "of": "a.fits", "v": [0, 1]}


def test_a_file_without_provenance_gives_none(tmp_path):
    for ending in (".fits", ".vot", ".ecsv", ".csv", ".parquet"):
        write_table(Table({"x": [1]}), tmp_path / f"t{ending}", provenance={})
        assert read_provenance(tmp_path / f"t{ending}") == {}
    assert not (tmp_path / "t.csv.provenance.json").exists()


def test_the_sidecar_of_an_earlier_run_is_removed(tmp_path):
    write_table(Table({"x": [1]}), tmp_path / "t.csv", provenance={"run": 1})
    assert sorted(os.listdir(tmp_path)) == ["t.csv", "t.csv.provenance.json"]
    assert (tmp_path / "t.csv").read_text() == "x\n1\n"
    write_table(Table({"x": [1]}), tmp_path / "t.csv", provenance={})
    assert os.listdir(tmp_path) == ["t.csv"]


def test_fits_has_readable_provenance_lines_too(tmp_path):
    write_table(Table({"x": [1]}), tmp_path / "t.fits", provenance={"software": "sameas 0.1.0"})
    assert "sameas: software = sameas 0.1.0" in list(fits.getheader(tmp_path / "t.fits", 1)["HISTORY"])


def test_checksum_is_the_sha256(tmp_path):
    (tmp_path / "x").write_bytes(b"abc" * 1000)
    assert checksum(tmp_path / "x") == hashlib.sha256(b"abc" * 1000).hexdigest()
    with pytest.raises(InputError, match="cannot be read"):
        checksum(tmp_path / "y")


@pytest.mark.slow
def test_importing_io_imports_nothing_heavy():
    code = "import sys, sameas.io; print(*{'astropy', 'pyarrow', 'numba', 'scipy', 'pandas'} & set(sys.modules))"
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "\n"


@pytest.mark.parametrize("ending", [".vot", ".ecsv"])
def test_a_text_that_only_looks_like_json_stays_text(ending, tmp_path):
    table, facts = Table({"id": ["a"]}), {"deep": "[" * 100_000, "digits": "9" * 5000}
    write_table(table, tmp_path / f"t{ending}", provenance=facts)
    assert read_provenance(tmp_path / f"t{ending}") == facts
