"""The errors of surveys by magnitude, of positions and proper motions, for tables that have left the errors out.

They are medians from the literature, 1σ an axis: right on the average of a magnitude, not star by star. Tables only.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from sameas.arrays import FloatArray


@dataclass(frozen=True)
class Survey:
    """One survey and its errors.

    title : as people call it. source : where the numbers are from. band : the magnitude that they go by.
    mag_mas : (magnitude, error in mas an axis), ascending; between them the logarithm goes straight, beyond them it
        stays. typical_mas : where no magnitude is known. mag_mas_per_yr, typical_mas_per_yr : of proper motions, the
        same; empty and None where the survey has none.
    conventions : titles of conventions whose tables are of this survey. epochs_jyr : (least, largest) of them, where a
        convention has several surveys. words : what texts of its tables say.
    """

    title: str
    source: str
    band: str
    mag_mas: tuple[tuple[float, float], ...]
    typical_mas: float
    conventions: tuple[str, ...] = ()
    epochs_jyr: tuple[float, float] = (-np.inf, np.inf)
    words: str = ""
    mag_mas_per_yr: tuple[tuple[float, float], ...] = ()
    typical_mas_per_yr: float | None = None

    def sigma_mas(self, magnitude: FloatArray | None, n: int) -> FloatArray:
        """(n,) standard deviation an axis, by magnitude where it is known.

        >>> SURVEYS[0].title, SURVEYS[0].sigma_mas(np.array([12.0, 20.0, np.nan]), 3).round(3).tolist()
        ('Gaia DR3', [0.015, 0.4, 0.1])
        """
        return _by_magnitude(self.mag_mas, self.typical_mas, magnitude, n)

    def pm_sigma_mas_per_yr(self, magnitude: FloatArray | None, n: int) -> FloatArray | None:
        """(n,) standard deviation of a proper motion along an axis, mas a year; None where the survey has no motions.

        >>> SURVEYS[0].pm_sigma_mas_per_yr(np.array([12.0, 20.0, np.nan]), 3).round(3).tolist()
        [0.02, 0.5, 0.12]
        """
        if self.typical_mas_per_yr is None:
            return None
        return _by_magnitude(self.mag_mas_per_yr, self.typical_mas_per_yr, magnitude, n)


def _by_magnitude(
    known: tuple[tuple[float, float], ...], typical: float, magnitude: FloatArray | None, n: int
) -> FloatArray:
    if magnitude is None or not known:
        return np.full(n, typical)
    mags, errors = np.array(known).T
    return np.where(np.isfinite(magnitude), np.exp(np.interp(magnitude, mags, np.log(errors))), typical)


_GAIA = ("Gaia archive", "Gaia at VizieR")
_MOTIONS_DR3 = ((15.0, 0.02), (17.0, 0.07), (20.0, 0.5), (21.0, 1.4))
_MOTIONS_DR2 = ((15.0, 0.06), (17.0, 0.2), (20.0, 1.2), (21.0, 3.0))
_DR3 = Survey(
    "Gaia DR3", "Gaia Collaboration 2021, A&A 649, A1", "G",
    ((15.0, 0.015), (17.0, 0.05), (20.0, 0.4), (21.0, 1.0)), 0.1,
    _GAIA, (2015.9, 2016.1), r"gaia[ _-]?e?dr3|\bI[/_]35[05]\b", _MOTIONS_DR3, 0.12,
)  # fmt: skip
#: The first one that fits is taken.
SURVEYS = (
    _DR3,
    Survey(
        "Gaia DR2", "Gaia Collaboration 2018, A&A 616, A1", "G",
        ((15.0, 0.03), (17.0, 0.1), (20.0, 0.7), (21.0, 2.0)), 0.2,
        _GAIA, (2015.4, 2015.6), r"gaia[ _-]?dr2|\bI[/_]345\b", _MOTIONS_DR2, 0.3,
    ),
    Survey(
        "Gaia DR1", "Gaia Collaboration 2016, A&A 595, A2", "G", ((21.0, 10.0),), 10.0,
        _GAIA, (2014.9, 2015.1), r"gaia[ _-]?dr1|\bI[/_]337\b",
    ),
    # Of a release that nothing tells, the last.
    replace(_DR3, epochs_jyr=(-np.inf, np.inf), words=""),
    Survey(
        "Hipparcos", "ESA 1997, SP-1200", "Hp", ((9.0, 0.7), (12.0, 1.6)), 0.8,
        ("Hipparcos (I/239)", "Hipparcos, the new reduction (I/311)"), words=r"\bI[/_](239|311)\b|hipparcos",
        mag_mas_per_yr=((9.0, 0.8), (12.0, 1.8)), typical_mas_per_yr=0.9,
    ),
    Survey(
        "Tycho-2", "Høg et al. 2000, A&A 355, L27", "VT", ((9.0, 7.0), (11.5, 60.0)), 60.0,
        ("Tycho-2 (I/259)",), words=r"tycho[ _-]?2|\bI[/_]259\b", typical_mas_per_yr=2.5,
    ),
    Survey(
        "2MASS", "Skrutskie et al. 2006, AJ 131, 1163: of order 100 mas; by J against Gaia DR2 in NGC 188", "J",
        ((8.5, 110.0), (9.5, 75.0), (15.0, 78.0), (15.75, 100.0), (16.25, 200.0), (16.75, 255.0)), 80.0,
        ("2MASS", "2MASS at VizieR (II/246)"), words=r"2MASS|\bII[/_]246\b",
    ),
    Survey(
        # 45 mas against UCAC and 20 to 30 mas common to a region, in quadrature; at r = 22 of photons alone.
        "SDSS", "Pier et al. 2003, AJ 125, 1559, abstract", "r", ((20.0, 51.0), (22.0, 103.0)), 60.0,
        ("SDSS",), words=r"\bSDSS\b|\bV[/_]147\b",
    ),
    Survey(
        # A median distance of 13.5 mas to Gaia is 11.5 mas an axis; 5 mas of the frame; the faint end is assumed.
        "Pan-STARRS1", "Lubow et al. 2021, AJ 161, 6, and Magnier et al. 2020, ApJS 251, 6, abstracts", "r",
        ((19.0, 12.5), (21.5, 60.0)), 30.0,
        ("Pan-STARRS1",), words=r"pan-?starrs|\bII[/_]349\b",
    ),
    Survey(
        # Assumed: the supplement's table was not at hand.
        "AllWISE", "assumed after Cutri et al. 2013, AllWISE Explanatory Supplement, II.5", "W1",
        ((13.0, 50.0), (17.0, 300.0)), 150.0,
        ("AllWISE", "AllWISE at VizieR (II/328)"), words=r"allwise|\bII[/_]328\b",
    ),
    Survey(
        # 15 to 20 mas from 10 to 14 mag, 15 to 100 mas and 1 to 10 mas a year over all; UCAC2 has 70 mas at 16 mag,
        # motions of 1 to 3 mas a year to 12 mag and of 4 to 7 to 16 mag.
        "UCAC4", "Zacharias et al. 2013, AJ 145, 44, and of UCAC2 2004, AJ 127, 3043, abstracts", "f",
        ((10.0, 15.0), (14.0, 20.0), (16.0, 70.0)), 40.0,
        words=r"\bUCAC4\b|\bI[/_]322", mag_mas_per_yr=((12.0, 2.0), (14.0, 4.0), (16.0, 7.0)), typical_mas_per_yr=4.0,
    ),
    Survey("USNO-B1.0", "Monet et al. 2003, AJ 125, 984", "R", ((21.0, 200.0),), 200.0, words=r"USNO-?B1|\bI[/_]284\b"),
)  # fmt: skip


def survey_of(convention: str, epoch_jyr: float | None, texts: list[str]) -> Survey | None:
    """The survey of a table, by the title of its convention and its epoch, or by its texts; None if not known."""
    for survey in SURVEYS:
        least, largest = survey.epochs_jyr
        dated = survey.epochs_jyr[0] == -np.inf or (epoch_jyr is not None and least < epoch_jyr < largest)
        if convention in survey.conventions and dated:
            return survey
    named = [s for s in SURVEYS if s.words and any(re.search(s.words, text, re.IGNORECASE) for text in texts)]
    return named[0] if len({survey.title for survey in named}) == 1 else None
