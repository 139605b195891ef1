"""Maps: what a map of a picture shows, before anybody draws it.

- :class:`MapSheet`: objects and records as columns, sensors, alarms, summary; made by whoever has a picture.
- :func:`outline`: coasts, lakes and borders around a place, in its plane.

``sameas.pages.map`` draws a sheet as a page with a time slider, ``sameas.plots.map`` as a picture of one instant.
"""

from sameas.maps.outline import Outline, outline
from sameas.maps.sheet import MapAlarm, MapSensor, MapSheet

__all__ = ["MapAlarm", "MapSensor", "MapSheet", "Outline", "outline"]
