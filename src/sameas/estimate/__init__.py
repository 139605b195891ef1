"""Estimates of unknown parameters: densities, coverage, miss rates, error scales and floors, photometry.

:func:`~sameas.estimate.match.match`, behind :func:`sameas.match`, makes them together with the identification, by
expectation and maximisation (EM). The iterations are in :mod:`~sameas.estimate.em`, each fit in a module of its own.
"""
