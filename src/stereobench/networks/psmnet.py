"""PSM-Net (Chang and Chen, CVPR 2018), in the variant of the WHU-Stereo authors.

It differs from the original by hourglasses of half the width, classifiers that look at one plane
at a time, and upsampling of the costs to the nearest pixel and plane.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import (
    Conv2d,
    Conv3d,
    ConvTranspose3d,
    Residual,
    SoftArgmin,
    concatenation_volume,
    initialise,
    normalised,
    planes,
    residuals,
    resize,
)

CHANNELS = 32
POOLS = (64, 32, 16, 8)  # sides of the averaged squares, in pixels of the features


def _conv2d(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return normalised(Conv2d(inputs, outputs, kernel, stride), nn.ReLU(inplace=True))


def _conv3d(inputs: int, outputs: int, stride: int = 1, relu: bool = True) -> nn.Sequential:
    activation = nn.ReLU(inplace=True) if relu else None
    return normalised(Conv3d(inputs, outputs, stride=stride), activation)


class Features(nn.Module):
    """[N, C, H, W] images -> [N, 32, H / 4, W / 4], by spatial pyramid pooling."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        n = CHANNELS
        self.start = nn.Sequential(_conv2d(channels, n, stride=2), _conv2d(n, n), _conv2d(n, n))
        self.fine = residuals(n, (1, 1), 0.0, None)
        self.down = Residual(n, 2 * n, between=0.0, after=None, stride=2)
        self.coarse = residuals(2 * n, (1,) * 12, 0.0, None)
        self.wide = residuals(2 * n, (2, 2, 4, 4), 0.0, None)
        self.branches = nn.ModuleList(
            nn.Sequential(nn.AvgPool2d(side), _conv2d(2 * n, n, 1)) for side in POOLS
        )
        self.fusion = nn.Sequential(_conv2d(4 * n + len(POOLS) * n, n), Conv2d(n, n, 1))

    def forward(self, x: Tensor) -> Tensor:
        """Sides of the images are multiples of 256 px."""
        coarse = self.coarse(self.down(self.fine(self.start(x))))
        wide = self.wide(coarse)
        size = wide.shape[2:]
        pooled = [resize(branch(wide), size) for branch in self.branches]
        return self.fusion(torch.cat([coarse, wide, *pooled], 1))


class Hourglass(nn.Module):
    """The layers of an hourglass, down twice and up again; see :meth:`PSMNet.forward`."""

    def __init__(self) -> None:
        super().__init__()
        n = CHANNELS
        self.down = nn.Sequential(_conv3d(n // 2, n, stride=2), _conv3d(n, n, relu=False))
        self.bottom = nn.Sequential(_conv3d(n, n, stride=2), _conv3d(n, n))
        self.up = normalised(ConvTranspose3d(n, n, 3))
        self.top = normalised(ConvTranspose3d(n, n // 2, 3))


class PSMNet(nn.Module):
    """Matching by three stacked hourglasses over features of both images at 1/4 of the resolution.

    ``disparity_range`` in px, max exclusive: from a multiple of 4 over multiples of 16;
    ``channels`` of the images.
    """

    divisor = 256
    plane_px = 4
    planes_divisor = 4
    loss_weights = (0.5, 0.7, 1.0)
    regularisation = 1e-4
    margin_px = 512

    def __init__(self, disparity_range: tuple[int, int], channels: int = 1) -> None:
        super().__init__()
        self.set_range(disparity_range)
        self.expected = SoftArgmin()
        n = CHANNELS
        self.features = Features(channels)
        self.before = nn.Sequential(_conv3d(2 * n, n // 2), _conv3d(n // 2, n // 2))
        self.residual = nn.Sequential(_conv3d(n // 2, n // 2), _conv3d(n // 2, n // 2, relu=False))
        self.hourglasses = nn.ModuleList(Hourglass() for _ in range(3))
        self.classifiers = nn.ModuleList(
            nn.Sequential(_conv3d(n // 2, n // 2), Conv3d(n // 2, 1, (1, 3, 3))) for _ in range(3)
        )
        initialise(self)

    def set_range(self, disparity_range: tuple[int, int]) -> None:
        """Look for these disparities, px; no weight depends on them."""
        self.planes = planes(disparity_range, self.plane_px, self.planes_divisor)

    def forward(self, left: Tensor, right: Tensor) -> list[Tensor]:
        """[N, C, H, W] images -> three [N, H, W] disparities in px, of full size."""
        volume = concatenation_volume(self.features(left), self.features(right), *self.planes)
        x = self.before(volume)
        start = x + self.residual(x)
        x, middle, first = start, None, None  # middle: half-way up the hourglass before
        costs: list[Tensor] = []
        for hourglass, classify in zip(self.hourglasses, self.classifiers):
            down = hourglass.down(x)
            if middle is not None:
                down = down + middle
            first = down if first is None else first
            middle = hourglass.up(hourglass.bottom(down)) + first
            x = hourglass.top(middle) + start
            cost = classify(x).squeeze(1)
            costs.append(cost if not costs else cost + costs[-1])
        if not self.training:
            costs = costs[-1:]
        return [self._disparity(cost) for cost in costs]

    def _disparity(self, cost: Tensor) -> Tensor:
        """Costs at 1/4 of the resolution -> disparities of full size.

        A plane stands for the four disparities to which its cost would be spread, and thus for
        their mean; a pixel likewise for 4 x 4.
        """
        disparity = self.expected(cost, 4 * self.planes[0] + 1.5, 4.0)
        return F.interpolate(disparity.unsqueeze(1), scale_factor=4.0, mode="nearest").squeeze(1)
