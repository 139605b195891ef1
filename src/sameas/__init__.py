"""sameas tells which records of two or more sources are the same real thing, and how sure it is."""

__version__ = "0.1.0"
