"""A series of frames of one field as one product: each star once, in every frame.

- :mod:`~sameas.sky.series.tied`: identified frames (``Exposure``) → ``Series``, tied together, with what stands still;
- :mod:`~sameas.sky.series.stars`: what stands still → ``Stars``, each once, zero points and differential magnitudes.

What is left is searched for movers (:mod:`sameas.sky.movers.search`).
"""
