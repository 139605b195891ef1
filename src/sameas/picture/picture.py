"""A picture over time: the moments of a whole span, as tables and a summary.

    scene = Scene.of([(radar_description, radar), (ais_description, ais)])
    picture = Picture.of(scene, instants(scene.span_s, every_s=10.0))
    picture.objects["object"], picture.records["object"], picture.summary

``scene.registered()`` takes the sensors' offsets away first. For live use see :mod:`sameas.picture.moment`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from sameas.errors import InputError
from sameas.picture.columns import Columns, gathered, joined, object_columns, record_columns, with_degrees
from sameas.picture.lookout import Lookout, nameless
from sameas.picture.moment import Moment, Watch
from sameas.picture.summary import Summary, Tally
from sameas.records import FloatArray
from sameas.tracks.coordinates import LocalPlane
from sameas.tracks.scene import POSITION, Scene

#: More instants than this are refused: a slip of the unit, most likely.
MOST = 1_000_000
#: A rival less probable than this is not worth a new explanation.
LIKELY = 1e-3


def instants(span_s: tuple[float, float], every_s: float) -> FloatArray:
    """(k,) every so many seconds within a span, whole multiples of ``every_s``; its end where there are none.

    Example
    -------
    >>> instants((3.0, 31.0), 10.0).tolist()
    [10.0, 20.0, 30.0]
    >>> instants((3.0, 5.0), 10.0).tolist()
    [5.0]
    """
    first, last = span_s
    if not (math.isfinite(first) and math.isfinite(last) and first <= last):
        raise InputError(f"instants: span is {first} to {last}; give the first and the last time in seconds")
    if not 0.0 < every_s < math.inf:
        raise InputError(f"instants: every_s is {every_s}; give seconds above 0")
    low, high = math.ceil(first / every_s), math.floor(last / every_s)
    if high - low >= MOST:
        raise InputError(f"instants: {high - low + 1} instants from {first:g} to {last:g} s; give a longer every_s")
    return every_s * np.arange(low, high + 1, dtype=np.float64) if high >= low else np.array([last])


def watch_of(scene: Scene) -> Watch | Lookout:
    """What a picture of a scene begins with: a :class:`Lookout` where no source names what it shows."""
    return Lookout() if nameless(scene) else Watch()


def moments(
    scene: Scene, instants_s: Iterable[float], watch: Watch | Lookout | None = None, *, features: int = POSITION
) -> Iterator[Moment]:
    """The moments of a scene one after another; ``watch``: what to begin with.

    features : as of ``Scene.at``; a :class:`Lookout` follows velocities in any case.
    """
    carried = watch_of(scene) if watch is None else watch
    for instant_s in map(float, instants_s):
        if isinstance(carried, Lookout):
            moment = carried.at(scene, instant_s)
        else:
            moment = carried.advance(scene.at(instant_s, features=features))
        carried = moment.watch
        yield moment


@dataclass(frozen=True)
class Picture:
    """A picture over time. Make it with :meth:`Picture.of`.

    Attributes
    ----------
    instants_s : (k,) its instants.
    objects : columns, one row per object and instant; records : one row per record that took part and instant. See
        :mod:`sameas.picture.columns`.
    summary : what there is to know of the whole.
    texts : why, by place in ``instants_s`` and number of the object: where its records or their rivals changed.
    plane : of x_m and y_m; None for the user's own.
    watch : what it would carry on.
    """

    instants_s: FloatArray
    objects: Columns = field(repr=False)
    records: Columns = field(repr=False)
    summary: Summary
    texts: Mapping[tuple[int, int], str] = field(repr=False)
    plane: LocalPlane | None
    watch: Watch | Lookout = field(repr=False)

    @classmethod
    def of(
        cls,
        scene: Scene,
        instants_s: Sequence[float] | FloatArray,
        *,
        watch: Watch | Lookout | None = None,
        features: int = POSITION,
        biases: Sequence[str] = (),
        progress: Callable[[str], object] | None = None,
    ) -> Picture:
        """The picture of a scene at some instants.

        Parameters
        ----------
        instants_s : ascending; see :func:`instants`.
        watch : what counts as evidence, what is remembered, when objects are confirmed; or where an earlier picture
            ended. Without it scenes in which no source names anything are followed by a :class:`Lookout`.
        features : POSITION, or POSITION_AND_VELOCITY, which a :class:`Lookout` follows in any case.
        biases : printable lines on the sensors' offsets, for the summary.
        progress : called with what is being done, at every instant.

        Raises
        ------
        InputError : no instants, or not ascending; a source lacks what its evidence needs.

        Example
        -------
        >>> from sameas.tracks.reports import Reports
        >>> from sameas.tracks.source import Description, ErrorModel
        >>> said = {"time_s": [0.0, 10.0], "x_m": [0.0, 50.0], "y_m": [0.0, 0.0], "track_id": ["7", "7"]}
        >>> radar = Reports.of("radar", "table", said)
        >>> said = {"time_s": [0.0, 10.0], "x_m": [3.0, 54.0], "y_m": [1.0, 2.0], "mmsi": ["235000001"] * 2}
        >>> ais = Reports.of("ais", "ais", said)
        >>> tracker = Description("radar", "tracks", errors=ErrorModel(position_m=5.0))
        >>> picture = Picture.of(Scene.of([(tracker, radar), (Description("ais", "ais"), ais)]), [0.0, 10.0])
        >>> print(picture.objects["object"], picture.objects["members"], picture.objects["label"])
        [1 1] ['radar:0 ais:0' 'radar:1 ais:1'] ['235000001' '235000001']
        """
        times = np.asarray(instants_s, dtype=np.float64)
        if times.ndim != 1 or not len(times) or not np.isfinite(times).all() or np.any(np.diff(times) <= 0):
            raise InputError("picture: give one instant or more, in seconds, each later than the one before")
        objects, records, tallies = [], [], []
        texts: dict[tuple[int, int], str] = {}
        shown: dict[int, tuple[str, str]] = {}
        moment = None
        for k, moment in enumerate(moments(scene, times, watch, features=features)):
            if progress is not None:
                progress(f"instant {k + 1} of {len(times)}")
            objects.append(object_columns(moment))
            records.append(record_columns(moment))
            tallies.append(Tally.of(moment))
            texts |= {(k, number): str(moment.explain(number)) for number in _changed(moment, shown)}
        assert moment is not None
        table = with_degrees(gathered(objects), scene.plane)
        return cls(
            times, table, with_degrees(gathered(records), scene.plane), Summary.of(scene, table, tallies, biases),
            texts, scene.plane, moment.watch,
        )  # fmt: skip


def _changed(moment: Moment, shown: dict[int, tuple[str, str]]) -> list[int]:
    """Objects of two records or with a likely rival, whose tracks, or the rival's, are not what was explained last.

    A plot without a track is another at every look.
    """
    roll = moment.roll
    names = [description.name for description in roll.now.descriptions]
    columns = zip(roll.source.tolist(), roll.track.tolist(), roll.row.tolist(), strict=True)
    words = [f"{names[s]}:{track or row}" for s, track, row in columns]
    several, out = (moment.members >= 0).sum(axis=1) > 1, []
    rivals = np.where(moment.p_runner_up[:, None] > LIKELY, moment.runner_up, -1)
    both = joined(moment.members, words).tolist(), joined(rivals, words).tolist()
    for number, members, rival, told in zip(moment.number.tolist(), *both, several.tolist(), strict=True):
        if (told or rival) and shown.get(number) != (members, rival):
            shown[number] = members, rival
            out.append(number)
    return out
