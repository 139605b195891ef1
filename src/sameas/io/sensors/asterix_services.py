"""Service messages of radars in ASTERIX (categories 002 and 034): their places and their clocks.

Some radars state their place in item 120 of category 034. Category 002 has the whole time of day; records of category
001 have it modulo 512 s. Sources: EUROCONTROL-SPEC-0149-2a (002), -2b (034, editions 1.27 to 1.29).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from sameas.io.sensors.asterix_records import CATEGORIES, Block, DamagedRecord, Item, records_of, signed, unsigned
from sameas.io.sensors.format import DAY_S

#: Latitude and longitude in degrees, height above the ellipsoid in metres.
Place = tuple[float, float, float]
_CLOCKS, _PLACES = 2, 34
#: Seconds after which a truncated time of day begins anew.
TRUNCATED_S = 512.0


@dataclass
class Services:
    """What service messages have said so far, by SAC and SIC. places : of radars. of_day_s : the last time of day."""

    places: dict[tuple[int, int], Place] = field(default_factory=dict)
    of_day_s: dict[tuple[int, int], float] = field(default_factory=dict)

    def take(self, block: Block) -> bool:
        """Takes a block of service messages; False if it is none, or says neither place nor time of day."""
        if block.category not in (_CLOCKS, _PLACES) or block.problem:
            return False
        used = False
        try:
            for items in records_of(CATEGORIES[block.category], block.data):
                identity = items.get("010")
                if isinstance(identity, bytes):
                    used |= self._take(block.category, (identity[0], identity[1]), items)
        except DamagedRecord:
            pass
        return used

    def _take(self, category: int, sensor: tuple[int, int], items: Mapping[str, Item]) -> bool:
        if category == _CLOCKS:
            if not isinstance(time := items.get("030"), bytes):
                return False
            self.of_day_s[sensor] = unsigned(time) / 128.0
            return True
        place = items.get("120")
        # Radars that do not know it send the origin.
        if not isinstance(place, bytes) or not any(place[2:]):
            return False
        lat, lon = (signed(place[k : k + 3]) * 180.0 / 2.0**23 for k in (2, 5))
        if abs(lat) > 90.0:
            return False
        self.places[sensor] = lat, lon, float(signed(place[:2]))
        return True

    def with_time(
        self, row: dict[str, Any], items: Mapping[str, Any], identity: bytes, received_s: float
    ) -> dict[str, Any] | str:
        """The row of a record of category 001 with its time of day, or the reason why that is not known: the truncated
        time nearest to that of the last message of category 002 of its radar, else to the time of receipt."""
        near_s = self.of_day_s.get((identity[0], identity[1]), received_s % DAY_S)
        if math.isnan(near_s):
            return "a plot of category 001, and no message of category 002 before it that gives the time of day"
        if "141" not in items:
            return row | {"day_s": near_s}
        late_s = (unsigned(items["141"]) / 128.0 - near_s) % TRUNCATED_S
        return row | {"day_s": (near_s + late_s - TRUNCATED_S * (late_s > 0.5 * TRUNCATED_S)) % DAY_S}
