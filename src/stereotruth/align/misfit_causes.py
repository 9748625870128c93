"""Why labels are less sure than the scatter of their tie points alone would have it, in words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .lack_of_fit import CHANCE, SharedErrors
from .line_fit import LineFit

Floats = NDArray[np.float64]


TOLD = 2.0  # times that σ grows, from which on it is said


@dataclass(frozen=True)
class LabelSigma:
    """Standard deviation px of disparity on level ground, median of the tie points: by the scatter
    of the tie points alone, and as labels state it."""

    by_scatter: float
    stated: float

    @classmethod
    def of(
        cls,
        design: Floats,
        lines: Floats,
        rows: int,
        covariances: tuple[Floats, Floats],
        fit: LineFit,
        shared: SharedErrors,
    ) -> LabelSigma:
        """At tie points: ``design`` [n, 12] along the rows, ``lines`` [n] of the left image, which
        has ``rows``; ``covariances`` [12, 12] of the parameters by scatter alone and as stated."""
        alone, all_ = (np.einsum("np,pq,nq->n", design, c, design) for c in covariances)
        all_ = all_ + shared.label_px**2
        if (nodes := fit.used_covariance) is not None:
            at = np.clip(np.rint(lines / (rows - 1.0) * (len(nodes) - 1)), 0, len(nodes) - 1)
            shifts = design[:, [2, 5, 8, 11]]
            all_ = all_ + np.einsum("np,npq,nq->n", shifts, nodes[at.astype(int)], shifts)
        return cls(*(float(np.sqrt(np.median(values))) for values in (alone, all_)))


def remark_of(sigma: LabelSigma, fit: LineFit, shared: SharedErrors) -> str:
    """A sentence where lines are corrected, or σ grows by more than TOLD; else nothing."""
    grown = sigma.stated > TOLD * sigma.by_scatter
    causes = []
    if fit.stands_out:
        along, across = fit.rms_px
        causes.append(
            f"the attitude jitters (residuals of tie points depend on the image line, by "
            f"{along:.2f} px along and {across:.2f} px across the lines), which is corrected by "
            "line"
        )
    if shared.sigma_px[0] and shared.chance[0] < CHANCE and grown:
        amount = f"{shared.sigma_px[0]:.3f} px of disparity"
        causes.append(
            f"residuals change smoothly over the scene and not by line ({amount}), as RPCs leave "
            "that no affine corrects"
            if shared.smooth
            else f"tie points near each other share errors, not by line ({amount}), as strips of "
            "the LiDAR that disagree leave"
        )
    if not causes:
        return ""
    stated = (
        f"the alignment's part of labels' uncertainty is {sigma.stated:.3f} px instead of "
        f"{sigma.by_scatter:.3f} px"
    )
    return "; ".join([*causes, stated] if grown else causes)
