"""Kernels: loops over arrays, compiled by numba (cached on disk, without the GIL) or interpreted for small inputs.

Small inputs are interpreted because numba takes a second to load, and half a minute to compile every kernel for the
first time. Decorators:

- ``kernel``: called from Python, always compiled.
- ``small``, ``small_by``: called from Python, interpreted for small inputs. The interpreted result is the same to the
  last bit: the function adds, multiplies and compares in the same order, sums in loops, squares by multiplication, and
  takes logarithms and exponentials from ``math`` (NumPy's differ).
- ``part``: called from kernels only, which saves compiling its wrappers.
- ``borrowing_part``: a part that counts no references to arrays, which takes a third of the time of short loops. So it
  may not allocate arrays (nor compute with whole ones or copy one into another, for which numba allocates), return any,
  or call functions that return some.
- ``inlined``: inserted at the call, for innermost loops, where passing arrays takes longer than the work: one of 4 × 4
  numbers took six times as long. Where their sizes are known there, the compiler unrolls the loops over them.

Division by zero gives infinity or not-a-number, so that no loop has to test for it.
"""

from __future__ import annotations

import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property, lru_cache
from pathlib import Path
from types import FunctionType
from typing import Any, Generic, ParamSpec, TypeVar, cast

import numpy as np

P = ParamSpec("P")
R = TypeVar("R")
F = TypeVar("F", bound=Callable[..., object])
#: Most items that are interpreted: an item takes about 1 µs, so that more would take longer than loading the compiler.
MAX_INTERPRETED = 100_000
#: The same where the compiler is loaded and the kernel is in the cache: reading it takes 1 to 2 ms.
MAX_INTERPRETED_IF_LOADED = 2_000
#: CPU seconds of interpreting after which everything is compiled: with the kernel in the cache, and without (there the
#: first compilation on this machine has to pay).
INTERPRETING_LIMIT_S, INTERPRETING_LIMIT_UNCACHED_S = 2.0, 15.0
#: CPU seconds of interpreting one kernel, in all and in one call, after which it is compiled if the compiler is loaded:
#: about what that takes, and a twentieth of it, which every later run would take again.
KERNEL_LIMIT_S, CALL_LIMIT_S = 0.5, 0.05
#: Newest numba whose cache is known to have what is called here; the oldest is the required one.
NEWEST_KNOWN_NUMBA = (0, 68)
_OPTIONS: dict[str, Any] = {"cache": True, "nogil": True, "error_model": "numpy", "no_cfunc_wrapper": True}
_PART: dict[str, Any] = {**_OPTIONS, "no_cpython_wrapper": True}
_BORROWING: dict[str, Any] = {**_PART, "_nrt": False}  # NRT: numba's reference counts
_INLINED: dict[str, Any] = {"nogil": True, "error_model": "numpy", "inline": "always"}
#: Options of the functions that only kernels call.
_parts: dict[FunctionType, dict[str, Any]] = {}
_kernels: set[FunctionType] = set()
_python_versions: dict[FunctionType, FunctionType] = {}
_dispatchers: dict[FunctionType, Any] = {}
_lock = threading.RLock()
#: CPU seconds spent interpreting in this process.
_interpreting_s = float("inf") if os.environ.get("SAMEAS_COMPILE") == "1" else 0.0
_announced = False


def announce(cache: Path) -> None:
    """Write one line to stderr."""
    sys.stderr.write("sameas: compiling kernels for this machine, once; it takes some seconds\n")


#: Called once in a process, with the cache folder, before the first kernel that is not in the cache is compiled.
on_first_compilation: list[Callable[[Path], object]] = [announce]


class Kernel(Generic[P, R]):
    """A loop over arrays, interpreted or compiled at each call.

    function : the Python source. limit : most items to interpret, 0 for never. work : counts items in the arguments.
    """

    def __init__(self, function: Callable[P, R], limit: int, work: Callable[..., float]) -> None:
        assert isinstance(function, FunctionType)
        self.function, self.limit, self.work = function, limit, work
        self._dispatcher: Any = None
        self._interpreting_s = self._longest_call_s = 0.0
        _kernels.add(function)
        self.__name__, self.__doc__, self.__module__ = function.__name__, function.__doc__, function.__module__

    def __call__(self, *arguments: P.args, **named: P.kwargs) -> R:
        dispatcher = self._dispatcher
        if dispatcher is None:
            if self.interprets and self.work(*arguments, **named) <= self.max_interpreted:
                return self.interpreted(*arguments, **named)
            dispatcher = self.compiled
        result: R = dispatcher(*arguments, **named)
        return result

    @property
    def interprets(self) -> bool:
        """Whether a small input would be interpreted now."""
        if self.limit == 0 or self._dispatcher is not None:
            return False
        if _dispatchers and (self._interpreting_s > KERNEL_LIMIT_S or self._longest_call_s > CALL_LIMIT_S):
            return False
        if _interpreting_s < INTERPRETING_LIMIT_S:
            return True
        return _interpreting_s < INTERPRETING_LIMIT_UNCACHED_S and not self._is_cached

    @property
    def max_interpreted(self) -> int:
        """The most items that would be interpreted now."""
        return min(self.limit, MAX_INTERPRETED_IF_LOADED) if _dispatchers and self._is_cached else self.limit

    @cached_property
    def _is_cached(self) -> bool:
        """Whether the cache has an index file of this kernel; numba is not asked, so the file may be out of date."""
        home = Path(self.function.__code__.co_filename)
        cache, index = os.environ.get("NUMBA_CACHE_DIR"), f"{home.stem}.{self.function.__qualname__}-*.nbi"
        return any(Path(cache).glob(f"*/{index}") if cache else (home.parent / "__pycache__").glob(index))

    @property
    def compiled(self) -> Any:
        """numba's dispatcher; a call compiles the function or reads it from the cache."""
        with _lock:
            if self._dispatcher is None:
                dispatcher = _dispatcher(self.function)
                if not _announced:
                    _announce_compilation(dispatcher)
                self._dispatcher = dispatcher
        return self._dispatcher

    def read_cached(self) -> None:
        """Read everything that the cache has of this kernel; compiles nothing."""
        if self._is_cached and _knows_cache():
            dispatcher = self.compiled
            for signature, *_ in dispatcher._cache._cache_file._load_index():
                dispatcher.compile(signature)

    def interpreted(self, *arguments: P.args, **named: P.kwargs) -> R:
        """The result in Python."""
        global _interpreting_s
        function = _python_versions.get(self.function) or _python_version(self.function)
        begin = time.thread_time()
        with np.errstate(all="ignore"):
            result: R = function(*arguments, **named)
        seconds = time.thread_time() - begin
        self._interpreting_s += seconds
        self._longest_call_s = max(self._longest_call_s, seconds)
        _interpreting_s += seconds
        return result


def kernel(function: Callable[P, R]) -> Kernel[P, R]:
    """A kernel that is always compiled."""
    return _made(function, 0, items)


def small(function: Callable[P, R]) -> Kernel[P, R]:
    """A kernel that is interpreted for at most :data:`MAX_INTERPRETED` array elements."""
    return _made(function, MAX_INTERPRETED, items)


def small_by(work: Callable[..., float]) -> Callable[[Callable[P, R]], Kernel[P, R]]:
    """A kernel that is interpreted for at most :data:`MAX_INTERPRETED` items, counted by ``work(*arguments)``."""
    return lambda function: _made(function, MAX_INTERPRETED, work)


def _made(function: Callable[P, R], limit: int, work: Callable[..., float]) -> Kernel[P, R]:
    """The kernel; the function itself where numba is switched off."""
    return cast("Kernel[P, R]", function) if _switched_off() else Kernel(function, limit, work)


def part(function: F) -> F:
    """A function that kernels call; called from Python it is interpreted."""
    return _as_part(function, _PART)


def borrowing_part(function: F) -> F:
    """A part without arrays of its own."""
    return _as_part(function, _BORROWING)


def inlined(function: F) -> F:
    """A function that is inserted where kernels call it."""
    return _as_part(function, _INLINED)


def _as_part(function: F, options: dict[str, Any]) -> F:
    assert isinstance(function, FunctionType)
    _parts[function] = options
    return function


def compile_all() -> None:
    """Interpret nothing from now on in this process."""
    global _interpreting_s
    _interpreting_s = float("inf")


def prefer_compiled() -> None:
    """From now on in this process interpret only kernels that this machine has not compiled before."""
    global _interpreting_s
    _interpreting_s = max(_interpreting_s, INTERPRETING_LIMIT_S)


def runs_compiled(function: Callable[..., object]) -> bool:
    """Whether a kernel would run compiled for any input; callers with a NumPy equivalent use that one otherwise."""
    return isinstance(function, Kernel) and not function.interprets


def runs_interpreted(function: Callable[..., object]) -> bool:
    """Whether a kernel would be interpreted for a small input; False where numba is switched off."""
    return isinstance(function, Kernel) and function.interprets


def items(*arguments: Any) -> int:
    """Number of elements of all arrays among the arguments and in tuples of them."""
    total = 0
    for argument in arguments:
        if isinstance(argument, np.ndarray):
            total += argument.size
        elif isinstance(argument, tuple):
            total += items(*argument)
    return total


def _called(function: FunctionType) -> dict[str, FunctionType]:
    """The kernels and parts that a function calls, by their names in it."""
    called = {}
    for name in function.__code__.co_names:
        value = function.__globals__.get(name)
        value = value.function if isinstance(value, Kernel) else value
        if isinstance(value, FunctionType) and (value in _parts or value in _kernels):
            called[name] = value
    return called


def _with_globals(function: FunctionType, names: dict[str, Any]) -> FunctionType:
    """A copy of the function in which these global names have other values."""
    copy = FunctionType(
        function.__code__,
        {**function.__globals__, **names},
        function.__name__,
        function.__defaults__,
        function.__closure__,
    )
    copy.__module__, copy.__qualname__, copy.__doc__ = function.__module__, function.__qualname__, function.__doc__
    return copy


def _python_version(function: FunctionType) -> FunctionType:
    """The function with the kernels that it calls replaced by their Python sources."""
    if function not in _python_versions:
        called = {name: _python_version(value) for name, value in _called(function).items()}
        _python_versions[function] = _with_globals(function, called) if called else function
    return _python_versions[function]


def _import_compiler_without_scipy_linalg() -> None:
    """Import numba's compiler, but not ``scipy.linalg``, which is slow to load.

    numba imports it only to test that it exists, which our requirement of SciPy ensures; kernels that use linear
    algebra still import it when they are compiled.
    """
    try:
        from numba.np import linalg

        ensure_blas, linalg.ensure_blas = linalg.ensure_blas, lambda: None
        try:
            from numba.np import arraymath
        finally:
            linalg.ensure_blas = ensure_blas
        arraymath.ensure_blas = ensure_blas
    except (ImportError, AttributeError):  # a numba version with another layout
        pass


def _dispatcher(function: FunctionType) -> Any:
    """numba's dispatcher of the function, which calls the dispatchers of its parts."""
    from numba import njit

    if function not in _dispatchers:
        called = {name: _dispatcher(value) for name, value in _called(function).items()}
        options = _parts.get(function, _OPTIONS)
        _dispatchers[function] = njit(**options)(_with_globals(function, called) if called else function)
        if "cache" in options:
            _read_cache_first(_dispatchers[function], is_part=function in _parts)
    return _dispatchers[function]


def _knows_cache() -> bool:
    """Whether the cache of this version of numba is known."""
    import numba

    return hasattr(numba, "version_info") and bool(numba.version_info.full[:2] <= NEWEST_KNOWN_NUMBA)


def _read_cache_first(dispatcher: Any, is_part: bool) -> None:
    """Make the dispatcher read the cache before numba loads its compiler, which takes longer than reading every kernel
    of a match; a kernel that is not in the cache is compiled as usual.

    A kernel from the cache needs only numba's memory manager; one that hashes would need more, and none of ours does.
    """
    if not _knows_cache():
        return
    from numba.core.runtime.nrt import rtsys

    cache = dispatcher._cache
    load_with_compiler = cache.load_overload

    def rebuilt(context: Any, content: tuple[Any, ...]) -> Any:
        if is_part or content[0][1] != "object":
            return cache._impl.rebuild(context, content)
        content, module_for_linking = _without_linking(context, content)
        overload = cache._impl.rebuild(context, content)
        overload.library._get_module_for_linking = module_for_linking
        return overload

    def load(signature: Any, context: Any) -> Any:
        overload = None
        with cache._guard_against_spurious_io_errors(), _signals_deferred():
            rtsys.initialize(context)
            content = cache._cache_file.load(cache._index_key(signature, context.codegen())) if cache._enabled else None
            overload = None if content is None else rebuilt(context, content)
        if overload is None:
            _import_compiler_without_scipy_linalg()
            with _signals_deferred():
                overload = load_with_compiler(signature, context)
        return overload

    cache.load_overload = load
    # The hook would search for other packages' extensions of the compiler.
    dispatcher._compilation_chain_init_hook = lambda: None


def _without_linking(context: Any, content: tuple[Any, ...]) -> tuple[Any, Any]:
    """The content of a kernel's cache file without its code for linking it into others, and a function that reads this.

    Reading it takes more than half of the time; it is needed when a kernel that calls this one is compiled.
    """
    from llvmlite import binding

    (name, kind, (code, for_linking)), names, *others = content
    engine = context.codegen()._engine
    # numba would take these names from the code for linking.
    engine._defined_symbols |= {names.llvm_func_name, names.llvm_cpython_wrapper_name}

    @lru_cache(1)
    def module_for_linking() -> Any:
        module = binding.parse_bitcode(for_linking)
        engine._load_defined_symbols(module)
        return module

    nothing = binding.parse_assembly("").as_bitcode()
    return ((name, kind, (code, nothing)), names, *others), module_for_linking


@contextmanager
def _signals_deferred() -> Iterator[None]:
    """Call the handlers of SIGINT and SIGTERM after the block, not in it.

    LLVM asks numba for the code of a cached kernel through a callback, in which an exception (Ctrl-C) is lost together
    with the code; numba would then write to address zero.
    """
    received: list[tuple[int, Any]] = []
    handlers: dict[int, Callable[[int, Any], Any]] = {}
    if threading.current_thread() is threading.main_thread():  # where Python calls all handlers
        for number in (signal.SIGINT, signal.SIGTERM):
            handler = signal.getsignal(number)
            if callable(handler):
                handlers[number] = handler
                signal.signal(number, lambda number, frame: received.append((number, frame)))
    try:
        yield
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        for number, frame in received:
            handlers[number](number, frame)


def _announce_compilation(dispatcher: Any) -> None:
    """Call :data:`on_first_compilation` if the kernel is not in the cache."""
    global _announced
    folder, function = Path(str(dispatcher.stats.cache_path)), dispatcher.py_func
    if not any(folder.glob(f"{function.__module__.rsplit('.', 1)[-1]}.{function.__qualname__}-*.nbi")):
        _announced = True
        for callback in on_first_compilation:
            callback(folder)


def _switched_off() -> bool:
    """Whether the environment switches numba off."""
    return os.environ.get("NUMBA_DISABLE_JIT", "0") not in ("0", "")


__all__ = [
    "Kernel",
    "announce",
    "compile_all",
    "inlined",
    "items",
    "kernel",
    "on_first_compilation",
    "part",
    "prefer_compiled",
    "runs_compiled",
    "small",
    "small_by",
]
