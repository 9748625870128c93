"""How points are judged and condensed."""

from __future__ import annotations

from dataclasses import dataclass

from ..errors import InputError
from .image_agreement import VOTE_PX
from .seen_surface import EDGE


@dataclass(frozen=True)
class Settings:
    """How points are judged and condensed; see the module and config/README.md."""

    method: str = "correlation"
    window: int = 9
    correlation_threshold: float = 0.5
    representative: str = "top"
    edge_margin_px: float = 0.0
    min_points: int = 1

    def __post_init__(self) -> None:
        for name, allowed in (("method", METHODS), ("representative", REPRESENTATIVES)):
            if getattr(self, name) not in allowed:
                raise InputError(
                    f"{name} is {getattr(self, name)!r}", remedy=f"take one of {', '.join(allowed)}"
                )
        if self.window < 3 or self.window % 2 == 0:
            raise InputError(
                f"correlation window of {self.window} px", remedy="take an odd number from 3 on"
            )

    @property
    def uses_seen_surface(self) -> bool:
        """Whether points off the surface that the centre sees count as hidden from the left."""
        return self.uses_geometry or self.representative == "top"

    @property
    def uses_geometry(self) -> bool:
        """Whether rays are tested against the surface of the points."""
        return self.method in ("geometric", "both")

    @property
    def images_window(self) -> int:
        """Side in px of the window that the method compares in both images; 1 for none."""
        return self.window if self.method in ("correlation", "both") else 1

    @property
    def margin(self) -> int:
        """Pixels around a window whose points have a say in it."""
        # one for each ring of neighbours: planes, their pooled noise, support
        reach = EDGE + 3
        return reach + VOTE_PX + self.window // 2 if self.method == "both" else reach


METHODS = ("correlation", "geometric", "both", "none")

REPRESENTATIVES = ("top", "paper")
