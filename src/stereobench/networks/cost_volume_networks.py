"""StereoNet, PSM-Net and HMSM-Net, in the variants of the WHU-Stereo authors.

StereoNet: Khamis et al., ECCV 2018. PSM-Net: Chang and Chen, CVPR 2018; it differs from the
original by hourglasses of half the width, classifiers that look at one plane at a time, and
upsampling of the costs to the nearest pixel and plane. HMSM-Net: He, Li, Jiang, Jiang, ISPRS
Journal 2022, hierarchical multi-scale matching.

``disparity_range`` of a network is in px, max exclusive, a multiple of what its class says;
``channels`` are those of its images. No weight depends on the range.
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
    difference_volume,
    initialise,
    normalised,
    planes,
    residuals,
    resize,
)

SLOPE, REFINER_SLOPE = 0.2, 0.3  # of leaky ReLUs
STEREONET_CHANNELS = 32
DILATIONS = (1, 2, 4, 8, 1, 1)

PSMNET_CHANNELS = 32
POOLS = (64, 32, 16, 8)  # sides of the averaged squares, in pixels of the features

HMSMNET_CHANNELS = 16
SCALES = (4, 8, 16)


class StereoNetFeatures(nn.Sequential):
    """[N, C, H, W] images -> [N, 32, H / 8, W / 8]."""

    def __init__(self, channels: int) -> None:
        inputs = (channels, STEREONET_CHANNELS, STEREONET_CHANNELS)
        down = [
            normalised(Conv2d(n, STEREONET_CHANNELS, 5, 2), nn.ReLU(inplace=True)) for n in inputs
        ]
        super().__init__(
            *down,
            residuals(STEREONET_CHANNELS, (1,) * 6, SLOPE, SLOPE),
            Conv2d(STEREONET_CHANNELS, STEREONET_CHANNELS, 3, bias=True),
        )


class Aggregation(nn.Sequential):
    """[N, 32, D, H, W] differences -> [N, 1, D, H, W] costs."""

    def __init__(self) -> None:
        super().__init__(
            *(
                normalised(
                    Conv3d(STEREONET_CHANNELS, STEREONET_CHANNELS),
                    nn.LeakyReLU(SLOPE, inplace=True),
                )
                for _ in range(4)
            ),
            Conv3d(STEREONET_CHANNELS, 1, bias=True),
        )


class Refinement(nn.Module):
    """Adds to a disparity, brought to the size of the image, what the image tells about it."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        first = Conv2d(1 + channels, STEREONET_CHANNELS, 3)
        self.layers = nn.Sequential(
            normalised(first, nn.LeakyReLU(SLOPE, inplace=True)),
            residuals(STEREONET_CHANNELS, DILATIONS, SLOPE, SLOPE),
            Conv2d(STEREONET_CHANNELS, 1, 3, bias=True),
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
        self.features = StereoNetFeatures(channels)
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


def _conv2d(inputs: int, outputs: int, kernel: int = 3, stride: int = 1) -> nn.Sequential:
    return normalised(Conv2d(inputs, outputs, kernel, stride), nn.ReLU(inplace=True))


def _conv3d(inputs: int, outputs: int, stride: int = 1, relu: bool = True) -> nn.Sequential:
    activation = nn.ReLU(inplace=True) if relu else None
    return normalised(Conv3d(inputs, outputs, stride=stride), activation)


class PSMNetFeatures(nn.Module):
    """[N, C, H, W] images -> [N, 32, H / 4, W / 4], by spatial pyramid pooling."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        n = PSMNET_CHANNELS
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


class PSMNetHourglass(nn.Module):
    """The layers of an hourglass, down twice and up again; see :meth:`PSMNet.forward`."""

    def __init__(self) -> None:
        super().__init__()
        n = PSMNET_CHANNELS
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
        n = PSMNET_CHANNELS
        self.features = PSMNetFeatures(channels)
        self.before = nn.Sequential(_conv3d(2 * n, n // 2), _conv3d(n // 2, n // 2))
        self.residual = nn.Sequential(_conv3d(n // 2, n // 2), _conv3d(n // 2, n // 2, relu=False))
        self.hourglasses = nn.ModuleList(PSMNetHourglass() for _ in range(3))
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


class HMSMNetFeatures(nn.Module):
    """[N, C, H, W] images -> 16 channels at 1/4, 1/8 and 1/16 of the resolution."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        n = HMSMNET_CHANNELS
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


class HMSMNetHourglass(nn.Module):
    """Down twice and up again: [N, C, D, H, W] -> [N, 16, D, H, W]; sides are multiples of 4."""

    def __init__(self, inputs: int) -> None:
        super().__init__()
        n = HMSMNET_CHANNELS
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
        n = HMSMNET_CHANNELS
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
        self.features = HMSMNetFeatures(channels)
        self.hourglasses = nn.ModuleList(HMSMNetHourglass(2 * HMSMNET_CHANNELS) for _ in SCALES)
        self.estimators = nn.ModuleList(Conv3d(HMSMNET_CHANNELS, 1, bias=True) for _ in SCALES)
        self.fusions = nn.ModuleList(Fusion() for _ in range(2))
        self.fused = nn.ModuleList(HMSMNetHourglass(HMSMNET_CHANNELS) for _ in range(2))
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
