"""Saved states round-trip, and loading one never runs code."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from sameas import Records
from sameas.errors import InputError
from sameas.io.saved import dumps, loads, sealed
from sameas.picture import Watch


def test_data_round_trip() -> None:
    records = Records.of([[0.0, 1.0]], sigma=2.0, ids=["a"])
    masked = np.ma.MaskedArray([1.0, 2.0], [True, False])
    kept = {
        "records": records,
        "watch": Watch(),
        "path": Path("a"),
        "of": {1, 2},
        "texts": np.array(["x", None], object),
    }
    again = loads(dumps(kept | {"masked": masked}), "state")
    assert again["records"].features.tolist() == [[0.0, 1.0]] and again["records"].ids.tolist() == ["a"]
    assert again["path"] == Path("a") and again["of"] == {1, 2} and again["texts"].tolist() == ["x", None]
    assert again["masked"].tolist() == [None, 2.0] and again["watch"].evidence is Watch().evidence


class Harm:
    """A hostile object: pickle calls a function when it is loaded."""

    def __init__(self, function, *arguments) -> None:
        self.function, self.arguments = function, arguments

    def __reduce__(self):
        return self.function, self.arguments


def named(module: str, name: str, argument: str) -> bytes:
    """A hand-written pickle that calls a function by name."""
    texts = b"".join(b"\x8c" + bytes([len(text)]) + text.encode() for text in (module, name))
    return b"\x80\x04" + texts + b"\x93\x8c" + bytes([len(argument)]) + argument.encode() + b"\x85R."


@pytest.mark.parametrize(
    ("module", "name"),
    [("os", "system"), ("builtins", "eval"), ("builtins", "open"), ("subprocess", "check_output"), ("posix", "system"),
     ("sameas.io.tables", "os.remove"), ("sameas.io", "read_table"), ("importlib", "import_module"),
     ("sameas.io.saved", "pickle.loads"), ("numpy", "load")],
)  # fmt: skip
def test_no_call_of_a_hostile_state_is_made(module: str, name: str, tmp_path) -> None:
    mark = tmp_path / "mark"
    mark.write_text("there")
    content = named(module, name, str(mark))
    with pytest.raises(InputError, match=r"state.pickle: is damaged \(it names .*, which is no data\); move it away"):
        loads(sealed(content), "state.pickle")
    assert mark.read_text() == "there"


def test_pickled_code_is_refused() -> None:
    with pytest.raises(InputError, match="no data"):
        loads(sealed(pickle.dumps(Harm(print, "run"))), "state")
    for content in (b"", b"\x80\x05nonsense", sealed(b""), sealed(b"\x80\x05nonsense"), dumps({"a": 1})[:-3]):
        with pytest.raises(InputError, match="state: is damaged"):
            loads(content, "state")


def test_a_state_with_one_flipped_bit_is_refused() -> None:
    content = dumps({"at": np.arange(3)})
    for byte in range(len(content)):
        damaged = bytearray(content)
        damaged[byte] ^= 1 << byte % 8
        with pytest.raises(InputError, match=r"state: is damaged \(its checksum is another\)"):
            loads(bytes(damaged), "state")
