"""The journal of identities and alarms (SQLite, one transaction per tick), the archive of objects (Parquet), the state.

Table ``identities`` has a row each time a track joins or leaves an object, ``objects`` the last attributes of every
object. Both have an object once it was confirmed or in an alarm: most tentative ones of radars are clutter. ``alarms``
has every alarm, who acknowledged it and when, ``offsets`` what an operator held, set and released.

SQLite runs in WAL mode: readers, and a restart after a kill, see complete ticks only. The state file is replaced
atomically. Rows not yet archived, at most ten minutes of them, are lost when the process is killed. Only one watch may
use a folder.

:class:`Store` is what a running watch writes through: a full disk does not end it.
"""

from __future__ import annotations

import logging
import os
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

import sameas
from sameas.errors import InputError, reading
from sameas.io.atomic import held, replacing
from sameas.io.saved import dumps, loads
from sameas.live.situation import Alarm, Situation
from sameas.picture.rows import Columns, gathered

T = TypeVar("T")
LOG = logging.getLogger("sameas.live")
_TABLES = """
CREATE TABLE IF NOT EXISTS objects (object INTEGER PRIMARY KEY, first_s REAL, last_s REAL, confirmed INTEGER,
    label TEXT, mmsi TEXT, icao TEXT, callsign TEXT, name TEXT, type TEXT);
CREATE TABLE IF NOT EXISTS identities (time_s REAL, object INTEGER, source TEXT, track TEXT, event TEXT,
    probability REAL);
CREATE INDEX IF NOT EXISTS identities_object ON identities (object, time_s);
CREATE TABLE IF NOT EXISTS alarms (id INTEGER PRIMARY KEY, key TEXT, kind TEXT, text TEXT, objects TEXT, first_s REAL,
    last_s REAL, active INTEGER, acknowledged_s REAL, acknowledged_by TEXT);
CREATE TABLE IF NOT EXISTS offsets (time_s REAL, source TEXT, event TEXT, bias TEXT, value REAL, unit TEXT, by TEXT);
CREATE INDEX IF NOT EXISTS alarms_active ON alarms (active, key);
"""
#: An archive file is written after this many rows of objects, or this many seconds.
ARCHIVE_ROWS, ARCHIVE_S = 200_000, 600.0
#: At most this many rows are kept in memory while the disk refuses them; the oldest are dropped first.
WAITING_ROWS = 4 * ARCHIVE_ROWS
#: Version of the layout of a saved state, raised with every change of it (``tests/live/test_keeper.py`` checks).
LAYOUT = 73
_TEXTS = ("label", "mmsi", "icao", "callsign", "name", "type")


class Journal:
    """The journal and the archive in a folder, which is created with access for its owner only.

    Raises InputError: the folder cannot be made or written; another run writes there; the journal is another program's.
    """

    def __init__(self, folder: Path, *, archive_every_s: float = 10.0) -> None:
        self.folder, self.archive_every_s = folder, archive_every_s
        with ExitStack() as opened:
            try:
                folder.mkdir(parents=True, exist_ok=True, mode=0o700)
                self._lock = held(folder)
                opened.callback(self._lock.close)
                self._base = sqlite3.connect(folder / "journal.sqlite", isolation_level=None, check_same_thread=False)
                opened.callback(self._base.close)
                self._base.execute("PRAGMA journal_mode=WAL")
                self._base.execute("PRAGMA synchronous=NORMAL")
                self._base.executescript(_TABLES)
                self._tracks = self._joined()
                self._active: dict[str, int] = dict(
                    self._base.execute("SELECT key, id FROM alarms WHERE active = 1").fetchall()
                )
            except (sqlite3.Error, UnicodeDecodeError, OSError) as error:
                raise _refused(folder, error) from None
            opened.pop_all()
        self._known: dict[int, tuple[Any, ...]] = {}
        #: Since when an object is in the picture that is not in the journal yet.
        self._since_s: dict[int, float] = {}
        self._archive: list[Columns] = []
        self._archived_s = -np.inf

    def _joined(self) -> dict[tuple[str, str], int]:
        """The object of every track, from the last 200 000 rows of ``identities``."""
        tracks: dict[tuple[str, str], int] = {}
        for source, track, number, event in self._base.execute(
            "SELECT source, track, object, event FROM identities WHERE rowid > "
            "(SELECT COALESCE(MAX(rowid), 0) - 200000 FROM identities) ORDER BY rowid"
        ):
            if event == "joined":
                tracks[source, track] = number
            else:
                tracks.pop((source, track), None)
        return tracks

    def write(self, situation: Situation) -> None:
        """Writes one tick in one transaction.

        Raises
        ------
        sqlite3.Error, OSError, InputError : the disk refuses it; the next tick then writes what is missing.
        """
        tracks = self._tracks
        self._base.execute("BEGIN IMMEDIATE")
        try:
            self._write_objects(situation)
            self._write_identities(situation)
            self._base.execute("COMMIT")
        except BaseException:
            # The next tick writes what this one could not.
            self._tracks, self._known = tracks, {}
            if self._base.in_transaction:
                self._base.execute("ROLLBACK")
            raise
        due = self.archive_every_s > 0.0 and situation.time_s - self._archived_s >= self.archive_every_s
        if due and len(situation.objects["object"]):
            self._archived_s = situation.time_s
            self._archive.append(situation.objects)
            waiting = sum(len(part["object"]) for part in self._archive)
            while waiting > WAITING_ROWS and len(self._archive) > 1:
                waiting -= len(self._archive.pop(0)["object"])
            if waiting >= ARCHIVE_ROWS or situation.time_s - float(self._archive[0]["time_s"][0]) >= ARCHIVE_S:
                self.flush()

    def _write_objects(self, situation: Situation) -> None:
        o, rows = situation.objects, []
        stages = o["stage"].tolist()
        attributes = list(zip(*(o[name].tolist() for name in _TEXTS), strict=True)) if len(stages) else []
        alarmed = {number for alarm in situation.alarms for number in alarm.objects}
        waiting, self._since_s = self._since_s, {}
        for number, stage, texts in zip(o["object"].tolist(), stages, attributes, strict=True):
            known, since_s = self._known.get(number), waiting.get(number, situation.time_s)
            confirmed = int(stage in ("confirmed", "coasting")) or (known[0] if known else 0)
            if not (known or confirmed or number in alarmed):
                if stage != "ended":
                    self._since_s[number] = since_s
                continue
            # Unchanged objects get a new last_s once a minute.
            current = (confirmed, texts, int(situation.time_s // 60.0))
            if known != current:
                rows.append((number, since_s, situation.time_s, confirmed, *texts))
                self._known[number] = current
            if stage == "ended":
                self._known.pop(number, None)
        self._base.executemany(
            "INSERT INTO objects VALUES (?,?,?,?,?,?,?,?,?,?) ON CONFLICT (object) DO UPDATE SET "
            "last_s=excluded.last_s, confirmed=MAX(confirmed, excluded.confirmed), label=excluded.label, "
            "mmsi=excluded.mmsi, icao=excluded.icao, callsign=excluded.callsign, name=excluded.name, "
            "type=excluded.type",
            rows,
        )

    def _write_identities(self, situation: Situation) -> None:
        tracks = {
            (source, track): number for number, members in situation.members.items() for source, track in members
            if number in self._known and not track.startswith("plot ")
        }  # fmt: skip
        probabilities = np.ma.filled(situation.objects["probability"], np.nan).tolist()
        p_object = dict(zip(situation.objects["object"].tolist(), probabilities, strict=True))
        rows: list[tuple[Any, ...]] = []
        for (source, track), number in tracks.items():
            before = self._tracks.get((source, track))
            if before != number:
                if before is not None:
                    rows.append((situation.time_s, before, source, track, "left", None))
                p = p_object.get(number, np.nan)
                rows.append((situation.time_s, number, source, track, "joined", None if p != p else p))
        for key, number in self._tracks.items():
            if key not in tracks:
                rows.append((situation.time_s, number, *key, "left", None))
        self._tracks = tracks
        self._base.executemany("INSERT INTO identities VALUES (?,?,?,?,?,?)", rows)

    def flush(self) -> Path | None:
        """Writes the rows that wait for the archive to a Parquet file, and returns its path; None if there are none."""
        if not self._archive:
            return None
        import pyarrow as pa
        from pyarrow import parquet

        columns = gathered(self._archive)
        (self.folder / "archive").mkdir(exist_ok=True)
        stamp = datetime.fromtimestamp(float(columns["time_s"][0]), UTC).strftime("%Y%m%dT%H%M%S")
        path = self.folder / "archive" / f"objects-{stamp}.parquet"
        with replacing(path) as draft:
            arrays = {n: pa.array(np.ma.getdata(c), mask=np.ma.getmaskarray(c)) for n, c in columns.items()}
            parquet.write_table(pa.table(arrays), draft)
        self._archive = []
        return path

    # ---- alarms ----

    def alarm(self, alarm: Alarm, time_s: float) -> int:
        """Inserts a new alarm and returns its id."""
        cursor = self._base.execute(
            "INSERT INTO alarms (key, kind, text, objects, first_s, last_s, active) VALUES (?,?,?,?,?,?,1)",
            (alarm.key, alarm.kind, alarm.text, " ".join(map(str, alarm.objects)), time_s, time_s),
        )
        return int(cursor.lastrowid or 0)

    def ended(self, alarm_id: int, time_s: float) -> None:
        """Marks the alarm as no longer active."""
        self._base.execute("UPDATE alarms SET active = 0, last_s = ? WHERE id = ?", (time_s, alarm_id))

    def acknowledge(self, alarm_id: int, who: str, time_s: float) -> bool:
        """Records who acknowledged an alarm; False where the id is unknown or was acknowledged before."""
        cursor = self._base.execute(
            "UPDATE alarms SET acknowledged_s = ?, acknowledged_by = ? WHERE id = ? AND acknowledged_s IS NULL",
            (time_s, who[:80], alarm_id),
        )
        return cursor.rowcount > 0

    def alarms(self, *, most_ended: int = 500) -> list[dict[str, Any]]:
        """All active alarms and the last ``most_ended`` others, the newest first."""
        cursor = self._base.execute(
            "SELECT id, key, kind, text, objects, first_s, last_s, active, acknowledged_s, acknowledged_by FROM alarms "
            "WHERE active = 1 OR id IN (SELECT id FROM alarms WHERE active = 0 ORDER BY id DESC LIMIT ?) "
            "ORDER BY id DESC", (most_ended,),
        )  # fmt: skip
        names = [column[0] for column in cursor.description]
        out = [dict(zip(names, row, strict=True)) for row in cursor]
        return [one | {"objects": [int(n) for n in one["objects"].split()]} for one in out]

    def active(self) -> dict[str, int]:
        """Ids, by key, of the alarms that were active when the journal was last closed."""
        return self._active

    # ---- offsets that an operator holds or sets ----

    def offset(
        self, source: str, event: str, who: str, time_s: float, set_: tuple[str, float, str] | None = None
    ) -> None:
        """Records that the offsets of a source were "held", "released", or one "set": its name, value and unit."""
        row = (time_s, source, event, *(set_ or (None, None, None)), who[:80])
        self._base.execute("INSERT INTO offsets VALUES (?,?,?,?,?,?,?)", row)

    def offsets(self) -> dict[str, dict[str, float]]:
        """By source whose offsets are held, those that were set since they were last released."""
        held: dict[str, dict[str, float]] = {}
        for source, event, bias, value in self._base.execute(
            "SELECT source, event, bias, value FROM offsets ORDER BY rowid"
        ):
            if event == "released":
                held.pop(source, None)
            else:
                held.setdefault(source, {}).update({} if bias is None else {bias: value})
        return held

    def close(self) -> None:
        """Writes the waiting rows, and closes the files even when this fails."""
        try:
            self.flush()
        finally:
            self._base.close()
            self._lock.close()


class Store:
    """The folder of a watch. A write that the disk refuses does not end the watch: it is tried again when due.

    folder : None: nothing is written. archive_every_s : as of :class:`Journal`.

    journal : None without a folder, and once it is closed.
    """

    def __init__(self, folder: Path | None, *, archive_every_s: float = 10.0) -> None:
        self.folder = folder
        self.journal = None if folder is None else Journal(folder, archive_every_s=archive_every_s)
        # Why the journal or the state could not be written when last tried, and all reasons so far.
        self._refusals: dict[str, str] = {}
        self._said: set[str] = set()

    @property
    def refusal(self) -> str:
        """Why something could not be written when last tried; empty if all was."""
        return "; ".join(dict.fromkeys(self._refusals.values()))

    def attempt(self, write: Callable[[Journal], T], what: str = "journal") -> T | None:
        """The result of a write into the folder; None where there is no folder or the disk refuses.

        what : is written or read. Its refusal is logged once, and holds until the same succeeds: alarms can be listed
            while the disk is full.
        """
        if self.journal is None:
            return None
        try:
            value = write(self.journal)
        except (OSError, sqlite3.Error, InputError) as error:
            # The disk's own words, not those of a command that ends.
            reason = str(error if error.__cause__ is None else getattr(error.__cause__, "strerror", None) or error)
            # A full disk takes a small write now and then.
            if reason not in self._said:
                LOG.warning("%s: %s", self.folder, reason)
                self._said.add(reason)
            self._refusals[what] = reason
            return None
        self._refusals.pop(what, None)
        return value

    def close(self) -> None:
        """Closes the journal.

        Raises InputError: the disk refused the journal or the last state; what was saved before stays.
        """
        refusal = self.refusal
        self.attempt(Journal.close)
        self.journal = None
        if refusal or self.refusal:
            raise InputError(
                f"{self.folder}: the last state of the watch is not saved: {refusal or self.refusal}",
                "make room, or give a folder that can be written",
            )


def _refused(folder: Path, error: Exception) -> InputError:
    """The refusal of a folder whose journal cannot be opened."""
    unreadable = isinstance(error, UnicodeDecodeError | sqlite3.DatabaseError)
    if unreadable and not (isinstance(error, sqlite3.OperationalError) and "malformed" not in str(error)):
        return InputError(f"{folder}: its journal is damaged ({error})", "move it away to begin anew")
    return InputError(f"{folder}: cannot hold the journal ({error})", "give a folder that can be written")


def save_state(folder: Path, state: Mapping[str, Any]) -> None:
    """Saves the state atomically; the previous one stays where this fails."""
    with replacing(folder / "state.pickle") as draft:
        draft.write_bytes(dumps({"version": sameas.__version__, "layout": LAYOUT, **state}))
        os.chmod(draft, 0o600)


def load_state(folder: Path) -> dict[str, Any] | None:
    """The saved state; None where there is none.

    Raises InputError: the file is damaged, was saved by another version of sameas, or belongs to another user. There is
    no fresh start instead: the journal next to it refers to the object numbers of this state.
    """
    path = folder / "state.pickle"
    if not path.exists():
        return None
    if hasattr(os, "getuid") and path.stat().st_uid not in (os.getuid(), 0):
        raise InputError(f"{path}: belongs to another user", "give a folder of your own")
    state: Any = loads(path.read_bytes(), str(path))
    with reading(str(path), "is damaged"):
        kept: dict[str, Any] = dict(state)
        version, layout = str(kept["version"]), kept.get("layout", 1)
    if (version, layout) != (sameas.__version__, LAYOUT):
        whose = "an earlier build of this version" if version == sameas.__version__ else f"version {version}"
        raise InputError(
            f"{path}: was saved by {whose} of sameas, whose states this one ({sameas.__version__}) does not read",
            "move its folder away to begin anew, or go on with the version that saved it",
        )
    return kept
