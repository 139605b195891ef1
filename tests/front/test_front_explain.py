"""`sameas.explain`: explanations from the contents of an output."""

import numpy as np
import pytest

import sameas
from sameas import InputError
from sameas.io import read_provenance, write_table


@pytest.fixture(scope="module")
def crowded():
    """Two surveys in which records compete, with names."""
    rng = np.random.default_rng(8)
    place = rng.uniform(0.0, 60.0 / 3600.0, (60, 2))
    first = {"ra": 10.0 + place[:, 0], "dec": place[:, 1], "name": [f"a{k}" for k in range(60)]}
    scatter = 1.0 / 3600.0 * rng.standard_normal((45, 2))
    second = {"ra": 10.0 + place[:45, 0] + scatter[:, 0], "dec": place[:45, 1] + scatter[:, 1],
              "name": [f"b{k}" for k in range(45)]}  # fmt: skip
    return first, second


@pytest.fixture(scope="module")
def match(crowded):
    return sameas.match(*crowded, sigma1=0.7, sigma2=0.7, id="name")


@pytest.mark.slow
@pytest.mark.parametrize("ending", ["fits", "vot", "ecsv", "csv", "parquet"])
def test_a_match_in_memory_is_explained_from_its_file(match, tmp_path, ending):
    path = tmp_path / f"out.{ending}"
    match.write(path)
    for row in range(60):
        text, answers = str(sameas.explain(path, f"a{row}")), match.identification.answers_1
        partner = answers.partner[row]
        if partner is np.ma.masked:
            assert text.startswith(f"first a{row} has no partner")
        else:
            assert text.startswith(f"first a{row} is second b{partner}, probability ")
        if answers.second[row] is not np.ma.masked:
            assert f"b{answers.second[row]}" in text
    assert str(sameas.explain(path, row=5)) == str(sameas.explain(path, "a5"))


@pytest.mark.slow
def test_a_record_of_the_second_catalogue_is_explained(match, tmp_path):
    path = tmp_path / "out.fits"
    match.write(path, "1or2")
    text = str(sameas.explain(path, "b3", source=2))
    assert text.startswith("second b3 ") and text == str(sameas.explain(path, "b3", source="second"))
    with pytest.raises(InputError, match="b3 is a record of second; give source=2"):
        sameas.explain(path, "b3")
    with pytest.raises(InputError, match="it has no source 3; give one of first, second"):
        sameas.explain(path, "b3", source=3)


def test_every_candidate_is_listed_if_the_table_has_them(match, tmp_path):
    path = tmp_path / "pairs.fits"
    match.write(path, "pairs")
    row = int(np.argmax(match.identification.answers_1.candidates.filled(0)))
    text = str(sameas.explain(path, f"a{row}"))
    names = {f"b{j}" for i, j in zip(match.identification.rows_1, match.identification.rows_2, strict=True) if i == row}
    assert len(names) > 2 and all(name in text for name in names) and "no partner" in text


@pytest.mark.slow
def test_records_without_ids_are_named_by_row(crowded, tmp_path):
    first, second = ({name: one[name] for name in ("ra", "dec")} for one in crowded)
    found = sameas.match(first, second, sigma=0.7)
    path = tmp_path / "out.fits"
    found.write(path)
    partner = found.identification.answers_1.partner
    text = str(sameas.explain(path, 3))
    assert ("has no partner" in text) == (partner[3] is np.ma.masked)
    with pytest.raises(InputError, match="because the output does not hold all its rows in their order"):
        sameas.explain(path, 3, source=2)


@pytest.mark.parametrize("join", ["all1", "1or2", "all2"])
def test_rows_are_counted_with_rows_that_lack_a_position_or_share_one(join, tmp_path):
    """One row without a position, or two of the same, and every row was refused: the catalogue had no ids, it said."""
    ra = np.array([np.nan, 10.0, 10.1, 10.1, 10.2])
    first = {"ra": ra, "dec": np.full(5, 1.0), "name": np.array([f"a{k}" for k in range(5)])}
    second = {"ra": ra[[4, 2, 0]], "dec": np.full(3, 1.0), "name": np.array([f"b{k}" for k in range(3)])}
    source, names = (2, "b") if join == "all2" else (1, "a")
    for id_column in ("name", None):
        sides = [{key: side[key] for key in ("ra", "dec", id_column) if key} for side in (first, second)]
        found = sameas.match(*sides, sigma=0.3, sigma_unit="arcsec", id=id_column)
        path = tmp_path / f"{id_column}.fits"
        found.write(path, join)
        for row in range(len(second["ra"] if source == 2 else ra)):
            text = str(sameas.explain(path, row=row, source=source))
            at = (second["ra"] if source == 2 else ra)[row]
            assert (f"{names}{row}" if id_column else f"at {at:.6f}" if at > 0 else "without a position") in text
    sexagesimal = {"ra": ["00:40:00.0", "00:41:00.0"], "dec": ["+01:00:00", "+01:00:00"]}
    sameas.match(sexagesimal, second, sigma=0.3, sigma_unit="arcsec").write(tmp_path / "text.fits", "all1")
    assert "at 00:41:00.0 +01:00:00" in str(sameas.explain(tmp_path / "text.fits", row=1))
    # Its id finds a record without a position, which is in the output.
    missing = "b2" if source == 2 else "a0"
    assert "could not be used" in str(sameas.explain(tmp_path / "name.fits", missing, source=source))
    with pytest.raises(InputError, match="rows cannot be counted"):
        sameas.explain(tmp_path / "name.fits", row=1, source=3 - source)


@pytest.mark.slow
def test_objects_of_several_catalogues_are_explained(crowded, tmp_path):
    first, second = crowded
    found = sameas.match_many(first, second, first | {"name": [f"c{k}" for k in range(60)]}, sigma=0.7, id="name")
    path = tmp_path / "objects.fits"
    found.write(path)
    for row in (0, 7, 50):
        text = str(sameas.explain(path, f"a{row}"))
        number = int(found.objects.of("first").object[row])
        members = found.objects.members[number]
        for word, member in zip("abc", members, strict=True):
            assert member is np.ma.masked or f"{word}{member}" in text
    assert str(sameas.explain(path, "b3", source=2)) == str(sameas.explain(path, row=3, source="second"))
    assert "offset_1" not in read_provenance(path)


def test_outputs_that_cannot_be_explained_are_refused(crowded, match, tmp_path):
    from astropy.table import Table

    write_table(Table({"a": [1]}), tmp_path / "other.fits", provenance={})
    match.write(tmp_path / "out.fits")
    for words, arguments in (
        ("has no provenance", ("other.fits", 1)),
        ("give the id of a record, or row=", ("out.fits",)),
        ("first has no record with the id zz in the output; its first ids are a0, a1, a2", ("out.fits", "zz")),
    ):
        with pytest.raises(InputError, match=words):
            sameas.explain(tmp_path / arguments[0], *arguments[1:])
    with pytest.raises(InputError, match=r"was made from .* in memory, which no longer exists"):
        sameas.explain(tmp_path / "out.fits", "a1", again=True)
