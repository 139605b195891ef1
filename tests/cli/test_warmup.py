"""What is compiled beside the search is what an identification then needs."""

import os
import subprocess
import sys

import pytest

from sameas.cli import terminal

LATER = """
import numpy as np
from sameas import Field, Records, identify
from sameas.cli import warmup
from sameas.kernels import posterior

assert not warmup.needed()
places = np.random.default_rng(1).uniform(0.0, 5.0, (2, 30, 2))
identify(*(Records.of(x, sigma=0.5) for x in places), rule=Field(1.0))
assert posterior.exact.stats.cache_hits and not posterior.exact.stats.cache_misses
"""


@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="compilation is switched off")
def test_sums_compiled_beforehand_are_found(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-m", "sameas.cli.warmup"], env=environment, check=True, timeout=300)
    subprocess.run([sys.executable, "-c", LATER], env=environment, check=True, timeout=300)


def test_compilation_is_said_once_and_begun(monkeypatch, capsys):
    begun = []
    monkeypatch.setattr("sameas.cli.warmup.beside", lambda: begun.append(True))
    monkeypatch.setattr("sameas.cli.warmup.needed", lambda: True)
    terminal.tell_compilation()
    monkeypatch.setattr("sameas.cli.warmup.needed", lambda: False)
    terminal.tell_compilation()
    assert capsys.readouterr().err.count("compiling kernels") == len(begun) == 1


def test_one_process_compiles_at_a_time(tmp_path, monkeypatch):
    from sameas.cli import warmup

    begun = []
    monkeypatch.setattr(warmup, "_cache", lambda: tmp_path)
    monkeypatch.setattr(warmup.threading.Thread, "start", lambda thread: begun.append(thread))
    warmup.beside()
    warmup.beside()
    assert len(begun) == 1
    os.utime(tmp_path / "compiling", (0, 0))
    warmup.beside()
    assert len(begun) == 2
