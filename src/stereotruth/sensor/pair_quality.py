"""What a pair of a site will give, predicted from its geometry, its suns and its LiDAR.

Pairs are ranked by the information about heights that a pixel of theirs is expected to give: the
share of pixels that can be matched, times what a match tells of the height. A match of standard
uncertainty MATCH_SIGMA_PX tells a height to ``height_sigma_m`` (metres a pixel times that), and
so ½ log₂(1 + (RELIEF_M / height_sigma_m)²) bits of what stands RELIEF_M high (Shannon 1949). Wide
pairs match less, narrow pairs tell less: the best lie between, at 10 to 30° in most cities.

``matched`` is the share of the pixels that both images show whose disparity semi-global matching
finds within 1 px. Its log odds fall with the base over the height (what stands up looks different
from its sides, and steps along the rows grow), with the way of the shadows between the images, and
with the roughness of the site (:func:`stereotruth.lidar.point_statistics.roughness_m`), as far as
its LiDAR has been read. The roughness is that of all pairs of a site and orders none of them. The
coefficients are fitted, and the prediction is tested on other sites, by ``bench/pairs.py``;
the ratio of the pixel sizes, the days between the images, their season, the asymmetry and the
obliqueness of the pair explained nothing beside them there. What the simulated sites lack, clouds,
snow, haze and what people change, lowers the share of real pairs of dates far apart.
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
MATCH_SIGMA_PX = 0.3  # of a right match of semi-global matching
RELIEF_M = 10.0  # what heights are to be told apart: a building of three storeys
COARSE_SIGMA_M = 1.0  # heights to less than a third of a storey
WORTH_SAYING = 0.1  # loss of matched


@dataclass(frozen=True)
class Quality:
    """What a pair is expected to give.

    ``matched``: share of right matches; ``height_sigma_m``: standard uncertainty of a height from
    one match; ``bits``: information about the height that a pixel gives; ``reason``: what lowers
    it most.
    """

    matched: float
    height_sigma_m: float
    bits: float
    reason: str


def quality_of(pair: SitePair, roughness_m: float | None = None) -> Quality:
    """The predicted quality of a pair, from what is known before it is matched.

    ``roughness_m`` of its site; None: not known, taken as the usual one.
    """
    roughness = USUAL_ROUGHNESS_M if roughness_m is None else max(roughness_m, SMOOTHEST_M)
    of_site = BY_ROUGHNESS * math.log(roughness / USUAL_ROUGHNESS_M)
    shadow = UNKNOWN_SHADOW if pair.shadow is None else pair.shadow
    hidden, moved = BY_BASE * pair.base, BY_SHADOW * shadow
    matched = _matched(of_site + hidden + moved)
    losses = {
        f"{pair.convergence:.0f}° apart: much is hidden or seen askew": hidden,
        f"shadows move by {shadow:.1f} of what casts them": moved,
    }
    reason, worst = max(losses.items(), key=lambda item: item[1])
    if _matched(of_site + hidden + moved - worst) - matched < WORTH_SAYING:
        reason = "alike in angle and light"
    if pair.shadow is None:
        reason = "no date of one image: its sun is not known"
    sigma = pair.metres_per_px * MATCH_SIGMA_PX
    if sigma > COARSE_SIGMA_M:
        reason = f"heights follow badly: 1 px is {pair.metres_per_px:.1f} m"
    bits = matched * math.log2(1.0 + (RELIEF_M / sigma) ** 2) / 2
    return Quality(matched, sigma, bits, reason)


def _matched(log_odds: float) -> float:
    return 1.0 - 1.0 / (1.0 + math.exp(-WRONG_AT_NOTHING - log_odds))


@dataclass(frozen=True)
class RatedPair:
    """A pair and its predicted quality."""

    pair: SitePair
    quality: Quality

    @property
    def names(self) -> tuple[str, str]:
        """Of the left and the right image."""
        return self.pair.left, self.pair.right


def rate(images: Sequence[SiteImage], roughness_m: float | None = None) -> list[RatedPair]:
    """All pairs of a site that share ground, best first, whatever the order of its images.

    ``roughness_m``: see :func:`quality_of`.
    """
    rated = [RatedPair(pair, quality_of(pair, roughness_m)) for pair in pairs_of_site(images)]
    return sorted(rated, key=lambda r: (-r.quality.bits, r.pair.left, r.pair.right))
