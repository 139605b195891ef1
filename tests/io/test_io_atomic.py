"""Outputs are complete or absent, whatever interrupts them."""

import errno
import os
import shutil
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from astropy.table import Table

from sameas.errors import InputError
from sameas.io import read_provenance, read_table, replacing, write_table, written_formats
from sameas.io.atomic import discard_drafts, filling

ENDINGS = [extensions[0] for extensions in written_formats().values()]


@pytest.mark.parametrize("stop", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_interruption_leaves_the_old_file_and_no_other(stop, tmp_path):
    out = tmp_path / "plot.png"
    out.write_text("old")
    with pytest.raises(stop), replacing(out) as draft:
        draft.write_text("half")
        raise stop
    assert out.read_text() == "old" and os.listdir(tmp_path) == ["plot.png"]


@pytest.mark.parametrize("stop", [RuntimeError, KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize("there", [True, False])
def test_an_interruption_leaves_a_folder_as_it_was(there, stop, tmp_path):
    out = tmp_path / "picture"
    if there:
        out.mkdir()
        (out / "map.html").write_text("old")
    with pytest.raises(stop), filling(out) as draft:
        (draft / "map.html").write_text("new")
        raise stop
    assert os.listdir(tmp_path) == ["picture"] * there
    assert not there or (os.listdir(out), (out / "map.html").read_text()) == (["map.html"], "old")


def test_all_files_of_a_folder_appear_at_once_next_to_existing_ones(tmp_path):
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "map.html").write_text("old")
    with filling(tmp_path) as draft:
        for name in ("map.html", "table.csv"):
            (draft / name).write_text("new")
            assert not (tmp_path / name).exists() or (tmp_path / name).read_text() == "old"
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {
        "notes.txt": "mine", "map.html": "new", "table.csv": "new",
    }  # fmt: skip


def test_a_folder_that_cannot_be_created_is_refused(tmp_path):
    (tmp_path / "file").write_text("mine")
    for name in ("file", "file/deeper"):
        with pytest.raises(InputError, match=f"into .*{name}: .*; give another"), filling(tmp_path / name):
            raise AssertionError("never reached")


@pytest.mark.parametrize("ending", ENDINGS)
def test_an_interrupted_table_leaves_the_old_one(ending, tmp_path, monkeypatch):
    out = tmp_path / f"t{ending}"
    write_table(Table({"x": [1]}), out, provenance={"run": 1})
    before = sorted(os.listdir(tmp_path))

    def interrupted(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_table(Table({"x": [2]}), out, provenance={"run": 2})
    assert sorted(os.listdir(tmp_path)) == before
    assert read_table(out)["x"][0] == 1 and read_provenance(out) == {"run": 1}


def test_the_draft_has_the_same_extension_and_folder(tmp_path):
    with replacing(tmp_path / "t.fits.gz") as draft:
        assert draft.name.endswith(".fits.gz") and draft.parent == tmp_path


def test_permissions_follow_the_umask_or_the_replaced_file(tmp_path):
    out = tmp_path / "t.csv"
    before = os.umask(0o027)
    try:
        write_table(Table({"x": [1]}), out, provenance={})
        assert stat.S_IMODE(out.stat().st_mode) == 0o640
        out.chmod(0o604)
        write_table(Table({"x": [2]}), out, provenance={})
        assert stat.S_IMODE(out.stat().st_mode) == 0o604
    finally:
        os.umask(before)


def test_a_link_is_followed(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to(tmp_path / "real.txt")
    with replacing(tmp_path / "link.txt") as draft:
        draft.write_text("new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "new"


def test_invalid_outputs_are_refused_before_anything_is_written(tmp_path):
    with pytest.raises(InputError, match=r"nowhere does not exist; make it first"), replacing(tmp_path / "nowhere/x"):
        pass
    with pytest.raises(InputError, match="it is a directory"), replacing(tmp_path):
        pass
    (tmp_path / "x.csv").write_text("a\n1\n")
    with pytest.raises(InputError, match=r"x\.csv: it exists already"):
        write_table(Table({"x": [1]}), tmp_path / "x.csv", provenance={"a": 1}, overwrite=False)
    assert os.listdir(tmp_path) == ["x.csv"]


def test_other_errors_pass_through(tmp_path):
    with pytest.raises(FileNotFoundError), replacing(tmp_path / "x.txt"):
        raise FileNotFoundError(errno.ENOENT, "of the caller")


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT])
@pytest.mark.parametrize("ending", ENDINGS)
def test_a_full_device_is_reported_clearly(code, ending, tmp_path, monkeypatch):
    from sameas.io import tables

    out = tmp_path / f"t{ending}"
    known = tables._format_for(out, None).module()

    def full(table, path, provenance):
        try:
            raise OSError(code, os.strerror(code))
        except OSError as error:
            raise RuntimeError("the library's own words") from error

    monkeypatch.setattr(known, "write", full)
    with pytest.raises(
        InputError, match=rf"cannot write .*t{ending}: (no space|the disk quota).*; nothing was written"
    ):
        write_table(Table({"x": [1]}), out, provenance={"a": 1})
    assert os.listdir(tmp_path) == []


def is_device(path):
    return os.path.exists(path) and stat.S_ISCHR(os.stat(path).st_mode)


@pytest.mark.skipif(not is_device("/dev/full"), reason="needs /dev/full")
@pytest.mark.parametrize("format", ["fits", "csv", "ecsv", "votable", "parquet"])
def test_a_full_device_is_reported_and_remains_a_device(format):
    with pytest.raises(InputError, match="cannot write /dev/full: no space left on device"):
        write_table(Table({"x": range(100_000)}), "/dev/full", provenance={}, format=format)
    assert is_device("/dev/full")


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/dev/stdout"), reason="needs /dev/stdout")
def test_a_pipe_can_be_written():
    code = (
        "from sameas.io import write_table; from astropy.table import Table;"
        "write_table(Table({'x': [1, 2]}), '/dev/stdout', provenance={}, format='csv')"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True)
    assert result.stdout == b"x\n1\n2\n"


def test_the_draft_of_a_killed_process_is_removed_by_the_next_output(tmp_path):
    code = (
        "import os, sys, signal\nfrom sameas.io.atomic import filling, replacing\n"
        "with replacing(sys.argv[1]) as draft, filling(sys.argv[2]):\n os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    subprocess.run([sys.executable, "-c", code, tmp_path / "a.txt", tmp_path], check=False)
    assert len(os.listdir(tmp_path)) == 2 and all(name.startswith(".sameas-") for name in os.listdir(tmp_path))
    others = (
        tmp_path / f".sameas-00000000-{os.getpid()}-0123456789ab"
    )  # of another machine, where it may still be running
    others.touch()
    with replacing(tmp_path / "a.txt") as draft:
        with replacing(tmp_path / "b.txt"):
            pass
        draft.write_text("whole")  # that of a running process stays
    assert sorted(os.listdir(tmp_path)) == [others.name, "a.txt", "b.txt"]


def test_files_of_a_draft_folder_are_not_reported_as_written(tmp_path, monkeypatch):
    from sameas.io import atomic

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(atomic, "written", [])
    with pytest.raises(KeyboardInterrupt), filling("out") as draft:
        with replacing(draft / "table.csv") as table:
            table.write_text("a")
        raise KeyboardInterrupt
    assert atomic.written == [] and not (tmp_path / "out").exists()
    with filling("out") as draft, replacing(draft / "table.csv") as table:
        table.write_text("a")
    assert [path.name for path in atomic.written] == ["out"]


@pytest.mark.skipif(sys.platform == "win32", reason="signals are those of POSIX")
@pytest.mark.parametrize("kind", ["folder", "csv with its provenance"])
def test_files_of_one_output_appear_together_despite_interruptions(kind, tmp_path, monkeypatch):
    """A page was the new one, and the table beside it the old one, where SIGTERM came between."""
    replaced = os.replace

    def interrupted(draft, target):
        replaced(draft, target)
        signal.raise_signal(signal.SIGINT)

    def write(content):
        if kind == "folder":
            with filling(tmp_path / "out") as draft:
                for name in ("a", "b", "c"):
                    (draft / name).write_text(content)
        else:
            (tmp_path / "out").mkdir(exist_ok=True)
            write_table(Table({"name": [content]}), tmp_path / "out" / "t.csv", provenance={"by": content})

    write("old")
    # A run in the background may have been started with SIGINT ignored.
    handler = signal.default_int_handler
    before = signal.signal(signal.SIGINT, handler)
    monkeypatch.setattr(os, "replace", interrupted)
    try:
        with pytest.raises(KeyboardInterrupt):
            write("new")
        assert signal.getsignal(signal.SIGINT) is handler
    finally:
        signal.signal(signal.SIGINT, before)
    files = sorted((tmp_path / "out").iterdir())
    assert len(files) in (2, 3) and all("new" in file.read_text() for file in files)


@pytest.mark.parametrize("output", [replacing, filling])
def test_a_draft_whose_removal_is_interrupted_is_removed_at_exit(output, tmp_path, monkeypatch):
    """A refusal removed its draft when SIGTERM came: the draft was forgotten before it was gone."""

    def stopped(*given, **options):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt), output(tmp_path / "out"):
        patch.setattr(Path, "unlink", stopped)
        patch.setattr(shutil, "rmtree", stopped)
        raise ValueError
    assert [path for path in tmp_path.rglob("*") if path.name.startswith(".sameas-")]
    discard_drafts()
    assert not [path for path in tmp_path.rglob("*") if path.name.startswith(".sameas-")]
