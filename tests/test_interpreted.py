"""Kernels give the same result interpreted as compiled."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

SCENES = """
import json
import sys

import numpy as np

import sameas.posterior
from sameas import Box, CloseObjects, CommonObjects, Field, PerPair, Plane, Radius, Records, Sphere, identify
from sameas.posterior import APPROXIMATE
from sameas.simulate import Cap, sky_field

rng = np.random.default_rng(3)
plane = [
    Records.of(rng.uniform(0, 1, (12, 2)), sigma=rng.uniform(0.04, 0.08, (12, 2)), space=Plane((1.0, None)))
    for _ in range(2)
]
space = [Records.of(rng.uniform(0, 1, (8, 3)), covariance=np.eye(3) * 0.01 + 0.001) for _ in range(2)]
sky = sky_field(
    rng, n_common=8, n_only_1=3, n_only_2=3, sigma_arcsec=(0.5, 2.0), area=Cap(30.0, 90.0, 0.002), elliptical=True
)
scenes = {
    "plane": (*plane, CloseObjects(0.01, 0.2)),
    "space": (*space, Field(1.0)),
    "sky": (sky.first, sky.second, Field(0.01)),
}
gates = {"plane": Box(2.0), "space": Radius(2.5), "sky": Box(3.0)}
answers = {}


def note(name):
    first, second, rule = scenes[name]
    for prior in (PerPair(-0.5), CommonObjects(0.2, 0.3)):
        x = identify(first, second, rule=rule, prior=prior, gate=gates[name])
        answers[f"{name}, {prior}, {sameas.posterior._exact.__name__}"] = [
            x.pairs.i.tolist(), x.pairs.j.tolist(), x.chosen.tolist(), x.posterior.method.tolist(),
            x.p_pair.tolist(), x.log_odds.tolist(), x.answers_1.p_none.tolist(), x.pairs.residual.tolist(),
            x.pairs.determinant.tolist(), x.pairs.covariance.tolist(),
        ]


for name in scenes:
    note(name)


def without_elimination(groups, best, share, method, most=None):
    method[:] = APPROXIMATE


sameas.posterior._exact = without_elimination
for name in scenes:
    note(name)
json.dump(answers, sys.stdout)
"""


def answers(interpreted):
    # Without SAMEAS_COMPILE most kernels of so few records would be interpreted in both.
    environment = os.environ | {"NUMBA_DISABLE_JIT": str(int(interpreted)), "SAMEAS_COMPILE": "1"}
    run = subprocess.run(
        [sys.executable, "-c", SCENES], env=environment, cwd=Path(__file__).parent, capture_output=True, text=True
    )
    assert run.returncode == 0, run.stderr
    return json.loads(run.stdout)


@pytest.mark.slow
def test_interpreted_kernels_give_the_compiled_answer():
    slow, fast = answers(True), answers(False)
    assert slow.keys() == fast.keys() and len(fast) == 12
    for name in fast:
        assert sum(len(column) for column in fast[name][:1]) > 10
        # Which pairs, which of them chosen, and by which method: the same; numbers to the last digits.
        assert slow[name][:4] == fast[name][:4], name
        for ours, theirs in zip(slow[name][4:], fast[name][4:], strict=True):
            assert flat(ours) == pytest.approx(flat(theirs), rel=1e-12, abs=1e-12), name


def flat(values):
    return [x for value in values for x in flat(value)] if isinstance(values, list) else [values]
