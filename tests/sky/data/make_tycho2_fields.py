"""Writes tycho2_fields.csv: the stars of Tycho-2 (Høg et al. 2000) on the frames of ``test_real_field.py``.

Needs ``apt-get install astrometry-data-tycho2-07-littleendian``; run it in the project's folder.
"""

from pathlib import Path

import numpy as np
from astropy.table import vstack
from examples.three_catalogues import INDEX, tycho_table

#: Middle of a field, RA and Dec, and how far it reaches, degrees.
FIELDS = ((31.31, 46.77, 0.6), (266.40, -28.93, 0.55))

stars = tycho_table(INDEX)
parts = []
for ra, dec, reach in FIELDS:
    across = ((stars["ra"] - ra + 180.0) % 360.0 - 180.0) * np.cos(np.radians(dec))
    parts.append(stars[(np.abs(across) < reach) & (np.abs(stars["dec"] - dec) < reach)])
table = vstack(parts)
for name, form in (("ra", ".6f"), ("dec", ".6f"), ("VT", ".2f"), ("sigma", ".3f")):
    table[name].format = form
table.write(Path(__file__).with_name("tycho2_fields.csv"), overwrite=True)
