"""Test problems: random records, groups from a list of candidate pairs, and their solutions."""

import numpy as np

import naive
from sameas.assignment import assign
from sameas.gate import Pairs
from sameas.groups import groups
from sameas.posterior import posterior
from sameas.prior import LogPrior
from sameas.records import Records
from sameas.score.pairs import is_true_pair, score_probabilities
from sameas.space import Plane, Sphere

KINDS = ("one sigma", "axis sigmas", "full")


def random_errors(rng, n, d, scale, kind):
    """Keyword arguments of `Records.of` for random errors of about ``scale``, (n,) or a number."""
    size = np.broadcast_to(scale, n) * rng.uniform(0.5, 1.5, n)
    if kind == "one sigma":
        return {"sigma": size[:, None]}
    if kind == "axis sigmas":
        return {"sigma": size[:, None] * rng.uniform(0.5, 2, (n, d))}
    root = rng.standard_normal((n, d, d)) * 0.6 + np.eye(d)
    return {"covariance": size[:, None, None] ** 2 * (root @ root.transpose(0, 2, 1) + 0.1 * np.eye(d))}


def random_covariances(rng, *shape):
    """Positive definite matrices (*shape, d), d the last number of ``shape``."""
    root = rng.standard_normal((*shape, shape[-1]))
    return root @ np.swapaxes(root, -1, -2) + 0.1 * np.eye(shape[-1])


def crowd(n, source="a", seed=1):
    """Records that are all within one error of each other."""
    return Records.of(np.random.default_rng(seed).normal(0.0, 0.3, (n, 2)), sigma=1.0, source=source)


def plane_records(rng, n, d, *, extent=1.0, scale=0.03, kind="one sigma", periods=None, source="source"):
    """Records uniform in a box; on periodic axes up to two periods are added or subtracted."""
    features = rng.uniform(0, 1, (n, d)) * extent
    for v, period in enumerate(periods or ()):
        if period is not None:
            features[:, v] += period * rng.integers(-2, 3, n)
    errors = random_errors(rng, n, d, scale, kind)
    return Records.of(features, **errors, ids=rng.permutation(n) + 100, space=Plane(periods), source=source)


def sky_records(rng, lon, lat, *, scale_arcsec, kind="one sigma", source="source"):
    """Records at the directions ``lon``, ``lat`` in degrees."""
    n = len(lon)
    errors = random_errors(rng, n, 2, scale_arcsec, kind)
    ids = rng.permutation(n) + 100
    return Records.of(np.stack([lon, lat], axis=1), **errors, ids=ids, space=Sphere(), source=source)


def calibration(answer, scene):
    """Scores of the stated probabilities of the pairs of a simulated scene."""
    return score_probabilities(answer.p_pair, is_true_pair((answer.rows_1, answer.rows_2), scene.true_pairs()))


def by_id(pairs):
    """The candidates as pairs of ids, in their order."""
    first, second = pairs.first, pairs.second
    return list(zip(first.ids[first.rows[pairs.i]].tolist(), second.ids[second.rows[pairs.j]].tolist(), strict=True))


def shuffled(rng, records):
    """The same records with their rows permuted."""
    order = rng.permutation(len(records))
    return Records(
        records.features[order], records.covariance[order], np.arange(len(records)), records.ids[records.rows[order]],
        records.space, records.source,
    )  # fmt: skip


def laid_out(n1, n2, edges):
    """(pairs, groups) of n1 and n2 records with the candidates ``edges`` (i, j)."""
    i, j = np.array(sorted(edges), np.int32).reshape(-1, 2).T
    first, second = (Records.of(np.zeros((n, 1)), sigma=1.0) for n in (n1, n2))
    m = len(i)
    pairs = Pairs(first, second, i, j, i.copy(), j.copy(), np.zeros((m, 1)), np.zeros(m), np.ones(m), "by hand")
    return pairs, groups(pairs)


def solved(n1, n2, log_ratio, prior):
    """(pairs, groups, best hypothesis, posterior) for the likelihood ratios {(i, j): ln λ}."""
    pairs, grouped = laid_out(n1, n2, log_ratio)
    weight = np.array([log_ratio[edge] for edge in zip(pairs.i.tolist(), pairs.j.tolist(), strict=True)])
    log_prior = prior if isinstance(prior, LogPrior) else prior(grouped.sizes_1, grouped.sizes_2)
    best = assign(grouped, weight, log_prior)
    return pairs, grouped, best, posterior(grouped, best)


def chosen_edges(pairs, grouped, best):
    """The pairs of the best hypothesis as a set of (i, j)."""
    at = grouped.order[best.chosen]
    return set(zip(pairs.i[at].tolist(), pairs.j[at].tolist(), strict=True))


def components_of(n1, n2, log_ratio):
    """Per connected component with candidates: (rows of 1, rows of 2, ratios by row within the component)."""
    for rows_1, rows_2 in naive.components(n1, n2, log_ratio):
        if not (rows_1 and rows_2):
            continue
        one = {row: k for k, row in enumerate(sorted(rows_1))}
        two = {row: k for k, row in enumerate(sorted(rows_2))}
        local = {(one[i], two[j]): x for (i, j), x in log_ratio.items() if i in one}
        yield sorted(rows_1), sorted(rows_2), local


def random_ratios(rng, n1, n2, share, draw):
    """{(i, j): ln λ} for a random ``share`` of all pairs, with ratios from ``draw(rng)``."""
    return {(i, j): float(draw(rng)) for i in range(n1) for j in range(n2) if rng.uniform() < share}


DRAWS = {
    "ordinary": lambda rng: rng.normal(1, 3),
    "ties": lambda rng: rng.integers(-1, 3),
    "all equal": lambda rng: 0.5,
    "extreme": lambda rng: rng.choice([-600.0, 600.0, 0.0, 2.0]) + rng.normal(),
    "nearly equal": lambda rng: 1.0 + 1e-11 * rng.integers(0, 5),
    "all unlikely": lambda rng: -rng.uniform(1, 20),
}


def many_blocks(rng, draw, blocks=40, most=5):
    """(n1, n2, ratios) of many small separate graphs: sparse and dense, n1 < n2 and n1 > n2, some records isolated."""
    n1 = n2 = 0
    ratios = {}
    for _ in range(blocks):
        a, b = rng.integers(1, most + 1, 2)
        for (i, j), x in random_ratios(rng, a, b, rng.choice([0.3, 0.6, 1.0]), draw).items():
            ratios[n1 + i, n2 + j] = x
        n1, n2 = n1 + int(a), n2 + int(b)
    return n1, n2, ratios


def counterparts_of_ellipses(rng, *, n=600, share=0.85, factor=1.0):
    """X-ray sources in a dense catalogue, about six of its records within 3σ: the sources (n), the catalogue, the
    partner of every source (−1 for none) and the catalogue's magnitudes, whose partners are brighter.

    factor : of the true errors to the quoted ones, ellipses of 3 to 8 arcsec.
    """
    n_other, side = 20_000, 2546.0
    place, magnitude = rng.uniform(0.0, side, (n_other, 2)), 26.0 + np.log10(rng.uniform(1e-3, 1.0, n_other)) / 0.3
    weight = np.exp(-1.3 * magnitude)
    found = rng.choice(n_other, rng.binomial(n, share), replace=False, p=weight / weight.sum())
    partner = rng.permutation(np.concatenate([found, np.full(n - len(found), -1)]))
    centre = np.where(partner[:, None] >= 0, place[partner], rng.uniform(0.0, side, (n, 2)))
    major, angle = np.exp(rng.uniform(np.log(3.0), np.log(8.0), n)), rng.uniform(0.0, np.pi, n)
    axes = np.stack([major, major * rng.uniform(0.5, 1.0, n)], axis=1)
    root = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]).transpose(2, 0, 1)
    root = root * axes[:, None, :]
    measured = centre + factor * np.einsum("nvw,nw->nv", root, rng.standard_normal((n, 2)))
    first = Records.of(measured, covariance=root @ root.transpose(0, 2, 1), source="sources")
    sigma = rng.uniform(0.1, 0.3, n_other)
    second = Records.of(
        place + factor * sigma[:, None] * rng.standard_normal((n_other, 2)), sigma=sigma[:, None], source="catalogue"
    )
    return first, second, partner, magnitude
