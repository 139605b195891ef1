"""Units: those of ships and aircraft in metres and seconds."""

MILE_M = 1852.0
FOOT_M = 0.3048
KNOT_M_PER_S = MILE_M / 3600.0
FEET_PER_MINUTE_M_PER_S = FOOT_M / 60.0
