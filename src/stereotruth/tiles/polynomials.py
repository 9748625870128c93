"""Polynomials of orientation files, in normalised coordinates: fitted, and evaluated."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def _monomials(t: Floats, exponents: NDArray[np.intp]) -> Floats:
    """Terms [n, m] of normalised inputs [k, n] for exponents [m, k]."""
    return np.prod(t.T[:, None, :] ** exponents[None], axis=2)


def _exponents(variables: int, degree: int) -> NDArray[np.intp]:
    every = itertools.product(range(degree + 1), repeat=variables)
    return np.array(sorted((e for e in every if sum(e) <= degree), key=lambda e: (sum(e), e)))


def evaluate(polynomial: Mapping[str, Any], *inputs: ArrayLike) -> dict[str, Floats]:
    """Outputs by name of a polynomial of an orientation file; inputs in its order."""
    arrays = np.broadcast_arrays(*(np.asarray(v, dtype=np.float64) for v in inputs))
    t = np.stack([a.ravel() for a in arrays])
    offset, scale = (np.array(polynomial[f"input_{k}"])[:, None] for k in ("offset", "scale"))
    terms = _monomials((t - offset) / scale, np.array(polynomial["exponents"]))
    return {
        name: (
            polynomial["output_offset"][name]
            + polynomial["output_scale"][name] * (terms @ np.array(coefficients))
        ).reshape(arrays[0].shape)
        for name, coefficients in polynomial["coefficients"].items()
    }


def _middle(values: Floats) -> tuple[float, float]:
    low, high = float(values.min()), float(values.max())
    return (low + high) / 2.0, max((high - low) / 2.0, 1e-12)


def fit(
    inputs: Mapping[str, Floats],
    outputs: Mapping[str, Floats],
    check_inputs: Sequence[Floats],
    check_outputs: Sequence[Floats],
    tolerance: Mapping[str, float],
) -> dict[str, Any]:
    """Least-squares polynomial of degree 3, or up to 5 where 3 misses the tolerance.

    All arrays are flat; the check points take no part in the fit and give ``max_error``.
    """
    names = list(outputs)
    offset, scale = zip(*(_middle(values) for values in inputs.values()))
    t = (np.stack(list(inputs.values())) - np.array(offset)[:, None]) / np.array(scale)[:, None]
    for degree in (3, 4, 5):
        exponents = _exponents(len(inputs), degree)
        terms = _monomials(t, exponents)
        record: dict[str, Any] = {
            "inputs": list(inputs),
            "outputs": names,
            "degree": degree,
            "input_offset": list(offset),
            "input_scale": list(scale),
            "output_offset": {},
            "output_scale": {},
            "exponents": exponents.tolist(),
            "coefficients": {},
        }
        for name, values in outputs.items():
            middle, half = _middle(values)
            solution = np.linalg.lstsq(terms, (values - middle) / half, rcond=None)[0]
            record["output_offset"][name] = middle
            record["output_scale"][name] = half
            # 1e-11 of a tile: far below any error here, and the same text on every machine.
            record["coefficients"][name] = [round(float(c), 11) + 0.0 for c in solution]
        got = evaluate(record, *check_inputs)
        error = {n: float(np.abs(got[n] - v).max()) for n, v in zip(names, check_outputs)}
        # Below a thousandth of the tolerance it is the rounding of this machine.
        record["max_error"] = {
            n: float(f"{max(e, tolerance[n] / 1000):.2g}") for n, e in error.items()
        }
        if all(error[n] <= tolerance[n] for n in names):
            break
    return record
