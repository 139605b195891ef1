"""Reports of results: lines of text for people, one module a command.

:mod:`~sameas.report.match`, :mod:`~sameas.report.many`, :mod:`~sameas.report.frame`, :mod:`~sameas.report.picture`;
what they share is in :mod:`~sameas.report.findings` and :mod:`~sameas.report.prose`.
"""
