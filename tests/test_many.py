"""Many sources: the joint result against an enumeration of all partitions, and its invariances."""

import itertools
import json
import math
import os
import subprocess
import sys
from collections.abc import Callable
from functools import cache
from typing import Any, cast

import numpy as np
import pytest
from scipy.special import gammaln, logsumexp

import naive
from sameas import CloseObjects, CommonObjects, Field, PerPair, Plane, PoissonField, Records, Sphere, identify
from sameas.errors import InputError
from sameas.gate import Radius
from sameas.many.identify import identify_many, identify_sequentially
from sameas.many.observations import Bearing, LinearPart, Observations, Region
from sameas.many.rules import MissedObjects, PoissonObjects
from sameas.many.sets import ManyTuning

WIDE = Radius(1e4)


# ---- reference: all partitions, weighted by the definitions ----


def partitions(records):
    """All partitions of a list of (source, row) into sets of at most one record per source."""
    if not records:
        yield []
        return
    first, rest = records[0], records[1:]
    for size in range(len(rest) + 1):
        for others in itertools.combinations(rest, size):
            if len({s for s, _ in (first, *others)}) == size + 1:
                left = [r for r in rest if r not in others]
                for more in partitions(left):
                    yield [(first, *others), *more]


def log_joint(sources, members):
    """ln ∫ ∏ N(x_s; M, Σ_s) dM, sequentially: each record against the mean of the previous ones."""
    s, row = members[0]
    mean, cov = sources[s].features[row], sources[s].full_covariance()[row]
    total = 0.0
    for s, row in members[1:]:
        x, spread = sources[s].features[row], sources[s].full_covariance()[row]
        total += naive.log_normal(x - mean, cov + spread)
        gain = cov @ np.linalg.inv(cov + spread)
        mean, cov = mean + gain @ (x - mean), cov - gain @ cov
    return total


def poisson_weight(sources, density, q, false):
    @cache
    def weight(members):
        seen = {s for s, _ in members}
        log_w = math.log(density) + sum(math.log(1 - q[s] if s in seen else q[s]) for s in range(len(q)))
        if len(members) == 1:
            ((s, row),) = members
            return math.log(math.exp(log_w) + (false[s][row] if np.ndim(false[s]) else false[s]))
        return log_w + log_joint(sources, members)

    return lambda parted: sum(map(weight, parted))


def counted_weight(sources, a, b, q):
    d = sources[0].d
    a, b = np.full(d, a), np.full(d, b)

    @cache
    def weight(members):
        missed = sum(math.log(q[s]) for s in set(range(len(q))) - {s for s, _ in members})
        if len(members) == 1:
            return missed
        others = []
        for (s, i), (t, j) in itertools.combinations(members, 2):
            delta, cov = naive.residual(sources[s], i, sources[t], j)
            others.append(naive.close_objects_log_density(delta, np.sqrt(np.diag(cov)), a, b))
        return missed + log_joint(sources, members) - (len(members) - 1) * np.mean(others)

    def total(parted):
        n = len(parted)
        return gammaln(n + 1) + sum(map(weight, parted)) - (n + 1) * math.log(1 - math.prod(q))

    return total


def enumerated(sources, weight):
    """(best score, its sets, {set: probability}); ``weight`` maps a partition to its log weight."""
    records = [(s, row) for s, source in enumerate(sources) for row in range(len(source))]
    scored = [(weight(parted), parted) for parted in partitions(records)]
    total = logsumexp([score for score, _ in scored])
    p = {}
    for score, parted in scored:
        for members in parted:
            p[members] = p.get(members, 0.0) + math.exp(score - total)
    score, best = max(scored, key=lambda item: item[0])
    return score, {frozenset(members) for members in best}, {frozenset(k): v for k, v in p.items()}


def sets_of(objects):
    """The objects as sets of (source, row)."""
    rows = objects.members
    return [frozenset((s, int(row)) for s, row in enumerate(line) if row is not np.ma.masked) for line in rows]


def probabilities(objects):
    """{object or runner-up: stated probability}."""
    return dict(zip(sets_of(objects), objects.probability.tolist(), strict=True))


def small_scene(rng, counts, *, extent=4.0, d=2, full=False):
    sources = []
    for s, n in enumerate(counts):
        root = rng.standard_normal((n, d, d)) * 0.5 + np.eye(d)
        spread = {"covariance": root @ root.transpose(0, 2, 1)} if full else {"sigma": rng.uniform(0.5, 1.5, (n, 1))}
        sources.append(Records.of(rng.uniform(0, extent, (n, d)), **spread, source=f"s{s}"))
    return sources


def field_scene(rng, n_sources, n, *, extent, q=0.15, sigma=1.0, grid=None):
    objects = rng.uniform(0, extent, (n, 2))
    sources = []
    for s in range(n_sources):
        seen = rng.permutation(np.flatnonzero(rng.uniform(size=n) >= q))
        x = objects[seen] + rng.normal(size=(len(seen), 2)) * sigma
        if grid:
            x = np.round(x / grid) * grid
        sources.append(Records.of(x, sigma=sigma, source=f"s{s}"))
    return sources


# ---- against the reference ----


@pytest.mark.parametrize("counts", [(2, 2, 2), (3, 2, 1), (1, 1, 1, 2), (0, 2, 3), (3, 2, 2)])
@pytest.mark.parametrize("full", [False, True])
def test_poisson_objects_agree_with_all_partitions(counts, full):
    rng = np.random.default_rng([*counts, full])
    for _ in range(3):
        sources = small_scene(rng, counts, full=full)
        q, false = rng.uniform(0.1, 0.5, len(counts)), rng.uniform(0, 0.1, len(counts))
        got = identify_many(sources, rule=PoissonObjects(0.1, q, false), gate=WIDE)
        _, best, p = enumerated(sources, poisson_weight(sources, 0.1, q, false))
        assert set(sets_of(got)) == best
        for members, stated in probabilities(got).items():
            assert stated == pytest.approx(p[members], abs=1e-9)
        assert got.groups.exact.all() and not got.groups.gap.any()


@pytest.mark.parametrize("counts", [(2, 2, 2), (3, 2, 1)])
def test_false_records_may_be_denser_at_some_records_of_a_source(counts):
    rng = np.random.default_rng([*counts, 7])
    for _ in range(3):
        sources, q = small_scene(rng, counts), rng.uniform(0.1, 0.5, len(counts))
        false = [rng.uniform(0, 0.2, counts[0]), 0.05, rng.uniform(0, 0.2, counts[2])]
        got = identify_many(sources, rule=PoissonObjects(0.1, q, false), gate=WIDE)
        _, best, p = enumerated(sources, poisson_weight(sources, 0.1, q, false))
        assert set(sets_of(got)) == best
        for members, stated in probabilities(got).items():
            assert stated == pytest.approx(p[members], abs=1e-9)


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("counts", [(2, 2, 2), (3, 2, 1), (1, 1, 1, 2), (2, 2, 3)])
def test_close_objects_with_a_count_prior_agree_with_all_partitions(counts):
    rng = np.random.default_rng([*counts, 5])
    for _ in range(3):
        sources = small_scene(rng, counts)
        q = rng.uniform(0.1, 0.5, len(counts))
        got = identify_many(sources, rule=CloseObjects(1.0, 4.0), prior=MissedObjects(q), gate=WIDE)
        _, best, p = enumerated(sources, counted_weight(sources, 1.0, 4.0, q))
        assert set(sets_of(got)) == best
        for members, stated in probabilities(got).items():
            assert stated == pytest.approx(p[members], abs=1e-9)


def test_every_record_has_its_partners():
    rng = np.random.default_rng(8)
    sources = small_scene(rng, (3, 2, 2))
    q = (0.2, 0.3, 0.4)
    got = identify_many(sources, rule=PoissonObjects(0.1, q), gate=WIDE)
    _, _, p = enumerated(sources, poisson_weight(sources, 0.1, q, (0.0,) * 3))
    for s, source in enumerate(sources):
        answers = got.of(s)
        for row in range(len(source)):
            assert answers.p_alone[row] == pytest.approx(p[frozenset({(s, row)})], abs=1e-9)
            for t, other in enumerate(sources):
                if t == s:
                    assert answers.partner[row, t] is np.ma.masked
                    continue
                with_each = [sum(v for k, v in p.items() if {(s, row), (t, j)} <= k) for j in range(len(other))]
                assert answers.partner[row, t] == np.argmax(with_each)
                assert answers.p_partner[row, t] == pytest.approx(max(with_each), abs=1e-9)
    for members, second, p_second in zip(sets_of(got), got.runner_up, got.p_runner_up, strict=True):
        other = max(v for k, v in p.items() if k & members and k not in set(sets_of(got)))
        assert p_second == pytest.approx(other, abs=1e-9)
        found = frozenset((s, int(row)) for s, row in enumerate(second) if row is not np.ma.masked)
        assert p[found] == pytest.approx(other, abs=1e-9)


# ---- against identify ----


def same_as_identify(many, one, tolerance=1e-9):
    both = many.members[many.n_members == 2].data
    assert set(map(tuple, both.tolist())) == set(
        zip(one.matches.rows_1.tolist(), one.matches.rows_2.tolist(), strict=True)
    )
    for s, answers in enumerate((one.answers_1, one.answers_2)):
        np.testing.assert_allclose(many.of(s).p_alone, answers.p_none, atol=tolerance)


def test_two_sources_agree_with_identify_for_a_poisson_field():
    rng = np.random.default_rng(11)
    for _ in range(5):
        sources = field_scene(rng, 2, 15, extent=14.0)
        density, q, false = 0.08, (0.1, 0.3), (0.01, 0.02)
        shown = density * (1 - q[0]), density * (1 - q[1])
        field = PoissonField(shown[0] * (1 - q[1]), shown[0] * q[1] + false[0], shown[1] * q[0] + false[1])
        many = identify_many(sources, rule=PoissonObjects(density, q, false))
        same_as_identify(many, identify(*sources, rule=field))


def test_two_sources_agree_with_identify_for_a_count_prior():
    rng = np.random.default_rng(12)
    for _ in range(5):
        sources = field_scene(rng, 2, 9, extent=10.0)
        many = identify_many(sources, rule=CloseObjects(1.0, 6.0), prior=MissedObjects((0.1, 0.3)))
        same_as_identify(many, identify(*sources, rule=CloseObjects(1.0, 6.0), prior=CommonObjects(0.1, 0.3)))


def test_two_sources_on_the_sphere_agree_with_identify():
    rng = np.random.default_rng(13)
    at = np.stack([rng.uniform(359.999, 360.001, 12) % 360, rng.uniform(89.996, 89.999, 12)], axis=1)
    root = rng.standard_normal((2, 12, 2, 2)) + np.eye(2)
    sources = [Records.of(at, covariance=c, space=Sphere()) for c in 4.0 * root @ root.transpose(0, 1, 3, 2)]
    many = identify_many(sources, rule=Field(1e-3), prior=PerPair(-1.0))
    same_as_identify(many, identify(*sources, rule=Field(1e-3), prior=PerPair(-1.0)))


def test_objects_at_a_pole_are_found():
    rng = np.random.default_rng(14)
    plane = rng.uniform(-8.0, 8.0, (6, 2))
    sources = [plane + rng.normal(size=(6, 2)) for _ in range(3)]
    root = rng.standard_normal((3, 6, 2, 2)) * 0.4 + np.eye(2)
    spread = root @ root.transpose(0, 1, 3, 2)
    flat = [Records.of(x, covariance=c) for x, c in zip(sources, spread, strict=True)]
    polar = []
    for x, c in zip(sources, spread, strict=True):
        # x towards longitude 90°, y away from longitude 0: the pole viewed from outside, north along −r.
        lon = np.degrees(np.arctan2(x[:, 0], -x[:, 1]))
        lat = 90.0 - np.hypot(x[:, 0], x[:, 1]) / 3600.0
        turn = np.radians(lon)
        axes = np.stack([np.cos(turn), np.sin(turn), -np.sin(turn), np.cos(turn)], axis=1).reshape(-1, 2, 2)
        polar.append(Records.of(np.stack([lon, lat], 1), covariance=axes @ c @ axes.transpose(0, 2, 1), space=Sphere()))
    one, two = (identify_many(s, rule=PoissonObjects(0.02, 0.1)) for s in (flat, polar))
    assert set(sets_of(one)) == set(sets_of(two))
    for members, p in probabilities(two).items():
        assert p == pytest.approx(probabilities(one)[members], abs=1e-6)


# ---- invariances ----


@pytest.mark.slow
@pytest.mark.parametrize("grid", [None, 1.0, 3.0])
def test_the_order_of_sources_and_rows_changes_nothing(grid):
    rng = np.random.default_rng(21)
    sources = field_scene(rng, 3, 10, extent=12.0, grid=grid)
    q = (0.1, 0.2, 0.3)
    believed: list[tuple[Callable[..., Any], Callable[..., Any]]] = [
        (lambda q: PoissonObjects(0.07, q), lambda q: PerPair(0.0)),
        (lambda q: CloseObjects(1.0, 6.0), MissedObjects),
    ]
    for rule, prior in believed:
        first = probabilities(identify_many(sources, rule=rule(q), prior=prior(q)))
        for turn in itertools.permutations(range(3)):
            rows = [rng.permutation(len(sources[s])) for s in turn]
            mixed = [
                Records.of(sources[s].features[order], sigma=1.0, ids=order, source=sources[s].source)
                for s, order in zip(turn, rows, strict=True)
            ]
            permuted = tuple(q[s] for s in turn)
            got = probabilities(identify_many(mixed, rule=rule(permuted), prior=prior(permuted)))
            back = {frozenset((turn[s], int(rows[s][row])) for s, row in k): p for k, p in got.items()}
            assert back == first


def test_objects_across_a_period_boundary_are_joined():
    space = Plane(periods=(360.0, None))
    sources = [Records.of([[x, 5.0]], sigma=1.0, space=space) for x in (359.5, 0.5, 0.2)]
    got = identify_many(sources, rule=PoissonObjects(1e-4, 0.1))
    assert len(got) == 1 and got.probability[0] > 0.99
    assert got.fused.state[0, 0] == pytest.approx(0.2 / 3, abs=1e-9)


def test_large_groups_are_solved_and_probabilities_sum_to_one():
    rng = np.random.default_rng(22)
    sources = field_scene(rng, 4, 60, extent=60.0)
    got = identify_many(sources, rule=PoissonObjects(60 / 60.0**2, 0.15))
    assert got.groups.records.max() > 20 and not got.groups.gap.any()
    total = np.zeros(sum(map(len, sources)))
    at, source = np.nonzero(got.sets.members >= 0)
    np.add.at(total, got.sets.members[at, source], got.answer.probability[at])
    np.testing.assert_allclose(total, 1.0, atol=1e-6)
    assert sum(len(members) for members in sets_of(got)) == len(total)


def test_groups_too_large_for_a_sum_under_a_count_prior_use_branch_and_bound():
    rng = np.random.default_rng(23)
    sources = field_scene(rng, 3, 6, extent=6.0)
    arguments: dict[str, Any] = {"rule": CloseObjects(1.0, 6.0), "prior": MissedObjects(0.2)}
    whole = identify_many(sources, **arguments)
    cramped = identify_many(sources, **arguments, tuning=ManyTuning(max_steps=256))
    assert not cramped.groups.exact.all() and whole.groups.exact.all()
    assert set(sets_of(cramped)) == set(sets_of(whole))
    assert not cramped.groups.gap.any()


@pytest.mark.slow
@pytest.mark.long
def test_omitted_sets_are_reported_as_a_gap():
    rng = np.random.default_rng(24)
    sources = field_scene(rng, 4, 8, extent=6.0)
    union_of_all = identify_many(sources, rule=PoissonObjects(0.2, 0.1))
    cut = identify_many(sources, rule=PoissonObjects(0.2, 0.1), tuning=ManyTuning(max_sets=60))

    def value(objects):
        return float(objects.sets.log_weight[objects.answer.chosen].sum())

    assert cut.groups.floor.max() > 0
    assert value(cut) <= value(union_of_all) + 1e-9 <= value(cut) + cut.groups.gap.sum() + 2e-9


INTERPRETED = """
import json
import numpy as np
from sameas import CloseObjects, Records, identify_many
from sameas.many.rules import MissedObjects, PoissonObjects
rng = np.random.default_rng(25)
sources = [Records.of(rng.uniform(0, 4, (3, 2)), sigma=1.0) for _ in range(3)]
answers = [identify_many(sources, rule=PoissonObjects(0.1, 0.2)),
           identify_many(sources, rule=CloseObjects(1.0, 4.0), prior=MissedObjects(0.2))]
print(json.dumps([[x.members.filled(-1).tolist(), x.answer.probability.tolist()] for x in answers]))
"""


@pytest.mark.slow
def test_the_kernel_gives_the_same_result_interpreted():
    run: dict[str, Any] = {
        "args": [sys.executable, "-W", "error", "-c", INTERPRETED],
        "capture_output": True,
        "check": True,
    }
    answers = [
        json.loads(subprocess.run(**run, env={**os.environ, "NUMBA_DISABLE_JIT": off}).stdout) for off in ("0", "1")
    ]
    for (rows, p), (rows_too, p_too) in zip(*answers, strict=True):
        assert rows == rows_too
        np.testing.assert_allclose(p, p_too, atol=1e-13)


# ---- the papers' sequential method ----


def test_sequential_identification_of_two_sources_agrees_with_identify():
    rng = np.random.default_rng(31)
    sources = field_scene(rng, 2, 12, extent=12.0)
    got = identify_sequentially(sources, rule=PoissonObjects(0.08, (0.1, 0.3)))
    field = PoissonField(0.08 * 0.9 * 0.7, 0.08 * 0.9 * 0.3, 0.08 * 0.7 * 0.1)
    one = identify(*sources, rule=field)
    want = set(zip(one.matches.rows_1.tolist(), one.matches.rows_2.tolist(), strict=True))
    assert set(map(tuple, got.members[got.n_members == 2].data.tolist())) == want


@pytest.mark.slow
def test_joint_is_at_least_as_accurate_as_sequential_and_independent_of_the_order():
    rng = np.random.default_rng(32)
    right, differs = np.zeros(2), 0
    for _ in range(25):
        targets = np.stack([np.arange(5) * 2.5, np.zeros(5)], axis=1)
        seen = [rng.permutation(np.flatnonzero(rng.uniform(size=5) >= 0.1)) for _ in range(3)]
        sources = [Records.of(targets[k] + rng.normal(size=(len(k), 2)), sigma=1.0) for k in seen]
        truth = {frozenset((s, int(np.flatnonzero(k == t)[0])) for s, k in enumerate(seen) if t in k) for t in range(5)}
        arguments: dict[str, Any] = {"rule": PoissonObjects(5 / 96, 0.1)}
        joint = set(sets_of(identify_many(sources, **arguments)))
        forward = set(sets_of(identify_sequentially(sources, **arguments)))
        backward = sets_of(identify_sequentially(sources[::-1], **arguments))
        differs += forward != {frozenset((2 - s, row) for s, row in k) for k in backward}
        right += joint == truth - {frozenset()}, forward == truth - {frozenset()}
    assert right[0] >= right[1] > 0 and differs > 0


# ---- parts of the state ----


def test_a_bearing_selects_the_right_radar_record():
    radar = Records.of([[100.0, 1000.0], [-100.0, 1000.0]], sigma=30.0, source="radar")
    camera = Observations(
        Records.of([[5.5]], sigma=0.3, space=Plane(periods=(360.0,)), source="camera"), Bearing(sensor=(0.0, 0.0))
    )
    region = Region((0.0, 0.0), (5000.0, 5000.0))
    got = identify_many([camera, radar], rule=PoissonObjects(1e-6, 0.1, (1e-4, 0.0)), region=region)
    assert frozenset({(0, 0), (1, 0)}) in sets_of(got) and got.probability.min() > 0.9
    row = sets_of(got).index(frozenset({(0, 0), (1, 0)}))
    sigma = np.sqrt(np.diag(got.fused.covariance[row]))
    assert sigma[0] < 7.0 and sigma[1] > 25.0  # Across the bearing 1000 m · 0.3° = 5 m, along it the radar's 30 m.


def test_parts_that_measure_all_features_together_equal_whole_records():
    rng = np.random.default_rng(41)
    whole = field_scene(rng, 3, 6, extent=12.0)
    region = Region((6.0, 6.0), (1e4, 1e4))
    as_parts = [whole[0], whole[1], Observations(whole[2], LinearPart(np.eye(2)))]
    one = identify_many(whole, rule=PoissonObjects(0.05, 0.2))
    two = identify_many(as_parts, rule=PoissonObjects(0.05, 0.2), region=region)
    assert set(sets_of(one)) == set(sets_of(two))
    for members, p in probabilities(two).items():
        assert p == pytest.approx(probabilities(one)[members], abs=1e-5)


@pytest.mark.parametrize("region", [None, Region((0.3, -0.2), (2.0, 3.0))])
def test_positions_in_a_plane_have_the_joint_density_of_all_records(region):
    rng = np.random.default_rng(8)
    roots = rng.normal(size=(3, 5, 2, 2))
    sources = [
        Records.of(rng.normal(size=(5, 2)), covariance=root @ root.transpose(0, 2, 1) + 0.1 * np.eye(2), source=name)
        for root, name in zip(roots, ("one", "two", "three"), strict=True)
    ]
    from sameas.many.pooled import pooled

    together = pooled(sources, WIDE, region)
    for size in (2, 3):
        starts = list(itertools.combinations(range(3), size))
        sets = np.array([np.array(c) * 5 + rng.integers(0, 5, size) for c in starts for _ in range(4)])
        members = np.full((len(sets), 3), -1)
        np.put_along_axis(members, sets // 5, sets, axis=1)
        due = together.observers.joint(together.positions(members)).log_density
        np.testing.assert_allclose(together.log_joint(sets), due, rtol=1e-10, atol=1e-10)


def test_the_joint_density_of_parts_is_the_marginal_of_the_stacked_observations():
    rng = np.random.default_rng(42)
    parts = [np.eye(3)[:1], np.eye(3)[1:], rng.normal(size=(2, 3))]
    records = [Records.of(rng.normal(size=(1, len(h))), sigma=0.5 + k) for k, h in enumerate(parts)]
    region = Region(np.array([0.1, 0.2, 0.3]), np.diag([4.0, 9.0, 16.0]) + 0.5)
    sources = [Observations(r, LinearPart(h)) for r, h in zip(records, parts, strict=True)]
    from sameas.many.observations import joint_density

    joint = joint_density(sources, np.zeros((1, 3), int), region)
    centre = np.asarray(region.centre)
    h, z = np.vstack(parts), np.concatenate([r.features[0] for r in records])
    spread = h @ region.covariance @ h.T + np.diag(np.repeat([0.25, 2.25, 6.25], [1, 2, 2]))
    log_marginal = naive.log_normal(z - h @ centre, spread)
    peak = naive.log_normal(np.zeros(3), region.covariance)
    assert joint.log_density[0] == pytest.approx(log_marginal - peak, rel=1e-10)
    gain = region.covariance @ h.T @ np.linalg.inv(spread)
    np.testing.assert_allclose(joint.state[0], centre + gain @ (z - h @ centre), rtol=1e-9)
    np.testing.assert_allclose(joint.covariance[0], region.covariance - gain @ h @ region.covariance, rtol=1e-8)


@pytest.mark.parametrize("speed", [0.5, 20.0])
def test_pairs_of_parts_are_all_that_can_be_one_object(speed):
    """Of plots of 1 000 objects every two were tested, 2 s of the processor a scan; now neighbours are."""
    from sameas.many.observations import joint_density
    from sameas.many.pooled import pooled

    rng = np.random.default_rng(43)
    centre, spread = np.array([5.0, -3.0, 1.0, 2.0]), np.array([200.0, 300.0, speed, speed])
    region = Region(centre, spread)
    states = centre + rng.normal(size=(40, 4)) * spread
    roots = rng.normal(size=(40, 4, 4))
    known = Records.of(states, covariance=roots @ roots.transpose(0, 2, 1) + np.eye(4), source="known")
    sources: list[Any] = [known]
    for name, age_s in (("one", 2.0), ("two", 9.0)):
        observe = np.hstack([np.eye(2), -age_s * np.eye(2)])
        places = states @ observe.T + (7.0, 0.0) + 4.0 * rng.normal(size=(40, 2))
        sources.append(Observations(Records.of(places, sigma=4.0, source=name), LinearPart(observe, (7.0, 0.0))))
    together = pooled(sources, WIDE, region)
    every = np.array([pair for pair in itertools.combinations(range(120), 2) if pair[0] // 40 != pair[1] // 40])
    members = np.full((len(every), 3), -1)
    np.put_along_axis(members, every // 40, every % 40, axis=1)
    chi_sq = joint_density(together.observers.sources, members, region).chi_sq
    wholes = (np.isin(every // 40, together.observers.whole)).sum(axis=1)
    limit = np.where(wholes == 1, chi_sq_limit(6), chi_sq_limit(4))
    due = every[chi_sq <= limit]
    assert np.column_stack([together.i, together.j]).tolist() == due.tolist() and 120 < len(due) < 0.5 * len(every)


def chi_sq_limit(dimensions):
    """χ² of the wide gate's completeness."""
    from scipy.stats import chi2

    from sameas.gate import DEFAULT_COMPLETENESS

    return chi2.ppf(DEFAULT_COMPLETENESS, dimensions)


# ---- refusals ----


def test_invalid_input_is_refused_with_a_clear_message():
    plane = Records.of([[0.0, 0.0]], sigma=1.0, source="radar")
    line = Records.of([[0.0]], sigma=1.0, source="sonar")
    rule = PoissonObjects(0.1, 0.1)
    part = Observations(line, LinearPart([[1.0, 0.0]]))
    path, counted = cast("Any", "ais.csv"), cast("Any", CommonObjects(0.1, 0.1))
    partial = cast("Any", part)
    cases = [
        (lambda: identify_many([plane], rule=rule), "1 source given"),
        (lambda: identify_many([plane, path], rule=rule), r"source 1 is a str; make it with Records\.of"),
        (lambda: identify_many([plane, line], rule=rule), "radar: 2, sonar: 1"),
        (lambda: identify_many([plane, part], rule=rule), "sonar observes a part of the state; give region"),
        (lambda: identify_many([plane, part], rule=Field(0.1), region=Region((0, 0), (9, 9))), "compares whole"),
        (lambda: identify_many([plane, plane], rule=PoissonField(0.1, 0.1, 0.1)), "PoissonField is for two sources"),
        (lambda: identify_many([plane, plane], rule=PoissonObjects(0.1, (0.1,) * 3)), "q has 3 numbers for 2 sources"),
        (lambda: identify_many([plane, plane], rule=rule, prior=counted), r"give MissedObjects\(q\)"),
        (lambda: PoissonObjects(0.0, 0.1), "density is 0"),
        (lambda: MissedObjects((0.1, 1.0)), "strictly between 0 and 1"),
        (lambda: Observations(plane, LinearPart([[1.0, 0.0]])), "radar: its part gives 1 features of 2 components"),
        (lambda: Region((0, 0), [[1.0, 2.0], [2.0, 1.0]]), "not positive definite"),
        (lambda: identify_many([plane, plane], rule=rule).of(5), "source is 5; give 0 … 1"),
        (lambda: identify_sequentially([plane, partial], rule=rule), "part of the state"),
    ]
    for call, words in cases:
        with pytest.raises(InputError, match=words):
            call()


def test_without_records_there_are_no_objects():
    empty = Records.of(np.empty((0, 2)), sigma=1.0)
    got = identify_many([empty, empty, empty], rule=PoissonObjects(0.1, 0.1))
    assert len(got) == 0 and got.members.shape == (0, 3) and len(got.p_runner_up) == 0
    counted = identify_many([empty, empty], rule=CloseObjects(1.0, 2.0), prior=MissedObjects(0.1))
    assert len(counted) == 0


@pytest.mark.parametrize("false", [np.float32(0.01), np.array(0.01), [0.01, 0.01], [np.full(2, 0.01), 0.01]])
def test_false_records_may_be_a_number_of_any_kind_or_one_at_each_record(false):
    first = Records.of([[0.0, 0.0], [9.0, 0.0]], sigma=1.0, source="a")
    second = Records.of([[0.5, 0.0], [30.0, 0.0]], sigma=1.0, source="b")
    expected, got = (identify_many([first, second], rule=PoissonObjects(1e-3, 0.1, one)) for one in (0.01, false))
    assert np.allclose(got.probability, expected.probability, rtol=1e-7)
