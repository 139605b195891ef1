"""The types of joins of two catalogues, by the names of STILTS; the first is taken where none is named."""

JOINS = ("all1", "1and2", "all2", "1or2", "1not2", "2not1", "1xor2", "pairs")
