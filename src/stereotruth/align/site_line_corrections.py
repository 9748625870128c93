"""What corrections by line of a site's images are, and what they change for a pair of these."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..sensor.rpc import LineCorrection

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SiteLines:
    """``corrections`` by number of the images that have one; ``covariance`` [k, 4, 4] px² by scene,
    see :class:`.line_fit.LineFit`."""

    corrections: Mapping[int, LineCorrection]
    covariance: Mapping[str, Floats]

    def effect(self, design: Floats, lines: Floats, images: tuple[int, int]) -> Floats | float:
        """[n, 2] px: what the corrections of a pair's ``images`` change, along and across.

        ``design`` [n, 2, 12] of the affines, ``lines`` [n, 2] px.
        """
        total: Floats | float = 0.0
        for k, image in enumerate(images):
            if image in self.corrections:
                shift = self.corrections[image].at(lines[:, k])
                for axis in (0, 1):
                    total = total + design[:, :, 6 * k + 2 + 3 * axis] * shift[axis, :, None]
        return total
