"""Reports of results as lines of text, a module for each command.

:mod:`~sameas.report.estimates` has the estimates of two catalogues in words, :mod:`~sameas.report.prose` the parts of
all.
"""
