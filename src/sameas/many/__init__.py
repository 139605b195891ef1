"""Any number of sources at once: every partition of their records into objects is a hypothesis.

The way of the data: observations → joint densities → pooled records → terms → rules → sets → partition → marginals →
objects → explanation. :func:`sameas.identify_many` walks it for all sources together,
:func:`sameas.identify_sequentially` source after source; :mod:`~sameas.many.fusion` joins the positions of an object.
"""
