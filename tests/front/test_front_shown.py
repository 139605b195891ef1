"""Values print in at most ten lines; results and pictures have notebook representations."""

import dataclasses
import importlib
import inspect
from typing import Any

import numpy as np
import pytest

import sameas
from sameas import Records
from sameas.representation import LINES, in_short, shown

PACKAGES = ("sameas", "sameas.sky", "sameas.tracks", "sameas.picture", "sameas.simulate", "sameas.score",
            "sameas.evidence")  # fmt: skip


def reachable(value, found):
    """All sameas objects reachable from a value, by class."""
    kind = type(value)
    if not kind.__module__.startswith("sameas") or kind in found:
        return found
    found[kind] = value
    names = [f.name for f in dataclasses.fields(value)] if dataclasses.is_dataclass(value) else []
    for name in names:
        inner = getattr(value, name, None)
        for one in inner.values() if isinstance(inner, dict) else inner if isinstance(inner, tuple) else (inner,):
            reachable(one, found)
    return found


@pytest.fixture(scope="module")
def values(stars, in_memory):
    found = reachable(in_memory, {})
    many = sameas.match_many(stars.first, stars.second, sigma=0.05)
    reachable(many, found)
    for extra in (in_memory.identification.matches, in_memory.identification.answers_1, in_memory.explain(row=3),
                  many.objects.groups, many.state if hasattr(many, "state") else many.sky.state,
                  sameas.register(*(Records.of(np.random.default_rng(1).uniform(0, 99, (60, 2)), sigma=1.0),) * 2,
                                  sameas.Shift())):  # fmt: skip
        reachable(extra, found)
    return found


def test_every_value_prints_in_ten_lines(values):
    assert len(values) > 30  # public ones must; those inside are cut by them
    public = [getattr(importlib.import_module(package), name) for package in PACKAGES
              for name in importlib.import_module(package).__all__]  # fmt: skip
    for kind, value in values.items():
        if kind not in public:
            continue
        text = repr(value)
        assert len(text.splitlines()) <= 10 and len(text) < 1500, f"{kind.__qualname__}: {len(text)} letters"


ARRAYS = ("Array", "Table", "Mapping", "dict[", "Records", "Columns", "Identification", "Catalogue")


@pytest.mark.parametrize("package", PACKAGES)
def test_public_dataclasses_of_arrays_print_in_short(package):
    module = importlib.import_module(package)
    for name in module.__all__:
        kind = getattr(module, name)
        if not (inspect.isclass(kind) and dataclasses.is_dataclass(kind)):
            continue
        holds = any(word in str(f.type) for f in dataclasses.fields(kind) if f.repr for word in ARRAYS)
        own = kind.__repr__.__qualname__
        assert not holds or own != f"{kind.__qualname__}.__repr__" or "__repr__" in inspect.getsource(kind), name


def test_arrays_are_printed_by_dtype_and_shape():
    @in_short
    @dataclasses.dataclass(frozen=True)
    class Many:
        one: np.ndarray
        words: str
        rest: dict

    text = repr(Many(np.zeros((5, 2)), "x" * 500, {k: np.zeros(9) for k in range(40)}))
    assert "one=<float64 (5, 2)>" in text and "<dict of 40>" in text and len(text) < 200
    assert shown(np.ma.masked_equal(np.arange(9), 3)) == "<masked int64 (9,)>" and shown([1, 2]) == "[1, 2]"
    wide: type[Any] = dataclasses.make_dataclass("Wide", [(f"field_number_{k}", int) for k in range(200)])
    assert len(repr(in_short(wide)(*range(200))).splitlines()) == LINES + 1


@pytest.mark.slow
def test_results_have_notebook_representations(in_memory):
    pytest.importorskip("matplotlib")
    html = in_memory._repr_html_()
    assert (
        "font-family:monospace" in html
        and "data:image/png;base64," in html
        and "common objects" in html
        and "&lt;" not in html.split("<pre")[0]
    )
    assert len(html) < 300_000
    assert in_memory.plot()._repr_png_().startswith(b"\x89PNG")


def test_without_matplotlib_a_notebook_shows_the_report(in_memory, monkeypatch):
    def refused(*_):
        raise sameas.InputError("plots need matplotlib")

    monkeypatch.setattr("sameas.front.match.draw", refused)
    html = in_memory._repr_html_()
    assert "<img" not in html and "common objects" in html
