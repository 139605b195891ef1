"""Set rules next to positions, for many sources: enumeration, invariances, bounds, calibration, explanations."""

import gc
import itertools
import math
import weakref
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
from scipy.special import logsumexp

import test_many
from sameas import (
    CloseObjects,
    CommonObjects,
    Field,
    InputError,
    PerPair,
    Plane,
    PoissonField,
    Records,
    Region,
    Universal,
    identify,
)
from sameas.evidence import Displacement, Evidence, Flat, Identity, Rule
from sameas.gate import Radius
from sameas.many.identify import identify_many, identify_sequentially
from sameas.many.observations import Bearing, Observations, records_of
from sameas.many.pooled import pooled
from sameas.many.rules import (
    MissedObjects,
    PoissonObjects,
    SetRules,
    best_of_three,
    best_reference,
    by_precision,
    parts_of,
    terms_of,
)
from sameas.many.sets import ManyTuning, candidate_sets
from test_many import WIDE, enumerated, field_scene, probabilities, same_as_identify, sets_of, small_scene


@dataclass(frozen=True)
class PrescribedEvidence(Rule):
    """Prescribed evidence: ln r of two records by their (source, row), 0.0 if not listed."""

    values: dict

    def __call__(self, pairs):
        a, b = pairs.first, pairs.second
        rows = zip(a.rows[pairs.i].tolist(), b.rows[pairs.j].tolist(), strict=True)
        log_ratio = [self.values.get(frozenset({(a.source, i), (b.source, j)}), 0.0) for i, j in rows]
        return Evidence({"prescribed": np.array(log_ratio, dtype=np.float64)})


def random_rule(rng, sources, share):
    """Random evidence from −5 to 5 for a share of all pairs."""
    records = [(s.source, row) for s in sources for row in range(len(s))]
    pairs = itertools.combinations(records, 2)
    return PrescribedEvidence({frozenset(pair): rng.uniform(-5, 5) for pair in pairs if rng.random() < share})


def naive_best_reference(ln_r, members):
    """Log weight of a set under a rule, record by record; ln_r is {two members: value} of the pairs with evidence."""
    speak = [m for m in members if any(m in pair for pair in ln_r)]
    stars = []
    for hub in speak:
        others = [frozenset({hub, m}) for m in speak if m != hub]
        if all(pair in ln_r for pair in others):
            stars.append(sum(ln_r[pair] for pair in others))
    if stars:
        return max(stars)
    return min(1.0, (len(speak) - 1) / max(len(ln_r), 1)) * sum(ln_r.values())


def set_evidence(sources, rules, members):
    total = 0.0
    for rule in rules:
        named = {(s, row): (sources[s].source, row) for s, row in members}
        ln_r = {}
        for one, other in itertools.combinations(members, 2):
            value = rule.values.get(frozenset({named[one], named[other]}), 0.0)
            if value != 0.0:
                ln_r[frozenset({one, other})] = value
        total += naive_best_reference(ln_r, members)
    return total


# ---- against the enumeration of every partition ----


@pytest.mark.slow_after(3)
@pytest.mark.parametrize("counts", [(2, 2), (2, 2, 2), (3, 2, 1), (1, 2, 1, 2), (2, 1, 1, 1, 1)])
@pytest.mark.parametrize("share", [0.4, 1.0])
def test_rules_next_to_positions_agree_with_all_partitions(counts, share):
    rng = np.random.default_rng([*counts, int(10 * share)])
    for _ in range(3):
        sources = small_scene(rng, counts)
        rules = [random_rule(rng, sources, share), random_rule(rng, sources, share)]
        q, false = rng.uniform(0.1, 0.5, len(counts)), rng.uniform(0, 0.1, len(counts))
        of_positions = test_many.poisson_weight(sources, 0.1, q, false)
        got = identify_many(sources, rule=PoissonObjects(0.1, q, false) + rules[0] + rules[1], gate=WIDE)
        _, best, p = enumerated(sources, lambda x: of_positions(x) + sum(set_evidence(sources, rules, m) for m in x))  # noqa: B023
        assert set(sets_of(got)) == best and got.groups.exact.all()
        for members, stated in probabilities(got).items():
            assert stated == pytest.approx(p[members], abs=1e-9)


def test_rules_are_added_to_pairwise_ones_under_a_count_prior():
    rng = np.random.default_rng(2)
    for counts in ((2, 2, 2), (3, 2, 1)):
        sources = small_scene(rng, counts)
        rule, q = random_rule(rng, sources, 0.7), rng.uniform(0.1, 0.5, 3)
        of_positions = test_many.counted_weight(sources, 1.0, 4.0, q)
        got = identify_many(sources, rule=CloseObjects(1.0, 4.0) + rule, prior=MissedObjects(q), gate=WIDE)
        _, best, p = enumerated(sources, lambda x: of_positions(x) + sum(set_evidence(sources, [rule], m) for m in x))  # noqa: B023
        assert set(sets_of(got)) == best
        for members, stated in probabilities(got).items():
            assert stated == pytest.approx(p[members], abs=1e-9)


@pytest.mark.parametrize("position_rule", [PoissonObjects(0.3, 0.2), CloseObjects(1.0, 4.0)])
def test_no_set_that_outweighs_its_single_records_is_omitted(position_rule):
    """Bounds include non-positional evidence: at every floor the kept sets are those above it of floor −∞."""
    rng = np.random.default_rng(4)
    for _ in range(6):
        sources = small_scene(rng, (3, 3, 2, 2), extent=5.0)
        rule = position_rule + random_rule(rng, sources, rng.choice([0.3, 1.0])) + random_rule(rng, sources, 0.5)
        together = pooled(sources, Radius(4.0))
        terms = terms_of(rule, PerPair(-1.0), together)
        everything = candidate_sets(together, terms)
        heavy = {tuple(m): w for m, w in zip(everything.members.tolist(), everything.log_weight, strict=True)}
        for floor in (0.0, 3.0, 8.0):
            kept = candidate_sets(together, terms, ManyTuning(floors=(floor,)))
            several = kept.members[kept.size > 1].tolist()
            assert set(map(tuple, several)) == {m for m, w in heavy.items() if w > floor and sum(np.array(m) >= 0) > 1}
        assert max(heavy.values()) > 8.0


# ---- sums of pair evidence in a set ----


def exact_code(values, n_values, wrong):
    """ln λ of the texts of k records of one object, each wrong with some probability: the sum over true values."""
    p = 1.0 / n_values
    ln_each = [sum(math.log((1 - wrong) * (v == true) + wrong * p) for v in values) for true in [*set(values), None]]
    others = math.log1p(-len(set(values)) * p)
    ln_p = [math.log(p)] * len(set(values)) + [others]
    return float(logsumexp(np.add(ln_p, ln_each))) - len(values) * math.log(p)


@pytest.mark.parametrize("values", ["AA", "AB", "AAA", "AAB", "ABC", "AAAA", "AAAB", "AABB", "AABC", "ABCD", "AAAAB"])
def test_sets_of_codes_have_the_weight_of_their_model(values):
    """The rule's approximation (one record's value is true) is below the sum over all true values by less than ln k."""
    n_values, wrong = 1e5, 0.01
    pairs = [(i, j) for j in range(len(values)) for i in range(j)]
    ln_r = np.array([[exact_code([values[i], values[j]], n_values, wrong) for i, j in pairs]])
    found = float((best_reference(ln_r, np.ones(ln_r.shape, bool)) * ln_r).sum())
    assert found == pytest.approx(exact_code(values, n_values, wrong), abs=math.log(len(values)) + 0.05)


def test_a_third_equal_or_contradicting_record_counts_once():
    agree, against = 7.0, -5.0
    informative = np.ones((2, 3), bool)
    ln_r = np.array([[agree] * 3, [agree, against, against]])  # pairs (0, 1), (0, 2), (1, 2)
    np.testing.assert_allclose((best_reference(ln_r, informative) * ln_r).sum(axis=1), [2 * agree, agree + against])


def test_sets_of_three_weigh_by_their_best_reference_to_the_last_digit():
    rng = np.random.default_rng(1)
    ln_r = np.where(rng.random((500, 3)) < 0.3, 0.0, 10.0 * rng.standard_normal((500, 3)))
    informative = ln_r != 0.0
    by_shares = (best_reference(ln_r, informative) * ln_r).sum(axis=1)
    assert np.array_equal(best_of_three(ln_r, informative), by_shares)


def test_records_without_evidence_change_no_set():
    ln_r, informative = (
        np.array([[7.0, 0.0, 0.0], [7.0, 0.0, -5.0]]),
        np.array([[True, False, False], [True, False, True]]),
    )
    np.testing.assert_allclose((best_reference(ln_r, informative) * ln_r).sum(axis=1), [7.0, 2.0])
    # A–B and C–D have evidence of different kinds: both count, each once.
    apart = np.array([[3.0, 0.0, 0.0, 0.0, 0.0, 4.0]])
    np.testing.assert_allclose((best_reference(apart, apart != 0) * apart).sum(axis=1), [7.0])


# ---- invariances ----


def identity_of(rng, sources, objects, known=0.7, wrong=0.02):
    """An Identity rule for records of ``objects`` (for each source the object of every row)."""
    n = max(int(o.max()) for o in objects) + 1
    names = {"mmsi": rng.integers(200_000_000, 775_999_999, n), "callsign": rng.integers(10_000, 99_999, n)}
    attributes = {}
    for source, of in zip(sources, objects, strict=True):
        columns = {}
        for name, values in names.items():
            shown = np.where(rng.random(len(of)) < wrong, rng.permutation(values[of]), values[of]).astype(object)
            shown[rng.random(len(of)) >= known] = None
            columns[name] = shown
        attributes[source.source] = columns
    return Identity(attributes)


def named_scene(rng, n_sources, n, extent, sigma=1.0, q=0.15, **options):
    positions = rng.uniform(0, extent, (n, 2))
    objects = [rng.permutation(np.flatnonzero(rng.uniform(size=n) >= q)) for _ in range(n_sources)]
    sources = [
        Records.of(positions[o] + rng.normal(size=(len(o), 2)) * sigma, sigma=sigma, source=f"s{s}")
        for s, o in enumerate(objects)
    ]
    return sources, objects, identity_of(rng, sources, objects, **options)


def test_two_sources_agree_with_identify_for_the_same_rules():
    rng = np.random.default_rng(11)
    for _ in range(4):
        sources, _, identity = named_scene(rng, 2, 15, 14.0)
        q, density = (0.1, 0.3), 0.08
        field = PoissonField(density * 0.9 * 0.7, density * 0.9 * 0.3, density * 0.7 * 0.1)
        many = identify_many(sources, rule=PoissonObjects(density, q) + identity)
        same_as_identify(many, identify(*sources, rule=field + identity))
        many = identify_many(sources, rule=identity + CloseObjects(1.0, 6.0), prior=MissedObjects(q))
        prior = CommonObjects(*q)
        same_as_identify(many, identify(*sources, rule=CloseObjects(1.0, 6.0) + identity, prior=prior))


@pytest.mark.slow
@pytest.mark.parametrize("grid", [None, 3.0])
def test_the_order_of_sources_and_rows_changes_nothing(grid):
    rng = np.random.default_rng(21)
    sources = field_scene(rng, 3, 10, extent=12.0, grid=grid)
    identity = identity_of(rng, sources, [np.arange(len(s)) for s in sources])
    first = probabilities(identify_many(sources, rule=PoissonObjects(0.07, (0.1, 0.2, 0.3)) + identity))
    for turn in itertools.permutations(range(3)):
        rows = [rng.permutation(len(sources[s])) for s in turn]
        mixed, attributes = [], {}
        for s, order in zip(turn, rows, strict=True):
            name = sources[s].source
            mixed.append(Records.of(sources[s].features[order], sigma=1.0, ids=order, source=name))
            attributes[name] = {key: np.asarray(v)[order] for key, v in identity.attributes[name].items()}
        q = tuple((0.1, 0.2, 0.3)[s] for s in turn)
        got = probabilities(identify_many(mixed, rule=PoissonObjects(0.07, q) + Identity(attributes)))
        assert {frozenset((turn[s], int(rows[s][row])) for s, row in k): p for k, p in got.items()} == first


def test_a_rule_without_evidence_changes_nothing():
    rng = np.random.default_rng(22)
    sources = field_scene(rng, 3, 30, extent=30.0)
    alone = identify_many(sources, rule=PoissonObjects(0.03, 0.15))
    silent = identify_many(sources, rule=PoissonObjects(0.03, 0.15) + PrescribedEvidence({}) + Identity({}))
    assert probabilities(alone) == probabilities(silent)


@pytest.mark.slow
def test_probabilities_are_calibrated_when_some_identities_are_wrong():
    rng = np.random.default_rng(23)
    stated, right = [], []
    for _ in range(6):
        sources, objects, identity = named_scene(rng, 3, 150, 60.0, known=0.9, wrong=0.01)
        found = identify_many(sources, rule=PoissonObjects(150 / 60.0**2, 0.15) + identity)
        true_sets = {
            frozenset((s, int(np.flatnonzero(o == k)[0])) for s, o in enumerate(objects) if k in o) for k in range(150)
        }
        stated += found.probability.tolist()
        right += [members in true_sets for members in sets_of(found)]
    stated, right = np.array(stated), np.array(right)
    assert (~right).sum() == pytest.approx((1 - stated).sum(), abs=3 * math.sqrt((stated * (1 - stated)).sum()) + 3)
    assert right.mean() > 0.95


# ---- sources that measure only some features ----


def test_identities_of_bearings_are_used():
    radar = Records.of([[0.0, 1000.0], [100.0, 1000.0]], sigma=30.0, source="radar")
    bearings = Records.of([[2.9]], sigma=2.0, space=Plane(periods=(360.0,)), source="esm")
    region = Region((0.0, 0.0), (5000.0, 5000.0))
    sources: list[Records | Observations] = [radar, Observations(bearings, Bearing(sensor=(0.0, 0.0)))]
    objects = PoissonObjects(1e-6, 0.1, (0.0, 1e-4))
    without_identity = identify_many(sources, rule=objects, region=region)
    assert without_identity.of("esm").p_partner[0, 0] < 0.6
    for row in (0, 1):
        of_radar: list[str | None] = [None, None]
        of_radar[row] = "SUPER7"
        attributes = {"radar": {"callsign": of_radar}, "esm": {"callsign": ["SUPER7"]}}
        answers = identify_many(sources, rule=objects + Identity(attributes), region=region).of("esm")
        assert answers.partner[0, 0] == row and answers.p_partner[0, 0] > 0.95


# ---- refusals ----


def test_rules_are_split_into_position_rules_and_others():
    identity, objects = Identity({}), PoissonObjects(1.0, 0.1)
    no_rules: list[Any] = [1.0, objects]
    for rule in (
        objects + identity + PrescribedEvidence({}),
        identity + objects + PrescribedEvidence({}),
        objects + (identity + PrescribedEvidence({})),
    ):
        assert isinstance(rule, SetRules) and parts_of(rule) == (objects, (identity, PrescribedEvidence({})))
    assert [type(part) for part in parts_of(identity + Field(1.0))[1]] == [Identity]
    for other in no_rules:
        with pytest.raises(TypeError):
            objects + other


@dataclass(frozen=True)
class Near(Rule):
    """A custom position rule."""

    def __call__(self, pairs):
        return Evidence({"position": -pairs.mahalanobis_sq})


def test_invalid_rules_are_refused_with_a_clear_message():
    rng = np.random.default_rng(31)
    sources = small_scene(rng, (2, 2, 2))
    objects, identity = PoissonObjects(0.1, 0.2), Identity({})
    refused: dict[str, Any] = {
        "Identity does not use positions; add it to PoissonObjects": identity,
        "both rules use positions": objects + Field(1.0),
        "Universal is for two sources": objects + Universal(Flat(1.0), Displacement(Flat(1.0))),
        "both Near and the rule it is added to use positions": objects + Near(),
    }
    for words, rule in refused.items():
        with pytest.raises(InputError, match=words):
            identify_many(sources, rule=rule)
    impossible = PrescribedEvidence({frozenset({("s0", 1), ("s2", 0)}): -math.inf})
    with pytest.raises(
        InputError, match=r"prescribed is -inf for s(0 row 1 and s2 row 0|2 row 0 and s0 row 1).*bound it"
    ):
        identify_many(sources, rule=objects + impossible, gate=WIDE)
    with pytest.raises(InputError, match="identify_sequentially compares positions, and Identity needs records"):
        identify_sequentially(sources, rule=objects + identity)


# ---- explanations ----


@pytest.mark.slow
def test_explanations_state_the_weight_of_every_term():
    rng = np.random.default_rng(41)
    sources, _, identity = named_scene(rng, 3, 12, 14.0)
    for rule, prior in ((PoissonObjects(0.06, 0.15), PerPair(-0.5)), (CloseObjects(1.0, 6.0), MissedObjects(0.2))):
        found = identify_many(sources, rule=rule + identity, prior=prior)
        weight = dict(zip(map(tuple, found.sets.members.tolist()), found.sets.log_weight, strict=True))
        for k in range(len(found)):
            why = found.explain(k)
            assert why.chosen.probability == found.probability[k]
            if why.runner_up is None:
                assert found.p_runner_up[k] is np.ma.masked
            else:
                assert why.runner_up.probability == pytest.approx(float(found.p_runner_up[k]), abs=1e-12)
                difference = why.chosen.log_odds - why.runner_up.log_odds
                assert sum(why.against_runner_up.values()) == pytest.approx(difference, abs=1e-9)
            for rival in why.rivals:
                assert sum(rival.terms.values()) == pytest.approx(rival.log_odds, abs=1e-9)
                numbers = [-1, -1, -1]
                for source, row in rival.members:
                    s = found.pooled.given.index(int(source[1:]))
                    at = np.flatnonzero(records_of(found.pooled.sources[s]).rows == row)[0]
                    numbers[s] = int(found.pooled.start[s] + at)
                assert weight[tuple(numbers)] == rival.log_odds
            if found.groups.exact[why.group]:
                # A set and its rival sets together contain every record.
                one = why.chosen.members[0]
                assert sum(r.probability for r in why.rivals if one in r.members) == pytest.approx(1.0, abs=1e-6)


def test_explanations_of_two_sources_agree_with_identify():
    rng = np.random.default_rng(42)
    sources, _, identity = named_scene(rng, 2, 8, 8.0, known=1.0)
    density, q = 0.12, 0.15
    field = PoissonField(density * (1 - q) ** 2, density * (1 - q) * q, density * (1 - q) * q)
    one = identify(*sources, rule=field + identity)
    many = identify_many(sources, rule=PoissonObjects(density, q) + identity)
    for k in np.flatnonzero(many.n_members == 2).tolist():
        rows = many.members[k]
        pair = np.flatnonzero((one.rows_1 == rows[0]) & (one.rows_2 == rows[1]))[0]
        for name, value in many.explain(k).chosen.terms.items():
            assert value == pytest.approx(float(one.evidence.terms[name][pair]), abs=1e-9)


def test_explanations_print_as_text():
    radar = Records.of([[0.0, 0.0], [6.0, 0.0]], sigma=2.0, ids=["r1", "r2"], source="radar")
    ais = Records.of([[3.2, 0.0], [6.0, 3.0]], sigma=1.0, ids=["a1", "a2"], source="ais")
    attributes = {"radar": {"callsign": ["SUPER7", None]}, "ais": {"callsign": ["SUPER7", None]}}
    found = identify_many([radar, ais], rule=PoissonObjects(0.01, 0.2) + Identity(attributes))
    text = str(found.explain(0))
    assert text.startswith("Object 0 is radar r1 = ais a1, probability 0.99")
    assert "Group 0: 4 records; probabilities are summed over all partitions." in text
    assert "callsign +" in text and "\n→ radar r1 = ais a1" in text
    assert "Against the runner-up, " in text.splitlines()[-2] + text.splitlines()[-1]
    single = identify_many([radar, Records.of([[900.0, 0.0]], sigma=1.0)], rule=PoissonObjects(0.01, 0.2))
    assert str(single.explain(0)).endswith("Nothing else is possible.")


def test_a_rival_set_that_takes_a_record_from_another_object_is_marked():
    radar = Records.of([[0.0, 0.0], [2.0, 0.0]], sigma=1.0, source="radar")
    ais = Records.of([[0.9, 0.0], [2.2, 0.0]], sigma=1.0, source="ais")
    found = identify_many([radar, ais], rule=PoissonObjects(0.01, 0.1))
    why = found.explain(0)
    ((record, holder),) = why.runner_up.taken
    assert record in (("ais", 1), ("radar", 1)) and record in why.runner_up.members and holder == 1
    assert str(why).endswith(f"It would take {record[0]} 1 from object 1.")


def test_an_explained_result_is_released_with_its_last_reference():
    sources = small_scene(np.random.default_rng(43), (2, 2))
    found = identify_many(sources, rule=PoissonObjects(0.1, 0.2))
    found.explain(0)
    reference = weakref.ref(found)
    gc.disable()
    try:
        del found
        assert reference() is None
    finally:
        gc.enable()


def test_unknown_objects_and_sequential_results_cannot_be_explained():
    rng = np.random.default_rng(43)
    sources = small_scene(rng, (2, 2))
    found = identify_many(sources, rule=PoissonObjects(0.1, 0.2))
    with pytest.raises(InputError, match=f"there is no object {len(found)}; give 0 … {len(found) - 1}"):
        found.explain(len(found))
    with pytest.raises(InputError, match="only the objects of identify_many are explained"):
        identify_sequentially(sources, rule=PoissonObjects(0.1, 0.2)).explain(0)


def test_pairs_weighted_by_precision_have_the_joint_chi_squared_of_all_positions():
    rng = np.random.default_rng(4)
    for k in (2, 3, 4):
        x, w = rng.normal(size=k), rng.uniform(0.1, 5.0, k)
        later, earlier = np.tril_indices(k, -1)
        chi_sq = (x[later] - x[earlier]) ** 2 / (1.0 / w[later] + 1.0 / w[earlier])
        shares = by_precision((w[later] + w[earlier])[None])
        joint = (w * (x - np.average(x, weights=w)) ** 2).sum()
        assert float((shares * chi_sq).sum()) == pytest.approx(joint)
        assert shares.sum() == pytest.approx(k - 1.0)
    # A record that is compared with none of the others does not lower their shares.
    np.testing.assert_allclose(
        by_precision(np.array([[2.0, 0.0, 0.0], [2.0, 1.0, 0.0]])), [[1.0, 0.0, 0.0], [1.0, 2 / 3, 0.0]]
    )
