"""Files: reading and writing of tables in astronomical formats; outputs are written atomically.

``read_table`` and ``write_table`` support FITS, VOTable, ECSV, CSV and Parquet, chosen by the file name;
``read_table`` also reads catalogues of SExtractor and DAOPHOT, tables of VizieR, IPAC and the CDS, and text separated
by blanks, recognized by their content. ``read_provenance`` returns how a file of ours was made. ``replacing`` writes
any other output (an image, an HTML page) atomically. Heavy libraries are imported only when a file is read or written.
"""

from sameas.io.atomic import replacing
from sameas.io.tables import checksum, known_formats, read_provenance, read_table, write_table, written_formats

__all__ = ["checksum", "known_formats", "read_provenance", "read_table", "replacing", "write_table", "written_formats"]
