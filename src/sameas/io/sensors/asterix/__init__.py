"""ASTERIX: the binary records of radars, trackers and ADS-B ground stations (EUROCONTROL-SPEC-0149).

``blocks`` takes files and network captures apart into blocks of one category; ``layout`` knows how long every item of
a category is; ``records`` walks through them; ``cat021``, ``cat048`` and ``cat062`` say what the items mean.
"""

from sameas.io.sensors.asterix.reading import FORMAT, read

__all__ = ["FORMAT", "read"]
