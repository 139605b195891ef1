"""Outputs of sameas that were edited, cut or damaged: used as far as valid, otherwise refused in one line."""

import json
import sqlite3

import numpy as np
import pytest
from astropy.table import Table
from tests.live.conftest import replay, settings

import sameas
from sameas.errors import InputError
from sameas.io import read_table, write_table
from sameas.io.atomic import held
from sameas.io.saved import dumps
from sameas.live.journal import LAYOUT
from sameas.live.keeper import Keeper


def stars(shift):
    ra = np.random.default_rng(1).uniform(10.0, 10.02, 20)
    return Table({"id": [f"s{k}" for k in range(20)], "ra": ra + shift, "dec": ra - 10.01, "sigma": np.full(20, 0.1)})


@pytest.fixture(scope="module")
def output(tmp_path_factory):
    folder = tmp_path_factory.mktemp("match")
    match = sameas.match(stars(0.0), stars(1e-5))
    match.write(folder / "out.csv")
    facts = json.loads((folder / "out.csv.provenance.json").read_text(encoding="utf-8"))
    return read_table(folder / "out.csv"), facts


def _two_a_row(table):
    table.remove_columns([name for name in table.colnames if name.startswith("p_")])
    table["p_match"] = np.full((len(table), 2), 0.5)
    for name in [name for name in table.colnames if name.endswith("_2")]:
        table[name] = table[name][::-1]


EDITS = {
    "no declination": lambda table, facts: facts.pop("dec_column_1"),
    "a column that is not there": lambda table, facts: table.remove_column("ra_2"),
    "a number of rows that is none": lambda table, facts: facts.update(rows_1="nan"),
    "a text for a probability": lambda table, facts: table.replace_column("p_match", ["x"] * len(table)),
    "two probabilities a row, other partners": lambda table, facts: _two_a_row(table),
    "names that are lists": lambda table, facts: facts.update(name_1=["a"], name_2=["b"]),
    "nothing": lambda table, facts: None,
}


@pytest.mark.slow_after(1)
@pytest.mark.parametrize("edit", EDITS)
def test_an_edited_table_is_read_or_refused(edit, output, tmp_path):
    table, facts = output[0].copy(), dict(output[1])
    EDITS[edit](table, facts)
    write_table(table, tmp_path / "edited.ecsv", provenance=facts)
    write_table(output[0], tmp_path / "whole.ecsv", provenance=output[1])
    refused = 0
    for question in (
        lambda: sameas.explain(tmp_path / "edited.ecsv", "s3"),
        lambda: sameas.explain(tmp_path / "edited.ecsv", "s3", source=2),
        lambda: sameas.explain(tmp_path / "edited.ecsv", row=2),
        lambda: sameas.compare(tmp_path / "edited.ecsv", tmp_path / "whole.ecsv"),
    ):
        try:
            assert question().lines
        except InputError as error:
            assert str(error).isprintable()
            refused += 1
    assert bool(refused) == (edit != "nothing")


@pytest.mark.parametrize("damage", ["first page", "every page", "cut", "text"])
def test_a_damaged_journal_is_refused(damage, tmp_path):
    keeper = Keeper(settings(), tmp_path, replay=replay())
    keeper.tick()
    keeper.close()
    base = sqlite3.connect(tmp_path / "journal.sqlite")
    base.execute("PRAGMA journal_mode=DELETE")
    base.close()
    content = bytearray((tmp_path / "journal.sqlite").read_bytes())
    for begin in (
        (100,) if damage == "first page" else range(4096, len(content), 4096) if damage == "every page" else ()
    ):
        content[begin : begin + 10] = b"\xff" * 10
    content = content[:5000] if damage == "cut" else b"a journal" * 90 if damage == "text" else content
    (tmp_path / "journal.sqlite").write_bytes(content)
    with pytest.raises(InputError, match=r"its journal is damaged .*; move it away to begin anew") as refused:
        Keeper(settings(), tmp_path, replay=replay())
    held(tmp_path).close()  # the folder is free, though the refusal is still at hand
    assert refused.value.__traceback__ is not None


VERSION = {"version": sameas.__version__, "layout": LAYOUT}


@pytest.mark.parametrize("state", ["text", ["a", "list"], VERSION, {"names": []}, VERSION | {"picture": 3, "tick": 1}])
def test_a_state_of_another_kind_is_refused(state, tmp_path):
    if "picture" in state:
        state = state | {"names": list(settings().sources)}
    (tmp_path / "state.pickle").write_bytes(dumps(state))
    with pytest.raises(InputError, match="is damaged") as refused:
        Keeper(settings(), tmp_path, replay=replay())
    held(tmp_path).close()
    assert refused.value.__traceback__ is not None


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("hats.properties", b"\xff\xfe", "cannot be read"),
        ("partition_info.csv", b"Norder,Npix\n4,x\n", "cannot be read"),
        ("partition_info.csv", b"Norder\n4\n", "cannot be read"),
        ("partition_info.csv", b"Norder,Npix\n99999999,1\n", "no cell of HEALPix is of order 99999999"),
        ("partition_info.csv", b"Norder,Npix\n-2147483648,1\n", "no cell of HEALPix is of order -2147483648"),
        ("partition_info.csv", b"Norder,Npix\n1,48\n", "no cell of HEALPix is of order 1 and number 48"),
        ("partition_info.csv", b"Norder,Npix\n1,-1\n", "no cell of HEALPix is of order 1 and number -1"),
        ("hats.properties", b"hats_npix_suffix=" + 300 * b"A", "hats_npix_suffix is 'A"),
        ("hats.properties", b"hats_npix_suffix=/../../../other.parquet", "hats_npix_suffix is '/\\.\\."),
        ("partition_info.csv", b"Norder,Npix\n0,0\n1,3\n", "overlap"),
    ],
)
def test_a_damaged_list_of_partitions_is_refused(name, content, words, tmp_path):
    pytest.importorskip("cdshealpix", reason="catalogues in partitions need cdshealpix: pip install 'sameas[hats]'")
    from sameas.partitions.hats import HatsCatalogue, write_hats

    write_hats(stars(0.0), tmp_path / "cat", max_rows=10)
    assert HatsCatalogue.open(tmp_path / "cat").partition_rows.sum() == 20
    (tmp_path / "cat" / name).write_bytes(content)
    with pytest.raises(InputError, match=words):
        HatsCatalogue.open(tmp_path / "cat")


@pytest.mark.parametrize(
    "url", ["udp://127.0.0.1:1e308", "udp://127.0.0.1:99999", "udp://[::1", "udp://h:\N{VULGAR FRACTION ONE HALF}"]
)
def test_addresses_without_a_valid_port_are_refused(url):
    from dataclasses import replace

    from sameas.live.keeper import Keeper
    from sameas.live.outputs import sinks_of

    with pytest.raises(InputError, match="cannot be sent to"):
        sinks_of([{"url": url, "format": "nmea"}])
    given = settings()
    sources = {name: replace(source, url=url) for name, source in given.sources.items()}
    with pytest.raises(InputError, match="cannot be listened to"):
        Keeper(replace(given, sources=sources))
