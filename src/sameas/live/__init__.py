"""The live picture as a service: what sensors send taken in, a state that survives, a served map, outputs for others.

Data walks one way: :mod:`~sameas.live.inputs` (bytes with their time of receipt, and reports) →
:mod:`~sameas.live.keeper` (the picture, tick by tick) → :mod:`~sameas.live.frame` (one tick as others see it) →
:mod:`~sameas.live.journal` (SQLite, Parquet), :mod:`~sameas.live.outputs` (NMEA, Cursor on Target, Signal K, …) and
:mod:`~sameas.live.server` (the map, events, metrics). :mod:`~sameas.live.settings` reads the file of the user.
"""
