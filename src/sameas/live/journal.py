"""The journal: who was who and when, in SQLite, one transaction a tick; the archive of objects, in Parquet; the state.

``identities`` has a line when a track joins an object or leaves it, ``objects`` what is known of every object,
``alarms`` every alarm with who acknowledged it when. SQLite writes ahead (WAL): readers see whole ticks, and a program
that is killed leaves whole ticks. The state is saved beside it and replaces the one before only when it is whole. What
waits for the archive, ten minutes at most, is lost with a process that is killed. A folder is one watch's alone.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

import sameas
from sameas.errors import InputError, reading
from sameas.io.atomic import held, replacing
from sameas.live.frame import Alarm, Frame
from sameas.picture.picture import Columns, gathered
from sameas.saved import dumps, loads

_TABLES = """
CREATE TABLE IF NOT EXISTS objects (object INTEGER PRIMARY KEY, first_s REAL, last_s REAL, confirmed INTEGER,
    label TEXT, mmsi TEXT, icao TEXT, callsign TEXT, name TEXT, type TEXT);
CREATE TABLE IF NOT EXISTS identities (time_s REAL, object INTEGER, source TEXT, track TEXT, event TEXT,
    probability REAL);
CREATE INDEX IF NOT EXISTS identities_object ON identities (object, time_s);
CREATE TABLE IF NOT EXISTS alarms (id INTEGER PRIMARY KEY, key TEXT, kind TEXT, text TEXT, objects TEXT, first_s REAL,
    last_s REAL, active INTEGER, acknowledged_s REAL, acknowledged_by TEXT);
CREATE INDEX IF NOT EXISTS alarms_active ON alarms (active, key);
"""
#: A file of the archive is written at so many rows of objects, or after so many seconds.
ARCHIVE_ROWS, ARCHIVE_S = 200_000, 600.0
#: Where the disk refuses them, so many rows wait in memory; the oldest go first.
WAITING_ROWS = 4 * ARCHIVE_ROWS
#: Number of what a state holds; raised with every change of it (``tests/live/test_keeper.py`` notices).
LAYOUT = 4
_TEXTS = ("label", "mmsi", "icao", "callsign", "name", "type")


class Journal:
    """The journal and the archive in a folder, which is made for its owner alone.

    Raises
    ------
    InputError : the folder cannot be made or written; another run writes there; the journal is another program's.
    """

    def __init__(self, folder: Path, *, archive_every_s: float = 10.0) -> None:
        self.folder, self.archive_every_s = folder, archive_every_s
        try:
            folder.mkdir(parents=True, exist_ok=True, mode=0o700)
            self._lock = held(folder)
            self._base = sqlite3.connect(folder / "journal.sqlite", isolation_level=None, check_same_thread=False)
            self._base.execute("PRAGMA journal_mode=WAL")
            self._base.execute("PRAGMA synchronous=NORMAL")
            self._base.executescript(_TABLES)
            self._tracks = self._joined()
            self._active: dict[str, int] = dict(
                self._base.execute("SELECT key, id FROM alarms WHERE active = 1").fetchall()
            )
        except sqlite3.DatabaseError as error:
            if isinstance(error, sqlite3.OperationalError) and "malformed" not in str(error):
                raise InputError(
                    f"{folder}: cannot hold the journal ({error})", "give a folder that can be written"
                ) from None
            raise InputError(f"{folder}: its journal is damaged ({error})", "move it away to begin anew") from None
        except UnicodeDecodeError as error:
            raise InputError(f"{folder}: its journal is damaged ({error})", "move it away to begin anew") from None
        except OSError as error:
            raise InputError(
                f"{folder}: cannot hold the journal ({error})", "give a folder that can be written"
            ) from None
        self._known: dict[int, tuple[Any, ...]] = {}
        self._archive: list[Columns] = []
        self._archived_s = -np.inf

    def _joined(self) -> dict[tuple[str, str], int]:
        """Which object every track is of, by the last lines."""
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

    def write(self, frame: Frame) -> None:
        """One tick, in one transaction.

        Raises
        ------
        sqlite3.Error, OSError, InputError : the disk refuses it; the next tick then writes what is missing.
        """
        tracks = self._tracks
        self._base.execute("BEGIN IMMEDIATE")
        try:
            self._write_objects(frame)
            self._write_identities(frame)
            self._base.execute("COMMIT")
        except BaseException:
            # What did not come into the journal is written with the next tick that does.
            self._tracks, self._known = tracks, {}
            if self._base.in_transaction:
                self._base.execute("ROLLBACK")
            raise
        due = self.archive_every_s > 0.0 and frame.time_s - self._archived_s >= self.archive_every_s
        if due and len(frame.objects["object"]):
            self._archived_s = frame.time_s
            self._archive.append(frame.objects)
            waiting = sum(len(part["object"]) for part in self._archive)
            while waiting > WAITING_ROWS and len(self._archive) > 1:
                waiting -= len(self._archive.pop(0)["object"])
            if waiting >= ARCHIVE_ROWS or frame.time_s - float(self._archive[0]["time_s"][0]) >= ARCHIVE_S:
                self.flush()

    def _write_objects(self, frame: Frame) -> None:
        o, rows = frame.objects, []
        stages = o["stage"].tolist()
        texts = list(zip(*(o[name].tolist() for name in _TEXTS), strict=True)) if len(stages) else []
        for number, stage, words in zip(o["object"].tolist(), stages, texts, strict=True):
            known = self._known.get(number)
            confirmed = int(stage in ("confirmed", "coasting")) or (known[0] if known else 0)
            # Of what does not change only every minute that it is still there.
            now = (confirmed, words, int(frame.time_s // 60.0))
            if known != now:
                rows.append((number, frame.time_s, frame.time_s, confirmed, *words))
                self._known[number] = now
            if stage == "ended":
                self._known.pop(number, None)
        self._base.executemany(
            "INSERT INTO objects VALUES (?,?,?,?,?,?,?,?,?,?) ON CONFLICT (object) DO UPDATE SET "
            "last_s=excluded.last_s, confirmed=MAX(confirmed, excluded.confirmed), label=excluded.label, "
            "mmsi=excluded.mmsi, icao=excluded.icao, callsign=excluded.callsign, name=excluded.name, "
            "type=excluded.type",
            rows,
        )

    def _write_identities(self, frame: Frame) -> None:
        tracks = {
            (source, track): number for number, its in frame.members.items() for source, track in its
            if not track.startswith("plot ")
        }  # fmt: skip
        chances = np.ma.filled(frame.objects["probability"], np.nan).tolist()
        p = dict(zip(frame.objects["object"].tolist(), chances, strict=True))
        rows: list[tuple[Any, ...]] = []
        for (source, track), number in tracks.items():
            before = self._tracks.get((source, track))
            if before != number:
                if before is not None:
                    rows.append((frame.time_s, before, source, track, "left", None))
                chance = p.get(number, np.nan)
                rows.append((frame.time_s, number, source, track, "joined", None if chance != chance else chance))
        for key, number in self._tracks.items():
            if key not in tracks:
                rows.append((frame.time_s, number, *key, "left", None))
        self._tracks = tracks
        self._base.executemany("INSERT INTO identities VALUES (?,?,?,?,?,?)", rows)

    def flush(self) -> Path | None:
        """Writes what waits for the archive as a Parquet file; its path, None where nothing waits."""
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
        """A new alarm; its id."""
        cursor = self._base.execute(
            "INSERT INTO alarms (key, kind, text, objects, first_s, last_s, active) VALUES (?,?,?,?,?,?,1)",
            (alarm.key, alarm.kind, alarm.text, " ".join(map(str, alarm.objects)), time_s, time_s),
        )
        return int(cursor.lastrowid or 0)

    def ended(self, alarm_id: int, time_s: float) -> None:
        """The alarm does not hold any more."""
        self._base.execute("UPDATE alarms SET active = 0, last_s = ? WHERE id = ?", (time_s, alarm_id))

    def acknowledge(self, alarm_id: int, who: str, time_s: float) -> bool:
        """Notes who acknowledged an alarm; False where there is none of that id that was not acknowledged yet."""
        cursor = self._base.execute(
            "UPDATE alarms SET acknowledged_s = ?, acknowledged_by = ? WHERE id = ? AND acknowledged_s IS NULL",
            (time_s, who[:80], alarm_id),
        )
        return cursor.rowcount > 0

    def alarms(self, *, most: int = 500) -> list[dict[str, Any]]:
        """The last alarms, the newest first."""
        cursor = self._base.execute(
            "SELECT id, key, kind, text, objects, first_s, last_s, active, acknowledged_s, acknowledged_by FROM alarms "
            "ORDER BY id DESC LIMIT ?", (most,),
        )  # fmt: skip
        names = [column[0] for column in cursor.description]
        out = [dict(zip(names, row, strict=True)) for row in cursor]
        return [one | {"objects": [int(n) for n in one["objects"].split()]} for one in out]

    def active(self) -> dict[str, int]:
        """By key the ids of the alarms that held when the journal was closed."""
        return self._active

    def close(self) -> None:
        """Writes what waits and closes the files, in any case."""
        try:
            self.flush()
        finally:
            self._base.close()
            self._lock.close()


def save_state(folder: Path, state: Mapping[str, Any]) -> None:
    """Saves the state: whole, or the one before stays."""
    with replacing(folder / "state.pickle") as draft:
        draft.write_bytes(dumps({"version": sameas.__version__, "layout": LAYOUT, **state}))
        os.chmod(draft, 0o600)


def load_state(folder: Path) -> dict[str, Any] | None:
    """The saved state; None where there is none.

    Raises
    ------
    InputError : the file is damaged, another version of sameas saved it, or its owner is another user. The numbers of
        its objects are in the journal beside it, so that nothing begins anew there by itself.
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
