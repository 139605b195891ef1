"""Many catalogues at once: :func:`match_many` finds the objects of two catalogues or more, jointly.

>>> import numpy as np
>>> from sameas.sky.catalogue import Catalogue, CatalogueOptions
>>> rng = np.random.default_rng(1)
>>> ra, dec = rng.uniform(10.0, 11.0, 200), rng.uniform(40.0, 41.0, 200)
>>> def observed(name, rows):
...     scatter = 0.1 / 3600.0 * rng.standard_normal((2, len(rows)))
...     positions = {"ra": ra[rows] + scatter[0] / np.cos(np.radians(dec[rows])), "dec": dec[rows] + scatter[1]}
...     return Catalogue.of(positions, name, options=CatalogueOptions(sigma=0.1))
>>> radio, optical = observed("radio", np.arange(150)), observed("optical", np.arange(200))
>>> xray = observed("xray", np.arange(60))
>>> result = match_many([radio, optical, xray])
>>> np.bincount(result.objects.n_members).tolist()
[0, 50, 90, 60]
"""

from sameas.sky.many.match import ManyMatch, ManyOptions, match_many

__all__ = ["ManyMatch", "ManyOptions", "match_many"]
