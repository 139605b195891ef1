"""Readers of sensor files: tables, AIS, radar targets of ships, ADS-B, Mode S and ASTERIX, read into Reports.

``read_reports`` detects the format from the content and returns one :class:`~sameas.tracks.reports.Reports` for each
sensor in the file, ``read_sources`` those of several files with the descriptions of the sensors. One module per
format; in all of them a damaged line is counted, with its number, and skipped.
"""

from sameas.io.sensors.format import ReadOptions, SensorFile, SensorFormat
from sameas.io.sensors.report_formats import REPORT_FORMATS, read_reports
from sameas.io.sensors.sources import read_source_options, read_sources

__all__ = [
    "REPORT_FORMATS",
    "ReadOptions",
    "SensorFile",
    "SensorFormat",
    "read_reports",
    "read_source_options",
    "read_sources",
]
