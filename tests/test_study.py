"""The study: batches of scenes equal single scenes, tallies agree with scores, rules with enumeration."""

import dataclasses
import math

import numpy as np
import pytest
from benchmarks.study import experiments, mori, priors, several, tally, trial
from benchmarks.study.__main__ import main
from benchmarks.study.claims import Claim
from benchmarks.study.contenders import (
    PAPERS_GATE,
    Close,
    Constant,
    Enumerated,
    Identified,
    KnownFormation,
    NoPrior,
    Uniform,
    Verdict,
    line_up,
)
from benchmarks.study.reach import EstimatedReach
from benchmarks.study.scenes import EQUAL, FAR, UNEQUAL, Formation, Lattice, Scatter
from benchmarks.study.study import studied
from benchmarks.study.tally import Ratio, Tally, count, rightly

from sameas import CommonObjects, identify
from sameas.errors import InputError
from sameas.many.identify import identify_many
from sameas.score.pairs import is_true_pair, score_probabilities, score_records
from sameas.score.picture import gospa
from sameas.simulate.scenes import grid

FIVE = Lattice((5, 1), 1.9, (0.2, 0.3), UNEQUAL)
FORMATIONS: dict[str, Formation] = {
    "line": FIVE,
    "grid": Lattice((2, 3), 2.5, (0.3, 0.1)),
    "four features": Lattice((2, 2, 1, 1), 2.0, (0.1, 0.4)),
    "Poisson": Scatter(0.1, 6, (0.2, 0.2)),
}
TRIPLE = Scatter(0.1, 4, (0.1, 0.2, 0.15), (EQUAL[0], EQUAL[0], 0.4), numbers="fixed")


def drawn(formation, count=40, seed=1):
    return formation(np.random.default_rng(seed), count)


def pairs_of(verdict):
    return sorted(zip(verdict.i.tolist(), verdict.j.tolist(), strict=True))


# ---- scenes ----


@pytest.mark.parametrize("name", FORMATIONS)
def test_batches_of_scenes_equal_single_scenes(name):
    formation = FORMATIONS[name]
    scenes = drawn(formation)
    rules = [Identified("close", Close()), Identified("uniform", Uniform()),
             Identified("constant", Constant(), NoPrior(), experiments.OPEN_GATE)]  # fmt: skip
    for contender in rules:
        verdict = contender(scenes, formation)
        claimed, certain = [], {}
        for scene in range(len(scenes)):
            rows, records = scenes.one(scene)
            # A single scene with the same rule parameters, and a box from its own records only.
            alone = dataclasses.replace(scenes, count=1, stride=FAR, sources=records,
                                        scene=tuple(np.zeros(len(r), int) for r in rows))  # fmt: skip
            rule = contender.rule(alone, formation)
            found = identify(*records, rule=rule, prior=contender.prior(formation), gate=contender.gate)
            i, j = rows[0][found.pairs.i], rows[1][found.pairs.j]
            claimed += zip(i[found.chosen].tolist(), j[found.chosen].tolist(), strict=True)
            certain |= dict(zip(zip(i.tolist(), j.tolist(), strict=True), found.p_pair, strict=True))
        assert pairs_of(verdict) == sorted(claimed)
        i, j, p = verdict.candidates
        assert len(p) == len(certain) > 30
        expected = np.array([certain[a, b] for a, b in zip(i.tolist(), j.tolist(), strict=True)])
        np.testing.assert_allclose(p, expected, atol=1e-6)


def test_groups_never_join_scenes_even_without_a_gate():
    scenes = drawn(FORMATIONS["grid"])
    pairs = experiments.OPEN_GATE(*scenes.sources)
    assert np.array_equal(scenes.scene[0][pairs.i], scenes.scene[1][pairs.j])
    assert len(pairs) == (scenes.sizes[0] * scenes.sizes[1]).sum()


def test_a_lattice_agrees_with_simulate():
    formation = Lattice((3, 2), 2.0, (0.0, 0.0), (1e-9, 1e-9))
    scenes = drawn(formation, 2)
    given = grid(np.random.default_rng(0), shape=(3, 2), spacing_sigmas=2.0 / math.sqrt(2e-18), q1=0.0, q2=0.0,
                 sigma_1=1e-9, sigma_2=1e-9)  # fmt: skip
    for _, records in (scenes.one(0), scenes.one(1)):
        ours, theirs = (np.round(r.features, 5) for r in (records[0], given.first))
        assert {tuple(x + 0.0) for x in ours} == {tuple(x + 0.0) for x in theirs}


def test_sources_have_the_given_misses_and_errors():
    scenes = drawn(FIVE, 4000)
    seen = [len(t) / len(scenes.targets) for t in scenes.truth]
    assert seen == pytest.approx([0.8, 0.7], abs=0.015)
    for records, truth, sigma in zip(scenes.sources, scenes.truth, UNEQUAL, strict=True):
        assert (records.features - scenes.targets[truth]).std() == pytest.approx(sigma, rel=0.02)
    numbers = np.bincount(drawn(Scatter(0.1, 6), 2000).target_scene)
    assert numbers.mean() == pytest.approx(6, abs=0.2) and numbers.var() == pytest.approx(6, rel=0.12)
    assert np.all(np.bincount(drawn(TRIPLE).target_scene) == 4)


def test_a_run_of_more_scenes_repeats_a_shorter_one():
    point = trial.Point("x", "five", FIVE, (Identified("close", Close()),))
    one, two, both = (trial.tallies(point, blocks)[0] for blocks in ([0], [1], [0, 1]))
    np.testing.assert_array_equal(both.total, one.total + two.total)
    assert not np.array_equal(one.total, two.total)


@pytest.mark.parametrize(
    "make, words",
    [
        (lambda: Lattice((2, 1), 1.0, (0.1,), (1.0,)), "1 q and 1 sigma; give as many of both"),
        (lambda: Lattice((2, 1), 1.0, (0.1, 1.0)), "probabilities below 1"),
        (lambda: Scatter(0.1, 5, numbers="some"), 'give "fixed" or "Poisson"'),
        (lambda: studied(1), "scenes is 1; give at least 2"),
        (lambda: studied(10, ["gospel"]), "no experiment is called gospel; give one of claims, spacing"),
    ],
)
def test_invalid_scenes_and_experiments_are_refused(make, words):
    with pytest.raises(InputError, match=words):
        make()


# ---- tallies ----


def test_a_tally_agrees_with_the_scores_of_single_scenes():
    scenes = drawn(FIVE, 30)
    verdict = Identified("close", Close())(scenes, FIVE)
    figures = count(scenes, verdict).figures()
    right, whole, total, distance = 0, 0, 0, []
    for scene in range(len(scenes)):
        rows, records = scenes.one(scene)
        truth = [t[r] for t, r in zip(scenes.truth, rows, strict=True)]
        true = np.argwhere(truth[0][:, None] == truth[1][None])
        here = np.isin(verdict.i, rows[0])
        claimed = np.searchsorted(rows[0], verdict.i[here]), np.searchsorted(rows[1], verdict.j[here])
        score = score_records(claimed, (true[:, 0], true[:, 1]), len(rows[0]), len(rows[1]))
        right, total = right + score.n_right_1 + score.n_right_2, total + score.n_1 + score.n_2
        whole += score.share_right == 1.0
        weight = [1 / r.covariance[0, 0] for r in records]
        both = [r.features[c] for r, c in zip(records, claimed, strict=True)]
        fused = (weight[0] * both[0] + weight[1] * both[1]) / sum(weight)
        alone = [np.delete(r.features, c, axis=0) for r, c in zip(records, claimed, strict=True)]
        targets = scenes.targets[scenes.target_scene == scene] - [scene * scenes.stride, 0.0]
        distance.append(gospa(np.concatenate([fused, *alone]), targets, cutoff=tally.CUTOFF).distance)
    assert figures["right"].value == pytest.approx(right / total)
    assert figures["whole"].value == pytest.approx(whole / 30)
    assert figures["gospa"].value == pytest.approx(np.mean(distance))
    assert figures["gospa"].error == pytest.approx(np.std(distance, ddof=1) / math.sqrt(30))
    i, j, p = verdict.candidates
    true = np.intersect1d(*scenes.truth, return_indices=True)[1:]
    expected = score_probabilities(p, is_true_pair((i, j), true))
    assert figures["brier"].value == pytest.approx(expected.brier)
    assert figures["ece"].value == pytest.approx(expected.expected_calibration_error)
    assert figures["missed pairs"].value == pytest.approx(1 - is_true_pair((verdict.i, verdict.j), true).mean()
                                                          * len(verdict.i) / len(true[0]))  # fmt: skip


@pytest.mark.slow
def test_standard_errors_agree_with_repetition():
    contender = Identified("close", Close())
    figures = [count(s, contender(s, FIVE)).figures() for s in (drawn(FIVE, 100, seed) for seed in range(120))]
    for name in ("right", "whole", "wrong pairs"):
        spread = np.std([f[name].value for f in figures], ddof=1)
        assert np.mean([f[name].error for f in figures]) == pytest.approx(spread, rel=0.25)


def test_a_record_named_twice_counts_as_wrong():
    scenes = drawn(Lattice((2, 1), 3.0, (0.0, 0.0)), 1)
    same = int(np.flatnonzero(scenes.truth[1] == scenes.truth[0][0])[0])
    one_to_one = Verdict(np.array([0, 1]), np.array([same, 1 - same]))
    twice = Verdict(np.array([0, 1]), np.array([same, same]))
    # Of four records only the first of source 1 is right: its partner is named twice, that one's neighbour not at all.
    assert rightly(scenes, one_to_one).tolist() == [4.0]
    assert rightly(scenes, twice).tolist() == [1.0]


def test_a_lead_is_a_difference_of_two_rules_with_its_standard_error():
    point = trial.Point("x", "lead", FIVE, (Identified("close", Close()), Identified("uniform", Uniform())))
    close, uniform = (t.figures() for t in trial.tallies(point, [0]))
    assert close["lead"] == Ratio(0.0, 0.0)
    assert uniform["lead"].value == pytest.approx(uniform["right"].value - close["right"].value)
    assert 0 < uniform["lead"].error < 0.7 * uniform["right"].error


def test_an_empty_tally_is_nan():
    empty = Tally(np.zeros(len(tally.COLUMNS)), np.zeros((len(tally.COLUMNS),) * 2), np.zeros((1, 3, tally.BINS)), 0.0)
    assert math.isnan(empty.ratio("right", "records").value) and math.isnan(empty.calibration_error.value)


# ---- contenders ----


def test_enumeration_agrees_with_assignment():
    for formation in (FIVE, FORMATIONS["grid"]):
        scenes = drawn(formation, 30)
        assert pairs_of(Enumerated("all", Close())(scenes, formation)) == pairs_of(
            Identified("close", Close())(scenes, formation)
        )


@pytest.mark.slow
def test_the_rule_with_the_known_formation_is_best():
    formation = Lattice((5, 1), 1.9, (0.2, 0.2))
    scenes = drawn(formation, 1500)
    shares = {
        c.name: count(scenes, c(scenes, formation)).figures()["right"].value
        for c in (*line_up(formation)[:7], Identified("known", KnownFormation()))
    }
    assert max(shares, key=shares.get) == "known"
    assert shares["close objects"] > shares["independent Bayes"] + 0.08


def test_the_reach_is_estimated_for_each_scene():
    scenes = drawn(FIVE, 25)
    verdict = EstimatedReach()(scenes, FIVE)
    from sameas import CloseObjects
    from sameas.evidence.close import estimate_reach

    claimed = []
    for scene in range(25):
        rows, (first, second) = scenes.one(scene)
        b = tuple(estimate_reach(first, second).b)
        found = identify(
            first, second, rule=CloseObjects(1.1, b), prior=CommonObjects(FIVE.q[0], FIVE.q[1]), gate=PAPERS_GATE
        )
        claimed += zip(rows[0][found.matches.rows_1].tolist(), rows[1][found.matches.rows_2].tolist(), strict=True)
    assert pairs_of(verdict) == sorted(claimed)
    alone = Lattice((1, 1), 1.0, (0.3, 0.3))
    assert len(EstimatedReach()(drawn(alone), alone).i) > 5  # one record a source: nothing to measure, b is assumed


def test_stone_soup_minimises_distances_within_its_threshold():
    pytest.importorskip("stonesoup")
    from benchmarks.study.stonesoup import StoneSoup
    from scipy.optimize import linear_sum_assignment

    scenes = drawn(FIVE, 12)
    expected = []
    for scene in range(12):
        rows, (first, second) = scenes.one(scene)
        distance = np.linalg.norm(first.features[:, None] - second.features[None], axis=-1) / UNEQUAL[0]
        limit = 3.0 / UNEQUAL[0]
        i, j = linear_sum_assignment(np.minimum(distance, limit))
        kept = distance[i, j] < limit
        expected += zip(rows[0][i[kept]].tolist(), rows[1][j[kept]].tolist(), strict=True)
    assert pairs_of(StoneSoup()(scenes, FIVE)) == sorted(expected)


@pytest.mark.slow
def test_without_stone_soup_its_column_is_omitted_with_a_note(monkeypatch):
    from benchmarks.study import command, stonesoup

    monkeypatch.setattr(stonesoup, "find_spec", lambda name: None)
    assert not any("Stone Soup" in c.name for point in experiments.spacing() for c in point.contenders)
    with pytest.raises(InputError, match=r"Stone Soup is missing: pip install 'sameas\[stonesoup\]'"):
        stonesoup.StoneSoup()(drawn(FIVE, 2), FIVE)
    lines = command.summary(studied(2, ["priors"]))
    assert any("Stone Soup is missing" in line for line in lines)


# ---- priors, many sources, Mori ----


def test_the_exact_prior_is_never_worse_and_the_line_rarely_is():
    found = priors.compared(600)
    assert len(found) == 600 and found.loss.min() >= -1e-9
    assert 0 < found.differ.mean() < 0.03
    assert np.all(found.loss[~found.differ] == 0)


def test_enumeration_of_three_sources_agrees_with_the_joint_result():
    scenes = drawn(TRIPLE, 25)
    answer = several._in_order(identify_many, scenes, TRIPLE, (0, 1, 2))
    best = several.enumerated(scenes, TRIPLE)
    assert not several.differs(scenes, best, answer.members).any()
    whole = several.wholly_right(scenes, best)
    assert 0 < whole.sum() < 25


@pytest.mark.slow
def test_only_the_sequential_result_depends_on_the_order():
    counts = several.counts(several.Several("order", dataclasses.replace(TRIPLE, density=0.15), 50), 0)
    assert counts.mean("joint order") == Ratio(0.0, 0.0)
    assert counts.mean("order matters").value > 0.1
    assert counts.mean("gap").value == 0.0
    assert math.isnan(counts.mean("oracle whole").value)


def test_partitions_are_compared_record_by_record():
    scenes = drawn(TRIPLE, 2)
    right = np.full((len(scenes.targets), 3), -1)
    for s, truth in enumerate(scenes.truth):
        right[truth, s] = np.arange(len(truth))
    right = right[(right >= 0).any(axis=1)]
    assert several.wholly_right(scenes, right).all()
    assert not several.differs(scenes, right, right[::-1]).any()
    # Two objects of the second scene exchange their records of source 3.
    wrong, at = right.copy(), np.flatnonzero(scenes.target_scene[scenes.truth[2][right[:, 2]]] == 1)
    at = at[right[at, 2] >= 0][:2]
    wrong[at, 2] = right[at[::-1], 2]
    assert several.wholly_right(scenes, wrong).tolist() == [True, False]
    assert several.differs(scenes, right, wrong).tolist() == [False, True]


def test_moris_constants_agree_with_the_paper_and_hold_for_sparse_fields():
    assert [mori.constant(m) for m in (1, 2, 3)] == pytest.approx([2 / math.sqrt(math.pi), math.pi, 9.453], abs=5e-4)
    for m in (1, 2, 3):
        density = 0.03 / mori.constant(m)
        found = mori.simulated(density, m, 20)
        assert abs(found.value - mori.formula(density, m)) < 4 * found.error < 0.02


# ---- what is written ----


def test_a_claim_agrees_within_the_errors_of_both():
    def claim(value, error):
        return Claim("paper", "x", 0.79, 0.83, "records", Ratio(value, error))

    assert claim(0.80, 0.001).agrees and claim(0.776, 0.001).agrees and claim(0.75, 0.021).agrees
    assert not claim(0.75, 0.01).agrees
    assert claim(0.75, 0.01).verdict == "0.040 below" and claim(0.85, 0.001).verdict == "0.020 above"


@pytest.fixture
def small(monkeypatch):
    """A study of seconds in this process."""
    monkeypatch.setenv("SAMEAS_THREADS", "1")
    monkeypatch.setattr(trial, "BLOCK", 6)
    monkeypatch.setattr(trial, "PIECE", 6)
    monkeypatch.setattr(several, "TOGETHER", 2)
    monkeypatch.setattr(mori, "OBJECTS", 20)
    monkeypatch.setattr(experiments, "crowd", lambda: experiments._scattered(16.0, 3, 20))
    for name, value in (("FIVE_Q", (0.1,)), ("TWO_Q", (0.02, 0.6)), ("SPACINGS", (1.9, 3.0))):
        monkeypatch.setattr(experiments, name, value)
        monkeypatch.setattr("benchmarks.study.figures." + name, value)
    monkeypatch.setattr("benchmarks.study.study.GROUPS", 30)
    some = ("line of 5, d 1.9", "grid 5 × 5", "Poisson, density 0.1")
    monkeypatch.setattr(experiments, "FORMATIONS", {name: experiments.FORMATIONS[name] for name in some})
    few = [several.Several("3 sources, spacing 4", TRIPLE, 4, True),
           several.Several("2 sources, spacing 8", experiments._scattered(8.0, 2), 4)]  # fmt: skip
    monkeypatch.setattr(experiments, "several", lambda scenes: few)


@pytest.mark.slow
def test_the_command_writes_tables_figures_and_the_page(small, tmp_path, capsys):
    pytest.importorskip("matplotlib")
    main(["--scenes", "6", "-o", str(tmp_path / "out")])
    printed = capsys.readouterr().out
    assert "What was claimed" in printed and "6 scenes per point" in printed
    page = (tmp_path / "out/study.md").read_text()
    assert page.startswith("# What the papers claim and what we measure")
    figures = sorted(path.name for path in (tmp_path / "out/figures").iterdir())
    assert figures == [f"study-{n}.svg" for n in ("calibration", "five", "mori", "order", "two", "wrong")]
    assert all(f"(figures/{name})" in page for name in figures)
    assert max(len(line) for line in page.splitlines() if line[:1] not in "|!") <= 130
    import pyarrow.parquet as pq

    rules = pq.read_table(tmp_path / "out/tables/rules.parquet")
    assert {"rule", "right", "right s.e.", "gospa", "ece", "ms per scene"} <= set(rules.column_names)
    shares = rules["right"].drop_null().to_numpy()
    assert len(shares) > 100 and shares.min() >= 0 and shares.max() <= 1
    assert (tmp_path / "out/tables/several.md").read_text().startswith("| scene | sources |")


def test_a_single_experiment_writes_its_tables_and_no_page(small, tmp_path, capsys):
    main(["--quick", "--only", "priors", "-o", str(tmp_path)])
    assert "Linear prior" in capsys.readouterr().out
    assert sorted(path.name for path in tmp_path.rglob("*") if path.is_file()) == ["priors.md", "priors.parquet"]
    for arguments, words in (
        (["--only", "prior"], "no experiment is called prior"),
        (["--only", "priors", "--page", "x.md"], "the page needs every experiment"),
    ):
        with pytest.raises(SystemExit, match=words):
            main(["-o", str(tmp_path), *arguments])
    with pytest.raises(SystemExit, match="2"):
        main(["--quick", "--scenes", "9"])


@pytest.mark.slow
def test_the_number_of_processes_changes_nothing(monkeypatch):
    point = trial.Point("x", "processes", FIVE, (Identified("close", Close()),))
    monkeypatch.setattr(trial, "PIECE", trial.BLOCK)
    outcomes = []
    for cores in ("1", "2"):
        monkeypatch.setenv("SAMEAS_THREADS", cores)
        outcomes.append(trial.run([point], 2 * trial.BLOCK)[0].of("close"))
    np.testing.assert_array_equal(outcomes[0].total, outcomes[1].total)
    np.testing.assert_array_equal(outcomes[0].bins, outcomes[1].bins)
