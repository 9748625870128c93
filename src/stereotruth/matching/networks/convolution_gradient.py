"""The gradient of two-dimensional convolutions with respect to their kernels, on a CPU.

oneDNN takes 5 to 13 times as long for it as for the convolution itself where the image is large
and the kernel is spread (AVX2, float32); as products of matrices it takes twice as long.
"""

from __future__ import annotations

import torch
import torch.nn.functional as F
from torch import Tensor

CHANNELS = 16  # from here on, in and out, products of matrices are faster


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
