"""Small hostile files cost neither memory nor time: sizes they claim are checked first."""

import gzip

import numpy as np
import pytest
from astropy.io import fits
from astropy.table import Table

from sameas.bounds import Headers, Unpacking, checked_fits, memory_left, unpacked
from sameas.errors import InputError
from sameas.io import read_table, write_table
from sameas.sky.frame.image import read as read_frame

SKY = np.random.default_rng(5).poisson(500.0, (40, 50)).astype(np.int16)


def table(folder, **changes):
    """Path of a table of three rows, to be edited."""
    path = folder / "t.fits"
    write_table(Table({"x": [1.0, 2.0, 3.0]}), path, provenance={})
    return edited(path, 1, **changes)


def edited(path, number, **changes):
    """The same file with cards of one header changed in place."""
    with fits.open(path) as hdus:
        begin, end = hdus[number].fileinfo()["hdrLoc"], hdus[number].fileinfo()["datLoc"]
    content = bytearray(path.read_bytes())
    for name, value in changes.items():
        at = content.index(f"{name:8}=".encode(), begin, end)
        content[at : at + 80] = f"{name:8}= {value:>20}".ljust(80).encode()
    path.write_bytes(content)
    return path


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"TFIELDS": 999999999}, "says TFIELDS = 999999999, not 0 to 999"),
        ({"NAXIS": 500000000}, "says NAXIS = 500000000, not 0 to 999"),
        ({"NAXIS2": -3}, "says NAXIS2 = -3"),
        ({"PCOUNT": -8}, "says PCOUNT = -8"),
        ({"TFORM1": "'99999999D'"}, "says columns of 799999992 bytes in rows of 8"),
        ({"NAXIS1": 0, "NAXIS2": 2000000000}, "says 2000000000 rows without a byte"),
        ({"NAXIS2": "'1PB(99999999)'"}, "has no whole number in NAXIS2"),
        ({"NAXIS": "2.5"}, "has no whole number in NAXIS"),
    ],
)
def test_impossible_headers_are_refused_before_a_library_uses_them(changes, words, tmp_path):
    path = table(tmp_path, **changes)
    for read in (read_table, read_frame):
        with pytest.raises(InputError, match=f"t.fits.* the header of extension 1 {words}.*; .*copy it again"):
            read(path)
    packed = tmp_path / "t.fits.gz"
    packed.write_bytes(gzip.compress(path.read_bytes()))
    with pytest.raises(InputError, match=words):
        read_table(packed)


def test_a_header_without_an_end_is_refused(tmp_path):
    path = table(tmp_path)
    path.write_bytes(path.read_bytes()[:2880] + b"XTENSION= 'BINTABLE'".ljust(80) + b"COMMENT ".ljust(80) * 200)
    with pytest.raises(InputError, match="the header of extension 1 has no END; it is damaged or cut off"):
        read_table(path)
    path.write_bytes(b"SIMPLE  =                    T".ljust(80) + b"COMMENT ".ljust(80) * 2880)
    with pytest.raises(InputError, match="extension 0 has no END"):
        checked_fits(path, Headers(cards=360))


def test_a_compressed_image_with_an_impossible_ratio_is_refused(tmp_path):
    path = tmp_path / "c.fits"
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(SKY, compression_type="RICE_1")]).writeto(path)
    assert read_frame(path).shape == SKY.shape
    with pytest.raises(InputError, match="says a compressed image of 100000 × 900000 pixels, in a file of"):
        read_frame(edited(path, 1, ZNAXIS1=100000, ZNAXIS2=900000))


@pytest.mark.parametrize("name", ["ZGCOUNT", "ZTILE1"])
def test_text_in_place_of_a_count_in_a_compressed_image_is_refused(name, tmp_path):
    path = tmp_path / "c.fits"
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(SKY, compression_type="RICE_1")]).writeto(path)
    with pytest.raises(InputError, match=f"the header of extension 1 has no whole number in {name}"):
        read_frame(edited(path, 1, **{"ZPCOUNT": 9999999, name: "'x'"}))


@pytest.mark.parametrize("form", ["'9Z'", "3", "'x'"])
def test_a_compressed_image_whose_column_has_no_format_is_refused(form, tmp_path):
    path = tmp_path / "c.fits"
    fits.HDUList([fits.PrimaryHDU(), fits.CompImageHDU(SKY, compression_type="RICE_1")]).writeto(path)
    with pytest.raises(InputError, match=r"c\.fits: the file cannot be read as FITS"):
        read_frame(edited(path, 1, TFORM1=form))


@pytest.mark.parametrize("value", ["'x'", "T", "(1,2)", "1e999", "''", "58546", "'9999-99-99'"])
def test_an_invalid_date_is_no_internal_error(value, tmp_path):
    path = tmp_path / "f.fits"
    fits.PrimaryHDU(SKY, fits.Header({"DATE-OBS": "2019-03-04T05:06:07", "MJD-OBS": 1.0, "EXPTIME": 9.0})).writeto(path)
    frame = read_frame(edited(path, 0, **{"DATE-OBS": value, "MJD-OBS": value, "EXPTIME": value}))
    assert frame.shape == SKY.shape


def test_valid_files_pass(tmp_path):
    path = tmp_path / "many.fits"
    images = [fits.ImageHDU(SKY, name=f"I{k}") for k in range(3)]
    groups = fits.GroupsHDU(fits.GroupData(np.ones((4, 3, 2)), bitpix=-32, parnames=["A"], pardata=[np.ones(4)]))
    fits.HDUList([groups, *images]).writeto(path)
    path.write_bytes(path.read_bytes() + b"what stands behind the last header is not looked at")
    checked_fits(path)


def test_a_compressed_file_that_expands_without_limit_is_refused(tmp_path):
    path = tmp_path / "zeros.gz"
    path.write_bytes(gzip.compress(bytes(2_000_000)))
    assert len(unpacked(path)) == 2_000_000
    with pytest.raises(InputError, match=r"zeros\.gz: unpacks to more than 1 MB; unpack it yourself if that is right"):
        unpacked(path, Unpacking(least=1 << 20, ratio=100))
    path.write_bytes(path.read_bytes()[:-30])
    with pytest.raises(InputError, match="is cut off in the middle"):
        unpacked(path)
    path.write_bytes(gzip.compress(b"1,2,3\n" * 99)[:20] + bytes(60))
    with pytest.raises(InputError, match="is damaged, it cannot be unpacked"):
        unpacked(path)


def system(folder, **contents):
    """A folder with the files in which Linux states the available memory."""
    for name, text in contents.items():
        path = folder / {"meminfo": "proc", "statm": "proc/self"}.get(name, "sys/fs/cgroup") / name.replace("_", ".")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    return folder


def test_available_memory_respects_machine_and_container(tmp_path):
    machine = system(tmp_path, meminfo="MemTotal: 9 kB\nMemAvailable:     4000 kB\n")
    assert memory_left(machine) == 4000 * 1024
    assert memory_left(system(machine, memory_max="3000000\n", memory_current="1000000\n")) == 2_000_000
    assert memory_left(system(machine, memory_current="5000000\n")) == 0
    assert memory_left(system(machine, memory_max="max\n")) == 4000 * 1024


def test_available_memory_respects_the_process_limit(tmp_path, monkeypatch):
    resource = pytest.importorskip("resource")
    machine = system(tmp_path, meminfo="MemAvailable: 4000 kB\n", statm="10 5 1\n")
    page = resource.getpagesize()
    monkeypatch.setattr(resource, "getrlimit", lambda which: (30 * page, resource.RLIM_INFINITY))
    assert memory_left(machine) == 20 * page
    assert memory_left() is None or memory_left() >= 0
