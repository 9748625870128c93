"""Standard deviations of the greatest likelihood, on a grid of ratios: the same on any machine."""

from __future__ import annotations

from collections.abc import Callable

Steps = tuple[int, ...]

STEP = 2.0**0.5
WIDEST = 12  # steps to either side of one; none at the lowest


def amount(step: int) -> float:
    """A standard deviation by its step, in a unit of the caller's."""
    return 0.0 if step <= -WIDEST else STEP**step


def climb(score: Callable[[Steps], float], start: Steps) -> tuple[Steps, float]:
    """Steps from ``start`` on to where no neighbour along an axis scores higher, and the score."""
    scores: dict[Steps, float] = {}

    def known(steps: Steps) -> float:
        if steps not in scores:
            scores[steps] = score(steps)
        return scores[steps]

    best, top = start, known(start)
    moved = True
    while moved:
        moved = False
        for axis in range(len(start)):
            for step in (-1, 1):
                while abs(best[axis] + step) <= WIDEST:
                    there = (*best[:axis], best[axis] + step, *best[axis + 1 :])
                    if not (value := known(there)) > top + 1e-9:
                        break
                    best, top, moved = there, value, True
    return best, top
