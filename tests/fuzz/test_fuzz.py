"""A few hundred mutated files of every format are read, or refused in one line. scripts/fuzz tries more."""

import json
import sys
from pathlib import Path

import fuzzing
import pytest
from corpus import TARGETS
from fuzzing import Fuzzer

#: Inputs of each format; those that start processes of their own, or draw curves of dates, take longer.
INPUTS = 100
FEWER = {"frame hcompress": 4}


@pytest.fixture(scope="module")
def fuzzer():
    one = Fuzzer()
    yield one
    one.close()


def test_the_page_states_the_number_of_kinds():
    page = (Path(__file__).parents[2] / "docs/promises.md").read_text(encoding="utf-8")
    assert f"changes small files of {len(TARGETS)} kinds at random" in page


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="limits of memory are those of POSIX")
@pytest.mark.parametrize("name", TARGETS)
def test_a_changed_file_is_answered_or_refused(name, fuzzer):
    pytest.importorskip("pyais")
    pytest.importorskip("rs1090")
    found = fuzzer.run(name, 0, FEWER.get(name, INPUTS))
    assert not found.faults, f"scripts/fuzz --format '{name}' --inputs {INPUTS} --keep FOLDER: {found.faults}"
    assert found.tried == found.answered + found.refused and found.refused


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="limits of memory are those of POSIX")
def test_what_was_read_counts_for_the_code_that_read_it(tmp_path, monkeypatch, capsys):
    def run(*options):
        monkeypatch.setattr(sys, "argv", ["fuzz", "--format", "coast", "--results", str(tmp_path / "kept"), *options])
        assert fuzzing.main() == 0
        return capsys.readouterr().out.splitlines()[1].split()

    monkeypatch.setenv("SOURCE_DATE_EPOCH", "0")
    first = run("--inputs", "40")
    assert first[:2] == ["coast", "40"] and first[-2:] == ["this", "code"]
    assert run("--inputs", "40")[:6] == first[:6]  # nothing is read again
    path = tmp_path / "kept" / "coast-0.json"
    saved = json.loads(path.read_text())
    assert saved["upto"] == 40 and "maps/outline.py" in saved["code"]["modules"]
    saved["code"]["modules"]["maps/outline.py"] = "another"
    path.write_text(json.dumps(saved | {"day": "2026-01-02"}))
    assert run("--inputs", "10", "--older")[1::6] == ["40", "2026-01-02"]
    assert run("--inputs", "10")[1] == "10"
    assert run("--inputs", "10", "--older")[1] == "40" and json.loads(path.read_text())["older"]["day"] == "2026-01-02"


def test_only_what_a_module_does_counts_as_its_code(tmp_path):
    def meaning(text):
        (tmp_path / "module.py").write_text(text)
        return fuzzing._meaning(tmp_path / "module.py")

    plain = meaning("def half(x):\n    return x / 2\n")
    assert meaning('"""Halves."""\n\ndef half(x):\n    """Half of x."""\n    return x / 2  # exact\n') == plain
    assert meaning("def half(x):\n    return x / 3\n") != plain
