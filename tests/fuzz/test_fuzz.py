"""Some hundred changed files of every format: an answer, or one line that refuses them. scripts/fuzz tries more."""

import sys

import pytest
from corpus import TARGETS
from fuzzing import Fuzzer

#: Inputs of each format; those that start processes of their own, or draw curves of dates, take longer.
INPUTS = 200
FEWER = {"frame hcompress": 4}


@pytest.fixture(scope="module")
def fuzzer():
    one = Fuzzer()
    yield one
    one.close()


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="limits of memory are those of POSIX")
@pytest.mark.parametrize("name", TARGETS)
def test_a_changed_file_is_answered_or_refused(name, fuzzer):
    pytest.importorskip("pyais")
    pytest.importorskip("rs1090")
    found = fuzzer.run(name, 0, FEWER.get(name, INPUTS))
    assert not found.faults, f"scripts/fuzz --format '{name}' --inputs {INPUTS} --keep FOLDER: {found.faults}"
    assert found.tried == found.answered + found.refused and found.refused
