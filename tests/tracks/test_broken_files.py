"""Corrupt sensor files: one bad line counts as one damaged line, without unexpected exceptions."""

import json
import struct
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from sameas.errors import InputError
from sameas.io.sensors import ReadOptions, read_reports
from sameas.io.sensors.nmea import checksum
from sameas.io.sensors.sources import read_sources
from sameas.io.sensors.stream import ReportStream
from sameas.tracks.reports import Reports

STAMP = "\\c:1452603731*00\\"
POSITION = "!AIVDM,1,1,,B,15M67FC000G?ufbE`FepT@3n00Sa,0*5C"
SNAPSHOT = {"now": 1.7e9, "aircraft": [{"hex": "4ca7a8", "lat": 50.0, "lon": -1.0}]}
SBS = "MSG,3,1,1,4CA7A8,1,2024/05/01,12:00:{:02d}.000,2024/05/01,12:00:00.000,,35000,,,50.1,-1.25,,,0,0,0,0"


def sentence(body):
    return f"{body[0]}{body[1:]}*{checksum(body[1:]):02X}"


def read(folder, name, content, **options):
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_reports(path, ReadOptions(**options))


def damage(reports):
    return dict(zip(reports.damaged.lines.tolist(), reports.damaged.reasons.tolist(), strict=True))


def test_static_data_cut_short_is_one_damaged_line(tmp_path):
    pytest.importorskip("pyais")
    cut = sentence("!AIVDM,1,1,,A,5,0")
    [found] = read(tmp_path, "a.nmea", "\n".join(STAMP + line for line in (POSITION, cut, POSITION)) + "\n")
    assert len(found) == 2 and list(damage(found)) == [2]


def test_an_impossible_date_is_no_clock(tmp_path):
    zda = sentence("$GPZDA,120000,01,05,99999999999999999999,00,00")
    ttm = sentence("$RATTM,01,2.5,13.6,T,7.0,20.0,T,,,N,,T,,120000,A")
    with pytest.raises(InputError, match=r"no time: the sentences have the time of day, but no date"):
        read(tmp_path, "a.nmea", f"{zda}\n{ttm}\n")


def test_a_packet_shorter_than_its_header_says_is_ignored(tmp_path):
    head = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)
    for content in (head[:22], head + bytes(15), head + struct.pack("<IIII", 0, 0, 2000, 2000) + b"\x45" * 40):
        with pytest.raises(InputError, match=r"a\.pcap: no target of category 001, 010, 020, 021, 048 or 062"):
            read(tmp_path, "a.pcap", content)


@pytest.mark.parametrize("share", [0.3, 0.6, 0.9])
def test_a_broken_parquet_file_is_refused_by_name(share, tmp_path):
    path = tmp_path / "a.parquet"
    parquet.write_table(pa.table({"time": [1.7e9], "lat": [50.0], "lon": [-1.0]}), path)
    content = path.read_bytes()
    with pytest.raises(InputError, match=r"a\.parquet: cannot be read as .*Parquet"):
        read(tmp_path, "a.parquet", content[: int(share * len(content))])


@pytest.mark.parametrize(
    "column",
    [
        pa.array([b"\xff\xfe", b"a"]),
        pa.array([{"a": 1}, None]),
        pa.array([[1.0], []]),
        pa.array([1, 2], pa.duration("s")),
    ],
)
def test_a_column_of_the_wrong_type_has_no_numbers(column, tmp_path):
    path = tmp_path / "a.parquet"
    parquet.write_table(
        pa.table({"time": [1.7e9, 1.7e9], "lat": [50.0, 51.0], "lon": [-1.0, -1.0], "sog": column}), path
    )
    try:
        read_reports(path)
    except InputError as error:
        assert "a.parquet" in str(error)


@pytest.mark.parametrize("now", [float("nan"), float("inf"), 1e300, -1e300])
def test_a_snapshot_without_time_is_set_aside(now, tmp_path):
    lines = [json.dumps(SNAPSHOT), json.dumps(SNAPSHOT | {"now": now})]
    [found] = read(tmp_path, "a.json", "\n".join(lines) + "\n")
    assert len(found) == 1 and damage(found) == {2: "no time"}


def test_a_report_without_receipt_time_is_set_aside(tmp_path):
    pytest.importorskip("pyais")
    far = POSITION.join(["\\c:" + "9" * 400 + "*00\\", ""])
    [found] = read(tmp_path, "a.nmea", f"{STAMP}{POSITION}\n{far}\n{STAMP}{POSITION}\n")
    assert np.isfinite(found.time_s).all()


def test_infinite_values_are_set_aside_or_missing():
    columns: dict[str, Any] = {
        "time_s": [1.0, 2.0, 3.0, np.nan], "lat_deg": [1.0, np.inf, 1.0, 1.0], "lon_deg": [2.0, 2.0, 2.0, 2.0],
        "speed_m_per_s": [1.0, 1.0, np.inf, 1.0], "line": [5, 6, 7, 8],
    }  # fmt: skip
    columns["nic"] = columns["speed_m_per_s"]
    made = Reports.of("radar", "table", columns)
    assert made.time_s.tolist() == [1.0, 3.0] and damage(made) == {6: "no position", 8: "no time"}
    np.testing.assert_array_equal(made.speed_m_per_s, [1.0, np.nan])
    np.testing.assert_array_equal(made.extra["nic"], [1.0, np.nan])
    with pytest.raises(InputError, match="radar: no report has a time"):
        Reports.of("radar", "table", {"time_s": [np.nan], "lat_deg": [1.0], "lon_deg": [1.0]})


def test_a_negative_distance_is_no_position(tmp_path):
    text = "time,range_m,bearing_deg,kind\n1700000000,-5,10,a\n1700000001,5,10,a\n"
    [found] = read(tmp_path, "radar.csv", text)
    assert len(found) == 1 and damage(found) == {2: "a distance below 0"}


@pytest.mark.parametrize(
    ("name", "content", "line"),
    [
        ("a.jsonl", '{"time": 1, "lat": 2, "lon": 3}\n{"time": 2, "lat": 2, "lon": 3}\n{"time": 3, "la', 3),
        ("a.csv", "time,lat,lon\n1700000000,2,3\n1700000001,2,3\n1700000002,2", 4),
        ("a.sbs", f"{SBS.format(1)}\n{SBS.format(2)[:83]}", 2),
        ("a.json", f"{json.dumps(SNAPSHOT)}\n{json.dumps(SNAPSHOT)[:40]}", 2),
        ("a.nmea", f"{STAMP}{POSITION}\n{STAMP}{POSITION[:30]}", 2),
    ],
)
def test_a_truncated_last_line_is_reported(name, content, line, tmp_path):
    if name == "a.nmea":
        pytest.importorskip("pyais")
    [found] = read(tmp_path, name, content)
    assert damage(found) == {line: "the last line is incomplete"}, (found.damaged, len(found))


def test_a_table_without_a_last_line_end_may_be_incomplete(tmp_path):
    [found] = read(tmp_path, "a.csv", "time,lat,lon\n1700000000,2,3\n1700000001,2,3")
    assert any("its last line has no line end" in note for note in found.notes) and len(found) == 2
    [found] = read(tmp_path, "a.csv", "time,lat,lon\n1700000000,2,3\n1700000001,2,3\n")
    assert not any("last line" in note for note in found.notes)


def test_a_reader_that_fails_names_the_file_and_the_library_error(tmp_path, monkeypatch):
    def broken(*_):
        raise struct.error("unpack requires a buffer of 4 bytes")

    monkeypatch.setattr("sameas.io.sensors.table_cells.cells_of_csv", broken)
    with pytest.raises(InputError, match=r"a\.csv: cannot be read as .*: unpack requires a buffer of 4 bytes") as found:
        read(tmp_path, "a.csv", "time,lat,lon\n1,2,3\n")
    assert isinstance(found.value.__cause__, struct.error)


def test_one_unreadable_source_does_not_stop_the_others(tmp_path):
    (tmp_path / "coast.csv").write_text("time,lat,lon,mmsi\n1700000000,2,3,235070762\n")
    (tmp_path / "radar.parquet").write_bytes(b"PAR1" + bytes(90) + b"PAR1")
    files = [tmp_path / "coast.csv", tmp_path / "radar.parquet"]
    set_aside: dict[str, InputError] = {}
    [coast] = read_sources(files, set_aside=set_aside)
    assert coast.description.name == "coast" and list(set_aside) == ["radar"] and "radar" in str(set_aside["radar"])
    with pytest.raises(InputError, match="radar"):
        read_sources(files)
    with pytest.raises(InputError, match="radar"):
        read_sources(files[1:], set_aside={})


def delta(latitude, name="x", second=0):
    position = {"path": "navigation.position", "value": {"latitude": latitude, "longitude": -1.0}}
    update = {"timestamp": f"2024-05-01T12:00:{second:02d}Z", "values": [{"path": "name", "value": name}, position]}
    return {"context": "vessels.urn:mrn:imo:mmsi:235070762", "updates": [update]}


def snapshot(latitude, name="x", second=0):
    plane = {"hex": "4ca7a8", "lat": latitude, "lon": -1.0, "r": name, "flight": name, "t": name, "category": name}
    return {"now": 1.7e9 + second, "aircraft": [plane]}


def row(latitude, name="x", second=0):
    return {"time": 1.7e9 + second, "lat": latitude, "lon": -1.0, "mmsi": "235070762", "name": name}


LINES_OF_JSON = {"signalk": delta, "aircraft": snapshot, "table": row}
#: JSON nested beyond the stack, unclosed, nested to the limit, and integers beyond floats or the reader.
NOT_TO_BE_READ = {
    "deep list": "[" * 100_000 + "]" * 100_000, "deep object": '{"a":' * 100_000 + "1" + "}" * 100_000,
    "open": "[" * 100_000, "nearly too deep": "[" * 960 + "]" * 960, "beyond floats": "9" * 400, "digits": "9" * 5000,
}  # fmt: skip


@pytest.mark.parametrize("first", [True, False])
@pytest.mark.parametrize("text", NOT_TO_BE_READ.values(), ids=NOT_TO_BE_READ)
@pytest.mark.parametrize("kind", LINES_OF_JSON)
def test_unreadable_json_sets_one_line_aside(kind, text, first, tmp_path):
    made = LINES_OF_JSON[kind]
    good = [json.dumps(made(50.0)), json.dumps(made(51.0, second=20))]
    for hostile in (json.dumps(made("@")).replace('"@"', text), text):
        lines = [hostile, *good] if first else [good[0], hostile, good[1]]
        [found] = read(tmp_path, "a.json", "\n".join(lines) + "\n", format=kind)
        assert found.lat_deg.tolist() == [50.0, 51.0] and list(damage(found)) == [1 if first else 2]
        stream = ReportStream("wire", format=kind)
        stream.feed("".join(line + "\n" for line in lines).encode(), 1.7e9)
        [received] = stream.reports()
        assert received.lat_deg.tolist() == [50.0, 51.0] and sum(stream.damaged.values()) == 1


@pytest.mark.parametrize("depth", [1, 100, 800])
@pytest.mark.parametrize("kind", LINES_OF_JSON)
def test_a_name_that_is_no_text_is_missing(kind, depth, tmp_path):
    made = LINES_OF_JSON[kind]
    for opening, inside, closing in ("[", "", "]"), ('{"a":', "1", "}"):
        hostile = json.dumps(made(50.5, "@", 10)).replace('"@"', opening * depth + inside + closing * depth)
        lines = [json.dumps(made(50.0, None)), hostile, json.dumps(made(51.0, "x", 20))]
        [found] = read(tmp_path, "a.json", "\n".join(lines) + "\n", format=kind)
        assert found.lat_deg.tolist() == [50.0, 50.5, 51.0] and found.name.tolist() == [None, None, "x"]


def table(times, mmsi="235000001"):
    return "time,mmsi,lat,lon\n" + "".join(f"{t},{mmsi},{50.0 + 1e-5 * (t % 1000)},-1.0\n" for t in times)


@pytest.mark.parametrize("days", [30.0, -365.0, 1.0])
def test_a_wrong_date_is_one_damaged_line_and_does_not_stretch_the_picture(days, tmp_path):
    times = [1_714_560_000 + 5 * k for k in range(200)]
    wrong = [*times[:57], times[57] + int(86400 * days), *times[58:]]
    (tmp_path / "ais.csv").write_text(table(wrong))
    [source] = read_sources([tmp_path / "ais.csv"])
    assert damage(source.reports) == {59: "a time far from all others"} and len(source.reports) == 199
    assert np.ptp(source.reports.time_s) == 995.0


@pytest.mark.parametrize("times", [
    # Sessions on two days; satellites that see a ship now and then; a log that ends after a night's pause.
    [*range(0, 1000, 5), *range(86_400, 86_460, 5)], list(range(0, 5_000_000, 50_000)),
    [*range(0, 100_000, 500), 140_000],
])  # fmt: skip
def test_times_far_from_each_other_are_no_wrong_dates(times, tmp_path):
    (tmp_path / "ais.csv").write_text(table([1_714_560_000 + t for t in times]))
    [source] = read_sources([tmp_path / "ais.csv"])
    assert len(source.reports) == len(times) and damage(source.reports) == {}


def test_wrong_dates_here_and_there_are_damaged_lines_also_of_a_short_file(tmp_path):
    times = [1_714_560_000 + 5 * k for k in range(200)]
    wrong = [t - 365 * 86_400 if k % 50 == 7 else t for k, t in enumerate(times)]
    (tmp_path / "ais.csv").write_text(table(wrong))
    [source] = read_sources([tmp_path / "ais.csv"])
    assert damage(source.reports) == dict.fromkeys([9, 59, 109, 159], "a time far from all others")
    (tmp_path / "ais.csv").write_text(table([*times[:9], 0]))
    [source] = read_sources([tmp_path / "ais.csv"])
    assert damage(source.reports) == {11: "a time far from all others"}


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "utf-8-sig"])
def test_text_of_other_encodings_with_a_byte_order_mark_is_read(encoding, tmp_path):
    mark = "\ufeff" if encoding == "utf-16-be" else ""
    content = (
        mark + table(range(1_714_560_000, 1_714_560_100, 5)).replace("mmsi", "name").replace("235000001", "Ærø")
    ).encode(encoding)
    [found] = read(tmp_path, "a.csv", content)
    assert len(found) == 20 and set(found.name) == {"Ærø"}
    # A file that only begins like one is none.
    with pytest.raises(InputError, match="is binary"):
        read(tmp_path, "b.csv", b"\xff\xfe" + bytes(99))
