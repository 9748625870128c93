"""How the simulator's kernels are compiled, in one place."""

from __future__ import annotations

from collections.abc import Callable

from numba import njit

kernel: Callable = njit(cache=True, nogil=True, error_model="numpy")
"""A compiled loop over points or pixels."""

inlined: Callable = njit(cache=True, nogil=True, error_model="numpy", forceinline=True, _nrt=False)
"""A function called inside such loops, that allocates nothing.

Without reference counting of the arrays that it looks at: counting took two thirds of the time
(1000 against 290 ns a ray, textures and shadows included).
"""
