"""Crossmatch of two HATS catalogues larger than memory: one-to-one, with probabilities, partition by partition.

Two :class:`~sameas.partitions.hats.HatsCatalogue` → counts of every partition, summed → a sample of cells, from which
everything is estimated once (``estimated.py``) → for every cell of the output, its records and a halo are identified
(``part.py``) → a HATS catalogue with a margin (``hats.py``). ``run.py`` decides the parts in parallel processes
(``workers.py``) and resumes an interrupted run.

- *Owner.* A pair belongs to the cell of its first record's stored position; a record of the second catalogue without
  partner to the cell of its own. Every record of the first catalogue is in one cell, so no row is written twice, and no
  record is claimed twice where both parts decide alike.
- *Halo.* A record's answer depends on the group that competes for it: only pairs of positive log odds can be
  chosen. If no such group comes within a gate of the halo's edge, a wider halo changes nothing. Otherwise the doubtful
  cells are decided again with twice the halo, until none is doubtful or the halo has its largest width.
- *Far.* Few records have a large motion since their catalogue's epoch, or large errors; every part reads those that may
  reach it, wherever they are stored.
"""
