"""How every kernel is compiled.

Lives here: the decorators of the kernels and of their vector code. Not here: the kernels, and where machine
code is kept (`cache`).

Kernels are compiled without numba's reference counts. With them each call of one kernel from another counts
every array up and down, atomically, in tuples of forty: 480 ns an event, where counting it takes 10. An
array that a caller holds outlives the call, so nothing is lost by it; and a kernel that tries to
allocate an array does not compile.
"""

from collections.abc import Callable
from typing import Any

from numba import njit
from numba.extending import intrinsic

from streamfeat.kernels.cache import keep


def _kept(**options: Any) -> Any:
    compiled = njit(nogil=True, **options)

    def decorate(function: Callable[..., Any]) -> Any:
        dispatcher = compiled(function)
        keep(dispatcher)
        return dispatcher

    return decorate


_PLAIN = {"error_model": "numpy", "_nrt": False, "no_cfunc_wrapper": True}

kernel = _kept(**_PLAIN)
"""Compiled once for each set of argument types, kept on disk, and free of the GIL while it runs."""

inlined = _kept(**_PLAIN, no_cpython_wrapper=True, forceinline=True)
"""The same for small parts of a loop over events: a call would copy all arrays' descriptions. Only kernels
can call it, Python cannot: to describe forty arrays to it takes a quarter of a second of compiling."""

spliced = _kept(**_PLAIN, inline="always")
"""The same for a sequence of kernels: whoever calls it has its lines, for LLVM would optimise all that is in
them once more for it."""

allocating = _kept()
"""The same for what makes arrays, whose references must be counted."""

generated: Callable[[Callable[..., Any]], Callable[..., Any]] = intrinsic
"""A function whose machine code its body writes, in LLVM's own terms; for `vectors` alone."""
