"""Reports of results as lines of text, by command.

:mod:`~sameas.report.match` (also ``many``), :mod:`~sameas.report.frame` (also ``movers``),
:mod:`~sameas.report.picture` and :mod:`~sameas.report.explain`; shared parts are in :mod:`~sameas.report.prose`.
"""
