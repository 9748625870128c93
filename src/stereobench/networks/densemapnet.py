"""DenseMapNet (Atienza, ICRA 2018), in the variant of the Data Fusion Contest 2019 (track 2).

The variant has separable convolutions and regresses disparities in px, of any sign and size. A
network without cost volume learns its disparities' range, and no other can be asked for.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import EPSILON, MOMENTUM, initialise, planes

STEREO, LEFT = 32, 16  # channels of features of both images, of the left image alone
WIDE, GROWTH = 64, 16  # channels within a step of the disparity part, and those that it adds
DILATIONS = (1, 2, 3, 4)
CELL = 8  # px of a pooled pixel
DROPOUT = 0.2


class Separable(nn.Sequential):
    """A convolution of each channel by itself, then one over all channels; with "same" padding."""

    def __init__(self, inputs: int, outputs: int, kernel: int, dilation: int = 1) -> None:
        super().__init__(
            nn.Conv2d(
                inputs,
                inputs,
                kernel,
                padding=dilation * (kernel // 2),
                dilation=dilation,
                groups=inputs,
                bias=False,
            ),
            nn.Conv2d(inputs, outputs, 1),
        )


class Normalised(nn.BatchNorm2d):
    """Batch normalisation and ReLU of [N, C, H, W]."""

    def __init__(self, channels: int) -> None:
        super().__init__(channels, eps=EPSILON, momentum=MOMENTUM)

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, H, W] -> the same."""
        return F.relu(super().forward(x))


class DenseMapNet(nn.Module):
    """Disparities regressed from both images at 1/8 of the resolution, then refined by the left.

    ``disparity_range``: what the network is trained for; the structure does not depend on it.
    ``channels`` of each image.
    """

    divisor = CELL
    plane_px = 1
    planes_divisor = 1
    loss_weights = (1.0,)
    regularisation = 0.0
    colour_scaling = "dfc2019"
    margin_px = 256  # farther pixels change nothing: 28 cells and 12 px

    def __init__(self, disparity_range: tuple[int, int], channels: int = 1) -> None:
        super().__init__()
        self.set_range(disparity_range)
        seen = STEREO * (1 + len(DILATIONS)) + LEFT
        grown = [seen + k * GROWTH for k in range(len(DILATIONS) + 1)]
        # in the order in which weights are stored
        self.stereo = Separable(2 * channels, STEREO, 5)
        self.stereo_norm = Normalised(STEREO)
        self.correspondences = nn.ModuleList(Separable(STEREO, STEREO, 5, d) for d in DILATIONS)
        self.left = Separable(channels, LEFT, 5)
        self.steps = nn.ModuleList(
            part
            for dilation, inputs in zip(DILATIONS, grown)
            for part in (
                Normalised(inputs),
                Separable(inputs, WIDE, 1),
                Normalised(WIDE),
                Separable(WIDE, GROWTH, 5, dilation),
            )
        )
        self.coarse_norm = Normalised(grown[-1])
        self.coarse = Separable(grown[-1], STEREO, 1)
        self.edges = Separable(channels, 1, 5, 2)
        self.fine_norm = Normalised(STEREO + 1)
        self.fine = Separable(STEREO + 1, GROWTH, 5)
        self.last_norm = Normalised(STEREO + 1 + GROWTH)
        self.last = nn.ConvTranspose2d(STEREO + 1 + GROWTH, 1, 9, padding=4)
        initialise(self)

    def set_range(self, disparity_range: tuple[int, int]) -> None:
        """Nothing to set; raises ValueError if the range is empty."""
        planes(disparity_range, self.plane_px)

    def forward(self, left: Tensor, right: Tensor) -> list[Tensor]:
        """[N, C, H, W] images -> one [N, H, W] disparity in px."""
        both = self.stereo(torch.cat([left, right], 1))
        both = self.stereo_norm(F.max_pool2d(both, CELL))
        seen = both
        for part in self.correspondences:
            seen = torch.cat([self._dropped(part(both)), seen], 1)
        known, new = F.max_pool2d(self.left(left), CELL), seen
        for first in range(0, len(self.steps), 4):
            norm, narrow, narrow_norm, widen = self.steps[first : first + 4]
            known = torch.cat([known, new], 1)
            new = self._dropped(widen(narrow_norm(narrow(norm(known)))))
        coarse = self.coarse(self.coarse_norm(torch.cat([known, new], 1)))
        full = F.interpolate(coarse, scale_factor=float(CELL), mode="nearest")
        full = torch.cat([full, self.edges(left)], 1)
        full = torch.cat([full, self.fine(self.fine_norm(full))], 1)
        return [self.last(self.last_norm(full)).squeeze(1)]

    def _dropped(self, x: Tensor) -> Tensor:
        return F.dropout(x, DROPOUT, self.training)
