"""The live picture as a service: sensor inputs, a state that survives restarts, a web map, outputs to other programs.

Data flow: :mod:`~sameas.live.inputs` (bytes with their receive time, decoded to reports) or
:mod:`~sameas.live.replay` (files and recordings in their place) → :mod:`~sameas.live.reception` (the reports of each
source) → :mod:`~sameas.live.keeper` (the picture, tick by tick, what it subtracts: :mod:`~sameas.live.offsets`, and
what it raises: :mod:`~sameas.live.alarms`) → :mod:`~sameas.live.situation` (one tick as plain rows) →
:mod:`~sameas.live.journal` (SQLite, Parquet), :mod:`~sameas.live.outputs` (NMEA, Cursor on Target, Signal K, …) and
:mod:`~sameas.live.server` (the map, events, metrics). :mod:`~sameas.live.settings` reads the user's TOML file.
"""
