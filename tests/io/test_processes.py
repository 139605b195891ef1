"""Large work is done in a process of its own, with the same results."""

import os
import signal
import subprocess
import sys
import time

import pytest

from sameas.errors import InputError
from sameas.io.processes import NICENESS, Aside


@pytest.fixture
def aside():
    made = Aside(1000)
    yield made
    made.close()


def refuse(words):
    raise InputError(words, "give another")


def fail_on(path):
    """Fails as a full disk does, and leaves a line at each call."""
    with open(path, "a") as file:
        file.write("called\n")
    raise OSError("no space left on device")


def end_at_once():
    os.kill(os.getpid(), signal.SIGKILL)


def end_there(started):
    """Ends the process that is not ``started``."""
    if os.getpid() != started:
        end_at_once()
    return os.getpid()


@pytest.mark.slow
def test_little_work_is_done_here_and_much_in_another_process(aside):
    assert aside.call(999, os.getpid) == os.getpid()
    there = aside.call(1000, os.getpid)
    assert there != os.getpid() and there == aside.call(1000, os.getpid)
    with pytest.raises(InputError, match="no such thing; give another"):
        aside.call(1000, refuse, "no such thing")
    if hasattr(os, "nice"):
        assert aside.call(1000, os.nice, 0) == min(os.nice(0) + NICENESS, 19)


@pytest.mark.slow
def test_an_error_of_the_work_is_not_one_of_the_process(aside, tmp_path):
    there = aside.call(1000, os.getpid)
    with pytest.raises(OSError, match="no space left"):
        aside.call(1000, fail_on, tmp_path / "calls")
    assert (tmp_path / "calls").read_text() == "called\n" and aside.call(1000, os.getpid) == there


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills a process by a signal")
def test_where_the_process_dies_the_work_is_done_here_and_the_next_in_a_new_one(aside):
    first = aside.call(1000, os.getpid)
    assert aside.call(1000, end_there, os.getpid()) == os.getpid()
    assert aside.call(1000, os.getpid) not in (first, os.getpid())


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kills a process by a signal")
def test_a_script_needs_no_guard_and_a_killed_one_leaves_no_process(tmp_path):
    script = tmp_path / "script.py"
    script.write_text(
        "import os, time\n"
        "from sameas.io.processes import Aside\n"
        "print('begun', Aside(1).call(1, os.getpid), flush=True)\n"
        "time.sleep(60)\n"
    )
    with subprocess.Popen([sys.executable, script], stdout=subprocess.PIPE, text=True) as run:
        begun, there = run.stdout.readline().split()
        run.kill()
        assert begun == "begun" and run.stdout.readline() == ""
    until_s = time.monotonic() + 20.0
    while is_running(int(there)) and time.monotonic() < until_s:
        time.sleep(0.1)
    assert not is_running(int(there))


def is_running(process):
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return True
