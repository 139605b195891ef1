"""Fuzz targets: a few small files of every format, mostly from the library's own writers, and their readers."""

from __future__ import annotations

import ast
import contextlib
import gzip
import io
import json
import os
import re
import select
import signal
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import outputs

TESTS = Path(__file__).parents[1]
DATA = TESTS / "tracks" / "data"


@dataclass(frozen=True)
class Target:
    """One format. ending : of its files. seeds : whole files. read : reads a path. inside : bytes to be changed, of a
    file, and outside : the file of changed bytes, with sums that fit again."""

    ending: str
    seeds: Callable[[], list[bytes]]
    read: Callable[[Path], object]
    inside: Callable[[bytes], bytes] = bytes
    outside: Callable[[bytes], bytes] = bytes


# How they are read: as the commands do, up to where a file has become records.


def table(path: Path) -> object:
    from sameas.io import read_provenance, read_table
    from sameas.sky.catalogue import Catalogue, CatalogueOptions

    read_provenance(path)
    return Catalogue.of(read_table(path), "t", options=CatalogueOptions(sigma=0.1))


def frame(path: Path) -> object:
    from sameas.sky.frame.image import read

    return read(path)


def compressed(path: Path) -> object:
    """A frame; a separate decoding process is kept, because starting Python takes longer than decoding."""
    from unittest import mock

    with mock.patch.object(subprocess, "run", DECODER.run):
        return frame(path)


class Decoder:
    """A forked process that decodes images one after another; it is replaced when an image kills it.

    Memory corrupted by one image may affect later ones: an image that kills a used decoder is read again by a new one,
    so that every outcome belongs to its image.
    """

    def __init__(self) -> None:
        self.process, self.read = 0, 0

    def run(self, command: list[str], **_: Any) -> subprocess.CompletedProcess[str]:
        """The result of ``subprocess.run`` for [Python, "-c", program, *arguments]."""
        while True:
            if not self.process:
                self._fork(command[2])
            self.read += 1
            answer = self._asked(command[3:])
            if answer is not None:
                if self.read >= DECODED:
                    self.end()
                return subprocess.CompletedProcess(command, answer[0], "", answer[1])
            alone, code = self.read == 1, self.end()
            if alone and code == -signal.SIGXCPU:
                raise AssertionError("the decoder hung")
            if alone:
                return subprocess.CompletedProcess(command, code, "", "")

    def _asked(self, arguments: list[str]) -> tuple[int, str] | None:
        try:
            self.requests.write(json.dumps(arguments) + "\n")
            self.requests.flush()
            # After memory corruption the process may wait for one of its locks for ever.
            is_ready = select.select([self.answers], [], [], DECODED_S)[0]
            if not is_ready:
                os.kill(self.process, signal.SIGXCPU)
            line = self.answers.readline()
        except BrokenPipeError:
            return None
        return tuple(json.loads(line)) if line.endswith("\n") else None

    def _fork(self, program: str) -> None:
        (request_in, request_out), (answer_in, answer_out) = os.pipe(), os.pipe()
        self.process, self.read = os.fork(), 0
        if self.process:
            for end in (request_in, answer_out):
                os.close(end)
            self.requests, self.answers = (
                os.fdopen(request_out, "w"),
                os.fdopen(answer_in, encoding="utf-8", errors="replace"),
            )
            return
        for end in (request_out, answer_in):
            os.close(end)
        code = 1
        try:
            _decode_all(compile(program, "decoder", "exec"), os.fdopen(request_in), answer_out)
            code = 0
        finally:
            os._exit(code)

    def end(self) -> int:
        """Close the pipe, on which the process ends, and return its exit code."""
        with contextlib.suppress(BrokenPipeError):
            self.requests.close()
        self.answers.close()
        code = os.waitstatus_to_exitcode(os.waitpid(self.process, 0)[1])
        self.process = 0
        return code


def _decode_all(program: Any, requests: Any, answer_out: int) -> None:
    """Run the program with the arguments of every line, within CPU and memory (1 GB) limits, and answer each."""
    import resource
    import time

    if os.path.exists("/proc/self/statm"):
        most = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize() + (1 << 30)
        resource.setrlimit(resource.RLIMIT_AS, (most, resource.RLIM_INFINITY))
    for line in requests:
        last_s = int(time.process_time()) + 11
        resource.setrlimit(resource.RLIMIT_CPU, (last_s, resource.RLIM_INFINITY))
        sys.argv = ["-c", *json.loads(line)]
        answer = (0, "")
        try:
            exec(program, {"__name__": "__main__"})
        except BaseException as error:
            answer = (1, f"{type(error).__name__}: {error}"[:4000])
        os.write(answer_out, (json.dumps(answer) + "\n").encode())


#: Images per decoder process, and wall-clock seconds per image.
DECODED, DECODED_S = 500, 20.0
DECODER = Decoder()


def sensor(path: Path) -> object:
    from sameas.io.sensors import ReadOptions, read_reports

    every = read_reports(path, ReadOptions(source="radar", start="2024-05-01"))
    for reports in every:
        assert np.isfinite(reports.time_s).all(), "a time that is not finite"
        assert not any(np.isinf(column).any() for column in reports.columns().values() if column.dtype.kind == "f")
        reports.summary(), reports.in_time_order().velocity_m_per_s()
    return every


def sensors_toml(path: Path) -> object:
    from sameas.io.sensors.sources import read_source_options

    return read_source_options(path)


def settings_toml(path: Path) -> object:
    """Read the settings of a watch and create its keeper, without opening inputs."""
    from sameas.live.keeper import Keeper
    from sameas.live.settings import read_settings

    keeper = Keeper(read_settings(path))
    keeper.close()
    return keeper.tick(1.7e9)


def report_toml(path: Path) -> object:
    from sameas.io.ades import Observer

    return Observer.read(path)


def coast(path: Path) -> object:
    from sameas.maps.geojson import read_coast

    return read_coast(path)


def chart(path: Path) -> object:
    from sameas.maps.tiles import open_chart

    opened = open_chart(path)
    return [opened.tile(z, x, y) for z in range(4) for x in range(1 << z) for y in range(1 << z)]


def elements(path: Path) -> object:
    from sameas.sky.movers.orbits import Elements

    return Elements.read(path)


# The files.


@cache
def stars() -> Any:
    from astropy.table import MaskedColumn, Table

    rng = np.random.default_rng(7)
    table = Table({
        "id": np.arange(12) + 4472832130942575872, "name": [f"s{k}" for k in range(12)],
        "ra": rng.uniform(10.0, 10.2, 12), "dec": rng.uniform(-0.1, 0.1, 12),
        "pmra": rng.normal(0.0, 9.0, 12), "pmdec": rng.normal(0.0, 9.0, 12), "sigma": np.full(12, 0.1),
        "mag": MaskedColumn(rng.uniform(9.0, 18.0, 12), mask=np.arange(12) == 3), "known": np.arange(12) % 2 == 0,
    })  # fmt: skip
    for name, unit in {"ra": "deg", "dec": "deg", "sigma": "arcsec", "pmra": "mas/yr", "pmdec": "mas/yr"}.items():
        table[name].unit = unit
    table.meta["EPOCH"] = 2016.0
    return table


def written(ending: str) -> Callable[[], list[bytes]]:
    """The stars as written by our writer of this extension."""

    def seeds() -> list[bytes]:
        from sameas.io import write_table

        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / f"t{ending}"
            write_table(stars(), path, provenance={"command": "sameas match a b"})
            return [path.read_bytes()]

    return seeds


def votables() -> list[bytes]:
    from astropy.io.votable import from_table

    kinds = []
    for kind in ("tabledata", "binary", "binary2"):
        out = io.BytesIO()
        from_table(stars()).to_xml(out, tabledata_format=kind)
        kinds.append(out.getvalue())
    return kinds


def texts(*names: str, mark: str = ";", instead: str = ";") -> Callable[[], list[bytes]]:
    """Texts of tests/io/test_io_text.py. mark : column separator there; instead : its replacement."""

    def seeds() -> list[bytes]:
        source = (TESTS / "io" / "test_io_text.py").read_text(encoding="utf-8")
        constants = {
            target.id: node.value
            for node in ast.parse(source).body
            if isinstance(node, ast.Assign) and isinstance(target := node.targets[0], ast.Name)
        }
        text = "".join(ast.literal_eval(constants[name]) for name in names)
        return [text.replace(mark, instead).replace(f"ra{instead}", f"ra{mark}").encode()]

    return seeds


def fits_bytes(*hdus: Any) -> bytes:
    from astropy.io import fits

    out = io.BytesIO()
    fits.HDUList(list(hdus)).writeto(out)
    return out.getvalue()


def frames(compression: str = "") -> Callable[[], list[bytes]]:
    def seeds() -> list[bytes]:
        from astropy.io import fits

        sky = np.random.default_rng(5).poisson(500.0, (40, 50)).astype(np.int16)
        header = fits.Header({
            "EXPTIME": 30.0, "DATE-OBS": "2019-03-04T05:06:07.8", "MJD-OBS": 58546.2, "GAIN": 1.5, "RDNOISE": 7.0,
            "OBJCTRA": "05 35 17", "OBJCTDEC": "-05 23 28", "LST": "10:11:12", "SITELAT": "+40 10 11",
            "SITELONG": "-70 01 02", "EQUINOX": 1950.0, "PEDESTAL": -100, "SATURATE": 60000.0, "BUNIT": "adu",
        })  # fmt: skip
        if compression:
            return [fits_bytes(fits.PrimaryHDU(), fits.CompImageHDU(sky, header, compression_type=compression))]
        quality = fits.ImageHDU((sky > 560).astype(np.int16), fits.Header({"MP_SAT": 1, "MP_CR": 3}), name="MASK")
        planes = fits_bytes(fits.PrimaryHDU(), fits.ImageHDU(sky, header, name="SCI"), quality,
                            fits.ImageHDU(np.sqrt(sky).astype("f4"), name="ERR"))  # fmt: skip
        return [fits_bytes(fits.PrimaryHDU(sky, header)), fits_bytes(fits.PrimaryHDU(sky.astype("f4"), header)), planes]

    return seeds


SENSOR_ROWS = [
    {"time": 1.7e9 + k, "mmsi": 235070762 + k % 3, "lat": 50.0 + 0.01 * k, "lon": -1.0, "sog": 5.0 + k, "cog": 9.0 * k,
     "sigma": 15.0, "name": f"ship {k % 3}"} for k in range(9)
]  # fmt: skip
POLAR_ROWS = [
    {"time": f"2024-05-01T12:00:0{k}Z", "track": k % 3, "range_nm": 2.5 + k, "bearing_deg": 33.0 * k, "alt_ft": 300}
    for k in range(9)
]


def sensor_csv() -> list[bytes]:
    every = []
    for rows, mark in ((SENSOR_ROWS, ","), (POLAR_ROWS, ";")):
        lines = [mark.join(rows[0]), *(mark.join(map(str, row.values())) for row in rows)]
        every.append(("\n".join(lines) + "\n").encode())
    day_first = b"# Timestamp,MMSI,Latitude,Longitude\n13/01/2024 12:00:00,1,50,1\n14/01/2024 12:00:09,2,50,1\n"
    return [*every, day_first]


def beast_frames() -> list[bytes]:
    """The messages of the sample, as a receiver with GPS sends them."""
    lines = (DATA / "mode_s_sample.csv").read_text().splitlines()
    bodies = [(n << 30).to_bytes(6) + b"@" + bytes.fromhex(line.split(",")[1]) for n, line in enumerate(lines)]
    return [b"".join(b"\x1a3" + body.replace(b"\x1a", b"\x1a\x1a") for body in bodies)]


def sensor_json() -> list[bytes]:
    lines = "".join(json.dumps(row) + "\n" for row in SENSOR_ROWS)
    return [lines.encode(), json.dumps([{"what": row} for row in SENSOR_ROWS]).encode()]


def sensor_parquet() -> list[bytes]:
    import pyarrow as pa
    from pyarrow import parquet

    every = []
    for rows in (SENSOR_ROWS, POLAR_ROWS):
        out = io.BytesIO()
        table = pa.Table.from_pylist(rows)
        if isinstance(rows[0]["time"], float):
            table = table.set_column(0, "time", table["time"].cast(pa.int64()).cast(pa.timestamp("s")))
        parquet.write_table(table, out)
        every.append(out.getvalue())
    return every


def aircraft() -> list[bytes]:
    planes = [
        {"hex": "4ca7a8", "flight": "EIN1 ", "lat": 50.1, "lon": -1.2, "seen_pos": 1.5, "gs": 430.5, "track": 93.1,
         "alt_baro": 35000, "alt_geom": 35525, "baro_rate": -64, "nac_p": 9, "nac_v": 2, "nic": 8, "rc": 186,
         "t": "A320", "squawk": "1234", "type": "adsb_icao"},
        {"hex": "~2a3b4c", "lat": 51.0, "lon": 1.0, "alt_baro": "ground"}, {"hex": "4ca7a9"},
    ]  # fmt: skip
    every = [{"now": 1.7e9 + k, "messages": 5, "aircraft": planes} for k in range(3)]
    return ["".join(json.dumps(one) + "\n" for one in every).encode(), json.dumps(every[0], indent=1).encode()]


def sbs() -> list[bytes]:
    day = "2024/05/01,12:00:{:02d}.000,2024/05/01,12:00:{:02d}.000"
    lines = []
    for k in range(6):
        begin = f"MSG,{{}},1,1,4CA7A{k % 2},1,{day.format(k, k)}"
        lines += [begin.format(3) + f",,35000,,,5{k}.1,-1.25,,,0,0,0,0", begin.format(1) + ",EIN1,,,,,,,,,,,",
                  begin.format(4) + ",,,430,93,,,-64,,,,,"]  # fmt: skip
    return ["\r\n".join([*lines, "STA,,1,1,4CA7A0,1", ""]).encode()]


def ships_log() -> list[bytes]:
    ais = (DATA / "ais_sample.nmea").read_bytes()
    bodies = ["GPZDA,120000,01,05,2024,00,00", "HEHDT,45.0,T", "GPRMC,120001,A,5000.0,N,00100.0,W,5,45,010524,,",
              "RATTM,01,2.5,13.6,T,7.0,20.0,T,,,N,one,T,,120002,A", "RATTM,02,2.5,13.6,R,7.0,20.0,R,,,K,,Q,R,120002,M",
              "RATLL,03,5000.0,N,00100.0,W,b,120003,T,", "PGHP,1,2024,5,1,12,0,4,0,219,,2,,1,5B",
              "AIVDM,1,1,,A,403OtVAv7=i@D?fuDF3pB1g00D0:,0"]  # fmt: skip
    log = "".join(f"{'!' if 'VDM' in body else '$'}{body}*00\n" for body in bodies)
    stamped = b"\\c:1452603731*00\\" + ais.splitlines()[-1]
    radar = "".join(line for line in log.splitlines(keepends=True) if "VDM" not in line)
    return [ais, summed(radar.encode()), summed(log.encode() + stamped + b"\n")]


def summed(content: bytes) -> bytes:
    """Sentences with checksums that fit, but for those that have four digits where two belong."""

    def fitting(line: re.Match[bytes]) -> bytes:
        total = 0
        for byte in line[1]:
            total ^= byte
        return line[0][:1] + line[1] + b"*%02X" % total

    return re.sub(rb"[!$]([^*\n]*)\*[0-9A-Fa-f]{0,2}(?![0-9A-Fa-f])", fitting, content)


def asterix() -> list[bytes]:
    blocks = [
        bytes.fromhex(case["block"]) for case in json.loads((DATA / "asterix_oracle.json").read_text())["records"]
    ]
    return [b"".join(blocks), *blocks[:6]]


def asterix_pcap() -> list[bytes]:
    out = [struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, 1)]
    for k, payload in enumerate(asterix()[1:]):
        udp = struct.pack(">HHHH", 8600, 8600, 8 + len(payload), 0) + payload
        ip = struct.pack(">BBHHHBBH8x", 0x45, 0, 20 + len(udp), 0, 0, 64, 17, 0) + udp
        packet = bytes(12) + b"\x08\0" + ip
        out.append(struct.pack("<IIII", 1714564800 + k, 0, len(packet), len(packet)) + packet)
    return [b"".join(out)]


SENSORS_TOML = b"""\
[sources.radar]
kind = "marine radar"
site = { lat_deg = 50.0, lon_deg = -1.0, height_m = 20.0 }
file = { path = "plots.csv", start = "2024-05-01", columns = { range_m = "d" }, units = { d = "km" } }
errors = { range_m = 25.0, bearing_deg = 0.5 }
motion = { speed_m_per_s = 8.0, stationary_share = 0.2, stationary_m_per_s = 0.1 }
[sources.ais]
kind = "ais"
file = "log.nmea"
"""
REPORT_TOML = b"""\
observers = { name = ["J. Doe"] }
comment = { line = ["clear"] }
[observatory]
mpcCode = "810"
[submitter]
name = "J. Doe"
[telescope]
design = "Schmidt-Cassegrain"
aperture = "0.36"
detector = "CCD"
[report]
astCat = "Gaia3"
band = "G"
"""


def coasts() -> list[bytes]:
    ring = [[-1.0, 50.0], [-1.1, 50.0], [-1.1, 50.2], [-1.0, 50.0]]
    features = [
        {"type": "Feature", "properties": {}, "geometry": {"type": "Polygon", "coordinates": [ring]}},
        {"type": "Feature", "properties": {}, "geometry": {"type": "MultiLineString", "coordinates": [ring[:2]]}},
    ]
    return [json.dumps({"type": "FeatureCollection", "features": features}).encode()]


def tiles_sqlite() -> list[bytes]:
    import sqlite3

    with tempfile.TemporaryDirectory() as folder:
        base = sqlite3.connect(Path(folder) / "tiles.mbtiles")
        base.execute("CREATE TABLE metadata (name TEXT, value TEXT)")
        base.execute("CREATE TABLE tiles (zoom_level INT, tile_column INT, tile_row INT, tile_data BLOB)")
        base.execute("INSERT INTO metadata VALUES ('format', 'jpg'), ('bounds', '-2,50,-1,51')")
        rows = [(z, x, 0, b"\xff\xd8\xff" + bytes(9)) for z in range(3) for x in range(1 << z)]
        base.executemany("INSERT INTO tiles VALUES (?, ?, ?, ?)", rows)
        base.commit()
        base.close()
        return [(Path(folder) / "tiles.mbtiles").read_bytes()]


def recordings() -> list[bytes]:
    from sameas.io.sensors.recording import RecordedInput, RecordedSource, Recorder

    every = []
    for seed, format_name in ((ships_log()[0], "nmea"), (asterix()[0], "asterix"), (sensor_json()[0], None)):
        sources = (RecordedSource("ais", "ais"), RecordedSource("all", "tracks"))
        with tempfile.TemporaryDirectory() as folder:
            recorder = Recorder(Path(folder), RecordedInput(sources, format_name))
            cuts = range(0, len(seed), max(len(seed) // 5, 1))
            recorder.write([(1.7e9 + k, seed[a : a + cuts.step], k % 2, False) for k, a in enumerate(cuts)])
            recorder.close()
            every.append(next(Path(folder).iterdir()).read_bytes())
    return every


ORBITS = b"""\
00001    3.34  0.15 K2555 188.70269   73.27343   80.25221   10.58780  0.0794013  0.21424651   2.7660512  0 E2024-V47  7330 125 1801-2024 0.80 M-v 30k MPCLINUX   4000      (1) Ceres              20241101
00433   10.40  0.15 K2555 310.55432  178.92978  304.27009   10.82847  0.2228359  0.55977529   1.4581207  0 E2024-V47  9999  59 1893-2024 0.50 M-v 3Ek MPCLINUX   1804    (433) Eros               20241101
"""  # noqa: E501


WATCH_TOML = b"""\
[watch]
every_s = 1.0
plane = { lat_deg = 50.0, lon_deg = -1.0 }
own_ship = { lat_deg = 50.0, lon_deg = -1.0, mmsi = "235070762" }
outputs = [ { url = "udp://127.0.0.1:1", format = "nmea" } ]
chart = "coast.geojson"
[sources.radar]
kind = "marine radar"
site = { lat_deg = 50.0, lon_deg = -1.0, height_m = 20.0 }
input = { url = "udp://127.0.0.1:5000", format = "nmea", columns = { range_m = "d" }, units = { d = "km" } }
errors = { range_m = 25.0, bearing_deg = 0.5 }
[sources.ais]
kind = "ais"
input = "tcp://127.0.0.1:5001"
[sources.boat]
kind = "ais"
input = { url = "ws://127.0.0.1:3000", username = "mate", password = { env = "HOME" } }
"""


def signal_k() -> list[bytes]:
    def delta(context: str, k: int, **values: object) -> str:
        each = [{"path": path.replace("_", "."), "value": value} for path, value in values.items()]
        return json.dumps({"context": context, "updates": [{"timestamp": f"2024-05-01T12:00:0{k}Z", "values": each}]})

    place = {"latitude": 50.0, "longitude": -1.0}
    lines = [json.dumps({"self": "vessels.urn:mrn:imo:mmsi:235070762", "version": "1.7.0", "roles": ["main"]})]
    for k in range(5):
        lines += [delta("vessels.self", k, navigation_position=place, navigation_headingTrue=0.5, name="own"),
                  delta("vessels.urn:mrn:imo:mmsi:235070763", k, navigation_position=place | {"latitude": 50.1},
                        navigation_speedOverGround=5.0, navigation_courseOverGroundTrue=1.5),
                  delta("vessels.self", k, **{"radars_main_targets_4": {
                      "position": {"distance": 900.0, "bearing": 1.0, "latitude": 50.01, "longitude": -1.01},
                      "motion": {"course": 1.0, "speed": 4.0}, "status": "tracking"}})]  # fmt: skip
    return ["".join(line + "\n" for line in lines).encode()]


def small_bodies() -> list[bytes]:
    """Responses of JPL's small-body database: to a query, and for one object with its covariance."""
    fields = ["full_name", "epoch_mjd", "e", "q", "i", "om", "w", "a", "ma", "tp", "H", "G", "condition_code"]
    row = ["1 Ceres (A801 AA)", "61200", ".0796", "2.5455", "10.588", "80.25", "73.3", "2.7656", "231.5", "2461599.9",
           "3.35", "0.12", "0"]  # fmt: skip
    names = {"e": ".2228", "q": "1.1334", "tp": "2460445.66", "node": "304.27", "peri": "178.93", "i": "10.828"}
    elements = [{"name": name, "value": value, "sigma": "1e-9"} for name, value in names.items()]
    covariance = {"epoch": "2459800.5", "labels": [*names, "A2"], "elements": elements,
                  "data": (np.eye(7) * 1e-16).tolist()}  # fmt: skip
    orbit = {"epoch": "2461200.5", "elements": elements, "covariance": covariance, "condition_code": "0"}
    object_ = {"object": {"fullname": "433 Eros (A898 PA)"}, "orbit": orbit,
               "phys_par": [{"name": "H", "value": "10.4"}, {"name": "G", "value": ".46"}]}  # fmt: skip
    return [json.dumps({"fields": fields, "data": [row, row]}).encode(), json.dumps(object_).encode(),
            json.dumps([object_] * 2).encode()]  # fmt: skip


def packed(seeds: Callable[[], list[bytes]]) -> Callable[[], list[bytes]]:
    return lambda: [gzip.compress(seed, mtime=0) for seed in seeds()]


def _packed_again(content: bytes) -> bytes:
    return gzip.compress(content, compresslevel=1, mtime=0)


TARGETS: Mapping[str, Target] = {
    "fits": Target(".fits", written(".fits"), table),
    "fits.gz": Target(".fits.gz", written(".fits.gz"), table, gzip.decompress, _packed_again),
    "votable": Target(".vot", votables, table),
    "ecsv": Target(".ecsv", written(".ecsv"), table),
    "parquet": Target(".parquet", written(".parquet"), table),
    "csv": Target(".csv", written(".csv"), table),
    "csv.gz": Target(".csv.gz", packed(written(".csv")), table),
    "sextractor": Target(".cat", texts("SEXTRACTOR"), table),
    "vizier": Target(".tsv", texts("VIZIER", instead="\t"), table),
    "ipac": Target(".tbl", texts("IPAC"), table),
    "mrt": Target(".mrt", texts("MRT", "MRT_ROWS"), table),
    "ascii": Target(".dat", texts("BLANKS"), table),
    "frame": Target(".fits", frames(), frame),
    "frame.fz": Target(".fits.fz", lambda: [seed for kind in ("RICE_1", "GZIP_1", "PLIO_1")
                                            for seed in frames(kind)()], compressed),
    "frame hcompress": Target(".fits.fz", frames("HCOMPRESS_1"), compressed),
    "frame.gz": Target(".fits.gz", packed(frames()), frame, gzip.decompress, _packed_again),
    "sensor csv": Target(".csv", sensor_csv, sensor),
    "sensor json": Target(".jsonl", sensor_json, sensor),
    "sensor parquet": Target(".parquet", sensor_parquet, sensor),
    "ship's log": Target(".nmea", ships_log, sensor, outside=summed),
    "aircraft.json": Target(".json", aircraft, sensor),
    "sbs": Target(".sbs", sbs, sensor),
    "mode s": Target(".csv", lambda: [(DATA / "mode_s_sample.csv").read_bytes()], sensor),
    "mode s beast": Target(".bin", beast_frames, sensor),
    "asterix": Target(".ast", asterix, sensor),
    "asterix pcap": Target(".pcap", asterix_pcap, sensor),
    "sensors.toml": Target(".toml", lambda: [SENSORS_TOML], sensors_toml),
    "report.toml": Target(".toml", lambda: [REPORT_TOML], report_toml),
    "coast": Target(".geojson", coasts, coast),
    "pmtiles": Target(".pmtiles", lambda: [(TESTS / "data" / "tiles.pmtiles").read_bytes()], chart),
    "mbtiles": Target(".mbtiles", tiles_sqlite, chart),
    "recording": Target(".jsonl", recordings, sensor),
    "orbits": Target(".txt", lambda: [ORBITS], elements),
    "orbits json": Target(".json", small_bodies, elements),
    "signal k": Target(".jsonl", signal_k, sensor),
    "watch.toml": Target(".toml", lambda: [WATCH_TOML], settings_toml),
    "output": Target(".ecsv", outputs.SEEDS["table"], outputs.explain_table),
    "output fits": Target(".fits", outputs.SEEDS["fits"], outputs.explain_table),
    "provenance": Target(".txt", outputs.SEEDS["provenance"], outputs.explain_with_provenance),
    "picture": Target(".csv", outputs.SEEDS["picture"], outputs.explain_picture),
    "state": Target(".pickle", outputs.SEEDS["state"], outputs.continue_watch),
    "journal": Target(".sqlite", outputs.SEEDS["journal"], outputs.continue_watch),
    "partitions": Target(".part", outputs.SEEDS["partitions"], outputs.finish_partitions),
}  # fmt: skip


@dataclass
class Corpus:
    """The seeds of the targets, created on first use and unpacked for mutation."""

    unpacked: dict[str, list[bytes]] = field(default_factory=dict)

    def seeds(self, name: str) -> list[bytes]:
        """The seeds of a target, unpacked."""
        if name not in self.unpacked:
            self.unpacked[name] = [TARGETS[name].inside(seed) for seed in TARGETS[name].seeds()]
        return self.unpacked[name]
