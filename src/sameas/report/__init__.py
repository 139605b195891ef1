"""Reports of results as lines of text, one module per command.

:mod:`~sameas.report.match`, :mod:`~sameas.report.many`, :mod:`~sameas.report.frame`, :mod:`~sameas.report.movers`,
:mod:`~sameas.report.picture`, :mod:`~sameas.report.explain`; shared parts are in :mod:`~sameas.report.prose`.
"""
