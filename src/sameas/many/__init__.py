"""Identification of the records of any number of sources; a hypothesis is a partition of all records into objects.

- All sources jointly, independent of their order: :func:`sameas.identify_many`.
- Source after source, for comparison: :func:`sameas.identify_sequentially`.
- One position from several estimates of it: :mod:`sameas.many.fusion`.

Stages: observations and their joint density → pooled records → rules and their terms → sets → partition and marginals
→ objects → explanation.
"""
