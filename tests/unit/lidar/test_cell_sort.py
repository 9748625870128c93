"""Sorting points by cells through files."""

from __future__ import annotations

import errno
from pathlib import Path

import numpy as np
import pytest

from stereotruth.lidar import cell_sort


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
def test_a_full_disk_says_so() -> None:
    with Path("/dev/full").open("wb", buffering=0) as disk:
        runs = cell_sort.SortedRuns(np.empty((0, 4), np.uint32), disk)
        lattice, attributes = np.zeros((3, 1000), np.int64), np.zeros(1000, np.uint32)
        with pytest.raises(OSError, match="No space left") as error:
            runs.add(lattice, attributes, attributes)
    assert error.value.errno == errno.ENOSPC
