"""sameas tells which records of two or more sources are the same real thing, and how sure it is.

What to use when:

- two sources, and nothing known of them but what they say: :func:`match`, of files, tables, data frames, records;
- two sources whose densities, miss rates or costs you know: :func:`identify` with a rule and a prior;
- more than two sources: :func:`identify_many`; one after the other, as they come: :func:`identify_sequentially`;
- one source shifted, turned or biased against the other: :func:`register`;
- star catalogues and CCD frames: :mod:`sameas.sky`; radar, AIS, ADS-B: :mod:`sameas.tracks` and :mod:`sameas.picture`;
- scenes whose truth is known, and scores against it: :mod:`sameas.simulate`, :mod:`sameas.score`.

``__init__.pyi`` is the one list of public names, here and in the subpackages; what it does not list is private. Names
are imported when they are first used, so ``import sameas`` costs nothing.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
