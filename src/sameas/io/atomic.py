"""Atomic outputs: a file appears under its name only when it is complete.

For any writer that takes a path: tables, images, text. An earlier file of that name stays until then. The draft of a
killed process (.sameas-…) is removed by the next output into the same folder.
"""

from __future__ import annotations

import errno
import hashlib
import os
import platform
import re
import secrets
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sameas.errors import InputError

if TYPE_CHECKING:
    import sqlite3

_NO_ROOM = {
    errno.ENOSPC: "no space left on device",
    errno.EDQUOT: "the disk quota is used up",
    errno.EFBIG: "the file is too large for this file system",
    errno.EIO: "the device reports an input/output error",
    errno.EROFS: "the file system is read-only",
}


_DRAFT = re.compile(r"\.sameas-([0-9a-f]{8})-(\d+)-[0-9a-f]{12}")
#: Drafts of this process that are not complete, and outputs that it has completed.
_drafts: set[Path] = set()
written: list[Path] = []


@contextmanager
def replacing(path: str | os.PathLike[str], *, overwrite: bool = True) -> Iterator[Path]:
    """A temporary file that replaces ``path`` when the block succeeds, and is deleted when it fails.

    path : the output; links are followed. The temporary file is in the same folder, with the same extension and the
        permissions of the replaced file, or those of the umask.
    overwrite : False refuses a path that exists.

    Raises InputError: no such directory, no permission, a directory, an existing path, a full device. Other exceptions
    of the block, KeyboardInterrupt included, pass through.

    >>> with replacing("note.txt") as draft:  # doctest: +SKIP
    ...     draft.write_text("whole")
    """
    given = Path(path)
    if given.exists() and not (given.is_file() or given.is_dir()):
        with _copied_into(given) as draft:
            yield draft
        return
    target = Path(os.path.realpath(given))
    _check_target(given, target, overwrite)
    draft = _draft_of(target)
    _drafts.add(draft)
    try:
        with _clear_errors(given):
            # Not tempfile.mkstemp: its files are readable by their owner only, whatever the umask says.
            os.close(os.open(draft, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o666))
            yield draft
            if target.exists():
                shutil.copymode(target, draft)
            os.replace(draft, target)
            # A file within a draft folder is not complete yet.
            if not _drafts.intersection(target.parents):
                written.append(given)
    except BaseException:
        with suppress(OSError):
            draft.unlink()
        _drafts.discard(draft)  # not in a finally: if a signal comes first, ``discard_drafts`` still removes it
        raise
    _drafts.discard(draft)


@contextmanager
def filling(folder: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder whose files all move into ``folder`` when the block succeeds, and are deleted when it fails.

    Other files in the folder stay. The files are moved in the order in which they were written. A folder that was
    created for this is removed on failure.

    Raises InputError: the folder cannot be made or written, a full device. Other exceptions of the block,
    KeyboardInterrupt included, pass through.

    >>> with filling("report") as draft:  # doctest: +SKIP
    ...     (draft / "note.txt").write_text("all or none")
    """
    target = Path(folder)
    created = not target.exists()
    draft = target / _draft_name()
    real_draft = Path(os.path.realpath(draft))
    _drafts.add(real_draft)
    try:
        try:
            target.mkdir(parents=True, exist_ok=True)
            _remove_abandoned(target)
            draft.mkdir(mode=0o700)
        except OSError as error:
            raise InputError(
                f"cannot write into {folder}: {str(error.strerror).lower()}; give another folder"
            ) from error
        with _clear_errors(target):
            yield draft
            with together() as arm:
                arm()
                for file in sorted(draft.iterdir(), key=lambda file: (file.stat().st_mtime_ns, file.name)):
                    os.replace(file, target / file.name)
                written.append(target)
        created = False
    finally:
        shutil.rmtree(draft, ignore_errors=True)
        _drafts.discard(real_draft)
        if created:
            with suppress(OSError):
                target.rmdir()


#: Held while the files of one output are moved; the code that ends the process waits for it.
placing = threading.RLock()


@contextmanager
def together() -> Iterator[Callable[[], None]]:
    """A function that defers SIGINT and SIGTERM to the end of the block, so that several files are moved as one output.

    It has an effect in the main thread only, which alone receives signals.
    """
    deferred: list[int] = []
    handlers: dict[int, Any] = {}
    lock = ExitStack()

    def arm() -> None:
        if threading.current_thread() is threading.main_thread():
            lock.enter_context(placing)
            for number in (signal.SIGINT, signal.SIGTERM):
                if signal.getsignal(number) is not None:  # None: installed by code that is not Python
                    handlers[number] = signal.signal(number, lambda number, frame: deferred.append(number))

    try:
        yield arm
    finally:
        lock.close()
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number in deferred[:1]:
            signal.raise_signal(number)


@contextmanager
def _copied_into(device: Path) -> Iterator[Path]:
    """For a device or a pipe (/dev/stdout), which cannot be replaced: a temporary file, copied into it at the end.

    Libraries do not get the name of the device: some delete a file they failed to write, and root may delete a device.
    """
    with tempfile.TemporaryDirectory(prefix="sameas-") as directory, _clear_errors(device):
        draft = Path(directory) / device.name
        yield draft
        with draft.open("rb") as whole, device.open("wb") as out:
            shutil.copyfileobj(whole, out)


def _check_target(given: Path, target: Path, overwrite: bool) -> None:
    if target.is_dir():
        raise InputError(f"cannot write {given}: it is a directory; give a file name")
    if not target.parent.is_dir():
        raise InputError(f"cannot write {given}: the directory {target.parent} does not exist; make it first")
    if not overwrite and target.exists():
        raise InputError(f"cannot write {given}: it exists already; give another name or allow overwriting")


def _draft_of(target: Path) -> Path:
    _remove_abandoned(target.parent)
    return target.with_name(_draft_name() + "".join(target.suffixes[-2:]))


class FolderHeld(InputError):
    """A folder that another process has locked."""


def held(folder: Path) -> sqlite3.Connection:
    """Locks a folder for this process, until the returned connection is closed or the process ends.

    SQLite uses the file locks of the operating system; only ``lock.sqlite`` is locked.

    Raises FolderHeld: another process holds it. sqlite3.Error : it cannot be written.
    """
    import sqlite3

    lock = sqlite3.connect(folder / "lock.sqlite", isolation_level=None, check_same_thread=False, timeout=0.0)
    try:
        lock.execute("BEGIN EXCLUSIVE")
    except sqlite3.OperationalError as error:
        lock.close()
        if "locked" not in str(error):
            raise
        raise FolderHeld(f"{folder}: another run writes there", "give another folder, or end that one") from None
    return lock


def discard_drafts() -> None:
    """Removes the incomplete drafts: for a process that exits without unwinding its stack."""
    for draft in list(_drafts):
        _remove(draft)


def end_with_parent() -> None:
    """Makes this worker remove its drafts and exit when the process that started it ends."""
    import multiprocessing

    parent = multiprocessing.parent_process()
    assert parent is not None

    def watch() -> None:
        parent.join()
        discard_drafts()
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def _draft_name() -> str:
    return f".sameas-{_machine()}-{os.getpid()}-{secrets.token_hex(6)}"


@cache
def _machine() -> str:
    """Eight hexadecimal digits that identify the machine and its PID namespace, which containers have of their own."""
    namespace = os.readlink("/proc/self/ns/pid") if os.path.exists("/proc/self/ns/pid") else ""
    return hashlib.sha256(f"{platform.node()} {namespace}".encode()).hexdigest()[:8]


def _remove_abandoned(folder: Path) -> None:
    """Removes drafts of processes of this machine that no longer run; drafts of other machines stay."""
    if os.name != "posix":  # elsewhere os.kill(pid, 0) may end the process
        return
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            match = _DRAFT.match(entry.name)
            if match and match[1] == _machine() and not _is_running(int(match[2])):
                _remove(Path(entry.path))


def _is_running(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except (OSError, OverflowError):
        return True
    return True


def _remove(draft: Path) -> None:
    with suppress(OSError):
        if draft.is_dir() and not draft.is_symlink():
            shutil.rmtree(draft, ignore_errors=True)
        else:
            draft.unlink()


@contextmanager
def _clear_errors(given: Path) -> Iterator[None]:
    try:
        yield
    except InputError:
        raise
    except Exception as error:
        reason = refused_by_disk(error)
        if reason is None:
            raise
        raise InputError(f"cannot write {given}: {reason}; nothing was written") from error


def refused_by_disk(error: BaseException | None) -> str | None:
    """Why the device refused a write, from an error or its causes; None where it did not."""
    while error is not None:
        if isinstance(error, PermissionError):
            return "permission denied"
        if isinstance(error, OSError) and error.errno in _NO_ROOM:
            return _NO_ROOM[error.errno]
        if isinstance(error, OSError) and "Not enough space on disk" in str(error):  # astropy.io.fits
            return _NO_ROOM[errno.ENOSPC]
        error = error.__cause__ or error.__context__
    return None


# Outputs must not overwrite inputs.


def is_input(path: str | os.PathLike[str], inputs: Sequence[str]) -> bool:
    """Whether a path is the same file as one of the inputs."""
    return any(
        (os.path.exists(one) and os.path.exists(path) and os.path.samefile(path, one))
        or os.path.realpath(one) == os.path.realpath(path)
        for one in inputs
    )


def refuse_inputs(path: str | os.PathLike[str], inputs: Sequence[str]) -> None:
    """Refuses an output path that is one of the inputs."""
    if is_input(path, inputs):
        raise InputError(f"{os.fspath(path)}: is also an input; it would be overwritten", "give another name")
