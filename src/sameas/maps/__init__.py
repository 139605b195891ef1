"""Maps: the content of a map of a picture, independent of how it is drawn.

- :class:`MapSheet`: objects and records as columns, sensors, alarms and a summary.
- :func:`outline`: coasts, lakes and borders around a place, in its local plane.

``sameas.pages.map`` draws a sheet as a page with a time slider, ``sameas.plots.map`` as a chart of one instant.
"""

from sameas.maps.outline import Outline, outline
from sameas.maps.sheet import MapAlarm, MapSensor, MapSheet

__all__ = ["MapAlarm", "MapSensor", "MapSheet", "Outline", "outline"]
