"""Estimates of what nobody knows beforehand: densities, coverage, miss rates, error scales and floors, photometry.

:func:`~sameas.estimate.match.match`, behind :func:`sameas.match`, finds them together with the identification, by
expectation and maximisation (EM): the rounds are in :mod:`~sameas.estimate.em`, what each learns in a module of its
own.
"""
