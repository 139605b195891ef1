"""How kernels are compiled: when they are first called, once for a machine, without the interpreter's lock.

``kernel`` is called from Python; ``part`` only from kernels, which saves compiling its wrappers; ``inlined`` is written
out where it is called, for what innermost loops call with many arrays: handing these over takes longer than the work.
Divisions follow floating point (a zero divisor gives infinity or not-a-number), so that no loop has to look for them.
"""

from __future__ import annotations

from numba import njit

kernel = njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True)  # type: ignore[call-overload]
part = njit(cache=True, nogil=True, error_model="numpy", no_cfunc_wrapper=True, no_cpython_wrapper=True)  # type: ignore[call-overload]
inlined = njit(nogil=True, error_model="numpy", inline="always")
