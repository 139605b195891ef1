"""Kinds of sources: tables of the values assumed for each if its description does not give them, with reasons.

A new kind is a new :class:`Kind` in :data:`KINDS`. Names are those of :class:`sameas.tracks.source.Description`,
``part.field``. Every value used from here is in the description's ``assumed`` and is printed with the result.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

Value = float | tuple[float, ...]
#: Ships at anchor or moored, and those of class B that make less than 2 kn, send at such intervals (ITU-R M.1371,
#: table 1).
AT_REST_EVERY_S = 180.0


@dataclass(frozen=True)
class Kind:
    """One kind of source.

    defaults : (value, reason) by name of the quantity. correlation_s : prior correlation time of its position errors,
    seconds (chosen). directions : whether it gives only directions. self_named : whether its objects transmit their
    own ids, so that no tracker swaps them. target : "vessel" or "aircraft" if all its objects are, else "".
    """

    title: str
    defaults: Mapping[str, tuple[Value, str]]
    correlation_s: float = 60.0
    directions: bool = False
    self_named: bool = False
    target: str = ""


_VESSEL = {
    "motion.acceleration_m2_per_s3": (
        0.01,
        "random walk of a vessel's velocity: 0.1 m/s in a second, 1.3 m/s in three minutes",
    ),
    "motion.speed_m_per_s": (8.0, "vessels move at up to 16 knots"),
}
#: Motion of aircraft, by name of the number, with its source.
AIRCRAFT_MOTION = {
    "motion.acceleration_m2_per_s3": (4.0, "an airliner's turns and speed changes: 2 m/s in a second"),
    "motion.manoeuvring_share": (0.1, "near an airport, aircraft turn or change speed for a tenth of the time"),
    "motion.speed_m_per_s": (150.0, "aircraft move at 300 knots, at most twice that"),
}
_DRONE = {
    "motion.acceleration_m2_per_s3": (4.0, "a multicopter's turns and stops: 2 m/s in a second"),
    "motion.speed_m_per_s": (12.0, "drones move at up to 20 m/s or so"),
}
_FIXED_ERRORS = {
    "errors.speed_m_per_s": (0.3, "satellite receivers"),
    "errors.course_deg": (3.0, "satellite receivers"),
}
#: Kind of a source that only gives the positions of a vessel which carries sensors.
CARRIER_KIND = "tracks"

KINDS: Mapping[str, Kind] = {
    "marine radar": Kind(
        "a ship's or coastal navigation radar, plots or ARPA targets",
        {
            "coverage.range_m": (44_448.0, "24 nautical miles, the longest scale of target tracking"),
            "misses.q": (0.1, "a radar shows nine of ten vessels within its range"),
            "clutter.per_km2": (0.01, "a few false echoes in the picture"),
            "resolution.range_m": (40.0, "IMO MSC.192(79): two targets 40 m apart in range are two"),
            "resolution.bearing_deg": (2.5, "IMO MSC.192(79): two targets 2.5° apart are two"),
            "resolution.split": (0.02, "one hull rarely gives two echoes"),
            "errors.range_m": (15.0, "IMO MSC.192(79) allows 30 m, taken as 2σ"),
            "errors.range_share": (0.005, "IMO MSC.192(79) allows 1 % of the scale, taken as 2σ"),
            "errors.bearing_deg": (0.5, "IMO MSC.192(79) allows 1°, taken as 2σ"),
            "errors.extent_m": (15.0, "the echo wanders over a hull of 50 m"),
            "errors.speed_m_per_s": (0.5, "ARPA after three minutes of tracking"),
            "errors.course_deg": (5.0, "ARPA after three minutes of tracking"),
            "timing.period_s": (3.0, "20 rotations a minute"),
            "timing.latency_s": (0.0, "time stamp of the measurement"),
            "timing.latency_sigma_s": (1.5, "within one rotation"),
            "bias.range_m": (50.0, "cable and trigger delay"),
            "bias.azimuth_deg": (1.0, "alignment of the antenna, compass"),
            "bias.time_s": (2.0, "displays and networks forward plots about one rotation late"),
            **_VESSEL,
        },
        correlation_s=60.0,  # a radar smooths its tracks over about a minute
    ),
    "air radar": Kind(
        "a surveillance radar for aircraft: primary, secondary or Mode S",
        {
            "coverage.range_m": (370_400.0, "200 nautical miles"),
            "misses.q": (0.05, "EUROCONTROL asks for a detection of 95 % and more"),
            "clutter.per_km2": (1e-5, "a few false plots a rotation"),
            "resolution.range_m": (200.0, "pulse length"),
            "resolution.bearing_deg": (2.0, "beam width"),
            "resolution.split": (0.02, "one aircraft rarely gives two plots"),
            "errors.range_m": (70.0, "secondary radar; primary 120 m, Mode S 50 m"),
            "errors.range_share": (0.0, "clock error, negligible"),
            "errors.bearing_deg": (0.06, "secondary radar, monopulse"),
            "errors.height_m": (60.0, "pressure height against height above the ellipsoid is biased besides"),
            "errors.speed_m_per_s": (5.0, "tracked"),
            "errors.course_deg": (3.0, "tracked"),
            "targets.height_m": (5000.0, "where no height is reported"),
            "targets.height_sigma_m": (3500.0, "where no height is reported"),
            "timing.period_s": (8.0, "terminal 4 s, en route 8 to 12 s"),
            "timing.latency_s": (0.0, "time stamp of the measurement"),
            "timing.latency_sigma_s": (0.1, "ASTERIX stamps 1/128 s; clocks differ"),
            "bias.range_m": (100.0, "transponder and cable delay"),
            "bias.azimuth_deg": (0.2, "alignment to north"),
            "bias.time_s": (0.5, "clocks and queues"),
            **AIRCRAFT_MOTION,
        },
        correlation_s=5.0,  # every rotation is a new measurement
    ),
    "ais": Kind(
        "vessels' self-reported positions (AIS)",
        {
            "misses.q": (0.2, "small craft carry no transponder, and time slots collide"),
            "clutter.per_km2": (0.0, "each transmission comes from a real target"),
            "errors.position_m": (15.0, "accuracy flag 0 in ITU-R M.1371: worse than 10 m"),
            "errors.extent_m": (10.0, "unknown antenna position on a hull of 35 m"),
            "timing.period_s": (10.0, "2 s to 3 min by speed and class"),
            "timing.latency_s": (0.0, "time stamp of the position fix"),
            "timing.latency_sigma_s": (1.0, "whole seconds; receivers add delay"),
            "motion.stationary_m_per_s": (0.1, "a vessel at anchor swings by some 20 m in three minutes"),
            "motion.stationary_share": (0.2, "more near a harbour, fewer at sea"),
            **_FIXED_ERRORS,
            **_VESSEL,
        },
        correlation_s=600.0,  # the antenna's place on the hull is constant, and a receiver's error drifts over minutes
        self_named=True,
        target="vessel",
    ),
    "ads-b": Kind(
        "aircraft's self-reported positions (ADS-B)",
        {
            "misses.q": (0.1, "some carry no transponder, and not all messages are received"),
            "clutter.per_km2": (0.0, "each transmission comes from a real target"),
            "errors.position_m": (76.0, "NACp 8: 95 % within 93 m, σ = 93 / 2.448 per axis, twice that for caution"),
            "errors.height_m": (60.0, "pressure height against height above the ellipsoid is biased besides"),
            "timing.period_s": (1.0, "two positions a second are sent"),
            "timing.latency_s": (0.2, "uncompensated latency"),
            "timing.latency_sigma_s": (0.2, "DO-260B: within 0.6 s"),
            "errors.speed_m_per_s": (1.5, "NACv 2: 95 % within 3 m/s"),
            "errors.course_deg": (1.0, "from the velocity"),
            **AIRCRAFT_MOTION,
        },
        correlation_s=600.0,  # a receiver's error drifts over minutes
        self_named=True,
        target="aircraft",
    ),
    "mlat": Kind(
        "aircraft located by the times of arrival at several receivers",
        {
            "misses.q": (0.3, "four receivers must hear one reply"),
            "clutter.per_km2": (1e-5, "wrong solutions"),
            "errors.position_m": (200.0, "amateur receivers; no covariance is sent"),
            "errors.height_m": (60.0, "pressure height"),
            "timing.period_s": (1.0, "usual"),
            "timing.latency_s": (2.0, "solving takes a while"),
            "timing.latency_sigma_s": (1.0, "usual"),
            "errors.speed_m_per_s": (10.0, "tracked"),
            "errors.course_deg": (5.0, "tracked"),
            **AIRCRAFT_MOTION,
        },
        correlation_s=30.0,  # the same receivers for a while
        self_named=True,
        target="aircraft",
    ),
    "wam": Kind(
        "aircraft located by the multilateration of a surveillance system, wide area or airport (ASTERIX 020)",
        {
            "misses.q": (0.2, "replies collide; four receivers must hear one"),
            "clutter.per_km2": (1e-5, "wrong solutions"),
            "errors.position_m": (50.0, "between airports, ED-117: 20 m, and ED-142: 150 m over wide areas"),
            "errors.height_m": (60.0, "pressure height"),
            "timing.period_s": (1.0, "usual"),
            "timing.latency_s": (0.0, "item 140: time stamp of the measurement"),
            "timing.latency_sigma_s": (0.1, "ASTERIX stamps 1/128 s; clocks differ"),
            "errors.speed_m_per_s": (5.0, "tracked"),
            "errors.course_deg": (3.0, "tracked"),
            "bias.time_s": (0.5, "clocks and queues"),
            **AIRCRAFT_MOTION,
        },
        correlation_s=30.0,  # the same receivers for a while
        self_named=True,
        target="aircraft",
    ),
    "drone": Kind(
        "drones' self-reported positions (Remote ID, MAVLink)",
        {
            "misses.q": (0.2, "a broadcast a second, not all received"),
            "clutter.per_km2": (0.0, "each transmission comes from a drone"),
            "errors.position_m": (5.0, "ASTM F3411: mostly better than 10 m in 95 %, with the wind in the antenna"),
            "errors.height_m": (15.0, "ASTM F3411: vertical accuracy mostly worse than 10 m"),
            "errors.speed_m_per_s": (0.5, "satellite receivers"),
            "errors.course_deg": (5.0, "whole degrees, of a vehicle that turns"),
            "timing.period_s": (1.0, "ASTM F3411: once a second at least"),
            "timing.latency_s": (0.0, "time stamp of the position"),
            "timing.latency_sigma_s": (0.5, "ASTM F3411: within a second"),
            **_DRONE,
        },
        correlation_s=600.0,  # a receiver's error drifts over minutes
        self_named=True,
        target="aircraft",
    ),
    "drone radar": Kind(
        "a radar against drones, some kilometres, with range, bearing and elevation",
        {
            "coverage.range_m": (5000.0, "small drones are lost there"),
            "misses.q": (0.2, "small drones that hover are taken for clutter"),
            "clutter.per_km2": (0.5, "birds, vehicles and trees"),
            "resolution.range_m": (5.0, "bandwidth of some 30 MHz"),
            "resolution.bearing_deg": (2.0, "beam width with monopulse"),
            "resolution.split": (0.02, "a small drone rarely gives two plots"),
            "errors.range_m": (3.0, "bandwidth of some 30 MHz"),
            "errors.range_share": (0.0, "clock error, negligible"),
            "errors.bearing_deg": (0.7, "data sheets of such radars: 0.5° to 1°"),
            "errors.height_m": (15.0, "where a height is reported"),
            "errors.speed_m_per_s": (1.0, "tracked"),
            "errors.course_deg": (10.0, "tracked"),
            "targets.height_m": (60.0, "where neither height nor elevation is reported"),
            "targets.height_sigma_m": (40.0, "drones fly below 120 m"),
            "timing.period_s": (0.5, "electronic scan, or 60 rotations a minute"),
            "timing.latency_s": (0.0, "time stamp of the measurement"),
            "timing.latency_sigma_s": (0.2, "clocks and queues"),
            "bias.range_m": (10.0, "cable and trigger delay"),
            "bias.azimuth_deg": (2.0, "set up in the field"),
            "bias.time_s": (0.5, "clocks and queues"),
            **_DRONE,
        },
        correlation_s=5.0,  # every scan is a new measurement
        target="aircraft",
    ),
    "lidar": Kind(
        "clusters of a scanning laser",
        {
            "coverage.range_m": (150.0, "returns of dark hulls end there"),
            "misses.q": (0.3, "waves, angle, dark hulls"),
            "clutter.per_km2": (20.0, "wakes and the shore"),
            "resolution.range_m": (2.0, "clusters nearer than this merge"),
            "resolution.bearing_deg": (1.0, "clusters nearer than this merge"),
            "resolution.split": (0.1, "bow and stern of a long hull are two clusters"),
            "errors.range_m": (0.5, "pose of the platform"),
            "errors.range_share": (0.0, "time of flight"),
            "errors.bearing_deg": (0.5, "pose of the platform"),
            "errors.extent_m": (2.0, "only the near side of a hull is seen"),
            "timing.period_s": (0.5, "usual"),
            "timing.latency_s": (0.0, "time stamp of the measurement"),
            "timing.latency_sigma_s": (0.05, "usual"),
            "bias.azimuth_deg": (1.0, "mounting"),
            **_VESSEL,
        },
        correlation_s=10.0,  # the same side of the hull for a while
    ),
    "camera": Kind(
        "directions of what an electro-optical or infrared camera sees",
        {
            "coverage.range_m": (1000.0, "detectors lose small boats there"),
            "misses.q": (0.4, "weather, light and detectors"),
            "clutter.per_deg": (0.01, "shores, buoys and waves"),
            "resolution.bearing_deg": (1.0, "boxes nearer than this merge"),
            "resolution.split": (0.1, "detectors draw boxes about parts of a long hull"),
            "errors.bearing_deg": (1.0, "pose of the platform"),
            "errors.extent_m": (3.0, "the box is centred on the visible part of the hull"),
            "timing.period_s": (0.2, "usual"),
            "timing.latency_s": (0.0, "time stamp of the measurement"),
            "timing.latency_sigma_s": (0.1, "exposure and transfer"),
            "bias.azimuth_deg": (1.0, "mounting"),
            **_VESSEL,
        },
        correlation_s=10.0,  # the same side of the hull for a while
        directions=True,
    ),
    "esm": Kind(
        "directions of emitters (ESM, DF)",
        {
            "coverage.range_m": (100_000.0, "the radio horizon and beyond"),
            "misses.q": (0.5, "many do not emit"),
            "clutter.per_deg": (0.001, "reflections: one in three scans all around"),
            "resolution.bearing_deg": (5.0, "usual"),
            "resolution.split": (0.02, "one emitter rarely gives two bearings"),
            "errors.bearing_deg": (3.0, "usual"),
            "timing.period_s": (5.0, "usual"),
            "timing.latency_s": (0.0, "time stamp of the measurement"),
            "timing.latency_sigma_s": (1.0, "usual"),
            "bias.azimuth_deg": (2.0, "mounting"),
            **_VESSEL,
        },
        correlation_s=10.0,
        directions=True,
    ),
    "tracks": Kind(
        "tracks of another system, which state their own covariances",
        {
            "misses.q": (0.1, "usual"),
            "clutter.per_km2": (0.0, "tracks are confirmed"),
            "errors.speed_m_per_s": (1.0, "where the track states none"),
            "errors.course_deg": (5.0, "where the track states none"),
            "bias.shift_m": (50.0, "the other system's own alignment"),
            "timing.latency_s": (0.0, "time stamp of the state"),
            "timing.latency_sigma_s": (0.0, "time stamp of the state"),
            **_VESSEL,
        },
        correlation_s=60.0,  # smoothed
    ),
    "other": Kind("a source without assumed properties", {}),
}
