"""Error model: which source's quoted errors are too small, and by how much; a diagnostic, from identified pairs.

With the covariance of a pair modelled as

    S = a₁² Σ₁ + a₂² Σ₂ + f² 1

the factors a₁, a₂ and the floor f are found by maximum likelihood over the pairs, weighted by their posterior. Some
pairs may be of a tail: normals several times wider than S, whose shares are found with them. What is beyond the model
is then told by the model itself, not by the quoted errors, of which a floor makes any multiple.

Only the variation of Σ₁, Σ₂ from pair to pair tells the terms apart. Where the information says that it does not, the
direction in which it is weakest says which terms look alike: a factor that looks like the floor, or that hardly
matters, is held at 1; two factors that look alike become one of both sources; and where one number is all that can be
told, either of the two that it may be is given. Two floors, one of each source, look the same as one of both.

Error scales (:func:`fit_errors`): by how much residuals spread more or less than their quoted errors, found from pairs.
The spread is a mixture of normals over a ladder of error scales. Its shares have one maximum of the likelihood, so that
errors quoted too small and heavy tails come out of the same estimate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sameas.arrays import FloatArray, IntArray
from sameas.estimate.quantity import Quantity
from sameas.evidence import Errors
from sameas.gate import Pairs
from sameas.gaussian import inverse, log_determinant
from sameas.records import unpack
from sameas.representation import in_short
from sameas.result import Identification

#: Pairs learned from: at least, in expectation, and at most.
FEWEST, ENOUGH = 200.0, 5_000
#: Pairs less probable than this tell nothing of errors.
TELLING_P = 0.05
#: The core and the normals of the tail, in units of the modelled error; shares that the search begins with.
SCALES, FIRST_SHARES = np.array([1.0, 3.0, 6.0, 12.0]), np.array([0.97, 0.01, 0.01, 0.01])
#: A normal that has fewer pairs than this tells nothing of the errors, and takes nothing from what is known of them.
NO_PAIRS = 0.5
STEPS, SETTLED = 300, 1e-5
#: Standard errors to either side of an estimate, with 95 % between.
INTERVAL = 1.96
#: A factor whose standard error is larger than this share of it is not told from the others.
TELLING = 0.25
#: Least eigenvalue of the information beside its greatest: less is none.
NONE = 1e-10
#: Less information of a term is taken for this, of which the inverse is still a number.
NOTHING = 1e-200
#: Two factors are exchanged for each other, not one of them for the floor, from this ratio of their changes on.
EXCHANGED = 0.5
#: ln of the likelihood by which a floor must be better or worse than a common factor (three standard errors).
BETTER = 4.5


@dataclass(frozen=True)
class ErrorModel:
    """Factors on the quoted errors of either source and a floor of both together, in the unit of the residuals.

    factor_1, factor_2 : None where the data cannot tell them; 1 is then taken for them, unless there is ``both``.
    both : one factor on the errors of both, where the two cannot be told apart.
    floor : None where it cannot be told from a factor.
    floor_instead : the floor that explains the residuals as well as ``both`` does.
    note : what could not be told and why, "" where all could.
    """

    factor_1: Quantity | None = None
    factor_2: Quantity | None = None
    both: Quantity | None = None
    floor: Quantity | None = None
    floor_instead: Quantity | None = None
    note: str = ""

    @property
    def terms(self) -> Mapping[str, Quantity]:
        """What could be told, by its name here.

        >>> list(ErrorModel(both=Quantity(1.7, 0.1), floor_instead=Quantity(0.2, 0.1)).terms)
        ['both', 'floor_instead']
        """
        return {name: value for name, value in vars(self).items() if isinstance(value, Quantity)}

    @property
    def is_estimated(self) -> bool:
        """Whether anything was."""
        return bool(self.terms)

    def variance(self, quoted_1: FloatArray, quoted_2: FloatArray) -> FloatArray:
        """Variances (n,) of pairs, on an axis, from the quoted ones of both sides.

        >>> ErrorModel(factor_1=Quantity(2.0, 0.1), floor=Quantity(3.0, 0.1)).variance(np.ones(1), np.ones(1))
        array([14.])
        """
        one, two, floor = (
            0.0 if q is None else q.value
            for q in (self.factor_1 or self.both or AS_QUOTED, self.factor_2 or self.both or AS_QUOTED, self.floor)
        )
        return np.asarray(one**2 * quoted_1 + two**2 * quoted_2 + floor**2)

    @property
    def errors(self) -> Errors:
        """The same as evidence."""
        one, two = (self.factor_1 or self.both or AS_QUOTED), (self.factor_2 or self.both or AS_QUOTED)
        floor = 0.0 if self.floor is None else self.floor.value
        return Errors(factor_1=max(one.value, 1e-3), factor_2=max(two.value, 1e-3), floor=floor)


AS_QUOTED = Quantity(1.0, 0.0)


def error_model(answer: Identification) -> ErrorModel:
    """The error model of the pairs of an answer.

    Example
    -------
    >>> error_model(match(plate, gaia)[0]).factor_1  # doctest: +SKIP
    Quantity(value=1.68, standard_error=0.04, unit='')
    """
    return model_of(answer.pairs, answer.p_pair, ENOUGH)


def model_of(pairs: Pairs, p_pair: FloatArray, most: int) -> ErrorModel:
    """The error model of pairs with these probabilities (m,), learned from ``most`` of them."""
    probable = _probable(p_pair, most)
    weight = p_pair[probable]
    if weight.sum() < FEWEST:
        return ErrorModel(note=f"fewer than {FEWEST:.0f} pairs: too few to judge the sources' errors apart")
    one = unpack(pairs.first.covariance[pairs.i[probable]], pairs.d)
    two = unpack(pairs.second.covariance[pairs.j[probable]], pairs.d)
    names = pairs.first.source, pairs.second.source
    return _Judgement(pairs.residual[probable], weight, one, two, names).model()


def _probable(p_pair: FloatArray, most: int) -> IntArray:
    """Pairs that tell of errors; every second, third, … where there are more than ``most``.

    Not only those more probable than not: where large errors meet many neighbours, these have small residuals.
    """
    probable = np.flatnonzero(p_pair > TELLING_P)
    return probable[:: max(1, -(-len(probable) // most))]


def better_model(errors: Errors, pairs: Pairs, p_pair: FloatArray, most: int) -> tuple[Errors, float]:
    """Errors of the model that these pairs (m,) show, and by how much it betters ln of their likelihood.

    errors : the model to be bettered. Either has the tail that suits it best.
    """
    probable = _probable(p_pair, most)
    model = model_of(pairs, p_pair, most)
    if not model.is_estimated:
        return errors, 0.0
    some, weight = pairs.part(probable), p_pair[probable]
    now, there = (log_likelihood(each, some, weight) for each in (errors, model.errors))
    if np.any(errors.floor) or errors.factor_1 != errors.factor_2:
        factor = over_quoted(errors, pairs, p_pair) * errors.typical_scale
        factor = factor if abs(math.log(factor)) > ABOUT_QUOTED else 1.0
        plain = Errors(factor_1=factor, factor_2=factor)
        if log_likelihood(plain, some, weight) > max(now, there) - BETTER:
            return plain, math.inf
    return model.errors, there - now


#: A factor on all errors that is no farther from 1 than this, in ln, is left to the mixture.
ABOUT_QUOTED = 0.3
#: Scales of the normals that a spread about a modelled error is mixed of, to compare models; steps of EM.
LADDER, LADDER_STEPS = 1.5 ** np.arange(-5.0, 8.0), 30


def log_likelihood(errors: Errors, pairs: Pairs, weight: FloatArray) -> float:
    """ln of the likelihood of pairs with these weights (m,), the mixture of scales being the likeliest."""
    return float(weight @ with_spread(errors, pairs, weight).log_density(pairs))


def with_spread(errors: Errors, pairs: Pairs, weight: FloatArray) -> Errors:
    """The same S with the mixture of scales that is likeliest for pairs (m,) with these weights."""
    return errors.with_mixture(_mixture(errors.pairs(pairs).mahalanobis_sq, pairs.d, weight, LADDER))


def _mixture(mahalanobis_sq: FloatArray, d: int, weight: FloatArray, scales: FloatArray) -> Errors:
    """The likeliest mixture of these scales for pairs (m,) with these weights, by EM."""
    exponent = -0.5 * mahalanobis_sq[:, None] / scales**2
    density = np.exp(exponent - exponent.max(axis=1, keepdims=True)) / scales**d
    shares = np.full(len(scales), 1.0 / len(scales))
    for _ in range(LADDER_STEPS):
        member = density * shares
        shares = (weight / member.sum(axis=1)) @ member / weight.sum()
    shares = np.where(shares > 1e-6, shares, 0.0)
    return Errors(tuple(scales.tolist()), tuple((shares / shares.sum()).tolist()))


def over_quoted(errors: Errors, pairs: Pairs, p_pair: FloatArray) -> float:
    """The modelled error of the typical probable pair over that quoted, the mixture left aside."""
    if not errors.as_modelled or not len(pairs):
        return 1.0
    probable = _probable(p_pair, ENOUGH)
    some = pairs.part(probable) if len(probable) else pairs
    ratio = errors.pairs(some).determinant / some.determinant
    return float(np.median(ratio) ** (0.5 / pairs.d))


def spread(pairs: Pairs, p_pair: FloatArray) -> Errors:
    """How the residuals of pairs (m,) spread about their quoted covariances."""
    probable = _probable(p_pair, ENOUGH)
    if not len(probable):
        return Errors()
    square = pairs.mahalanobis_sq[probable]
    farthest = max(math.sqrt(float(square.max())), 2.0)
    rungs = math.ceil(math.log(farthest) / math.log(1.5)) + 1
    mixture = _mixture(square, pairs.d, p_pair[probable], 1.5 ** np.arange(-5.0, rungs))
    kept = [(scale, share) for scale, share in zip(mixture.scales, mixture.shares, strict=True) if share > 0.0]
    scales, shares = zip(*kept, strict=True)
    return Errors(scales, shares)


def fit_variances(residual: FloatArray, weight: FloatArray, parts: FloatArray) -> FloatArray:
    """(k,) the θ ≥ 0 of greatest likelihood of residuals (m, d) whose covariances are Σ θ_k parts_k, (k, m, d, d).

    Where the parts do not tell them apart, they are any of the likeliest: their sum is known.
    """
    return _fit(residual, weight, parts, np.zeros_like(parts[0])).theta


@in_short
@dataclass(frozen=True)
class _Judgement:
    """Residuals (m, d) of pairs, their weights (m,), the quoted covariances (m, d, d) of both sides, their names."""

    residual: FloatArray
    weight: FloatArray
    one: FloatArray
    two: FloatArray
    names: tuple[str, str]

    @property
    def unit(self) -> float:
        """A typical variance of the pairs, which the floor is counted in."""
        return float(np.median(np.einsum("mvv->m", self.one + self.two)) / self.residual.shape[1])

    @property
    def level(self) -> FloatArray:
        """(m, d, d) the covariance of a floor of that variance."""
        return np.broadcast_to(self.unit * np.eye(self.residual.shape[1]), self.one.shape)

    def model(self) -> ErrorModel:
        """All three terms where they can be told apart, else the two or the one that can."""
        fit = self._fit((self.one, self.two, self.level))
        if all(fit.tells(k) for k in (0, 1)):
            return ErrorModel(fit.root(0), fit.root(1), floor=self._floor(fit, 2))
        change = np.abs(fit.weakest)
        more = int(change[1] > change[0])
        if change[1 - more] > max(EXCHANGED * change[more], change[2]):
            return self._common()
        return self._held(more)

    def _held(self, source: int) -> ErrorModel:
        """With the errors of this source as quoted."""
        held, free = (self.one, self.two) if source == 0 else (self.two, self.one)
        fit = self._fit((free, self.level), held)
        if not fit.tells(0):
            return self._one_number()
        name, bare = self.names[source], self._fit((self.one, self.two))
        if bare.log_likelihood - fit.log_likelihood > BETTER and all(bare.tells(k) for k in (0, 1)):
            return ErrorModel(
                bare.root(0), bare.root(1), note=f"a floor cannot be distinguished from the errors of {name}"
            )
        note = f"those of {name} taken as quoted: too small or too uniform to be distinguished from a floor"
        factor, floor = fit.root(0), self._floor(fit, 1)
        first, second = (None, factor) if source == 0 else (factor, None)
        return ErrorModel(first, second, floor=floor, note=note)

    def _common(self) -> ErrorModel:
        """With one factor on the errors of both."""
        fit = self._fit((self.one + self.two, self.level))
        if not fit.tells(0):
            return self._one_number()
        note = "the quoted errors of the two are correlated from pair to pair: which are too small cannot be determined"
        return ErrorModel(both=fit.root(0), floor=self._floor(fit, 1), note=note)

    def _one_number(self) -> ErrorModel:
        """A factor on both, or a floor, or either where both explain the residuals."""
        both = self._fit((self.one + self.two,))
        raised = self._fit((self.level,), self.one + self.two)
        gain = raised.log_likelihood - both.log_likelihood
        alike = "the quoted errors vary too little from pair to pair to determine"
        if gain > BETTER:
            return ErrorModel(floor=self._floor(raised, 0), note=f"{alike} whether their own sizes are right too")
        if gain < -BETTER:
            return ErrorModel(both=both.root(0), note=f"{alike} which source's are wrong, or whether there is a floor")
        note = f"{alike} a factor from a floor, or which source's errors are wrong"
        return ErrorModel(both=both.root(0), floor_instead=self._floor(raised, 0), note=note)

    def _fit(self, parts: Sequence[FloatArray], held: FloatArray | None = None) -> _VarianceFit:
        return _fit(self.residual, self.weight, np.stack(parts), np.zeros_like(self.one) if held is None else held)

    def _floor(self, fit: _VarianceFit, k: int) -> Quantity:
        """The root of term k, in the unit of the residuals."""
        root, sigma = fit.root(k), float(np.sqrt(self.unit))
        return Quantity(sigma * root.value, sigma * root.standard_error)


@in_short
@dataclass(frozen=True)
class _VarianceFit:
    """Factors (k,) of variances, their covariance (k, k), the direction (k,) that is known least, the likelihood."""

    theta: FloatArray
    covariance: FloatArray
    weakest: FloatArray
    log_likelihood: float

    def root(self, k: int) -> Quantity:
        """√θ and its standard error, from that of θ ≥ 0: how far the root moves when θ moves across its 95 % interval.

        Where θ is zero within its error its root is not normal, and to first order its error would be nearly none. So
        the root is within 1.96 errors of zero where θ is within 1.96 of its own.
        """
        theta, error = float(self.theta[k]), INTERVAL * float(np.sqrt(self.covariance[k, k]))
        value = float(np.sqrt(theta))
        ends = np.sqrt(np.maximum([theta - error, theta + error], 0.0))
        return Quantity(value, float(np.abs(ends - value).max()) / INTERVAL)

    def tells(self, k: int) -> bool:
        """Whether a factor is known well enough to speak of it."""
        root = self.root(k)
        return root.standard_error < TELLING * max(root.value, 1.0)


def _fit(residual: FloatArray, weight: FloatArray, parts: FloatArray, held: FloatArray) -> _VarianceFit:
    """S = ``held`` + Σ θ_k parts_k of greatest likelihood, by EM over core and tail.

    residual (m, d), weight (m,), parts (k, m, d, d), held (m, d, d).
    """
    # Pairs last: every product runs along them.
    residual, parts, held = residual.T.copy(), _pairs_last(parts), _pairs_last(held)
    theta, shares, damping = np.full(len(parts), 0.5), FIRST_SHARES, 0.5
    for _ in range(STEPS):
        state = _State.of(residual, parts, held, theta, shares)
        core = weight * state.member[0]
        score = state.slope @ core
        flat = len(parts), -1
        information = 0.5 * (state.along * core).reshape(flat) @ state.along.swapaxes(1, 2).reshape(flat).T
        free = (theta > 1e-9) | (score > 0.0)
        step = np.zeros(len(theta))
        step[free] = np.linalg.lstsq(information[np.ix_(free, free)], score[free], rcond=1e-9)[0]
        before, theta = theta, np.maximum(theta + damping * step, 1e-9)
        shares, damping = state.member @ weight / weight.sum(), 1.0
        if np.abs(theta - before).max() < SETTLED * max(1.0, float(theta.max())):
            break
    return _judged(_State.of(residual, parts, held, theta, shares), weight, theta, shares)


def _pairs_last(matrices: FloatArray) -> FloatArray:
    """(…, d, d, m) of (…, m, d, d)."""
    return np.ascontiguousarray(np.moveaxis(matrices, -3, -1))


@in_short
@dataclass(frozen=True)
class _State:
    """What a model says of every pair.

    along : (k, d, d, m) S⁻¹ parts. slope : (k, m) of ln N(residual; 0, S) with θ. member : (n, m) the probabilities of
    core and tail. log_density : (m,) of the residual.
    """

    along: FloatArray
    slope: FloatArray
    member: FloatArray
    log_density: FloatArray

    @classmethod
    def of(
        cls, residual: FloatArray, parts: FloatArray, held: FloatArray, theta: FloatArray, shares: FloatArray
    ) -> _State:
        """Of residuals (d, m), parts (k, d, d, m) and held (d, d, m)."""
        covariance = np.moveaxis(held + np.tensordot(theta, parts, 1), -1, 0)
        precision = _pairs_last(inverse(covariance))
        scaled = np.einsum("vwm,wm->vm", precision, residual)
        along = np.einsum("vwm,kwxm->kvxm", precision, parts)
        slope = 0.5 * np.einsum("vwm,kvwm->km", scaled[:, None] * scaled - precision, parts)
        square = (scaled * residual).sum(axis=0)
        with np.errstate(divide="ignore"):
            log_share = np.log(shares) - len(residual) * np.log(SCALES)
        log_member = log_share[:, None] - 0.5 * square / SCALES[:, None] ** 2
        greatest = log_member.max(axis=0)
        member = np.exp(log_member - greatest)
        total = member.sum(axis=0)
        log_density = greatest + np.log(total) - 0.5 * log_determinant(covariance)
        return cls(along, slope, member / total, log_density)


def _judged(state: _State, weight: FloatArray, theta: FloatArray, shares: FloatArray) -> _VarianceFit:
    """What was found, with the covariance from the squares of the pairs' scores; the shares of the tail take part.

    A term that is held at zero takes nothing from what is known of the others.
    """
    core = state.member[0]
    tail = np.flatnonzero(shares[1:] * weight.sum() > NO_PAIRS) + 1
    scores = np.vstack([state.slope * core, state.member[tail] / shares[tail, None] - core / shares[0]])
    information = np.einsum("m,am,bm->ab", weight, scores, scores)
    k = len(theta)
    open_ = np.concatenate([theta > 1e-6, np.ones(len(tail), np.bool_)])
    covariance = np.diag(np.diag(_bounded_inverse(information)))[:k, :k]
    held = _bounded_inverse(information[np.ix_(open_, open_)])
    inside = np.flatnonzero(open_[:k])
    covariance[np.ix_(inside, inside)] = held[: len(inside), : len(inside)]
    weakest = np.linalg.eigh(_bounded_inverse(information)[:k, :k])[1][:, -1]
    return _VarianceFit(theta, covariance, weakest, float(weight @ state.log_density))


def _bounded_inverse(information: FloatArray) -> FloatArray:
    """Its inverse; where there is no information, a variance that is larger than any."""
    size = np.sqrt(np.maximum(np.diag(information), NOTHING))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    scaled = (vectors / np.maximum(values, NONE * values.max(initial=0.0))) @ vectors.T
    return np.asarray(scaled / np.outer(size, size))


# Tails: the small share of the pairs that lie much farther apart than the typical one, and how sure that share is.
#
# The spread of the errors is a mixture of normals (:class:`sameas.evidence.Errors`); its components far wider than the
# typical error are the tail: outliers, binaries, blends. That the quoted errors are too small for all makes no tail.

#: A component is of the tail when it is so many times wider than the typical error.
FAR = 2.5
#: Pairs less probable than this do not tell of it. A smaller share than the second is none.
TAILS_TELLING, LEAST_SHARE = 1e-3, 1e-4


@dataclass(frozen=True)
class Tail:
    """``share`` of the pairs in the tail, and the ``factor`` (geometric mean) of their errors over those quoted."""

    share: Quantity
    factor: float


def tail(answer: Identification, errors: Errors) -> Tail | None:
    """The tail of the errors of the pairs of an answer; None where there is none.

    The standard error is that of the share in a mixture of tail and core of known forms: its information is
    Σ p [(f_tail − f_core) / f]².

    Example
    -------
    >>> found, told = match(plate, gaia)  # doctest: +SKIP
    >>> tail(found, told.errors).share  # doctest: +SKIP
    Quantity(value=0.021, standard_error=0.0018, unit='')
    """
    scales, shares = np.asarray(errors.scales), np.asarray(errors.shares)
    far = scales > FAR * errors.typical_scale
    share = float(shares[far].sum())
    if not LEAST_SHARE < share < 1.0:
        return None
    d, weight = answer.pairs.d, answer.p_pair
    probable = weight > TAILS_TELLING
    # Densities but for what all components have in common.
    square = errors.pairs(answer.pairs.part(probable)).mahalanobis_sq[:, None]
    density = shares * np.exp(-0.5 * square / scales**2) / scales**d
    outer, core = density[:, far].sum(axis=1) / share, density[:, ~far].sum(axis=1) / (1.0 - share)
    slope = (outer - core) / np.maximum(share * outer + (1.0 - share) * core, np.finfo(float).tiny)
    information = float(np.sum(weight[probable] * slope**2))
    factor = math.exp(float(shares[far] @ np.log(scales[far])) / share)
    factor *= over_quoted(errors, answer.pairs, answer.p_pair)
    return Tail(Quantity(share, 1.0 / math.sqrt(max(information, np.finfo(float).tiny))), factor)


@dataclass(frozen=True)
class ScalesTuning:
    """How the mixture of error scales is found.

    Attributes
    ----------
    rung, lowest : the step of the ladder, as a factor, fine enough for any smooth spread to be mixed from it; and how
        many steps below 1 it begins.
    as_quoted, shifts : where typical errors are not within this of those quoted, in ln, ladders shifted by these parts
        of a rung are tried.
    bins, nearest : pairs of like distance are counted together, in so many bins from this distance on, in standard
        deviations.
    least_log_odds, most_log_odds, across : pairs of smaller log odds say nothing of the errors, whatever these are;
        greater are as sure as can be; in so many steps.
    settled, steps : the search for the shares stops when ln of the likelihood grows by less than this, or after so many
        steps.
    tail, standing_out : errors larger than so many times the quoted ones are a tail. It must better ln of the
        likelihood by so much, four standard errors: what chance pairs look like feeds on itself, as more of them are
        then believed.
    spread : what every share begins with besides its own: EM never revives one that is zero.
    shortest, ridge : least part of a step, and what is added to the curvature, of its trace: neighbouring normals are
        much alike.
    """

    rung: float = 1.5
    lowest: float = -5.0
    as_quoted: float = 0.1
    shifts: tuple[float, ...] = (1.0 / 3.0, 2.0 / 3.0)
    bins: int = 160
    nearest: float = 1e-2
    least_log_odds: float = -12.0
    most_log_odds: float = 30.0
    across: int = 43
    settled: float = 1e-2
    steps: int = 40
    tail_scale: float = 2.0
    standing_out: float = 8.0
    spread: float = 1e-3
    shortest: float = 1e-3
    ridge: float = 1e-10


DEFAULT_SCALES = ScalesTuning()


@dataclass(frozen=True)
class ErrorFit:
    """The errors, and by how much a tail of them would better ln of the likelihood, whether it stands out or not.

    log_likelihood : of the errors, up to a constant of the pairs.
    """

    errors: Errors
    tail_gain: float
    log_likelihood: float


def fit_errors(
    mahalanobis_sq: FloatArray,
    log_odds: FloatArray,
    d: int,
    start: Errors,
    *,
    widest: float = math.inf,
    tuning: ScalesTuning = DEFAULT_SCALES,
) -> ErrorFit:
    """The mixture of error scales of greatest likelihood for pairs that are true with odds of exp(log_odds) · f.

    f = Σ share scale^(−d) exp(−m²/(2 scale²)) is what the mixture says of a pair (``Errors.log_profile``), ``log_odds``
    what everything else does. The scales are a ladder from 0.13 upwards as far as the residuals reach, and not beyond
    ``widest``; a pseudo-count on the scale nearest to 1 keeps a few pairs from saying much. Where errors are typically
    not as quoted, ladders that begin between its rungs are tried too: mixed from two neighbours, one normal would have
    too long a tail, which chance pairs fill.

    Parameters
    ----------
    mahalanobis_sq, log_odds : (m,) squared normalised distances m² in d features, and ln of the odds.
    start : where the search begins.
    """
    reach, cells = _cells(mahalanobis_sq, log_odds, tuning)
    fit = _on_ladder(reach, cells, d, start, widest, 0.0, tuning)
    if abs(math.log(fit.errors.typical_scale)) < tuning.as_quoted:
        return fit
    others = [_on_ladder(reach, cells, d, fit.errors, widest, shift, tuning) for shift in tuning.shifts]
    return max(fit, *others, key=lambda fit: fit.log_likelihood)


def _on_ladder(
    reach: float,
    cells: tuple[NDArray[Any], ...],
    d: int,
    start: Errors,
    widest: float,
    shift: float,
    tuning: ScalesTuning,
) -> ErrorFit:
    """The likeliest mixture of one ladder, whose rungs stand ``shift`` of one higher than 1, 1.5, …"""
    from sameas.kernels.mixture import fit

    rungs = max(4, math.ceil(math.log(reach / 2.0) / math.log(tuning.rung)) + 1)
    steps = np.arange(tuning.lowest, rungs) + shift
    scales = tuning.rung**steps
    scales = scales[scales <= max(widest, tuning.rung**shift)]
    nearest = np.round(np.log(np.asarray(start.scales)) / math.log(tuning.rung) - steps[0])
    at = nearest.clip(0, len(scales) - 1).astype(np.int64)
    shares = np.asarray(np.bincount(at, start.shares, len(scales)), np.float64)
    core, pseudo = int(np.searchsorted(scales, tuning.tail_scale, side="right")), np.zeros(len(scales))
    pseudo[np.argmin(np.abs(np.log(scales)))] = 2.0
    search = tuning.spread, tuning.steps, tuning.settled, tuning.shortest, tuning.ridge
    shares, tail, likelihood = fit(*cells, d, scales, core, pseudo, shares, tuning.standing_out, search)
    kept = shares > 1e-6
    errors = Errors(tuple(scales[kept].tolist()), tuple((shares[kept] / shares[kept].sum()).tolist()))
    return ErrorFit(errors, tail, likelihood)


def _cells(z2: FloatArray, log_odds: FloatArray, tuning: ScalesTuning) -> tuple[float, tuple[NDArray[Any], ...]]:
    """How far the pairs (m,) reach, but for those of too little odds, and these in cells of like distance and odds."""
    from sameas.kernels.mixture import cells

    furthest = float(z2.max(initial=1.0, where=log_odds > tuning.least_log_odds))
    reach = max(math.sqrt(furthest), 2.0)
    return reach, cells(
        z2, log_odds, tuning.least_log_odds, tuning.most_log_odds, tuning.nearest, reach, (tuning.bins, tuning.across)
    )
