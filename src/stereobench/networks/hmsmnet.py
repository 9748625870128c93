"""HMSM-Net (He, Li, Jiang, Jiang, ISPRS Journal 2022): hierarchical multi-scale matching."""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from .layers import (
    Conv2d,
    Conv3d,
    ConvTranspose3d,
    SoftArgmin,
    concatenation_volume,
    initialise,
    normalised,
    planes,
    residuals,
    resize,
)

CHANNELS = 16
SLOPE, REFINER_SLOPE = 0.2, 0.3  # of leaky ReLUs
SCALES = (4, 8, 16)


class Features(nn.Module):
    """[N, C, H, W] images -> 16 channels at 1/4, 1/8 and 1/16 of the resolution."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        n = CHANNELS
        self.trunk = nn.Sequential(
            normalised(Conv2d(channels, n, 5, 2), nn.ReLU(inplace=True)),
            normalised(Conv2d(n, 2 * n, 5, 2), nn.ReLU(inplace=True)),
            residuals(2 * n, (1, 1, 1, 1, 2, 2, 4, 4, 1, 1), 0.0, 0.0),
        )
        self.branches = nn.ModuleList(
            nn.Sequential(nn.AvgPool2d(side), Conv2d(2 * n, n, 1, bias=True)) for side in (1, 2, 4)
        )

    def forward(self, x: Tensor) -> list[Tensor]:
        """Sides of the images are multiples of 16 px."""
        x = self.trunk(x)
        return [branch(x) for branch in self.branches]


def _conv(inputs: int, outputs: int, stride: int = 1) -> nn.Sequential:
    activation = nn.LeakyReLU(SLOPE, inplace=True)
    return normalised(Conv3d(inputs, outputs, stride=stride), activation)


def _up(inputs: int, outputs: int) -> nn.Sequential:
    return normalised(ConvTranspose3d(inputs, outputs, 4), nn.LeakyReLU(SLOPE, inplace=True))


class Hourglass(nn.Module):
    """Down twice and up again: [N, C, D, H, W] -> [N, 16, D, H, W]; sides are multiples of 4."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        n = CHANNELS
        self.start = nn.Sequential(_conv(inputs, n), _conv(n, n))
        self.down = nn.Sequential(_conv(n, 2 * n, 2), _conv(2 * n, 2 * n))
        self.bottom = nn.Sequential(_conv(2 * n, 2 * n, 2), _conv(2 * n, 2 * n))
        self.up = _up(2 * n, 2 * n)
        self.top = _up(2 * n, n)

    def forward(self, x: Tensor) -> Tensor:
        """See the class."""
        start = self.start(x)
        down = self.down(start)
        return self.top(self.up(self.bottom(down)) + down) + start


class Fusion(nn.Module):
    """Weighs a coarser cost volume against a finer one, channel by channel, by what both hold."""

    def __init__(self) -> None:
        super().__init__()
        n = CHANNELS
        self.gate = nn.Sequential(
            nn.Linear(n, n), nn.ReLU(inplace=True), nn.Linear(n, n), nn.Sigmoid()
        )

    def forward(self, coarse: Tensor, fine: Tensor) -> Tensor:
        """[N, C, D / 2, H / 2, W / 2], [N, C, D, H, W] -> [N, C, D, H, W]."""
        coarse = F.interpolate(coarse, size=fine.shape[2:], mode="nearest")
        share = self.gate((coarse + fine).mean((2, 3, 4)))[:, :, None, None, None]
        return coarse * share + fine * (1 - share)


class HMSMNet(nn.Module):
    """Matching at 1/16, 1/8 and 1/4 of the resolution, each led by the one before, and refined.

    ``disparity_range`` in px, max exclusive: from a multiple of 16 over multiples of 64;
    ``channels`` of the images.
    """

    divisor = 64
    plane_px = 16  # of the coarsest volume
    planes_divisor = 4
    loss_weights = (0.5, 0.7, 1.0, 0.6)
    regularisation = 1e-5
    margin_px = 512

    def __init__(self, disparity_range: tuple[int, int], channels: int = 1) -> None:
        super().__init__()
        self.set_range(disparity_range)
        self.expected = SoftArgmin()
        self.features = Features(channels)
        self.hourglasses = nn.ModuleList(Hourglass(2 * CHANNELS) for _ in SCALES)
        self.estimators = nn.ModuleList(Conv3d(CHANNELS, 1, bias=True) for _ in SCALES)
        self.fusions = nn.ModuleList(Fusion() for _ in range(2))
        self.fused = nn.ModuleList(Hourglass(CHANNELS) for _ in range(2))
        inputs = (1 + 3 * channels, 32, 32, 32, 32)
        self.refinement = nn.Sequential(
            *(
                normalised(Conv2d(n, 32, 3, 1, d), nn.LeakyReLU(REFINER_SLOPE, inplace=True))
                for n, d in zip(inputs, (1, 1, 2, 3, 1))
            ),
            Conv2d(32, 1, 3, bias=True),
        )
        initialise(self)

    def set_range(self, disparity_range: tuple[int, int]) -> None:
        """Look for these disparities, px; no weight depends on them."""
        planes(disparity_range, self.plane_px, self.planes_divisor)
        self.planes = [planes(disparity_range, scale) for scale in SCALES]

    def forward(self, left: Tensor, right: Tensor) -> list[Tensor]:
        """[N, C, H, W] images -> disparities at 1/16, 1/8, 1/4 (in their own px) and full size."""
        volumes = [
            hourglass(concatenation_volume(a, b, *span))
            for hourglass, a, b, span in zip(
                self.hourglasses, self.features(left), self.features(right), self.planes
            )
        ]
        x, found = volumes[-1], []
        for k in (2, 1, 0):
            if k < 2:
                x = self.fused[1 - k](self.fusions[1 - k](x, volumes[k]))
            if k == 0 or self.training:
                found.append(self.expected(self.estimators[k](x).squeeze(1), self.planes[k][0]))
        disparity = 4 * resize(found[-1].unsqueeze(1), left.shape[2:])
        hints = torch.cat([disparity, left, *gradients(left)], 1)
        final = (disparity + self.refinement(hints)).squeeze(1)
        return [*found, final] if self.training else [final]


def gradients(image: Tensor) -> tuple[Tensor, Tensor]:
    """Differences of the pixels before and after, along rows and along columns; 0 outside."""
    along, down = F.pad(image, (1, 1)), F.pad(image, (0, 0, 1, 1))
    return along[..., :-2] - along[..., 2:], down[..., :-2, :] - down[..., 2:, :]
