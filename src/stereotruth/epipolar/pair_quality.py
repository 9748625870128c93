"""How well a pair of a site will match, predicted from its geometry, its suns and its LiDAR.

``matched`` is the share of the pixels that both images show whose disparity semi-global matching
finds within 1 px. Its log odds fall with the base over the height (what stands up looks different
from its sides, and steps along the rows grow), with the way of the shadows between the images, and
with the roughness of the site (:func:`stereotruth.lidar.roughness.roughness_m`), as far as its
LiDAR has been read. The roughness is that of all pairs of a site and orders none of them. The
coefficients are fitted, and the prediction is tested on other sites, by ``bench/pairs.py``;
the ratio of the pixel sizes, the days between the images, their season, the asymmetry and the
obliqueness of the pair explained nothing beside them there. What the simulated sites lack, clouds,
snow, haze and what people change, lowers the share of real pairs of dates far apart.

How well heights follow from a match is geometry alone: ``SitePair.metres_per_px``.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from .site_pairs import SiteImage, SitePair, pairs_of_site

# log odds of a wrong match: of a usual site at no base and no way of the shadows; then by each
WRONG_AT_NOTHING = -2.8
BY_BASE = 2.2  # per base over height
BY_SHADOW = 1.3  # per height of what casts the shadow
BY_ROUGHNESS = 1.6  # per logarithm of the roughness over the usual one
USUAL_ROUGHNESS_M = 1.3  # the median of the simulated sites
SMOOTHEST_M = 0.1  # steps of bare ground and noise
UNKNOWN_SHADOW = 0.4  # of a pair of unknown dates: the median of the simulated ones
LEAST_CONVERGENCE_DEG = 5.0  # below it heights follow badly (asp_plot: 5 to 15 for cities)
WORTH_SAYING = 0.5  # log odds


@dataclass(frozen=True)
class Quality:
    """``matched``: predicted share of right matches; ``reason``: what lowers it most."""

    matched: float
    reason: str


def quality_of(pair: SitePair, roughness_m: float | None = None) -> Quality:
    """The predicted quality of a pair, from what is known before it is matched.

    ``roughness_m`` of its site; None: not known, taken as the usual one.
    """
    roughness = USUAL_ROUGHNESS_M if roughness_m is None else max(roughness_m, SMOOTHEST_M)
    of_site = BY_ROUGHNESS * math.log(roughness / USUAL_ROUGHNESS_M)
    shadow = UNKNOWN_SHADOW if pair.shadow is None else pair.shadow
    terms = {
        f"{pair.convergence:.0f}° apart: much is hidden or seen askew": BY_BASE * pair.base,
        f"shadows move by {shadow:.1f} of what casts them": BY_SHADOW * shadow,
    }
    wrong = 1.0 / (1.0 + math.exp(-WRONG_AT_NOTHING - of_site - sum(terms.values())))
    reason, worst = max(terms.items(), key=lambda item: item[1])
    if worst < WORTH_SAYING:
        reason = "alike in angle and light"
    if pair.shadow is None:
        reason = "no date of one image: its sun is not known"
    if pair.convergence < LEAST_CONVERGENCE_DEG:
        reason = f"heights follow badly: 1 px is {pair.metres_per_px:.0f} m"
    return Quality(1.0 - wrong, reason)


@dataclass(frozen=True)
class RatedPair:
    """A pair and its predicted quality."""

    pair: SitePair
    quality: Quality


def rate(images: Sequence[SiteImage], roughness_m: float | None = None) -> list[RatedPair]:
    """All pairs of a site that share ground, best first, whatever the order of its images.

    ``roughness_m``: see :func:`quality_of`.
    """
    rated = [RatedPair(pair, quality_of(pair, roughness_m)) for pair in pairs_of_site(images)]
    return sorted(rated, key=lambda r: (-r.quality.matched, r.pair.left, r.pair.right))
