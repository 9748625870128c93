"""What a pixel is in metres: on the ground, and in height for one px of disparity."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean
from typing import Any

from ..core.numerics.geometry import metres_per_degree
from .polynomials import evaluate


@dataclass(frozen=True)
class PixelSize:
    """Metres of one px: ``ground_m`` along a row, ``height_m`` for one px of disparity."""

    ground_m: float
    height_m: float

    @property
    def base_to_height(self) -> float:
        """Parallax on the ground for one metre of height."""
        return self.ground_m / self.height_m

    @classmethod
    def of(cls, orientation: Mapping[str, Any]) -> PixelSize:
        """In the middle of a tile and of its disparities, by its orientation record."""
        ground = orientation["ground"]
        middle = orientation["window"]["size"] / 2
        low, high = ground["disparity_range_px"]
        d = (low + high) / 2
        below, above = (evaluate(ground, middle, middle, d + k)["height"] for k in (-0.5, 0.5))
        a, b = (evaluate(ground, middle + k, middle, d) for k in (-0.5, 0.5))
        degrees = b["lon"] - a["lon"], b["lat"] - a["lat"]
        return cls(math.hypot(*(degrees * metres_per_degree(a["lat"]))), float(above - below))

    @classmethod
    def mean(cls, orientations: Iterable[Path]) -> PixelSize | None:
        """Of several tiles' orientation files, those that are there; None of none."""
        found = [
            cls.of(json.loads(file.read_text(encoding="utf-8")))
            for file in orientations
            if file.is_file()
        ]
        if not found:
            return None
        return cls(fmean(p.ground_m for p in found), fmean(p.height_m for p in found))
