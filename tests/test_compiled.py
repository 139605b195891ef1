"""Kernels interpreted for few items give the compiled result bit for bit; one line announces their
compilation."""

import ast
import importlib
import os
import pkgutil
import subprocess
import sys
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from sameas import Plane, Records, identify, kernels
from sameas.estimate.match import match
from sameas.evidence import Field, Magnitudes
from sameas.kernels import compiled
from sameas.prior import CommonObjects
from sameas.simulate import Cap, sky_field

pytestmark = pytest.mark.skipif(os.environ.get("NUMBA_DISABLE_JIT") == "1", reason="compilation is switched off")


def copied(value):
    if isinstance(value, np.ndarray):
        return value.copy()
    if isinstance(value, tuple):
        copies = [copied(each) for each in value]
        return type(value)(*copies) if hasattr(value, "_fields") else tuple(copies)
    return value


def same(one, two):
    if isinstance(one, np.ndarray):
        return one.dtype == two.dtype and np.array_equal(one, two, equal_nan=one.dtype.kind == "f")
    if isinstance(one, tuple):
        return len(one) == len(two) and all(map(same, one, two))
    return one == two or (one != one and two != two)


@pytest.fixture
def both(monkeypatch):
    """Runs the first calls of every kernel that may be interpreted both ways; lists the kernels run, and those of
    different answers or changes of their arguments."""
    ran, different, calls = set(), set(), Counter()

    def run(kernel, *arguments):
        twice = kernel.limit and kernel.work(*arguments) <= kernel.limit and calls[kernel] < 6
        again = copied(arguments) if twice else ()
        answer = kernel.compiled(*arguments)
        if twice:
            calls[kernel] += 1
            name = f"{kernel.__module__.rsplit('.', 1)[1]}.{kernel.__name__}"
            ran.add(name)
            if not same((answer, arguments), (kernel.interpreted(*again), again)):
                different.add(name)
        return answer

    monkeypatch.setattr(compiled.Kernel, "__call__", run)
    return ran, different


def crowd(seed, elliptical, sigma=(0.5, 2.0), radius_deg=0.03):
    scene = sky_field(
        np.random.default_rng(seed), n_common=120, n_only_1=60, n_only_2=60, sigma_arcsec=sigma,
        area=Cap(30.0, 80.0, radius_deg), elliptical=elliptical,
    )  # fmt: skip
    return scene.first, scene.second


@pytest.mark.slow
@pytest.mark.parametrize("elliptical", [False, True])
def test_estimation_on_the_sky(both, elliptical):
    first, second = crowd(1, elliptical)
    match(first, second)
    ran, different = both
    assert not different and len(ran) > 15


@pytest.mark.slow
def test_estimation_with_magnitudes(both):
    first, second = crowd(2, False)
    rng = np.random.default_rng(3)
    depth = rng.uniform(14.0, 20.0, 120)
    one, two = (
        Magnitudes(np.concatenate([depth + rng.normal(0.3, 0.1, 120), rng.uniform(14.0, 20.0, 60)]), np.full(180, 0.05))
        for _ in range(2)
    )
    match(first, second, brightness=(one, two))
    ran, different = both
    assert not different and any(name.startswith("relation.") for name in ran)


@pytest.mark.parametrize("space", [Plane(), Plane((10.0, None))])
@pytest.mark.parametrize("prior", [None, CommonObjects(0.2, 0.3)])
@pytest.mark.parametrize("n", [15, 150])
def test_identification_on_a_plane(both, space, prior, n):
    rng = np.random.default_rng(4)
    one, two = (
        Records.of(rng.uniform(0.0, 10.0, (n, 2)), sigma=rng.uniform(0.1, 0.4, (n, 2)), space=space) for _ in range(2)
    )
    extra = {} if prior is None else {"prior": prior}
    identify(one, two, rule=Field(1.0), **extra)
    ran, different = both
    assert not different and len(ran) > 3


@pytest.mark.slow
def test_few_records_need_no_compiler_and_many_do():
    """In a new process: numba is imported only when a kernel has many items."""
    program = """
import sys
import numpy as np
from sameas import Field, Records, identify

def identified(n):
    places = np.random.default_rng(1).uniform(0.0, n**0.5, (2, n, 2))
    identify(*(Records.of(x, sigma=0.03) for x in places), rule=Field(1.0))
    return "numba" in sys.modules

print(identified(200), identified(20_000))
"""
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert run.stdout.split() == ["False", "True"]


@pytest.mark.slow
def test_cached_kernels_are_loaded_without_the_compiler(tmp_path):
    """With equal results; numba's own settings stay unchanged."""
    program = """
import sys
import numpy as np
from sameas.kernels.records import greatest_pair, per_record

position, value = np.array([1, 0, 1, 1], np.int32), np.array([0.25, 0.5, 0.75, 0.75])
print(*greatest_pair.compiled(position, 3, value), *per_record.compiled(position, 3, value > 0.6, value)[3])
print("numba.np.npyimpl" in sys.modules)
import numba
print(numba.njit(lambda words: words.upper())("us"))
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [
        subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True)
        for _ in range(2)
    ]
    first, second = (run.stdout.splitlines() for run in runs)
    assert first[0] == second[0] == "1 2 -1 0.5 1.75 0.0"
    assert (first[1:], second[1:]) == (["True", "US"], ["False", "US"])


@pytest.mark.slow
def test_a_kernel_is_read_ahead_only_if_it_is_in_the_cache(tmp_path):
    program = """
import numpy as np
from sameas.kernels.records import greatest_pair, per_record

greatest_pair.read_cached()
per_record.read_cached()
print(*(kernel._dispatcher is not None and len(kernel.compiled.signatures) for kernel in (greatest_pair, per_record)))
greatest_pair.compiled(np.array([1, 0, 1, 1], np.int32), 3, np.array([0.25, 0.5, 0.75, 0.75]))
print(sum(greatest_pair.compiled.stats.cache_misses.values()))
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    command = [sys.executable, "-c", program]
    printed = [
        subprocess.run(command, env=environment, capture_output=True, text=True, check=True).stdout.split()
        for _ in range(2)
    ]
    assert printed == [["False", "False", "1"], ["1", "False", "0"]]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="a process cannot send itself SIGINT")
def test_ctrl_c_while_a_cached_kernel_is_loaded_raises_after_it(tmp_path):
    """Within it, numba's callback would lose both the exception and the code, and numba would write to address zero."""
    program = """
import os, signal
import numpy as np
from numba.core.codegen import JITCPUCodegen
from sameas.kernels.records import greatest_pair

signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored where the tests run in the background
library = JITCPUCodegen._library_class
answer = library._object_getbuffer_hook.__func__

def interrupted(cls, module):
    while signals:
        os.kill(os.getpid(), signals.pop())
    return answer(cls, module)

arguments = np.array([1, 0, 1, 1], np.int32), 3, np.array([0.25, 0.5, 0.75, 0.75])
if greatest_pair._is_cached:
    library._object_getbuffer_hook, signals = classmethod(interrupted), [signal.SIGINT]
    try:
        greatest_pair.compiled(*arguments)
    except KeyboardInterrupt:
        print("interrupted")
print(*greatest_pair.compiled(*arguments))
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [
        subprocess.run([sys.executable, "-c", program], env=environment, capture_output=True, text=True)
        for _ in range(2)
    ]
    assert [(run.returncode, run.stdout.split()) for run in runs] == [
        (0, ["1", "2", "-1"]),
        (0, ["interrupted", "1", "2", "-1"]),
    ], runs[1].stderr


@pytest.mark.slow
def test_a_kernel_that_calls_one_from_the_cache_can_be_compiled(tmp_path):
    """The code of the called kernel for linking is not read with it, but when the caller is compiled."""
    (tmp_path / "pair.py").write_text("""
from sameas.kernels.compiled import kernel, part

@part
def doubled(x):
    return 2.0 * x

@kernel
def inner(x):
    total = 0.0
    for value in x:
        total += doubled(value)
    return total

@kernel
def outer(x):
    return inner(x) + 1.0
""")
    program = """
import sys
import numpy as np
import pair

x = np.arange(4.0)
for name in sys.argv[1:]:
    kernel = getattr(pair, name)
    print(kernel.compiled(x), sum(kernel.compiled.stats.cache_misses.values()))
"""
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(tmp_path / "cache"),
        "PYTHONPATH": f"{tmp_path}:{os.environ.get('PYTHONPATH', '')}",
    }
    printed = [
        subprocess.run(
            [sys.executable, "-c", program, *names], env=environment, capture_output=True, text=True, check=True
        ).stdout.split()
        for names in (["inner"], ["inner", "outer"], ["outer", "inner"])
    ]
    assert printed == [["12.0", "1"], ["12.0", "0", "13.0", "1"], ["13.0", "0", "12.0", "0"]]


def test_borrowing_parts_own_no_arrays():
    """They would leak an array that they receive from a function, and give away one that they do not own."""
    for module in pkgutil.iter_modules(kernels.__path__, "sameas.kernels."):
        importlib.import_module(module.name)

    def returns_arrays(function):
        annotation = str(function.__annotations__.get("return"))
        named = function.__globals__.get(annotation)  # such as a named tuple of arrays
        return "Array" in annotation or (isinstance(named, type) and issubclass(named, tuple))

    borrowing = [function for function, options in compiled._parts.items() if not options.get("_nrt", True)]
    assert len(borrowing) > 30
    for function in borrowing:
        for used in (function, *compiled._called(function).values()):
            assert not returns_arrays(used), f"{function.__module__}.{function.__name__}: {used.__name__}"


#: What numba defines in ``numba.np.arraymath``, which imports ``scipy.linalg``: a kernel that calls one of these names
#: it in the cache, and takes a tenth of a second longer to be read.
COSTLY = {"max", "min", "argmax", "argmin", "flatnonzero", "nonzero", "sum", "prod", "cumsum", "any", "all", "median"}


KERNELS_OF_A_MATCH = ("assign", "components", "coverage", "elimination", "folding", "messages", "mixture", "posterior",
                      "probability_bounds", "records", "search", "zones")  # fmt: skip


@pytest.mark.parametrize("name", KERNELS_OF_A_MATCH)
def test_kernels_of_a_match_are_loaded_without_linear_algebra(name):
    tree = ast.parse((Path(compiled.__file__).parent / f"{name}.py").read_text())
    kernels = [node for node in tree.body if isinstance(node, ast.FunctionDef) and node.decorator_list]
    called = {
        node.func.attr
        for kernel in kernels
        for node in ast.walk(kernel)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
    }
    assert kernels and not called & COSTLY


@pytest.mark.slow
def test_everything_is_compiled_on_request():
    program = """
import sys
import numpy as np
from sameas import Records

Records.of(np.zeros((3, 2)), covariance=np.array([np.eye(2)] * 3))
print("numba" in sys.modules, "scipy.linalg" in sys.modules)
if "numba" in sys.modules:  # and for others numba is what it was
    import numba
    assert numba.njit(lambda a: a @ a)(np.eye(2)).trace() == 2.0
"""
    for wanted in ("0", "1"):
        environment = os.environ | {"SAMEAS_COMPILE": wanted}
        run = subprocess.run(
            [sys.executable, "-c", program], env=environment, capture_output=True, text=True, check=True
        )
        assert run.stdout.split() == [str(wanted == "1"), "False"]


def test_a_kernel_interpreted_for_long_is_compiled(monkeypatch):
    """After interpretation has taken as long as loading the compiler takes."""
    loop = compiled.small(_doubled)
    loop._is_cached = False
    monkeypatch.setattr(compiled, "_interpreting_s", 0.0)
    assert loop(np.arange(3.0)) == 6.0 and loop._dispatcher is None
    monkeypatch.setattr(compiled, "_interpreting_s", compiled.INTERPRETING_LIMIT_S)
    assert loop.interprets  # it has no cached version yet
    loop._is_cached = True
    assert not loop.interprets and loop(np.arange(3.0)) == 6.0 and loop._dispatcher is not None


@pytest.mark.parametrize("taken", [{"_interpreting_s": 0.6}, {"_longest_call_s": 0.06}])
def test_one_kernel_interpreted_for_long_is_compiled_if_the_compiler_is_loaded(monkeypatch, taken):
    """Else a kernel with long calls, or with hundreds of them, is interpreted in every run, as no run compiles it."""
    loop = compiled.small(_doubled)
    loop._is_cached = False
    monkeypatch.setattr(compiled, "_interpreting_s", 0.0)
    monkeypatch.setattr(compiled, "_dispatchers", {})
    assert loop(np.arange(3.0)) == 6.0
    assert 0.0 < loop._longest_call_s == loop._interpreting_s == compiled._interpreting_s
    vars(loop).update(taken)
    assert loop.interprets  # the compiler takes longer to load
    monkeypatch.setattr(compiled, "_dispatchers", {_fresh(): None})
    assert not loop.interprets and loop(np.arange(3.0)) == 6.0 and loop._dispatcher is not None


def _doubled(values):
    total = 0.0
    for value in values:
        total += 2.0 * value
    return total


def test_compilation_is_announced_once(monkeypatch, capsys, tmp_path):
    begun = []
    monkeypatch.setattr(compiled, "_announced", False)
    monkeypatch.setattr(compiled, "on_first_compilation", [compiled.announce, begun.append])
    monkeypatch.setattr("numba.core.config.CACHE_DIR", str(tmp_path))
    for _ in range(2):
        _ = compiled.Kernel(_fresh(), 0, compiled.items).compiled
    assert capsys.readouterr().err.count("compiling kernels") == len(begun) == 1


def _fresh():
    def nothing(values):
        return 0.0

    return nothing


def test_a_large_dense_group_is_compiled_however_few_its_records():
    from sameas.kernels.assign import assign_counted, assign_linear
    from sameas.kernels.components import GroupLayout

    n = 2000  # a chain: every row has the columns i and i + 1
    start, start_1 = np.array([0, 2 * n]), np.array([0, n])
    alone = np.arange(0, 3 * n, 1)
    unused = np.empty(0, np.int64), np.empty(0, np.int32), np.empty(0, np.int32)
    for kernel in (assign_linear, assign_counted):
        assert kernel.work(0, 1, GroupLayout(start, start_1, start_1, *unused)) > compiled.MAX_INTERPRETED
        assert kernel.work(0, n, GroupLayout(2 * alone, alone, alone, *unused)) < compiled.MAX_INTERPRETED


def test_once_the_compiler_is_loaded_cached_kernels_are_used_early(monkeypatch):
    some = compiled.small(lambda values: float(values.sum()))
    monkeypatch.setattr(compiled, "_dispatchers", {})
    some._is_cached = True
    assert some.max_interpreted == compiled.MAX_INTERPRETED
    monkeypatch.setattr(compiled, "_dispatchers", {some.function: None})
    assert some.max_interpreted == compiled.MAX_INTERPRETED_IF_LOADED
    some._is_cached = False
    assert some.max_interpreted == compiled.MAX_INTERPRETED
