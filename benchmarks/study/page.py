"""The page "What the papers claim and what we measure", written from the study's numbers."""

from __future__ import annotations

import math
import re
import textwrap

from benchmarks.study.claims import LAST_POINT, PAIRS, PAPER, RECONSTRUCTION, TOLERANCE
from benchmarks.study.contenders import INNER
from benchmarks.study.study import Study
from benchmarks.study.tables import Row, all_tables, markdown, shown
from benchmarks.study.tally import CUTOFF
from sameas import __version__
from sameas.kernels import threads

WIDTH = 120
#: Scenes of the table of rules.
SCENES = (
    "line of 5, d 1.9",
    "line of 5",
    "line of 25",
    "grid 5 × 5",
    "line of 5, errors 3 : 1",
    "line of 5, q 0.05 and 0.5",
    "2 × 2 × 2 in 4 features, d 2",
    "Poisson, density 0.05",
    "Poisson, density 0.2",
)
#: Columns of the tables.
MEASURED = ("rule", "right", "whole", "wrong pairs", "missed pairs", "brier", "ece", "gospa", "ms per scene")
MANY = ("scene", "scenes", "joint whole", "sequential whole", "order matters", "joint gospa", "sequential gospa")


def page(study: Study) -> str:
    """The page in Markdown; its figures are ``figures/study-*.svg`` next to it."""
    tables = all_tables(study)
    parts = [
        _head(study),
        _claims(study, tables),
        _spacing(study),
        _rules(study, tables),
        _wrong(study),
        _calibration(study),
        _priors(study),
        _several(study, tables),
        _mori(study),
        _again(),
    ]
    return "\n\n".join(map(_flowed, parts)) + "\n"


def _flowed(text: str) -> str:
    """The text with paragraphs and items filled to WIDTH; tables, headings, images and code unchanged."""
    blocks, code = [], False
    for block in text.split("\n\n"):
        code ^= block.count("```") % 2 == 1
        if code or "```" in block or block.startswith(("#", "|", "!", "<")):
            blocks.append(block)
            continue
        items = re.split(r"\n(?=- )", block)
        lines = [_filled(" ".join(item.split())) for item in items]
        blocks.append("\n".join(lines))
    return "\n\n".join(blocks)


def _filled(item: str) -> str:
    indent = "  " if item.startswith("- ") else ""
    # A figure stays on one line with its error, and no line begins with a character that starts a Markdown list.
    joined = re.sub(r" (±|…|=|×|→|\+|-) ", lambda match: f"\0{match[1]}\0", item).replace(" %", "\0%")
    lines = textwrap.wrap(joined, WIDTH, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return "\n".join(lines).replace("\0", " ")


def _right(study: Study, experiment: str, point: str, rule: str, figure: str = "right") -> str:
    """A figure of a rule at a point, or a dash."""
    tally = study.tally(experiment, point, rule)
    return shown(tally.figures()[figure]) if tally else "–"


def _head(study: Study) -> str:
    missing = "" if study.stone_soup else " Stone Soup was not installed; its results are missing."
    load = "" if math.isnan(study.load) else f" with a load of {study.load:.1f} when it began"
    return f"""# What the papers claim and what we measure

The two papers behind [the method](method.md) claim that their rules decide better than the older ones. Here all rules
that they name decide the same simulated scenes. `scripts/bench study` made the numbers, the figures and this page:
version {__version__}, {study.scenes} scenes per point, {study.seconds:.0f} s on {threads.count()} cores{load}.{missing}

## Definitions

- The unit is σ, the standard deviation of a residual in one feature. Neighbours are d σ apart in one feature. Each
  source misses a target with probability q. There are two features unless stated otherwise.
- A record is *right* if its only partner is its true one, or if it has no partner and truly has none. Shares of records
  are over the records of both sources in all scenes. A scene is *wholly right* if all its records are.
- All rules get the same candidates, from the papers' gate of 3σ in each feature, unless marked *no gate*.
- *close objects* has a = {INNER} σ, b = 2 d σ and the exact prior.
- *uniform* has p_M = 1 / area of the box around the records of the scene, one σ wider on each side, and the same prior.
- *constant C* has C² = ρ q₁ q₂ with a density ρ of one target per d² in two features (our choice for targets in a
  line) and per d⁴ in four; *independent Bayes* has the same C without one-to-one.
- *Stone Soup* is `OneToOneTrackAssociator` with a threshold of 3σ and its Mahalanobis measure, all tracks at one time.
- GOSPA is that of the fused picture, of order 2 with a cutoff of {CUTOFF:g} σ, against all targets, including
  those that both sources missed.
- ± is one standard error, over scenes. Scenes are seeded: a run of the same version gives the same numbers, except for
  times."""


def _claims(study: Study, tables: dict[str, list[Row]]) -> str:
    records = [study.tally("claims", f"2 targets, d {d:g}, q {q:g}", "close objects") for d, q in PAIRS]
    shares = [t.figures()["right"].value for t in records if t is not None]
    narrow = _right(study, "claims", LAST_POINT, "uniform, box by a record's σ, no gate")
    gated = [_right(study, "claims", LAST_POINT, rule) for rule in ("close objects", "k = min")]
    line = next((c.mean("joint whole") for s, c in study.several if "in a line" in s.name), None)
    paper, earlier = ([row for row in tables["claims"] if row["source"] == s] for s in (PAPER, RECONSTRUCTION))
    columns = ("claim", "claimed", "measured", "counted as", "agrees")
    return f"""## What was claimed

The second paper states that close objects decides correctly with a probability above 0.75 … 0.80 from d = 1.6 … 1.9 on,
read here as above 0.75 at 1.6 and above 0.80 at 1.9:

{markdown(paper, columns)}

An earlier, small reconstruction of the paper by us gave these figures:

{markdown(earlier, columns)}

*Agrees*: within {TOLERANCE}, the tolerance set before this study was run, or within two standard errors of the
measurement.

The sources do not state how these figures were counted. We tried several ways, and chose between them knowing the
expected figures:

- Two targets at q = 0.2 … 0.4: the table gives the share of scenes in which both targets are right. The share of
  records is {min(shares):.2f} … {max(shares):.2f}. For the line of five it is the share of records, as was
  stated.
- Two targets at q = 0.5, d = 3: one source often sees nothing, and a scene with nothing to decide is right under every
  rule. The table gives three ways of counting. We also tried means over scenes, source 1 alone, scenes in which it has
  records, both gates, and other margins of the box of p_M. None reproduces all three figures to {TOLERANCE}; the order
  of the rules is the same in the three ways of the table.
- The box of p_M is wider by one σ of the residual. With one σ of a record instead, uniform has {narrow} of all records
  right.
- These figures are without a gate. Within 3σ, k = min is nearly as good as close objects ({gated[1]} of all records,
  compared with {gated[0]}), because the gate removes the distant pairs that it would choose.
- "4σ apart" with three sources: five targets in a line 4σ apart (σ of a record) are far easier, {shown(line)} of the
  scenes wholly right, and easier still with the σ of the residual. Of the readings that we tried, five targets
  scattered over a square of 5 · (4σ)² come closest; they too are right more often than in the earlier figures. The
  advantage of joint over sequential is about the same as there."""


def _spacing(study: Study) -> str:
    def lead(point: str, rule: str) -> str:
        return _right(study, "spacing", point, rule, "whole lead")

    def five(q: float) -> str:
        return _right(study, "spacing", f"5 targets, d 1.9, q {q:g}", "close objects")

    crowded, sparse, near = "2 targets, d 3, q 0.6", "2 targets, d 3, q 0.02", "2 targets, d 0.5, q 0.6"
    return f"""## Accuracy against spacing

![Share of records right in a line of five targets, against the spacing](figures/study-five.svg)

![Share of scenes wholly right with two targets, against the spacing](figures/study-two.svg)

- Close objects is better than the older rules where sources miss many targets and targets are not too close. Two
  targets, d = 3, q = 0.6, share wholly right minus that of close objects:
  uniform {lead(crowded, "uniform")}, constant C {lead(crowded, "constant C")}, k = min {lead(crowded, "k = min")}.
  At q = 0.02 the differences are {lead(sparse, "uniform")}, {lead(sparse, "constant C")}, {lead(sparse, "k = min")}.
- In a line of five, uniform, constant C and close objects differ little from d = 1.6 on: most of the gain
  there comes from the one-to-one constraint. Deciding record by record (independent Bayes, mutual nearest) loses most
  where targets are close and few are missed.
- The spacing at which a line of five exceeds 0.80 depends on q: at d = 1.9 close objects has {five(0.2)} of the records
  right at
  q = 0.2 and {five(0.4)} at q = 0.4. The paper's claim does not hold there, under any of these rules.
- Where targets are close and often missed, rules that form as many pairs as possible are right more often than those
  that weigh missed targets. Two targets, d = 0.5, q = 0.6, the same difference to close objects:
  k = min {lead(near, "k = min")}, Stone Soup
  {lead(near, "Stone Soup 1–1")}."""


def _rules(study: Study, tables: dict[str, list[Row]]) -> str:
    parts = [
        "## All rules on other scenes",
        "q = 0.2 and d = 3 unless the heading says otherwise. Poisson scenes: ten targets on average in a square, "
        "density per σ². *whole* is the share of scenes wholly right.",
    ]
    for scene in SCENES:
        rows = [r for r in tables["rules"] if r["experiment"] == "formations" and r["scene"] == scene]
        if rows:
            parts += [f"### {scene[0].upper()}{scene[1:]}", markdown(rows, MEASURED)]
    last = """*ms per scene*: 250 scenes per call, one core. *universal, formation known* is the universal rule (3.3)
given all displacements between targets: the value of knowing the formation. *enumeration* compares every hypothesis; as
it must, it decides as close objects does."""
    return "\n\n".join([*parts, last])


def _wrong(study: Study) -> str:
    def right(parameter: str, rule: str, figure: str = "right") -> str:
        return _right(study, "wrong", parameter, f"{rule}, no gate", figure)

    return f"""## Wrong parameters

![Share of records right with a wrong C, b or q](figures/study-wrong.svg)

Line of five, d = 3, q = 0.4, no gate. With the true parameters, close objects has {right("b", "b × 1")} of the records
right.

- C, three times too large: no pair is ever chosen, and only the records without a partner are right
  ({right("C", "C × 3")}). A hundred times too small: {right("C", "C × 0.01")}. The difference to close objects is
  {right("C", "C × 1", "lead")} with C by its formula and {right("C", "C × 0.3", "lead")} at 0.3 times that, the best
  factor tried: the advantage of the papers' rule is less its optimum than that it needs no density.
- b an eighth of its value: {right("b", "b × 0.125")}; sixteen times too large: {right("b", "b × 16")}; estimated from
  each scene's own few records: {right("b", "b estimated")}.
- q half its value: {right("q", "q × 0.5")}; twice: {right("q", "q × 2")}. A gate of 3σ hides much of each error."""


def _calibration(study: Study) -> str:
    def error(scene: str, rule: str) -> str:
        return _right(study, "formations", scene, rule, "ece")

    poisson, lattice = "Poisson, density 0.1", "grid 5 × 5"
    return f"""## Calibration

![Stated probability against the share that is true, three formations](figures/study-calibration.svg)

Probabilities are only as good as the assumptions. Calibration errors on {poisson}: uniform {error(poisson, "uniform")},
constant C {error(poisson, "constant C")}, close objects {error(poisson, "close objects")}, which assumes that no
neighbour is nearer than a. On the {lattice}, which none of these rules models: uniform {error(lattice, "uniform")},
constant C {error(lattice, "constant C")}, close objects {error(lattice, "close objects")}; the universal rule,
given the formation,
{error(lattice, "universal, formation known")}."""


def _priors(study: Study) -> str:
    p = study.priors
    if p is None:
        return ""
    differ = int(p.differ.sum())
    typical = math.exp(float(p.loss[p.differ].mean())) if differ else 1.0
    worse = int((p.loss < -1e-9).sum())
    return f"""## Exact and linear prior

{len(p)} groups from lines of 2 to 7 targets, d from 0.5 to 4, q from 0.02 to 0.6. The linear prior decides {differ} of
them ({100 * differ / len(p):.1f} %) differently from the exact one. Under the exact prior the exact decision is less
probable in {worse} of them; where the two differ it is {typical:.2f} times as probable on average (geometric) and
{math.exp(p.loss.max()):.2f} times at most. Records right: {p.right_exact:.4f} exact, {p.right_linear:.4f} linear."""


def _several(study: Study, tables: dict[str, list[Row]]) -> str:
    four = next((c for s, c in study.several if s.oracle), None)
    crowd = study.crowd
    text = f"""## Many sources

![Joint and sequential answers of many sources](figures/study-order.svg)

{markdown(tables["several"], MANY)}

- *Joint* solves all sources at once; *sequential* matches one source after another with the fused picture, and its
  share is the mean over orders. *Order matters* is the share of scenes in which two orders of the sources give
  different sequential results; of three sources all six orders are compared, of more sources six."""
    if four is not None:
        differs = four.mean("oracle differs").value
        order = max(c.mean("joint order").value for _, c in study.several)
        text += f"""
- Three sources at spacing 4: in a quarter of the scenes, every hypothesis of the first two sources was enumerated, each
  with the best third. Of these scenes, {_share(differs)} have one that is more probable than the joint result. Another
  order of the sources changes the joint result in {_share(order)} of the scenes, checked in a quarter of them."""
    if crowd is not None:
        text += f"""
- `identify_many`, six sources × 200 targets: {crowd.records} records, {crowd.largest_group} in the largest group,
  {crowd.unproved_groups} groups without a proof of optimality, {crowd.seconds:.2f} s."""
    return text


def _share(value: float) -> str:
    return "none" if value == 0.0 else f"{100.0 * value:.2g} %"


def _mori(study: Study) -> str:
    def worst(m: int) -> str:
        """Largest difference where at least a quarter gets its own record."""
        differences = [
            p.simulated.value - p.formula for p in study.mori if p.features == m and p.simulated.value >= 0.25
        ]
        return f"{max(differences, key=abs):+.3f}" if differences else "–"

    return f"""## Mori's formula

![Share of objects with their own record against density, formula and simulation](figures/study-mori.svg)

Mori, Chang, Chong and Dunn (1995) predict that one-to-one assignment gives an object its own record with probability
exp(−C_m β √|S|), for objects of density β that both sources see. It counts exchanges of two objects and is exact
as β → 0.
Where at least a quarter of the objects get their own record, the largest difference of simulation and formula is
{worst(1)}, {worst(2)} and {worst(3)} for one, two and three features: in three, longer exchanges are frequent. Where
fewer do, the formula is too low, because even a random assignment is sometimes right."""


def _again() -> str:
    return """## Run it again

<!-- not run: it takes minutes -->
```console
$ pip install ".[plots,stonesoup]"
$ scripts/bench study -o study
$ scripts/bench study --quick --only spacing -o quick
```

The tables, in Parquet and Markdown, contain every figure with its standard error. `scripts/bench study` writes this
page."""
