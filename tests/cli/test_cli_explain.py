"""`sameas explain`: from the contents of an output, or by repeating the match from its provenance."""

import shutil

import pytest
from fields import field, save


@pytest.fixture
def matched(tmp_path, sameas, field_files):
    inputs = [shutil.copy(path, tmp_path) for path in field_files]
    out = tmp_path / "out.vot"
    sameas("match", *inputs, "-o", out, "--id", "name", "-q")
    return out


@pytest.mark.slow
def test_a_record_is_explained_in_terms_of_the_sky(sameas, matched):
    text = sameas("explain", matched, "s7").stdout
    assert text.startswith("first s7 (row 7) is second s7, probability 1 − ")
    assert "arcsec" in text and "mag" in text and "no partner" in text
    assert sameas("explain", matched, "s7", "--source", "2").stdout.startswith("second s7 (row 7) is first s7")
    assert "first s110 (row 110) has no partner" in sameas("explain", matched, "s110").stdout


@pytest.mark.slow
def test_unknown_records_and_changed_or_missing_inputs_are_refused(tmp_path, refusal, matched, field_files):
    assert "first has no record with the id x; its first ids are" in refusal("explain", matched, "x")
    assert "has no provenance" in refusal("explain", field_files[0], "s1")
    save(field(99, 3), tmp_path / "second.fits")
    words = refusal("explain", matched, "s7", "--again")
    assert "second.fits, which has changed since" in words
    (tmp_path / "second.fits").unlink()
    assert "second.fits, which no longer exists" in refusal("explain", matched, "s7", "--again")


def test_a_record_is_explained_after_the_inputs_were_moved(tmp_path, sameas, refusal, matched):
    for name in ("first.fits", "second.fits"):
        (tmp_path / name).unlink()
    text = sameas("explain", matched, "s7").stdout
    assert text.startswith("first s7 is second s7, probability 1 − ") and "From the table alone" in text
    assert "no partner" in text and "mag_1" in text
    assert sameas("explain", matched, "7", "--row").stdout == text
    assert "first has no record with the id x in the output" in refusal("explain", matched, "x")
    assert "first s110 has no partner, probability" in sameas("explain", matched, "s110").stdout


@pytest.mark.slow
def test_an_id_of_the_other_catalogue_is_pointed_out(tmp_path, sameas, refusal, field_files):
    table = field(100, 3)
    table["name"] = [f"t{k}" for k in range(100)]
    second = save(table, tmp_path / "other.fits")
    sameas("match", field_files[0], second, "-o", tmp_path / "o.fits", "--id", "name", "-q")
    assert refusal("explain", tmp_path / "o.fits", "t5") == "t5 is a record of other; give --source 2"
