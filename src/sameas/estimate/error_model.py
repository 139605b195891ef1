"""Error model: factors on the quoted errors of each source and a common floor, fitted to identified pairs.

The covariance of a pair is modelled as

    S = a₁² Σ₁ + a₂² Σ₂ + f² 1.

The factors a₁, a₂ and the floor f maximize the likelihood of the pairs, weighted by their posterior probability. A part
of the pairs may belong to a tail: normals several times wider than S, whose shares are fitted too. So outliers are
defined relative to the model, not to the quoted errors, which a floor may exceed by any factor.

The terms can be distinguished only by the variation of Σ₁, Σ₂ from pair to pair. Where that is too small, the direction
of least information shows which terms are degenerate: a factor that is degenerate with the floor, or has hardly any
effect, is fixed at 1; two degenerate factors become one for both sources; if only one number can be determined, both
alternatives (factor or floor) are given. Separate floors of the two sources are always degenerate.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from sameas.arrays import FloatArray, IntArray, tall_product
from sameas.estimate.quantity import Quantity
from sameas.evidence import Errors
from sameas.gate import Pairs
from sameas.gaussian import inverse, log_determinant
from sameas.records import unpack
from sameas.result import Identification

MIN_P = 0.05  # pairs less probable than this are not used
MIN_TAIL_PAIRS = 0.5  # normals of the tail with fewer pairs than this are excluded from the information matrix
MAX_RELATIVE_ERROR = 0.25  # a factor is determined if its standard error is below this share of it (or of 1, if larger)
MIN_EIGENVALUE_RATIO = 1e-10  # lower limit of the eigenvalues of the information matrix, relative to the largest
MIN_INFORMATION = 1e-200  # lower limit of the information on a term, so that its inverse is finite
#: The factors are degenerate with each other, not one with the floor, from this ratio of their changes on.
EXCHANGE_RATIO = 0.5
#: Gain in ln likelihood by which a floor must be better or worse than a common factor (three standard errors).
MIN_GAIN = 4.5
MAX_MIXTURE_LOG_FACTOR = 0.3  # a common factor within this of 1, in ln, is left to the mixture of scales
TAIL_FACTOR = 2.5  # components this many times wider than the typical error belong to the tail
#: Pairs less probable than the first are not used for a tail; a smaller share than the second is none.
MIN_TAIL_P, MIN_TAIL_SHARE = 1e-3, 1e-4


MIN_PAIRS, MAX_PAIRS = 200.0, 5_000  # pairs needed for a fit (expected number), and pairs used at most
MAX_STEPS, TOLERANCE = 300, 1e-5  # most steps of a fit, and the change at which it ends

#: Scales of the core and the normals of the tail, in units of the modelled error, and their initial shares.
SCALES, INITIAL_SHARES = np.array([1.0, 3.0, 6.0, 12.0]), np.array([0.97, 0.01, 0.01, 0.01])
#: Standard errors on either side of an estimate that enclose 95 %.
INTERVAL = 1.96


@dataclass(frozen=True)
class ErrorModel:
    """Factors on the quoted errors of either source and a floor of both together, in the unit of the residuals.

    factor_1, factor_2 : None if not determined, then 1 unless ``both`` is given.
    both : one factor on the errors of both sources, if the two are degenerate.
    floor : None if degenerate with a factor.
    floor_instead : the floor that explains the residuals as well as ``both`` does.
    note : what is not determined and why; "" if everything is.
    """

    factor_1: Quantity | None = None
    factor_2: Quantity | None = None
    both: Quantity | None = None
    floor: Quantity | None = None
    floor_instead: Quantity | None = None
    note: str = ""

    @property
    def terms(self) -> Mapping[str, Quantity]:
        """The determined terms by name.

        >>> list(ErrorModel(both=Quantity(1.7, 0.1), floor_instead=Quantity(0.2, 0.1)).terms)
        ['both', 'floor_instead']
        """
        return {name: value for name, value in vars(self).items() if isinstance(value, Quantity)}

    @property
    def is_estimated(self) -> bool:
        """Whether any term is determined."""
        return bool(self.terms)

    def variance(self, quoted_1: FloatArray, quoted_2: FloatArray) -> FloatArray:
        """(n,) modelled variances of pairs along an axis, from the quoted ones of both sources.

        >>> ErrorModel(factor_1=Quantity(2.0, 0.1), floor=Quantity(3.0, 0.1)).variance(np.ones(1), np.ones(1))
        array([14.])
        """
        one, two, floor = (
            0.0 if q is None else q.value
            for q in (self.factor_1 or self.both or UNSCALED, self.factor_2 or self.both or UNSCALED, self.floor)
        )
        return np.asarray(one**2 * quoted_1 + two**2 * quoted_2 + floor**2)

    @property
    def errors(self) -> Errors:
        """The model as errors of the evidence."""
        one, two = (self.factor_1 or self.both or UNSCALED), (self.factor_2 or self.both or UNSCALED)
        floor = 0.0 if self.floor is None else self.floor.value
        return Errors(factor_1=max(one.value, 1e-3), factor_2=max(two.value, 1e-3), floor=floor)


UNSCALED = Quantity(1.0, 0.0)


def error_model(answer: Identification) -> ErrorModel:
    """The error model of the pairs of an answer.

    >>> error_model(match(plate, gaia)[0]).factor_1  # doctest: +SKIP
    Quantity(value=1.68, standard_error=0.04, unit='')
    """
    return fit_error_model(answer.pairs, answer.p_pair, MAX_PAIRS)


def fit_error_model(pairs: Pairs, p_pair: FloatArray, most: int) -> ErrorModel:
    """The error model of pairs with these (m,) probabilities, fitted to at most ``most`` of them."""
    probable = _sample(p_pair, most)
    weight = p_pair[probable]
    if weight.sum() < MIN_PAIRS:
        return ErrorModel(note=f"fewer than {MIN_PAIRS:.0f} pairs: too few to judge the sources' errors apart")
    one = unpack(pairs.first.covariance[pairs.i[probable]], pairs.d)
    two = unpack(pairs.second.covariance[pairs.j[probable]], pairs.d)
    names = pairs.first.source, pairs.second.source
    return _PairErrors(pairs.residual[probable], weight, one, two, names).model()


def _sample(p_pair: FloatArray, most: int) -> IntArray:
    """Indices of probable pairs; every second, third, … if there are more than ``most``.

    Pairs below 0.5 are included: where large errors have many candidates, only the smallest residuals exceed 0.5.
    """
    probable = np.flatnonzero(p_pair > MIN_P)
    return probable[:: max(1, -(-len(probable) // most))]


def better_model(errors: Errors, pairs: Pairs, p_pair: FloatArray, most: int) -> tuple[Errors, float]:
    """The errors of the model fitted to these (m,) pairs, and its gain in ln likelihood over ``errors``.

    Both get the maximum-likelihood mixture of error scales. The gain is infinite where one factor replaces ``errors``.
    """
    probable = _sample(p_pair, most)
    model = fit_error_model(pairs, p_pair, most)
    if not model.is_estimated:
        return errors, 0.0
    some, weight = pairs.part(probable), p_pair[probable]
    old, new = (log_likelihood(each, some, weight) for each in (errors, model.errors))
    if np.any(errors.floor) or errors.factor_1 != errors.factor_2:
        factor = factor_on_quoted(errors, pairs, p_pair) * errors.typical_scale
        factor = factor if abs(math.log(factor)) > MAX_MIXTURE_LOG_FACTOR else 1.0
        plain = Errors(factor_1=factor, factor_2=factor)
        if log_likelihood(plain, some, weight) > max(old, new) - MIN_GAIN:
            return plain, math.inf
    return model.errors, new - old


#: Scales of the mixture with which models are compared, and EM steps of its fit.
LADDER, LADDER_STEPS = 1.5 ** np.arange(-5.0, 8.0), 30


def log_likelihood(errors: Errors, pairs: Pairs, weight: FloatArray) -> float:
    """ln likelihood of pairs with these (m,) weights, by S with the maximum-likelihood mixture of scales."""
    return float(weight @ with_fitted_mixture(errors, pairs, weight).log_density(pairs))


def with_fitted_mixture(errors: Errors, pairs: Pairs, weight: FloatArray) -> Errors:
    """S with the maximum-likelihood mixture of scales for pairs with these (m,) weights."""
    return errors.with_mixture(_fit_mixture(errors.pairs(pairs).mahalanobis_sq, pairs.d, weight, LADDER))


def _fit_mixture(mahalanobis_sq: FloatArray, d: int, weight: FloatArray, scales: FloatArray) -> Errors:
    """The maximum-likelihood mixture of these scales for pairs with these (m,) weights, by EM."""
    exponent = -0.5 * mahalanobis_sq[:, None] / scales**2
    density = np.exp(exponent - exponent.max(axis=1, keepdims=True)) / scales**d
    shares = np.full(len(scales), 1.0 / len(scales))
    for _ in range(LADDER_STEPS):
        p_component = density * shares
        shares = (weight / p_component.sum(axis=1)) @ p_component / weight.sum()
    shares = np.where(shares > 1e-6, shares, 0.0)
    return Errors(tuple(scales.tolist()), tuple((shares / shares.sum()).tolist()))


def factor_on_quoted(errors: Errors, pairs: Pairs, p_pair: FloatArray) -> float:
    """Median over the probable pairs of modelled over quoted error, without the mixture."""
    if not errors.as_modelled or not len(pairs):
        return 1.0
    probable = _sample(p_pair, MAX_PAIRS)
    some = pairs.part(probable) if len(probable) else pairs
    ratio = errors.pairs(some).determinant / some.determinant
    return float(np.median(ratio) ** (0.5 / pairs.d))


def fit_spread(pairs: Pairs, p_pair: FloatArray) -> Errors:
    """Distribution of the residuals of pairs (m,) relative to their quoted covariances: a mixture of scales."""
    probable = _sample(p_pair, MAX_PAIRS)
    if not len(probable):
        return Errors()
    square = pairs.mahalanobis_sq[probable]
    farthest = max(math.sqrt(float(square.max())), 2.0)
    rungs = math.ceil(math.log(farthest) / math.log(1.5)) + 1
    mixture = _fit_mixture(square, pairs.d, p_pair[probable], 1.5 ** np.arange(-5.0, rungs))
    kept = [(scale, share) for scale, share in zip(mixture.scales, mixture.shares, strict=True) if share > 0.0]
    scales, shares = zip(*kept, strict=True)
    return Errors(scales, shares)


def fit_variances(residual: FloatArray, weight: FloatArray, parts: FloatArray) -> FloatArray:
    """(k,) the θ ≥ 0 of greatest likelihood for residuals (m, d) of covariance Σ θ_k parts_k, parts (k, m, d, d).

    For degenerate parts only the sum of their terms is determined.
    """
    return _fit(residual, weight, parts, np.zeros_like(parts[0])).theta


@dataclass(frozen=True)
class _PairErrors:
    """Residuals (m, d) of pairs, weights (m,), quoted covariances (m, d, d) of both sources, names of the sources."""

    residual: FloatArray
    weight: FloatArray
    quoted_1: FloatArray
    quoted_2: FloatArray
    names: tuple[str, str]

    @property
    def unit(self) -> float:
        """Typical variance of the pairs per axis; unit of the floor's variance."""
        return float(np.median(np.einsum("mvv->m", self.quoted_1 + self.quoted_2)) / self.residual.shape[1])

    @property
    def floor_covariance(self) -> FloatArray:
        """(m, d, d) covariance of a floor of one ``unit``."""
        return np.broadcast_to(self.unit * np.eye(self.residual.shape[1]), self.quoted_1.shape)

    def model(self) -> ErrorModel:
        """The model with all three terms if they can be distinguished, else with two or one."""
        fit = self._fit((self.quoted_1, self.quoted_2, self.floor_covariance))
        if all(fit.is_determined(k) for k in (0, 1)):
            return ErrorModel(fit.root(0), fit.root(1), floor=self._floor(fit, 2))
        change = np.abs(fit.weakest)
        more = int(change[1] > change[0])
        if change[1 - more] > max(EXCHANGE_RATIO * change[more], change[2]):
            return self._with_common_factor()
        return self._with_one_as_quoted(more)

    def _with_one_as_quoted(self, source: int) -> ErrorModel:
        """The model with the errors of ``source`` (0 or 1) as quoted."""
        fixed, free = (self.quoted_1, self.quoted_2) if source == 0 else (self.quoted_2, self.quoted_1)
        fit = self._fit((free, self.floor_covariance), fixed)
        if not fit.is_determined(0):
            return self._with_one_term()
        name, no_floor = self.names[source], self._fit((self.quoted_1, self.quoted_2))
        gain = no_floor.log_likelihood - fit.log_likelihood
        if gain > MIN_GAIN and all(no_floor.is_determined(k) for k in (0, 1)):
            note = f"a floor cannot be distinguished from the errors of {name}"
            return ErrorModel(no_floor.root(0), no_floor.root(1), note=note)
        note = f"those of {name} taken as quoted: too small or too uniform to be distinguished from a floor"
        factor, floor = fit.root(0), self._floor(fit, 1)
        first, second = (None, factor) if source == 0 else (factor, None)
        return ErrorModel(first, second, floor=floor, note=note)

    def _with_common_factor(self) -> ErrorModel:
        """The model with one factor on the errors of both sources."""
        fit = self._fit((self.quoted_1 + self.quoted_2, self.floor_covariance))
        if not fit.is_determined(0):
            return self._with_one_term()
        note = "the quoted errors of the two are correlated from pair to pair: which are too small cannot be determined"
        return ErrorModel(both=fit.root(0), floor=self._floor(fit, 1), note=note)

    def _with_one_term(self) -> ErrorModel:
        """The model with a factor on both or a floor, or with both alternatives if they are equally likely."""
        factor = self._fit((self.quoted_1 + self.quoted_2,))
        floor = self._fit((self.floor_covariance,), self.quoted_1 + self.quoted_2)
        gain = floor.log_likelihood - factor.log_likelihood
        alike = "the quoted errors vary too little from pair to pair to determine"
        if gain > MIN_GAIN:
            return ErrorModel(floor=self._floor(floor, 0), note=f"{alike} whether their own sizes are right too")
        if gain < -MIN_GAIN:
            note = f"{alike} which source's are wrong, or whether there is a floor"
            return ErrorModel(both=factor.root(0), note=note)
        note = f"{alike} a factor from a floor, or which source's errors are wrong"
        return ErrorModel(both=factor.root(0), floor_instead=self._floor(floor, 0), note=note)

    def _fit(self, parts: Sequence[FloatArray], fixed: FloatArray | None = None) -> _VarianceFit:
        fixed = np.zeros_like(self.quoted_1) if fixed is None else fixed
        return _fit(self.residual, self.weight, np.stack(parts), fixed)

    def _floor(self, fit: _VarianceFit, k: int) -> Quantity:
        """The root of term k as a floor, in the unit of the residuals."""
        root, sigma = fit.root(k), float(np.sqrt(self.unit))
        return Quantity(sigma * root.value, sigma * root.standard_error)


@dataclass(frozen=True)
class _VarianceFit:
    """Factors (k,) of variances, their covariance (k, k), direction (k,) of least information, and ln likelihood."""

    theta: FloatArray
    covariance: FloatArray
    weakest: FloatArray
    log_likelihood: float

    def root(self, k: int) -> Quantity:
        """√θ and its standard error: the change of the root across the 95 % interval of θ ≥ 0, over 1.96.

        First-order error propagation would fail where θ is zero within its error: the root is not normal there, and its
        error would be nearly zero.
        """
        theta, error = float(self.theta[k]), INTERVAL * float(np.sqrt(self.covariance[k, k]))
        value = float(np.sqrt(theta))
        ends = np.sqrt(np.maximum([theta - error, theta + error], 0.0))
        return Quantity(value, float(np.abs(ends - value).max()) / INTERVAL)

    def is_determined(self, k: int) -> bool:
        """Whether a factor is known well enough to be reported."""
        root = self.root(k)
        return root.standard_error < MAX_RELATIVE_ERROR * max(root.value, 1.0)


def _fit(residual: FloatArray, weight: FloatArray, parts: FloatArray, fixed: FloatArray) -> _VarianceFit:
    """S = ``fixed`` + Σ θ_k parts_k of greatest likelihood, by EM over core and tail.

    residual (m, d), weight (m,), parts (k, m, d, d), fixed (m, d, d).
    """
    # The axis of pairs is last, so that products are contiguous.
    residual, parts, fixed = residual.T.copy(), _pairs_last(parts), _pairs_last(fixed)
    theta, shares, damping = np.full(len(parts), 0.5), INITIAL_SHARES, 0.5
    for _ in range(MAX_STEPS):
        state = _PairTerms.of(residual, parts, fixed, theta, shares)
        core = weight * state.p_component[0]
        score = state.score @ core
        flat = len(parts), -1
        along = state.precision_parts
        information = 0.5 * tall_product((along * core).reshape(flat).T, along.swapaxes(1, 2).reshape(flat).T)
        free = (theta > 1e-9) | (score > 0.0)
        step = np.zeros(len(theta))
        step[free] = np.linalg.lstsq(information[np.ix_(free, free)], score[free], rcond=1e-9)[0]
        previous, theta = theta, np.maximum(theta + damping * step, 1e-9)
        shares, damping = state.p_component @ weight / weight.sum(), 1.0
        if np.abs(theta - previous).max() < TOLERANCE * max(1.0, float(theta.max())):
            break
    return _with_covariance(_PairTerms.of(residual, parts, fixed, theta, shares), weight, theta, shares)


def _pairs_last(matrices: FloatArray) -> FloatArray:
    """(…, d, d, m) of (…, m, d, d)."""
    return np.ascontiguousarray(np.moveaxis(matrices, -3, -1))


@dataclass(frozen=True)
class _PairTerms:
    """Terms of every pair by one model.

    precision_parts : (k, d, d, m) S⁻¹ parts. score : (k, m) derivative of ln N(residual; 0, S) with θ.
    p_component : (n, m) probabilities of core and tail. log_density : (m,) of the residual.
    """

    precision_parts: FloatArray
    score: FloatArray
    p_component: FloatArray
    log_density: FloatArray

    @classmethod
    def of(
        cls, residual: FloatArray, parts: FloatArray, fixed: FloatArray, theta: FloatArray, shares: FloatArray
    ) -> _PairTerms:
        """From residuals (d, m), parts (k, d, d, m) and fixed (d, d, m)."""
        covariance = np.moveaxis(fixed + np.tensordot(theta, parts, 1), -1, 0)
        precision = _pairs_last(inverse(covariance))
        scaled = np.einsum("vwm,wm->vm", precision, residual)
        precision_parts = np.einsum("vwm,kwxm->kvxm", precision, parts)
        slope = 0.5 * np.einsum("vwm,kvwm->km", scaled[:, None] * scaled - precision, parts)
        square = (scaled * residual).sum(axis=0)
        with np.errstate(divide="ignore"):
            log_share = np.log(shares) - len(residual) * np.log(SCALES)
        log_member = log_share[:, None] - 0.5 * square / SCALES[:, None] ** 2
        greatest = log_member.max(axis=0)
        p_component = np.exp(log_member - greatest)
        total = p_component.sum(axis=0)
        log_density = greatest + np.log(total) - 0.5 * log_determinant(covariance)
        return cls(precision_parts, slope, p_component / total, log_density)


def _with_covariance(state: _PairTerms, weight: FloatArray, theta: FloatArray, shares: FloatArray) -> _VarianceFit:
    """The fit, with the covariance from the outer products of the pairs' scores, including the shares of the tail.

    Terms at zero are excluded from the covariance of the others.
    """
    core = state.p_component[0]
    tail = np.flatnonzero(shares[1:] * weight.sum() > MIN_TAIL_PAIRS) + 1
    scores = np.vstack([state.score * core, state.p_component[tail] / shares[tail, None] - core / shares[0]])
    information = np.einsum("m,am,bm->ab", weight, scores, scores)
    k = len(theta)
    free = np.concatenate([theta > 1e-6, np.ones(len(tail), np.bool_)])
    covariance = np.diag(np.diag(_bounded_inverse(information)))[:k, :k]
    of_free = _bounded_inverse(information[np.ix_(free, free)])
    index = np.flatnonzero(free[:k])
    covariance[np.ix_(index, index)] = of_free[: len(index), : len(index)]
    weakest = np.linalg.eigh(_bounded_inverse(information)[:k, :k])[1][:, -1]
    return _VarianceFit(theta, covariance, weakest, float(weight @ state.log_density))


def _bounded_inverse(information: FloatArray) -> FloatArray:
    """The inverse, with a very large variance where there is no information."""
    size = np.sqrt(np.maximum(np.diag(information), MIN_INFORMATION))
    values, vectors = np.linalg.eigh(information / np.outer(size, size))
    scaled = (vectors / np.maximum(values, MIN_EIGENVALUE_RATIO * values.max(initial=0.0))) @ vectors.T
    return np.asarray(scaled / np.outer(size, size))


# The tail: pairs with residuals far larger than the typical ones (outliers, binaries, blends). It consists of the
# components of the error mixture (:class:`sameas.evidence.Errors`) that are far wider than the typical error; a common
# underestimation of all errors is no tail.


@dataclass(frozen=True)
class Tail:
    """``share`` of the pairs in the tail, and the ``factor`` (geometric mean) of their errors over the quoted ones."""

    share: Quantity
    factor: float


def tail(answer: Identification, errors: Errors) -> Tail | None:
    """The tail of the errors of the pairs of an answer; None without a tail.

    The standard error is that of the share in a mixture of tail and core of known shape, with the information
    Σ p [(f_tail − f_core) / f]².

    >>> answer, estimate = match(plate, gaia)  # doctest: +SKIP
    >>> tail(answer, estimate.errors).share  # doctest: +SKIP
    Quantity(value=0.021, standard_error=0.0018, unit='')
    """
    scales, shares = np.asarray(errors.scales), np.asarray(errors.shares)
    far = scales > TAIL_FACTOR * errors.typical_scale
    share = float(shares[far].sum())
    if not MIN_TAIL_SHARE < share < 1.0:
        return None
    d, weight = answer.pairs.d, answer.p_pair
    probable = weight > MIN_TAIL_P
    # Densities without the factor that all components share.
    square = errors.pairs(answer.pairs.part(probable)).mahalanobis_sq[:, None]
    density = shares * np.exp(-0.5 * square / scales**2) / scales**d
    outer, core = density[:, far].sum(axis=1) / share, density[:, ~far].sum(axis=1) / (1.0 - share)
    slope = (outer - core) / np.maximum(share * outer + (1.0 - share) * core, np.finfo(float).tiny)
    information = float(np.sum(weight[probable] * slope**2))
    factor = math.exp(float(shares[far] @ np.log(scales[far])) / share)
    factor *= factor_on_quoted(errors, answer.pairs, answer.p_pair)
    return Tail(Quantity(share, 1.0 / math.sqrt(max(information, np.finfo(float).tiny))), factor)
