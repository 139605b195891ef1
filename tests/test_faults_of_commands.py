"""Commands killed, interrupted or stopped by disk errors at a few moments; scripts/bench faults tries more."""

import os
import random
import signal
import sys
from functools import partial

import pytest

pytest.importorskip("photutils", reason="frames need the extra sameas[frames]")
pytest.importorskip("cdshealpix", reason="catalogues in partitions need cdshealpix: pip install 'sameas[hats]'")

from benchmarks import faults

NAMES = (
    "series of frames", "movers on frames", "watch", "match, partitions", "picture",
    "series of frames, 2 processes", "movers on frames, 2 processes", "match, partitions, 2 processes",
)  # fmt: skip


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="forks, and mounts a file system of bounded size")
@pytest.mark.parametrize("name", NAMES)
def test_outputs_are_complete_whatever_stops_a_command(name, tmp_path, monkeypatch):
    monkeypatch.setitem(os.environ, "SOURCE_DATE_EPOCH", "1700000000")
    [work] = [work for work in faults.works(tmp_path, endings=()) if work.name == name]
    runner = faults.NewProcess(work) if work.starts_others else faults.ForkServer(work)
    try:
        signals = [partial(faults.signalled, work, runner, number, 3, random.Random(5)) for number in faults.CODES]
        counts = [run() for run in (*signals, partial(faults.unwritable, work))]
    finally:
        runner.close()
    assert [one.faults for one in counts] == [[]] * 4 and all(one.runs >= 3 for one in counts)
    assert set(faults.CODES) == {signal.SIGKILL, signal.SIGTERM, signal.SIGINT}
