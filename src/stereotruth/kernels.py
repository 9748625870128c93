"""How numerics are compiled, in one place: loops that Python calls, and functions within them."""

from __future__ import annotations

from collections.abc import Callable

from numba import config, njit
from numba.extending import register_jitable

from .kernel_cache import KernelCache

_OPTIONS = {"error_model": "numpy", "no_cfunc_wrapper": True}
if config.BOUNDSCHECK:  # NUMBA_BOUNDSCHECK=1: kernels refuse indices out of bounds
    _OPTIONS["boundscheck"] = True


def kernel(function: Callable) -> Callable:
    """A compiled loop over points or pixels, which Python calls."""
    dispatcher = njit(nogil=True, **_OPTIONS)(function)
    dispatcher._cache = KernelCache(function, repr(_OPTIONS))
    return dispatcher


inner: Callable = register_jitable(**_OPTIONS)
"""A function that kernels call; plain Python where Python calls it.

It is compiled within its kernels: without a door for Python, and once for all constants of a type.
"""


def inlined(function: Callable) -> Callable:
    """An inner function whose code enters its callers', and that allocates nothing.

    Without reference counting of the arrays that it looks at: counting took two thirds of the time
    of the simulator's rays (1000 against 290 ns a ray, textures and shadows included).
    """
    function.enters_its_callers = True  # which compiled code follows from
    return register_jitable(forceinline=True, _nrt=False, **_OPTIONS)(function)
