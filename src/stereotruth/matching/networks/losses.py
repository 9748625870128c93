"""The loss of a network's disparities at all scales."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor


def loss_of(outputs: Sequence[Tensor], disparity: Tensor, weights: Sequence[float]) -> Tensor:
    """Weighted sum over the outputs of the mean smooth L1 over labelled pixels.

    ``outputs``: [N, h, w], of the labels' size or a whole part of it and then in their own pixels;
    ``disparity``: [N, H, W] px, NaN unlabelled. 0 without any label.
    """
    valid = torch.isfinite(disparity)
    known = torch.where(valid, disparity, 0.0)
    total = disparity.new_zeros(())
    for output, weight in zip(outputs, weights):
        scale = disparity.shape[1] // output.shape[1]
        target, where = known, valid
        if scale > 1:  # means over the labelled pixels only
            share = F.avg_pool2d(valid.float().unsqueeze(1), scale).squeeze(1)
            where = share > 0
            pooled = F.avg_pool2d(known.unsqueeze(1), scale).squeeze(1)
            target = pooled / share.clamp_min(1e-6) / scale
        if where.any():
            error = F.smooth_l1_loss(output.float()[where], target[where])
            total = total + weight * error
    return total
