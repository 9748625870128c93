"""Which labels of rough surfaces are in the tiles."""

from __future__ import annotations

import numpy as np
import pytest
import zarr

from stereotruth.core.status import Status
from stereotruth.tiles.manifest import tile_flags
from stereotruth.tiles.scene_stores import tile_labels

FLAGS = {0: "no_points", 1: "labelled", 12: "labelled_crown"}


@pytest.fixture
def store() -> zarr.Group:
    """Measured labels, one of them unsure, and crowns of 0.2, 0.5 and 0.6 px; a pixel of none."""
    group = zarr.open_group(zarr.storage.MemoryStore(), mode="w")
    group["status"] = np.array([[1, 1, 12], [12, 12, 0]], np.uint8)
    group["disparity"] = np.array([[1, 2, 3], [4, 5, np.nan]], np.float32)
    group["uncertainty"] = np.array([[0.1, 3, 0.2], [0.5, 0.6, np.nan]], np.float32)
    return group


@pytest.mark.parametrize(("limit", "left_out"), [(0.0, 3), (0.5, 1)])
def test_unsure_crowns_are_left_out_and_nothing_else(store, limit, left_out) -> None:
    sure = tile_labels(store, FLAGS, limit)
    status, disparity = (sure[name][0:2, 0:3] for name in ("status", "disparity"))
    assert sure["disparity"].shape == (2, 3)
    out = status == Status.TOO_UNCERTAIN
    assert out.sum() == left_out
    assert np.array_equal(np.isfinite(disparity), np.isin(status, (1, 12)))
    assert np.array_equal(disparity[~out], store["disparity"][:][~out], equal_nan=True)
    assert np.array_equal(status[~out], store["status"][:][~out])
    assert disparity.dtype == np.float32 and status.dtype == np.uint8


def test_stores_without_crowns_are_taken_as_they_are(store) -> None:
    flags = {0: "no_points", 1: "labelled"}
    assert isinstance(tile_labels(store, flags, 0.1)["disparity"], zarr.Array)
    assert tile_flags(flags) == flags
    assert tile_flags(FLAGS) == FLAGS | {Status.TOO_UNCERTAIN: "too_uncertain"}
