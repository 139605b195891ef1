"""What sensors write: tables, AIS, radar targets of ships, ADS-B, Mode S and ASTERIX, read into Reports.

``read_reports`` finds out the format from the content and returns one
:class:`~sameas.tracks.reports.Reports` for each sensor in the file. One module a format; each keeps the rule that a
damaged line is counted with its number and never ends the reading.
"""

from sameas.io.sensors.format import ReadOptions
from sameas.io.sensors.sources import REPORT_FORMATS, read_reports

__all__ = ["REPORT_FORMATS", "ReadOptions", "read_reports"]
