"""Catalogues that outgrow one machine: one-to-one, with probabilities, over the partitions of two HATS catalogues.

Data passes: two :class:`~sameas.partitions.layout.HatsCatalogue` → counts of every partition, added up → a sample of
cells, from which everything is estimated once → for every cell of the output its records with a halo, decided
(``part.py``) → a HATS catalogue with its margin (``output.py``). ``run.py`` has the parts worked on side by side, and
goes on where an earlier run ended.

- *Owner.* A pair belongs to the cell that holds its first record's position as its catalogue has it; a record of the
  second catalogue without a partner to that which holds its own. Every record of the first lies in one cell, so nothing
  is written twice, and no record is claimed twice where both claims would be decided alike.
- *Certain.* A record's answer depends on the group that can compete for it: pairs of positive log odds are the only
  ones that can be chosen (METHOD 11.5). Where no such group comes within a gate of where the halo ends, a wider halo
  changes nothing; else the part is decided again with twice the halo, until it is so.
- *Far.* Records that have moved far since their catalogue's epoch, or whose errors reach far, are few; every part gets
  those that reach into it, wherever they are stored.
"""
