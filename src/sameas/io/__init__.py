"""Files: the tables that astronomers have, read and written; every output is whole or absent.

``read_table`` and ``write_table`` know FITS, VOTable, ECSV, CSV and Parquet by the name of the file;
``read_table`` also reads catalogues of SExtractor, tables of VizieR, IPAC and the CDS, and text separated by blanks,
recognized by their content. ``read_provenance`` tells how a file that we wrote was made. ``replacing`` makes any other
output (a picture, a page of HTML) whole or absent too. Nothing heavy is imported before a file is touched.
"""

from sameas.io.atomic import replacing
from sameas.io.tables import checksum, known_formats, read_provenance, read_table, write_table, written_formats

__all__ = ["checksum", "known_formats", "read_provenance", "read_table", "replacing", "write_table", "written_formats"]
