"""The command as its own process: signals, devices and terminals."""

import errno
import importlib
import inspect
import json
import os
import pty
import re
import resource
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import typer
from astropy.table import Table

from sameas.cli.app import COMMANDS, app
from sameas.io import read_table, write_table

COMMAND = [str(Path(sys.executable).with_name("sameas"))]


def run(*arguments, **settings):
    return subprocess.run([*COMMAND, *map(str, arguments)], capture_output=True, text=True, timeout=120, **settings)


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGTERM, 143), (signal.SIGINT, 130)])
def test_a_terminated_process_prints_one_line_and_leaves_no_draft(number, code, tmp_path):
    pipe, folder = tmp_path / "never.csv", tmp_path / "out"
    os.mkfifo(pipe)
    process = subprocess.Popen([*COMMAND, "picture", f"radar={pipe}", "-o", str(folder)], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True, preexec_fn=_interruptible)  # fmt: skip
    _until(lambda: folder.exists() and list(folder.glob(".sameas-*")))  # it now waits for the sensor
    process.send_signal(number)
    _, printed = process.communicate(timeout=60)
    assert (process.returncode, printed) == (code, "sameas: stopped; nothing was written\n")
    assert [entry.name for entry in tmp_path.iterdir()] == ["never.csv"]


@pytest.mark.slow
def test_a_table_is_not_read_from_a_pipe(tmp_path, field_files):
    os.mkfifo(tmp_path / "pipe.csv")
    done = run("match", field_files[0], tmp_path / "pipe.csv", "-o", tmp_path / "o.fits", "-q")
    assert done.returncode == 1 and "pipe.csv: is a pipe, and a table is read more than once" in done.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="names of files are bytes")
def test_file_names_that_are_no_valid_text_work(tmp_path, field_files):
    paths = [tmp_path / f"{k}\udcff.csv" for k in (0, 1)]
    for path, table in zip(paths, field_files, strict=True):
        write_table(read_table(table), path, provenance={})
    for ending in (".csv", ".fits"):
        done = run("match", *paths, "-o", tmp_path / f"o\udcfe{ending}")
        assert (done.returncode, done.stderr) == (0, "") and "0\\udcff.csv" in done.stdout
        assert (tmp_path / f"o\udcfe{ending}").exists()
    beside = json.loads((tmp_path / "o\udcfe.csv.provenance.json").read_text("utf-8"))
    assert str(paths[0]) in beside.values()


@pytest.mark.parametrize("command", ["match", "compare", "picture", "explain"])
def test_a_file_name_that_is_too_long_is_no_internal_error(command, tmp_path, field_files, sameas):
    name, out = tmp_path / f"{'n' * 300}.fits", tmp_path / "out.fits"
    given = {"match": [name, field_files[0], "-o", out], "compare": [name, name],
             "picture": [name, name, "-o", out], "explain": [name, "1"]}[command]  # fmt: skip
    stderr = sameas(command, *given, exit_code=1).stderr
    assert "fault of sameas" not in stderr and ("too long" in stderr or "no such file" in stderr)
    if command == "match":
        stderr = sameas(command, *field_files, "-o", name, exit_code=1).stderr
        assert "the name is too long for a file; give a shorter one" in stderr


@pytest.mark.skipif(sys.platform == "win32", reason="such a folder cannot be removed there")
def test_a_folder_deleted_during_the_run_is_no_internal_error(tmp_path, field_files, monkeypatch, refusal):
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    message = refusal("match", *field_files, "-o", "out.fits")
    assert message == "the folder that this was started in no longer exists; change to another"


@pytest.mark.slow
@pytest.mark.parametrize("closed", ["0", "1", "2"])
def test_a_closed_stream_does_not_stop_the_command(closed, tmp_path, field_files):
    out = tmp_path / "o.fits"
    command = shlex.join([*COMMAND, "match", *map(str, field_files), "-o", str(out)])
    done = subprocess.run(["sh", "-c", f"{command} {closed}>&-"], capture_output=True, text=True, timeout=120)
    assert (done.returncode, done.stderr) == (0, "") and out.exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    "ending", [".fits", pytest.param(".parquet", marks=pytest.mark.long), pytest.param(".csv", marks=pytest.mark.long)]
)
def test_a_signal_at_any_time_leaves_the_old_or_the_new_output(ending, tmp_path, field_files):
    out = tmp_path / f"o{ending}"
    run("match", *field_files, "-o", out)  # may compile, which no later run does
    began = time.monotonic()
    run("match", *field_files, "-o", out)
    whole, longest = out.read_bytes()[:2880], time.monotonic() - began
    for moment in np.linspace(0.2, 1.1, 7) * longest:
        out.write_bytes(b"old")
        process = subprocess.Popen([*COMMAND, "match", *map(str, field_files), "-o", str(out), "-q"],
                                   stderr=subprocess.PIPE, text=True)  # fmt: skip
        time.sleep(moment)
        process.terminate()
        _, printed = process.communicate(timeout=60)
        assert process.returncode in (0, 143, -signal.SIGTERM) and "Traceback" not in printed
        assert not list(tmp_path.glob(".*"))
        new = out.read_bytes()
        assert new == b"old" or new[:80] == whole[:80]


@pytest.mark.slow
def test_two_frame_processes_end_on_a_signal(tmp_path):
    frames = [tmp_path / f"{name}.fits" for name in "ab"]
    for frame in frames:
        os.mkfifo(frame)
    process = subprocess.Popen([*COMMAND, "frame", *map(str, frames), "--catalog", "bright", "-o", str(tmp_path / "o")],
                               stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)  # fmt: skip
    _until(lambda: len(_children(process.pid)) >= 2)
    children = _children(process.pid)
    process.terminate()
    process.communicate(timeout=60)
    assert process.returncode == 143
    _until(lambda: not any(Path(f"/proc/{child}").exists() for child in children))


def _children(process):
    """The processes that a process has started, on Linux."""
    tasks = Path(f"/proc/{process}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


def _until(true, patience_s=60.0):
    end = time.monotonic() + patience_s
    while not true():
        assert time.monotonic() < end
        time.sleep(0.02)


def _interruptible():
    """Restore SIGINT: shells make background jobs, and so this command, ignore Ctrl-C."""
    signal.signal(signal.SIGINT, signal.SIG_DFL)


@pytest.mark.slow
def test_a_full_disk_leaves_no_half_written_file(tmp_path, field_files):
    def small():
        resource.setrlimit(resource.RLIMIT_FSIZE, (8192, 8192))

    run("match", *field_files, "-o", tmp_path / "o.fits")  # what is compiled once needs room of its own
    (tmp_path / "o.fits").unlink()
    done = run("match", *field_files, "-o", tmp_path / "o.fits", preexec_fn=small)
    assert done.returncode == 1
    assert done.stderr.splitlines()[-1].startswith(f"sameas: cannot write {tmp_path}/o.fits: ")
    assert "nothing was written" in done.stderr and "Traceback" not in done.stderr
    assert list(tmp_path.iterdir()) == []
    assert "100 identified" in done.stdout  # the summary is not lost with the file


@pytest.mark.slow
def test_a_closed_pipe_does_not_stop_the_work(tmp_path, field_files):
    out = tmp_path / "o.fits"
    arguments = [*COMMAND, "match", *field_files, "-o", str(out)]
    process = subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    process.stdout.close()
    assert process.stderr.read() == "" and process.wait(timeout=60) == 0
    process.stderr.close()
    assert out.exists()


@pytest.mark.slow
def test_colour_on_a_terminal_unless_no_color_is_set(field_files):
    for unwanted in (False, True):
        environment = {**os.environ, "TERM": "xterm"} | ({"NO_COLOR": "1"} if unwanted else {})
        for name in () if unwanted else ("NO_COLOR",):
            environment.pop(name, None)
        ours, theirs = pty.openpty()
        arguments = [*COMMAND, "match", *field_files, "--dry-run", "--density", "1e9,1e9"]
        done = subprocess.run(arguments, stdout=theirs, stderr=subprocess.PIPE, env=environment, timeout=60)
        os.close(theirs)
        text = b""
        while chunk := _read(ours):
            text += chunk
        os.close(ours)
        assert done.returncode == 0 and b"First catalogue" in text
        assert (b"\x1b[33m" in text) is not unwanted


def _read(terminal):
    try:
        return os.read(terminal, 65536)
    except OSError:  # the other end is closed
        return b""


@pytest.mark.slow
@pytest.mark.parametrize(
    ("end", "code", "output"),
    [
        ("raise SystemExit(3)", 3, "done\nended\n"),
        ("pass", 0, "done\nended\n"),
        ("threading.Thread(target=lambda: (time.sleep(0.3), print('waited'))).start()", 0, "done\nwaited\nended\n"),
        ("raise SystemExit('words')", 1, "done\nended\n"),
    ],
)
def test_a_process_ends_at_once_after_flushing_its_output(end, code, output):
    """What is registered for its end runs, and threads at work are waited for, as Python does."""
    probe = f"""
import atexit, sys, threading, time
import sameas.cli
def main():
    print("done")
    {end}
    raise SystemExit
sameas.cli.main = main
atexit.register(print, "ended")
sameas.cli.process()
"""
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stdout) == (code, output)


def test_help_imports_no_heavy_modules_of_sameas():
    probe = """
import sys
sys.argv = ["sameas", "--help"]
from sameas.cli import main
try:
    main()
except SystemExit:
    print([name for name in ("numba", "astropy", "scipy", "pyarrow", "sameas.sky") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "[]"
    assert "match" in done.stdout and "explain" in done.stdout


@pytest.mark.parametrize("command", COMMANDS)
def test_a_help_shows_arguments_as_they_are_typed_and_no_python_types(command, capsys):
    with pytest.raises(SystemExit):
        app([command, "--help"])
    shown = capsys.readouterr().out
    usage = next(line for line in shown.splitlines() if "Usage:" in line)
    assert "{" not in usage and "[[" not in usage
    assert not re.findall(r"<[a-z]+[\[\]a-z]*>", shown)


def test_paragraphs_of_a_help_are_filled():
    """Line breaks of a docstring were kept in all paragraphs but the first."""
    from sameas.cli.app import command_of

    assert all("\n" not in part for part in command_of("movers").help.split("\n\n"))


@pytest.mark.slow
@pytest.mark.parametrize(("rows", "side_deg"), [(60, 1.0), (1000, 0.02)])
def test_a_short_run_imports_no_unneeded_modules(tmp_path, rows, side_deg):
    """Which would take longer than the match itself: nor do the larger groups of a thousand rows in a crowd."""
    rng = np.random.default_rng(3)
    ra, dec = rng.uniform(10.0, 10.0 + side_deg, (2, rows))
    for name in ("one", "two"):
        off = rng.normal(0.0, 0.1 / 3600.0, (2, rows))
        columns = {"ra": ra + off[0], "dec": dec + off[1], "sigma": np.full(rows, 0.1)}
        write_table(Table(columns, units={"ra": "deg"}), tmp_path / f"{name}.parquet", provenance={})
    probe = """
import sys
from sameas.cli import main
try:
    main()
except SystemExit as error:
    print(error.code, [name for name in ("numba", "scipy.linalg", "scipy.special", "pydantic", "astropy.coordinates",
                                         "matplotlib") if name in sys.modules])
"""
    arguments = [
        "match",
        "one.parquet",
        "two.parquet",
        "-o",
        "out.parquet",
        "--sigma",
        "sigma",
        "--sigma-unit",
        "arcsec",
        "-q",
    ]
    done = subprocess.run(
        [sys.executable, "-c", probe, *arguments], capture_output=True, text=True, timeout=60, cwd=tmp_path
    )
    assert done.stdout.splitlines()[-1] == "0 []", done.stderr


def test_commands_are_listed_with_the_first_sentence_of_their_docstring():
    for name, sentence in COMMANDS.items():
        command = getattr(importlib.import_module(f"sameas.cli.{name}"), name)
        assert inspect.getdoc(command).partition("\n\n")[0].replace("\n", " ") == sentence


@pytest.mark.slow
def test_a_command_builds_only_its_own_options():
    probe = """
import sys
sys.argv = ["sameas", "match", "--help"]
from sameas.cli import main
try:
    main()
except SystemExit:
    print([name for name in ("many", "frame", "picture", "explain", "request") if f"sameas.cli.{name}" in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", probe], capture_output=True, text=True, timeout=60)
    assert done.stdout.splitlines()[-1] == "[]" and "--nway-columns" in done.stdout


_BUSY = """
import sys, time
import sameas.cli, sameas.cli.outcome as outcome
from sameas.io.atomic import replacing
from numba import njit

@njit(nogil=True)
def long(n):
    total = 0.0
    for k in range(n):
        total += (k % 7) ** 0.5
    return total

long(10)
outcome.end_cleanly_on_sigterm()
with outcome.answering(False), replacing(sys.argv[1]) as draft:
    draft.write_text("half")
    print("begun", flush=True)
    long(60_000_000_000)
"""


@pytest.mark.slow
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_compiled_loop_does_not_delay_termination(number, code, tmp_path):
    process = subprocess.Popen([sys.executable, "-c", _BUSY, str(tmp_path / "out.txt")], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, text=True, preexec_fn=_interruptible)  # fmt: skip
    assert process.stdout.readline() == "begun\n"
    time.sleep(0.5)
    process.send_signal(number)
    _, printed = process.communicate(timeout=20)  # the loop itself takes minutes
    assert (process.returncode, printed) == (code, "sameas: stopped; nothing was written\n")
    assert not list(tmp_path.iterdir())


_CAUGHT = """
import os, sys
from importlib.abc import MetaPathFinder
import sameas.cli, sameas.cli.app

number, where, asked = int(sys.argv[1]), sys.argv[2], []

class Asked(MetaPathFinder):
    def find_spec(self, name, path, target=None):
        if name == "numpy":
            try:
                if not asked:
                    asked.append(number)
                    os.kill(os.getpid(), number)
            except BaseException:
                pass
            raise AttributeError("half imported")

sys.meta_path.insert(0, Asked())
sys.argv[1:] = ["match", "a.fits", "b.fits", "-o", "o.fits"]
if where == "before":
    sameas.cli.app.app = lambda: __import__("numpy")
sameas.cli.main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("where", ["in", "before"])
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_import_that_swallows_the_signal_and_fails_is_no_internal_error(number, code, where, tmp_path, field_files):
    """NumPy 2.0 does: a traceback, or a fault of sameas, was printed where the command was asked to end."""
    for name, file in zip(("a.fits", "b.fits"), field_files, strict=True):
        (tmp_path / name).symlink_to(file)
    done = subprocess.run([sys.executable, "-c", _CAUGHT, str(int(number)), where], cwd=tmp_path, capture_output=True,
                          text=True, timeout=60, preexec_fn=_interruptible)  # fmt: skip
    assert (done.returncode, done.stderr) == (code, "sameas: stopped; nothing was written\n")
    assert not (tmp_path / "o.fits").exists()


_TWICE = """
import os, signal, sys, time
from pathlib import Path
from sameas.cli import outcome
from sameas.io.atomic import replacing
outcome.end_cleanly_on_sigterm(worker=True)
unlink = Path.unlink
def asked_again(path):
    os.kill(os.getpid(), signal.SIGTERM)
    unlink(path)
Path.unlink = asked_again
try:
    with replacing(sys.argv[1]):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(60)
except KeyboardInterrupt:
    sys.exit(3)
"""


def test_a_worker_signalled_twice_still_removes_its_draft(tmp_path):
    """Who is interrupted asks its workers to end, and again when it ends itself."""
    done = subprocess.run([sys.executable, "-c", _TWICE, str(tmp_path / "out.txt")], timeout=60, check=False)
    assert done.returncode in (3, 143) and not list(tmp_path.iterdir())


def _answer(path):
    from sameas.io import read_table

    table = read_table(path)
    return {name: table[name].tolist() for name in table.colnames}


@pytest.mark.slow
def test_a_signal_during_object_deletion_prints_no_traceback():
    program = """
import os, signal, time
from sameas.cli.outcome import end_cleanly_on_sigterm
class Deleted:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(0.01)
end_cleanly_on_sigterm()
Deleted()
time.sleep(30)
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (143, "sameas: stopped; nothing was written\n")


def test_an_interruption_in_compiled_code_is_reported_as_such(capsys):
    """numba's wrappers make a SystemError of it; it was called a fault of sameas."""
    from sameas.cli import outcome

    with pytest.raises(typer.Exit) as ended, outcome.answering(False):
        raise SystemError("returned a result with an exception set") from outcome.Terminated()
    assert (ended.value.exit_code, capsys.readouterr().err) == (143, "sameas: stopped; nothing was written\n")
    with pytest.raises(typer.Exit) as ended, outcome.answering(False):
        raise SystemError("another")
    assert ended.value.exit_code == 1 and "fault of sameas" in capsys.readouterr().err


@pytest.mark.parametrize(("kind", "code"), [("KeyboardInterrupt", 130), ("Terminated", 143)])
def test_a_process_stopped_before_its_command_begins_reports_it(kind, code, monkeypatch):
    """typer's own exit code is that of Ctrl-C, whatever the signal was, and it says nothing."""
    from sameas.cli import main, outcome

    ended, small = [], typer.Typer()

    def end_now(code, words=""):
        ended.append((code, words))
        raise RuntimeError("the process has ended")

    @small.command()
    def interrupted():
        raise getattr(outcome, kind, KeyboardInterrupt)

    monkeypatch.setattr(outcome, "end_now", end_now)
    monkeypatch.setattr(outcome, "end_cleanly_on_sigterm", lambda: None)
    monkeypatch.setattr("sameas.cli.app.app", small)
    monkeypatch.setattr("sys.argv", ["sameas"])
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(RuntimeError, match="has ended"):
            main()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
    assert ended == [(code, "stopped; nothing was written")]


def test_an_interruption_in_one_frame_ends_the_series(monkeypatch):
    """It was said to be a fault of that frame, and the next one was begun."""
    from sameas.cli import frames
    from sameas.front.framing import FrameRequest

    def interrupted(*given, **options):
        raise SystemError("returned a result with an exception set") from KeyboardInterrupt()

    monkeypatch.setattr(frames, "fulfil", interrupted)
    request = object.__new__(FrameRequest)
    with pytest.raises(KeyboardInterrupt):
        frames.run_all([request], processes=1, again=True, quiet=True, tell=print)


def test_a_full_temporary_disk_is_no_internal_error(capsys):
    from sameas.cli import outcome

    with pytest.raises(typer.Exit) as ended, outcome.answering(False):
        raise OSError(errno.ENOSPC, "No space left on device", "/full/x")
    message = "sameas: /full/x: no space left on device; make room, there too where TMPDIR says\n"
    assert (ended.value.exit_code, capsys.readouterr().err) == (1, message)
    with pytest.raises(typer.Exit), outcome.answering(False):
        raise OSError("what nobody knows")
    assert "fault of sameas" in capsys.readouterr().err


@pytest.fixture(scope="module")
def answer_here(field_files, tmp_path_factory):
    """The columns of the result of a process in the usual circumstances."""
    path = tmp_path_factory.mktemp("here") / "here.parquet"
    run("match", *field_files, "-o", path)
    return _answer(path)


@pytest.mark.slow
@pytest.mark.parametrize(
    "circumstance", ["python -O", "no home", "a home that is read-only", "no home, no place for compiled kernels"]
)
def test_the_result_does_not_depend_on_the_home_folder(circumstance, tmp_path, field_files, answer_here):
    switches = ["-O"] if circumstance == "python -O" else []
    environment = dict(os.environ)
    if "no home" in circumstance:
        environment["HOME"] = str(tmp_path / "none")
    if circumstance == "a home that is read-only":
        (tmp_path / "home").mkdir(mode=0o500)
        environment["HOME"] = environment["XDG_CACHE_HOME"] = environment["XDG_CONFIG_HOME"] = str(tmp_path / "home")
    if "compiled" in circumstance:
        environment["NUMBA_CACHE_DIR"] = str(tmp_path / "file" / "below")
        (tmp_path / "file").touch()
    arguments = ["match", *map(str, field_files), "-o", str(tmp_path / "there.parquet"), "-q"]
    done = subprocess.run([sys.executable, *switches, "-m", "sameas", *arguments], capture_output=True, text=True,
                          env=environment, timeout=120)  # fmt: skip
    assert (done.returncode, done.stderr) == (0, "")
    assert _answer(tmp_path / "there.parquet") == answer_here


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root may become another user")
def test_a_read_only_installation_works_for_another_user(tmp_path, field_files, answer_here):
    """Nobody has no home, and may write into his own folder only: neither kernels beside the source, nor caches."""
    for folder in {above for path in (tmp_path / "x", *map(Path, field_files)) for above in path.parents[:-2]}:
        folder.chmod(folder.stat().st_mode | 0o055)
    theirs = tmp_path / "theirs"
    theirs.mkdir()
    os.chown(theirs, 65534, 65534)
    environment = {"PATH": os.environ["PATH"], "HOME": "/nonexistent", "TMPDIR": str(theirs)}
    # The last digits depend on which processor BLAS takes this one for.
    environment |= {name: os.environ[name] for name in ("PYTHONPATH", "OPENBLAS_CORETYPE") if name in os.environ}
    command = [sys.executable, "-m", "sameas", "match", *map(str, field_files), "-o", str(theirs / "o.parquet"), "-q"]
    try:
        done = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=200, cwd="/",
                              user=65534, group=65534, extra_groups=[])  # fmt: skip
    except PermissionError:
        pytest.skip("another user may not run this Python")
    assert (done.returncode, done.stderr.replace(_COMPILING, "")) == (0, "")
    assert _answer(theirs / "o.parquet") == answer_here
    closed = tmp_path / "closed"
    closed.mkdir(mode=0o700)
    command[4] = str(closed / "a.fits")
    refused = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=200, cwd="/",
                             user=65534, group=65534, extra_groups=[])  # fmt: skip
    assert refused.returncode == 1 and refused.stderr == (
        f"sameas: {closed / 'a.fits'}: permission denied: this user may not use it, or a folder above it\n"
    )


_COMPILING = "sameas: compiling kernels for this machine, once; it takes some seconds\n"
_FORKED = """
import os, sys
import numpy as np
import sameas
from sameas.kernels import compiled

compiled.compile_all()
rng = np.random.default_rng(1)
a = {"ra": rng.uniform(10.0, 11.0, 30000), "dec": rng.uniform(-0.5, 0.5, 30000)}
b = {name: column + rng.normal(0.0, 3e-5, 30000) for name, column in a.items()}
answer = lambda: np.array(sameas.match(a, b, sigma=0.1).pairs["p_match"])
before = answer()
child = os.fork()
if child == 0:
    os._exit(0 if np.array_equal(answer(), before) else 3)
print(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]), np.array_equal(answer(), before))
"""


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork here")
def test_a_forked_process_gives_the_same_result():
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", _FORKED], capture_output=True, text=True, timeout=120)
    assert done.stdout == "0 True\n", done.stderr[-2000:]


_FIRST = """
import numpy as np
from sameas.kernels import components

one = np.array([0, 1, 1], np.int32)  # three pairs, of two components
short = [np.zeros(size, np.int32) for size in (2, 2, 3)]
parent = np.arange(4, dtype=np.int32)
print(components.label_pairs.compiled(one, one, parent, *short, *(np.zeros(4, np.int64) for _ in range(3))))
"""


@pytest.mark.slow
def test_two_simultaneous_first_compilations_do_not_interfere(tmp_path):
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", _FIRST]
    two = [subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment)
           for _ in range(2)]  # fmt: skip
    outputs = [process.communicate(timeout=120) for process in two]
    third = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=120)
    assert [*(process.returncode for process in two), third.returncode] == [0, 0, 0], outputs
    assert outputs[0][0] == outputs[1][0] == third.stdout != "" and list(tmp_path.rglob("*.nbi"))
    assert "compiling" not in third.stderr


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX")
def test_a_worker_that_waits_for_work_is_terminated_without_a_traceback():
    program = """
import multiprocessing
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial

from sameas.cli.outcome import TERMINATED, end_cleanly_on_sigterm

if __name__ == "__main__":
    context = multiprocessing.get_context("fork")
    pool = ProcessPoolExecutor(1, mp_context=context, initializer=partial(end_cleanly_on_sigterm, worker=True))
    pool.submit(int).result()
    time.sleep(0.2)
    (worker,) = multiprocessing.active_children()
    worker.terminate()
    worker.join()
    print(worker.exitcode == TERMINATED)
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (run.stdout, run.stderr) == ("True\n", "")
