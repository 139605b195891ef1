"""How kernels run: compiled, once for a machine, without the interpreter's lock; interpreted where they are given few
items, since the compiler takes a second to load, and half a minute to compile everything for the first time.

``kernel`` is called from Python; ``part`` only from kernels, which saves compiling its wrappers; ``inlined`` is written
out where it is called, for what innermost loops call with many arrays: handing these over takes longer than the work.
``small`` is a kernel that gives the same answer, to the last bit, interpreted: it adds, multiplies and compares in the
same order, sums in loops, takes squares by multiplication, and logarithms and exponentials from ``math`` (NumPy has
others), so that it does not matter which of the two runs.
Divisions follow floating point (a zero divisor gives infinity or not-a-number), so that no loop has to look for them.
"""

from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from functools import cached_property
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np

#: Kernels that are given more items than this are compiled: interpreted, an item takes about a microsecond, so that
#: loading the compiler costs less.
FEW = 100_000
#: The same where the compiler is loaded already and the machine has compiled the kernel before: reading it takes a
#: millisecond or two.
FEW_BESIDE = 2_000
#: When so many seconds of the processor have gone into interpreting, the compiler would have been loaded, or would have
#: compiled for the first time on this machine: all is compiled from then on.
PATIENCE_S, PATIENCE_AT_FIRST_S = 2.0, 15.0
#: The newest numba whose cache is known to be read by what :func:`_read_without_the_compiler` calls; the oldest is that
#: of our requirements.
NEWEST_KNOWN = (0, 68)
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_PART: dict[str, Any] = {**_OPTIONS, "no_cpython_wrapper": True}
_INLINED: dict[str, Any] = {"nogil": True, "error_model": "numpy", "inline": "always"}
#: The functions that kernels call, and how they are compiled.
_parts: dict[FunctionType, dict[str, Any]] = {}
_kernels: set[FunctionType] = set()
_plains: dict[FunctionType, FunctionType] = {}
_dispatchers: dict[FunctionType, Any] = {}
_lock = threading.RLock()
_spent = float("inf") if os.environ.get("SAMEAS_COMPILE") == "1" else 0.0
_announced = False


def say(cache: Path) -> None:
    """One line on stderr."""
    sys.stderr.write("sameas: compiling kernels for this machine, once; it takes some seconds\n")


#: Called once, with the folder of the cache, when something is compiled that this machine has not compiled before.
beginnings: list[Callable[[Path], object]] = [say]


class Kernel:
    """A loop over arrays.

    function : what it was written as. few : interpreted up to so many items. work : counts them in the arguments.
    """

    def __init__(self, function: FunctionType, few: int, work: Callable[..., float]) -> None:
        self.function, self.few, self.work = function, few, work
        self._dispatcher: Any = None
        _kernels.add(function)
        self.__name__, self.__doc__, self.__module__ = function.__name__, function.__doc__, function.__module__

    def __call__(self, *arguments: Any) -> Any:
        dispatcher = self._dispatcher
        if dispatcher is None:
            if self.interprets and self.work(*arguments) <= self.most:
                return self.interpreted(*arguments)
            dispatcher = self.compiled
        return dispatcher(*arguments)

    @property
    def interprets(self) -> bool:
        """Whether it would still be interpreted, if it were given few items."""
        if self.few == 0 or self._dispatcher is not None:
            return False
        return _spent < PATIENCE_S or (_spent < PATIENCE_AT_FIRST_S and not self._seems_cached)

    @property
    def most(self) -> int:
        """The most items for which it would be interpreted now."""
        return min(self.few, FEW_BESIDE) if _dispatchers and self._seems_cached else self.few

    @cached_property
    def _seems_cached(self) -> bool:
        """Whether this machine has compiled it before, as far as can be told without the compiler."""
        home = Path(self.function.__code__.co_filename)
        given, index = os.environ.get("NUMBA_CACHE_DIR"), f"{home.stem}.{self.function.__qualname__}-*.nbi"
        return any(Path(given).glob(f"*/{index}") if given else (home.parent / "__pycache__").glob(index))

    @property
    def compiled(self) -> Any:
        """The function as numba has it; it is compiled, or read from the cache, when it is called."""
        with _lock:
            if self._dispatcher is None:
                dispatcher = _dispatcher(self.function)
                if not _announced:
                    _tell(dispatcher)
                self._dispatcher = dispatcher
        return self._dispatcher

    def interpreted(self, *arguments: Any) -> Any:
        """The answer without the compiler."""
        global _spent
        plain = _plains.get(self.function) or _plain(self.function)
        begin = time.thread_time()
        with np.errstate(all="ignore"):
            answer = plain(*arguments)
        _spent += time.thread_time() - begin
        return answer


def kernel(function: Any) -> Any:
    """A kernel that is always compiled."""
    return function if _switched_off() else Kernel(function, 0, items)


def small(function: Any) -> Any:
    """A kernel that is interpreted for arguments of few elements."""
    return function if _switched_off() else Kernel(function, FEW, items)


def small_by(work: Callable[..., float]) -> Callable[[Any], Any]:
    """A kernel that is interpreted for few items, which ``work`` counts in its arguments."""
    return lambda function: function if _switched_off() else Kernel(function, FEW, work)


def part(function: Any) -> Any:
    """A function that kernels call; as it stands it is the interpreted one."""
    _parts[function] = _PART
    return function


def inlined(function: Any) -> Any:
    """A function that is written out where kernels call it."""
    _parts[function] = _INLINED
    return function


def compile_all() -> None:
    """From now on nothing is interpreted in this process."""
    global _spent
    _spent = float("inf")


def runs_compiled(function: Any) -> bool:
    """Whether a kernel would run compiled whatever it is given: what arrays do nearly as fast asks before it calls."""
    return isinstance(function, Kernel) and not function.interprets


def items(*arguments: Any) -> int:
    """Number of elements of all arrays among the arguments, and in tuples of them."""
    total = 0
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            total += argument.size
        elif isinstance(argument, tuple):
            total += items(*argument)
    return total


def _called(function: FunctionType) -> dict[str, FunctionType]:
    """The kernels and parts that a function calls, by the names that it has for them."""
    found = {}
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        value = value.function if isinstance(value, Kernel) else value
        if isinstance(value, FunctionType) and (value in _parts or value in _kernels):
            found[name] = value
    return found


def _with(function: FunctionType, instead: dict[str, Any]) -> FunctionType:
    """The same function, with other things of these names."""
    twin = FunctionType(
        function.__code__,
        {**function.__globals__, **instead},
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    twin.__module__, twin.__qualname__, twin.__doc__ = function.__module__, function.__qualname__, function.__doc__
    return twin


def _plain(function: FunctionType) -> FunctionType:
    """The function as it is interpreted: it calls no kernel, but what that was written as."""
    if function not in _plains:
        instead = {name: _plain(value) for name, value in _called(function).items()}
        _plains[function] = _with(function, instead) if instead else function
    return _plains[function]


def _without_linear_algebra() -> None:
    """Imports what numba compiles with, but not ``scipy.linalg`` with it.

    numba imports that only to see whether it is there (it is: SciPy is one of our dependencies); what is compiled with
    linear algebra still looks for it then.
    """
    try:
        from numba.np import linalg

        look, linalg.ensure_blas = linalg.ensure_blas, lambda: None
        try:
            from numba.np import arraymath
        finally:
            linalg.ensure_blas = look
        arraymath.ensure_blas = look  # type: ignore[attr-defined]
    except (ImportError, AttributeError):  # another numba, which looks elsewhere
        pass


def _dispatcher(function: FunctionType) -> Any:
    """The function as numba has it, with those it calls."""
    from numba import njit

    if function not in _dispatchers:
        instead = {name: _dispatcher(value) for name, value in _called(function).items()}
        options = _parts.get(function, _OPTIONS)
        _dispatchers[function] = njit(**options)(_with(function, instead) if instead else function)
        if "cache" in options:
            _read_without_the_compiler(_dispatchers[function])
    return _dispatchers[function]


def _read_without_the_compiler(dispatcher: Any) -> None:
    """Lets the dispatcher look into the cache before numba has loaded all that it compiles with, which takes longer
    than to read every kernel of a match; what is not in the cache is compiled as ever.

    A kernel that is read needs numba's memory manager, and nothing else: none of ours hashes, which would.
    """
    import numba

    if not hasattr(numba, "version_info") or numba.version_info.full[:2] > NEWEST_KNOWN:
        return
    from numba.core.runtime.nrt import rtsys

    cache = dispatcher._cache
    compiled_or_read = cache.load_overload

    def read(signature: Any, context: Any) -> Any:
        rtsys.initialize(context)
        with cache._guard_against_spurious_io_errors():
            found = cache._load_overload(signature, context)
        if found is None:
            _without_linear_algebra()
            found = compiled_or_read(signature, context)
        return found

    cache.load_overload = read
    # Other packages' additions to the compiler, which it looks for when it is loaded.
    dispatcher._compilation_chain_init_hook = lambda: None


def _tell(dispatcher: Any) -> None:
    """Say once that something is going to be compiled, where this machine has not done so yet."""
    global _announced
    folder, function = Path(str(dispatcher.stats.cache_path)), dispatcher.py_func
    if not any(folder.glob(f"{function.__module__.rsplit('.', 1)[-1]}.{function.__qualname__}-*.nbi")):
        _announced = True
        for begin in beginnings:
            begin(folder)


def _switched_off() -> bool:
    """Whether numba has been told not to compile."""
    return os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("0", "")


__all__ = [
    "Kernel",
    "beginnings",
    "compile_all",
    "inlined",
    "items",
    "kernel",
    "part",
    "runs_compiled",
    "say",
    "small",
    "small_by",
]
