"""How numerics are compiled, in one place: loops that Python calls, and functions within them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from numba import njit
from numba.core.caching import FunctionCache
from numba.core.runtime import rtsys
from numba.extending import register_jitable

_OPTIONS = {"error_model": "numpy", "no_cfunc_wrapper": True}


class _Compiled(FunctionCache):
    """Compiled kernels on disk, loaded without all that compiling would need.

    Numba's own cache first imports all it could compile, a third of a second in each of a run's
    jobs. What is compiled needs the runtime only; the compiler imports the rest where it starts.
    """

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """The compiled kernel for a signature, or None."""
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)


def kernel(function: Callable) -> Callable:
    """A compiled loop over points or pixels, which Python calls."""
    dispatcher = njit(nogil=True, **_OPTIONS)(function)
    dispatcher._cache = _Compiled(function)
    return dispatcher


inner: Callable = register_jitable(**_OPTIONS)
"""A function that kernels call; plain Python where Python calls it.

It is compiled within its kernels: without a door for Python, and once for all constants of a type.
"""

inlined: Callable = register_jitable(forceinline=True, _nrt=False, **_OPTIONS)
"""An inner function whose code enters its callers', and that allocates nothing.

Without reference counting of the arrays that it looks at: counting took two thirds of the time
of the simulator's rays (1000 against 290 ns a ray, textures and shadows included).
"""
