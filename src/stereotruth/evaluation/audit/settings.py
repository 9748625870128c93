"""Settings of the audit."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from ...settings import Number, Share, Unit, Whole, settings

Pixels = Annotated[Number, Field(gt=0), Unit("px")]


@settings
class Limits:
    """Tolerances (px, shares) and the rate of false alarms per check and dataset."""

    parallax_px: Pixels = 0.3
    """[audit](#audit): a pair whose vertical parallax is larger, in its middle or from there to an
    edge, is faulty, as is what exceeds the limits below"""

    label_bias_px: Pixels = 0.3
    """label - match of the images, likewise"""

    contradicted_share: Share = 0.03
    """labels that the images contradict: they correlate better elsewhere"""

    hidden_share: Share = 0.02
    """labels on pixels that other labels hide from the right view"""

    false_alarms: Annotated[Number, Field(gt=0, lt=1), Unit("rate")] = 0.01
    """how often a check may call any pair of a faultless dataset faulty; the confidence intervals
    of the verdicts follow from it"""


@settings
class Settings(Limits):
    """The configuration's section audit."""

    worst: Annotated[Whole, Field(ge=0), Unit("pairs")] = 12
    """that have pictures on the page"""

    @property
    def limits(self) -> Limits:
        """What the verdicts follow from."""
        return Limits(**{name: getattr(self, name) for name in Limits.__dataclass_fields__})
