"""Movers without the command: the detections of a night, from tables to tracklets and reports."""

import sys
from pathlib import Path

import pytest

from sameas.errors import InputError
from sameas.front.movers import MoverOptions, night_movers, read_night, series_movers

sys.path.insert(0, str(Path(__file__).parents[1] / "sky"))
from moving import night_table


@pytest.fixture
def table(tmp_path):
    return str(night_table(tmp_path / "night.csv"))


def test_a_night_is_searched_without_a_terminal(table):
    steps, lines = [], []
    read = read_night([table], columns={"sigma": 0.2}, progress=steps.append, say=lines.extend)
    found = night_movers(read, MoverOptions(least=3), progress=steps.append, say=lines.extend)
    detections, tracklets = found.tables().values()
    assert len(tracklets) > 25 and set(detections["tracklet"]) == set(tracklets["tracklet"])
    assert steps == [f"reading {table}", "searching"] and any("expected by chance" in line for line in lines)
    assert found.facts()["input_1"] == str(Path(table).resolve()) and "in_report" not in tracklets.colnames


def test_a_series_needs_two_frames():
    failed = [("one", "it is no frame")]
    with pytest.raises(InputError, match="0 of 1 frames could be identified; movers need two or more"):
        series_movers([], MoverOptions(), failed=failed)
