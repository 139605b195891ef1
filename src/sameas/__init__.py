"""sameas finds which records of two or more sources are the same real object, with probabilities.

What to use when:

- two sources, with everything estimated from the data: :func:`match`, of files, tables, data frames, records;
- one source that has objects several times: :func:`match_internal`;
- two sources whose densities, miss rates or costs you know: :func:`identify` with a rule and a prior;
- more than two sources: :func:`identify_many`; one after the other, in order of arrival: :func:`identify_sequentially`;
- one source shifted, rotated or biased relative to the other: :func:`register`;
- star catalogues and CCD frames: :mod:`sameas.sky`; radar, AIS, ADS-B: :mod:`sameas.tracks` and :mod:`sameas.picture`;
- scenes whose truth is known, and scores against it: :mod:`sameas.simulate`, :mod:`sameas.score`.

``__init__.pyi`` is the list of public names, here and in the subpackages; all others are private. Names are imported
when first used, so that ``import sameas`` takes no time.
"""

import lazy_loader

__version__ = "0.1.0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
