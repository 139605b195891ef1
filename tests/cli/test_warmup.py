"""Kernels compiled in parallel with the search are those that identification needs."""

import importlib
import os
import subprocess
import sys
import threading

import pytest

from sameas.cli import terminal, warmup
from sameas.kernels import compiled

LATER = """
import numpy as np
from sameas import Field, Records, identify
from sameas.kernels import posterior

posterior.exact.limit = 0  # it is compiled, what else is called is interpreted
places = np.random.default_rng(1).uniform(0.0, 5.0, (2, 30, 2))
identify(*(Records.of(x, sigma=0.5) for x in places), rule=Field(1.0))
assert posterior.exact.compiled.stats.cache_hits and not posterior.exact.compiled.stats.cache_misses
"""


@pytest.mark.long
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="compilation is switched off")
def test_kernels_compiled_beforehand_are_used(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-m", "sameas.cli.warmup"], env=environment, check=True, timeout=300)
    subprocess.run([sys.executable, "-c", LATER], env=environment, check=True, timeout=300)


PICTURE = """
import numpy as np
import sameas
from sameas.cli.warmup import LATER_KERNELS_OF_A_PICTURE
from sameas.kernels import compiled

compiled.compile_all()
rng = np.random.default_rng(1)
seconds, ship = np.repeat(np.arange(0.0, 120.0, 3.0), 30), np.tile(np.arange(30), 40)
x, y = rng.uniform(-3000.0, 3000.0, (2, 30))
noise = rng.normal(0.0, 15.0, (2, 2, len(seconds)))
places = [{"time": seconds, "x_m": x[ship] + dx, "y_m": y[ship] + dy} for dx, dy in noise]
sameas.match_picture({"ais": {**places[0], "mmsi": 235000001 + ship}, "radar": {**places[1], "track_id": ship}})
for module, names in LATER_KERNELS_OF_A_PICTURE.items():
    for name in names:
        stats = getattr(__import__(f"sameas.kernels.{module}", fromlist=[name]), name).compiled.stats
        if stats.cache_misses:
            print(module, name, stats)
"""


STARS = """
import numpy as np
import sameas
from sameas.kernels import compiled, mixture, posterior, relation

compiled.compile_all()
rng = np.random.default_rng(1)
ra, dec, g = 10.0 + rng.uniform(0.0, 0.2, 300), rng.uniform(-0.1, 0.1, 300), rng.uniform(12.0, 16.0, 300)
one = {"ra": ra, "dec": dec, "phot_g_mean_mag": g}
other = {"ra": ra + 1e-5 * rng.standard_normal(300), "dec": dec, "phot_g_mean_mag": g + 0.1 * rng.standard_normal(300)}
found = sameas.match(one, other, sigma=0.05, magnitudes="phot_g_mean_mag:phot_g_mean_mag")
assert found.estimate.photometry is not None
assert relation.learn.compiled.stats.cache_hits and posterior.exact.compiled.stats.cache_hits
for kernel in (relation.learn, mixture.fit, posterior.exact):
    if kernel.compiled.stats.cache_misses:
        print(kernel.__name__, kernel.compiled.stats)
"""


@pytest.mark.long
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="compilation is switched off")
def test_kernels_of_a_frame_compiled_beforehand_are_used(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-m", "sameas.cli.warmup", "frame"], env=environment, check=True, timeout=300)
    later = subprocess.run(
        [sys.executable, "-c", STARS], env=environment, check=True, timeout=300, capture_output=True, text=True
    )
    assert later.stdout == ""


@pytest.mark.long
@pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="compilation is switched off")
def test_kernels_of_a_picture_compiled_beforehand_are_used(tmp_path):
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-m", "sameas.cli.warmup", "picture"], env=environment, check=True, timeout=300)
    for module, names in warmup.LATER_KERNELS_OF_A_PICTURE.items():
        assert all(list(tmp_path.rglob(f"{module}.{name}-*.nbi")) for name in names)
    later = subprocess.run(
        [sys.executable, "-c", PICTURE], env=environment, check=True, timeout=300, capture_output=True, text=True
    )
    assert later.stdout == ""


def test_the_kernels_that_are_named_exist():
    named = {kernel for kernel, _ in warmup.IN_SECOND_PROCESS.values()}
    for group in (warmup.KERNELS_OF_A_MATCH, warmup.LATER_KERNELS_OF_A_PICTURE):
        named |= {f"{module}.{name}" for module, names in group.items() for name in names}
    for module, name in (kernel.split(".") for kernel in named):
        assert hasattr(importlib.import_module(f"sameas.kernels.{module}"), name), (module, name)


@pytest.mark.parametrize(("quiet", "announcements"), [(False, 1), (True, 0)])
def test_compilation_is_announced_and_shared(quiet, announcements, monkeypatch, capsys, tmp_path):
    begun = []
    monkeypatch.setattr(compiled, "on_first_compilation", [compiled.announce])
    monkeypatch.setattr("sameas.cli.warmup.start_second_process", lambda cache, result: begun.append((cache, result)))
    terminal.share_compilation(quiet, "picture")
    for begin in compiled.on_first_compilation:
        begin(tmp_path)
    assert begun == [(tmp_path, "picture")] and capsys.readouterr().err.count("compiling kernels") == announcements


def test_one_process_compiles_at_a_time(tmp_path, monkeypatch):
    begun = []
    monkeypatch.setattr(threading.Thread, "start", lambda thread: begun.append(thread))
    warmup.start_second_process(tmp_path, "match")
    warmup.start_second_process(tmp_path, "match")
    assert len(begun) == 1
    os.utime(tmp_path / "compiling", (0, 0))
    warmup.start_second_process(tmp_path, "match")
    assert len(begun) == 2
    (tmp_path / "compiling").unlink()
    (tmp_path / "posterior.exact-480.py311.nbi").touch()
    warmup.start_second_process(tmp_path, "match")
    assert len(begun) == 2


@pytest.mark.slow
def test_kernels_that_are_read_ahead_are_called_by_a_match():
    program = """
import numpy as np
import sameas
from sameas.cli.warmup import KERNELS_OF_A_MATCH

rng = np.random.default_rng(1)
n = 30_000
ra, dec, sigma = 10.0 + rng.uniform(0.0, 0.2, n), rng.uniform(-0.1, 0.1, n), rng.uniform(0.2, 0.8, n)
near = {"ra": ra + sigma / 3600.0 * rng.standard_normal(n), "dec": dec, "sigma": sigma}
found = sameas.match({"ra": ra, "dec": dec}, near, sigma1=0.1, sigma_unit2="arcsec")
found.table, found.report()
for module, names in KERNELS_OF_A_MATCH.items():
    for name in names:
        kernel = getattr(__import__(f"sameas.kernels.{module}", fromlist=[name]), name)
        if not kernel._dispatcher or not kernel.compiled.signatures:
            print(module, name)
"""
    environment = os.environ | {"SAMEAS_COMPILE": "1"}
    run = subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
    assert run.stdout == ""
