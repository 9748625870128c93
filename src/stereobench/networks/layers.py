"""What the stereo networks are built of: convolutions, cost volumes, soft-argmin.

Weights made by Keras must give the same results here, hence Keras' conventions: "same" padding of a
strided convolution puts the odd row and column at the end, batch normalisation has an epsilon of
1e-3 and keeps 99 % of its statistics at each step, kernels start from He's normal distribution.

For the gradient of a convolution by its kernel, on a CPU, oneDNN takes 5 to 13 times as long as for
the convolution itself where the image is large and the kernel is spread (AVX2, float32). So that
gradient is computed here, as products of matrices (:func:`kernel_gradient`): twice as long.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

CHANNELS = 16  # from here on, in and out, products of matrices are faster

EPSILON, MOMENTUM = 1e-3, 0.01  # of batch normalisation
TRAINED = (nn.Conv2d, nn.Conv3d, nn.ConvTranspose2d, nn.ConvTranspose3d, nn.Linear)  # kernels
SMALL = 20480  # channels x planes x rows; see _is_slow


def convolve(x: Tensor, kernel: Tensor, bias: Tensor | None, dilation: int) -> Tensor:
    """[N, C, H, W] -> [N, C', H, W]: stride 1, "same" padding, odd square kernel [C', C, k, k]."""
    extent = dilation * (kernel.shape[-1] // 2)
    ours = (
        kernel.requires_grad
        and torch.is_grad_enabled()
        and x.device.type == "cpu"
        and not torch.is_autocast_enabled("cpu")
        and min(kernel.shape[:2]) >= CHANNELS
    )
    if not ours:
        return F.conv2d(x, kernel, bias, 1, extent, dilation)
    y = _Convolution.apply(x, kernel, extent, dilation)
    return y if bias is None else y + bias[:, None, None]


class _Convolution(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x, kernel, extent, dilation):  # type: ignore[no-untyped-def]
        ctx.save_for_backward(x, kernel)
        ctx.extent, ctx.dilation = extent, dilation
        return F.conv2d(x, kernel, None, 1, extent, dilation)

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]
        x, kernel = ctx.saved_tensors
        to_x = None
        if ctx.needs_input_grad[0]:
            to_x, _, _ = torch.ops.aten.convolution_backward(
                gradient,
                x,
                kernel,
                None,
                [1, 1],
                [ctx.extent, ctx.extent],
                [ctx.dilation, ctx.dilation],
                False,
                [0, 0],
                1,
                [True, False, False],
            )
        return to_x, kernel_gradient(x, gradient, kernel.shape[-1], ctx.dilation), None, None


def kernel_gradient(x: Tensor, gradient: Tensor, side: int, dilation: int) -> Tensor:
    """Of a convolution's input [N, C, H, W] and its output's gradient [N, C', H, W]: [C', C, k, k].

    Each tap of the kernel is the product of the two images, moved against each other, summed over
    the pixels: row by row a product of matrices with the channels side by side.
    """
    rows, columns = x.shape[2:]
    pixels, moved = gradient.permute(0, 2, 3, 1), x.permute(0, 2, 3, 1)
    found = x.new_zeros((side, side, x.shape[1], gradient.shape[1]))
    for i in range(side):
        for j in range(side):
            down, along = ((k - side // 2) * dilation for k in (i, j))
            if abs(down) >= rows or abs(along) >= columns:
                continue  # nothing but padding there
            here = (
                slice(max(-down, 0), rows - max(down, 0)),
                slice(max(-along, 0), columns - max(along, 0)),
            )
            there = (
                slice(max(down, 0), rows + min(down, 0)),
                slice(max(along, 0), columns + min(along, 0)),
            )
            for a, b in zip(moved, pixels):
                found[i, j] += torch.bmm(a[there].transpose(1, 2), b[here]).sum(0)
    return found.permute(3, 2, 0, 1)


class Conv2d(nn.Conv2d):
    """Two-dimensional convolution with "same" padding.

    Kernels lie in memory with the channels last, and so do the results: on a CPU a StereoNet is
    then 1.6 times as fast, and its training 1.3 times.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: int,
        stride: int = 1,
        dilation: int = 1,
        bias: bool = False,
    ) -> None:
        extent = dilation * (kernel - 1)
        even = extent // 2 if stride == 1 else 0
        super().__init__(
            inputs, outputs, kernel, stride, padding=even, dilation=dilation, bias=bias
        )
        self.to(memory_format=torch.channels_last)
        self._extent = 0 if stride == 1 else extent

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, H, W] -> [N, C', ceil(H / stride), ceil(W / stride)]."""
        if self._extent:
            x = F.pad(x, _same(x.shape[2:], self._extent, self.stride))
        if self.stride != (1, 1):
            return super().forward(x)
        return convolve(x, self.weight, self.bias, self.dilation[0])


class Conv3d(nn.Conv3d):
    """Three-dimensional convolution with "same" padding; ``kernel`` along (planes, rows, cols)."""

    def __init__(
        self,
        inputs: int,
        outputs: int,
        kernel: tuple[int, int, int] = (3, 3, 3),
        stride: int = 1,
        bias: bool = False,
    ) -> None:
        even = tuple(k // 2 if stride == 1 else 0 for k in kernel)
        super().__init__(inputs, outputs, kernel, stride, padding=even, bias=bias)
        self._extent = 0 if stride == 1 else kernel[0] - 1

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, D, H, W] -> [N, C', ceil(D / stride), ceil(H / stride), ceil(W / stride)]."""
        if self._extent:
            x = F.pad(x, _same(x.shape[2:], self._extent, self.stride))
        if _is_slow(x):
            return super().forward(x.expand(2, -1, -1, -1, -1))[:1]
        return super().forward(x)


def _is_slow(x: Tensor) -> bool:
    """Whether PyTorch convolves a volume without oneDNN, which takes two of them in an eighth of
    the time: a single one on a CPU, in float32, small but for its last axis."""
    return (
        x.device.type == "cpu"
        and x.shape[0] == 1
        and x.shape[1:4].numel() <= SMALL
        and not torch.is_autocast_enabled("cpu")
    )


def _same(shape: Sequence[int], extent: int, stride: Sequence[int]) -> list[int]:
    """Padding of a strided convolution, last axis first, as :func:`torch.nn.functional.pad` asks.

    ``extent``: reach of the kernel, its size less one.
    """
    padding: list[int] = []
    for size, step in zip(reversed(shape), reversed(stride)):
        total = max((-(-size // step) - 1) * step + extent + 1 - size, 0)
        padding += [total // 2, total - total // 2]
    return padding


class ConvTranspose3d(nn.ConvTranspose3d):
    """Transposed convolution that doubles planes, rows and columns; kernel of 3 or 4."""

    def __init__(self, inputs: int, outputs: int, kernel: int) -> None:
        super().__init__(inputs, outputs, kernel, 2, padding=kernel // 2 - 1, bias=False)

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, D, H, W] -> [N, C', 2 D, 2 H, 2 W]."""
        d, h, w = (2 * size for size in x.shape[2:])
        return super().forward(x)[:, :, :d, :h, :w]


def normalised(convolution: nn.Module, activation: nn.Module | None = None) -> nn.Sequential:
    """A convolution, batch normalisation, and an activation where one is given."""
    flat = isinstance(convolution, nn.Conv2d)
    norm = (nn.BatchNorm2d if flat else nn.BatchNorm3d)(
        convolution.out_channels, eps=EPSILON, momentum=MOMENTUM
    )
    return nn.Sequential(convolution, norm, *([activation] if activation is not None else []))


class Residual(nn.Module):
    """Two normalised 3 x 3 convolutions and the input added to them.

    ``between``, ``after``: slope of the leaky ReLU (0: ReLU) after the first convolution and after
    the sum; None: no activation there. ``stride`` 2 halves rows and columns, and a third, strided
    convolution brings the input there.
    """

    def __init__(
        self,
        inputs: int,
        outputs: int,
        *,
        between: float,
        after: float | None,
        dilation: int = 1,
        stride: int = 1,
    ) -> None:
        super().__init__()
        first = Conv2d(inputs, outputs, 3, stride, dilation)
        self.first = normalised(first, nn.LeakyReLU(between, inplace=True))
        self.second = normalised(Conv2d(outputs, outputs, 3, 1, dilation))
        self.shortcut = None
        if stride != 1:
            self.shortcut = normalised(Conv2d(inputs, outputs, 3, stride, dilation))
        self.after = after

    def forward(self, x: Tensor) -> Tensor:
        """[N, C, H, W] -> [N, C', H / stride, W / stride]."""
        y = self.second(self.first(x))
        y = y + (x if self.shortcut is None else self.shortcut(x))
        return y if self.after is None else F.leaky_relu(y, self.after, inplace=True)


def residuals(
    channels: int, dilations: Sequence[int], between: float, after: float | None
) -> nn.Sequential:
    """Residual blocks in a row, one for each dilation."""
    return nn.Sequential(
        *(
            Residual(channels, channels, between=between, after=after, dilation=dilation)
            for dilation in dilations
        )
    )


def initialise(network: nn.Module) -> None:
    """Set all kernels to He's normal distribution, biases to zero."""
    for module in network.modules():
        if isinstance(module, TRAINED):
            nn.init.kaiming_normal_(module.weight, nonlinearity="relu")
            if module.bias is not None:
                nn.init.zeros_(module.bias)


def channels_last(network: nn.Module) -> nn.Module:
    """The network with the channels of its kernels side by side, as processors read them fastest.

    On a CPU, three-dimensional convolutions take half the time so (measured with float32).
    """
    formats = {4: torch.channels_last, 5: torch.channels_last_3d}
    for parameter in network.parameters():
        if parameter.dim() in formats:
            parameter.data = parameter.data.contiguous(memory_format=formats[parameter.dim()])
    return network


def planes(disparity_range: tuple[int, int], scale: int, divisor: int = 1) -> tuple[int, int]:
    """The range of a cost volume's planes at 1/scale of the resolution (max exclusive).

    Raises ValueError if the range is empty, if it does not begin with a plane, or if the number of
    planes is no multiple of ``divisor``.
    """
    low, high = disparity_range
    if low >= high or low % scale or (high - low) % (scale * divisor):
        raise ValueError(
            f"disparity range {low} to {high} px: it must begin at a multiple of {scale} px "
            f"and span multiples of {scale * divisor} px"
        )
    return low // scale, high // scale


class _Volume(torch.autograd.Function):
    """Cost volumes, with gradients in one pass over the planes (autograd's own take one each)."""

    @staticmethod
    def forward(ctx, left, right, low, high, concatenate):  # type: ignore[no-untyped-def]
        ctx.low, ctx.high, ctx.concatenate = low, high, concatenate
        n, c, h, w = left.shape
        volume = torch.empty(
            (n, 2 * c if concatenate else c, high - low, h, w),
            dtype=left.dtype,
            device=left.device,
            memory_format=torch.channels_last_3d,
        ).zero_()
        for k, d in enumerate(range(low, high)):
            a, b = _overlap(d, w)
            if concatenate:
                volume[:, :c, k, :, a] = left[..., a]
                volume[:, c:, k, :, a] = right[..., b]
            else:
                volume[:, :, k, :, a] = left[..., a] - right[..., b]
        return volume

    @staticmethod
    def backward(ctx, gradient):  # type: ignore[no-untyped-def]
        n, c, _, h, w = gradient.shape
        c = c // 2 if ctx.concatenate else c
        left, right = (
            torch.zeros((n, c, h, w), device=gradient.device).contiguous(
                memory_format=torch.channels_last
            )
            for _ in range(2)
        )
        for k, d in enumerate(range(ctx.low, ctx.high)):
            a, b = _overlap(d, w)
            left[..., a] += gradient[:, :c, k, :, a]
            if ctx.concatenate:
                right[..., b] += gradient[:, c:, k, :, a]
            else:
                right[..., b] -= gradient[:, :, k, :, a]
        return left.to(gradient.dtype), right.to(gradient.dtype), None, None, None


def difference_volume(left: Tensor, right: Tensor, low: int, high: int) -> Tensor:
    """Left features less the right ones that each disparity of [low, high) brings there.

    [N, C, H, W] twice -> [N, C, high - low, H, W]; 0 where there is no right pixel.
    """
    return _Volume.apply(left, right, low, high, False)


def concatenation_volume(left: Tensor, right: Tensor, low: int, high: int) -> Tensor:
    """Left features beside the right ones that each disparity of [low, high) brings there.

    [N, C, H, W] twice -> [N, 2 C, high - low, H, W]; 0 where there is no right pixel.
    """
    return _Volume.apply(left, right, low, high, True)


def _overlap(d: int, width: int) -> tuple[slice, slice]:
    """Columns of the left image whose match at disparity ``d`` is in the right one, and these."""
    first, end = max(d, 0), max(width + min(d, 0), max(d, 0))
    return slice(first, end), slice(first - d, end - d)


class SoftArgmin(nn.Module):
    """Expected disparity of each pixel: [N, D, H, W] costs of the planes -> [N, H, W] float32.

    Plane k stands for ``first + k * step``; its probability is the softmax of its negative cost
    (GC-Net, Kendall et al. 2017). A part of a network, so that who looks on sees the costs.
    """

    def forward(self, cost: Tensor, first: float, step: float = 1.0) -> Tensor:
        """See the class."""
        candidates = first + step * torch.arange(cost.shape[1], device=cost.device)
        probability = torch.softmax(-cost.float(), 1)
        return torch.einsum("ndhw,d->nhw", probability, candidates.float())


def perplexity(cost: Tensor) -> Tensor:
    """Number of planes that the softmax of [N, D, H, W] costs is spread over, [N, H, W], 1 to D.

    The exponential of its entropy: D for D equal costs, 1 for one that is far below the others.
    """
    log = torch.log_softmax(-cost.float(), 1)
    return torch.exp(-(log.exp() * log).sum(1))


def resize(x: Tensor, size: Sequence[int]) -> Tensor:
    """[N, C, H, W] -> [N, C, *size]: bilinear between pixel centres, without a low-pass filter."""
    return F.interpolate(x, size=tuple(size), mode="bilinear", align_corners=False)
