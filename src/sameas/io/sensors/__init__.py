"""Readers of sensor files: tables, AIS, radar targets of ships, ADS-B, Mode S and ASTERIX, read into Reports.

``read_reports`` detects the format from the content and returns one :class:`~sameas.tracks.reports.Reports` for each
sensor in the file. One module per format; in all of them a damaged line is counted, with its number, and skipped.
"""

from sameas.io.sensors.format import ReadOptions
from sameas.io.sensors.sources import REPORT_FORMATS, read_reports

__all__ = ["REPORT_FORMATS", "ReadOptions", "read_reports"]
