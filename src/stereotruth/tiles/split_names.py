"""What the splits of a dataset and the folders of the published layout are called."""

from __future__ import annotations

SPLITS = ("train", "val", "test")
NONE = "none"  # of pairs without labels, and of those that share ground with two splits
TRUTH, NO_TRUTH = "with ground truth", "without ground truth"
