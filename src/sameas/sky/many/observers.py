"""Catalogues as observers of stars: what :mod:`sameas.many` asks of several sources, answered for stars that move."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from sameas.joint import Joint, Observers
from sameas.records import FloatArray, IntArray, Records
from sameas.sky.many.candidates import place
from sameas.sky.many.population import Population, patterns_of
from sameas.sky.many.stars import Sightings, fitted
from sameas.terms import Linear, Terms
from sameas.union import Union

#: A bound that leaves out no set: a motion makes places far apart more probable than any peak of a density.
UNBOUNDED = 1e4


@dataclass(frozen=True)
class StarObservers(Observers):
    """Catalogues as observers of stars, ``sources`` their records in the order of the union.

    The state of a set: right ascension and declination in degrees at the reference epoch, proper motion east and north
    in arcsec per year, (k, 4); its covariance in arcsec and arcsec per year, as the residuals of its pattern spread
    where they tell of errors.

    sightings, population : in the order of the catalogues and of their tables. catalogue : (S,) which one each source
    is. position : per source where its records stand there.
    """

    sightings: tuple[Sightings, ...] = field(kw_only=True)
    population: Population = field(kw_only=True)
    catalogue: tuple[int, ...] = field(kw_only=True)
    position: tuple[IntArray, ...] = field(kw_only=True)

    @classmethod
    def of(
        cls, union: Union, records: Sequence[Records], sightings: tuple[Sightings, ...], population: Population
    ) -> StarObservers:
        """Those of a union of the catalogues' ``records``."""
        names = [one.source for one in records]
        sources = tuple(source for source in union.sources if isinstance(source, Records))
        catalogue = tuple(names.index(source.source) for source in sources)
        position = tuple(place(source, records[c]) for source, c in zip(sources, catalogue, strict=True))
        return cls(sources, None, sightings=sightings, population=population, catalogue=catalogue, position=position)

    def placed(self, sets: NDArray[np.integer]) -> IntArray:
        """Sets (k, sources) of positions in the sources, as (k, catalogues) of positions in the catalogues' records."""
        out = np.full(sets.shape, -1, np.int64)
        for s, c in enumerate(self.catalogue):
            k = np.flatnonzero(sets[:, s] >= 0)
            out[k, c] = self.position[s][sets[k, s]]
        return out

    def joint(self, sets: NDArray[np.integer]) -> Joint:
        """Density and state of ``sets`` (k, sources): density of objects of their pattern times that of the places."""
        placed = self.placed(sets)
        fit, patterns = fitted(self.sightings, placed), patterns_of(placed)
        log_density = fit.log_peak + self.population.log_spread(patterns, fit.chi_sq)
        several = patterns & (patterns - 1) > 0
        log_density += np.where(several, self.population.log_together(placed, patterns), 0.0)
        scale_sq = np.where(fit.judged, self.population.scale_sq(patterns, fit.chi_sq), 1.0)
        state = np.column_stack([fit.direction, fit.motion])
        return Joint(log_density, fit.chi_sq, state, scale_sq[:, None, None] * fit.covariance)

    def terms(self, union: Union) -> Terms:
        """What the records weigh as objects of their own."""
        alone = [self.population.log_alone(c)[p] for c, p in zip(self.catalogue, self.position, strict=True)]
        return Terms({"density of lone records": Linear(0.0, -np.concatenate(alone))})

    def log_peak(self, s: int) -> FloatArray:
        """(n,) no set gains more by a record of source s."""
        return np.full(len(self.position[s]), UNBOUNDED)
