"""StereoNet (Khamis et al., ECCV 2018), in the variant of the WHU-Stereo authors."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .layers import (
    Conv2d,
    Conv3d,
    SoftArgmin,
    difference_volume,
    initialise,
    normalised,
    planes,
    residuals,
    resize,
)

CHANNELS = 32
SLOPE = 0.2  # of leaky ReLUs
DILATIONS = (1, 2, 4, 8, 1, 1)


class Features(nn.Sequential):
    """[N, C, H, W] images -> [N, 32, H / 8, W / 8]."""

    def __init__(self, channels: int) -> None:
        inputs = (channels, CHANNELS, CHANNELS)
        down = [normalised(Conv2d(n, CHANNELS, 5, 2), nn.ReLU(inplace=True)) for n in inputs]
        super().__init__(
            *down,
            residuals(CHANNELS, (1,) * 6, SLOPE, SLOPE),
            Conv2d(CHANNELS, CHANNELS, 3, bias=True),
        )


class Aggregation(nn.Sequential):
    """[N, 32, D, H, W] differences -> [N, 1, D, H, W] costs."""

    def __init__(self) -> None:
        super().__init__(
            *(
                normalised(Conv3d(CHANNELS, CHANNELS), nn.LeakyReLU(SLOPE, inplace=True))
                for _ in range(4)
            ),
            Conv3d(CHANNELS, 1, bias=True),
        )


class Refinement(nn.Module):
    """Adds to a disparity, brought to the size of the image, what the image tells about it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        first = Conv2d(1 + channels, CHANNELS, 3)
        self.layers = nn.Sequential(
            normalised(first, nn.LeakyReLU(SLOPE, inplace=True)),
            residuals(CHANNELS, DILATIONS, SLOPE, SLOPE),
            Conv2d(CHANNELS, 1, 3, bias=True),
        )

    def forward(self, disparity: Tensor, image: Tensor) -> Tensor:
        """[N, 1, h, w] in its own pixels, [N, C, H, W] -> [N, 1, H, W]."""
        size = image.shape[2:]
        disparity = resize(disparity, size) * (size[0] / disparity.shape[2])
        return disparity + self.layers(torch.cat([disparity, image], 1))


class StereoNet(nn.Module):
    """Matching by differences of features at 1/8 of the resolution, refined in three steps.

    ``disparity_range`` in px, multiples of 8, max exclusive; ``channels`` of the images.
    """

    divisor = 8
    plane_px = 8
    planes_divisor = 1
    loss_weights = (1.0, 1.0, 1.0, 1.0)
    regularisation = 1e-4
    margin_px = 192  # beyond, the frame of a real tile changed it by 0.003 px at most

    def __init__(self, disparity_range: tuple[int, int], channels: int = 1) -> None:
        super().__init__()
        self.set_range(disparity_range)
        self.expected = SoftArgmin()
        self.features = Features(channels)
        self.aggregation = Aggregation()
        self.refinements = nn.ModuleList(Refinement(channels) for _ in range(3))
        initialise(self)

    def set_range(self, disparity_range: tuple[int, int]) -> None:
        """Look for these disparities, px; no weight depends on them."""
        self.planes = planes(disparity_range, self.plane_px)

    def forward(self, left: Tensor, right: Tensor) -> list[Tensor]:
        """[N, C, H, W] images -> four [N, H, W] disparities in px, coarse to fine, of full size."""
        size = left.shape[2:]
        volume = difference_volume(self.features(left), self.features(right), *self.planes)
        cost = self.aggregation(volume).squeeze(1)
        disparity = self.expected(cost, self.planes[0]).unsqueeze(1)
        found = [disparity]
        for refine, scale in zip(self.refinements, (4, 2, 1)):
            image = left if scale == 1 else resize(left, [side // scale for side in size])
            disparity = refine(disparity, image)
            found.append(disparity)
        if not self.training:
            return [disparity.squeeze(1)]
        full = [resize(d, size) * (size[0] / d.shape[2]) for d in found[:-1]]
        return [d.squeeze(1) for d in (*full, disparity)]
