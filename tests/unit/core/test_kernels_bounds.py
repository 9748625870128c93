"""Compiled loops write to their arrays alone: unchecked, they overwrite others unseen."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

HERE = Path(__file__).parents[1]
TESTS = (
    "labels/test_shifted_agreement.py",
    "epipolar/test_surface_windows.py",
    "lidar/test_smooth_maps.py",
)


@pytest.mark.slow
def test_kernels_of_labels_stay_within_their_arrays():
    """Numba checks each index of the same tests in another process."""
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "-p", "no:xdist"]
        + [str(HERE / name) for name in TESTS],
        cwd=HERE.parents[1],
        env=os.environ | {"NUMBA_BOUNDSCHECK": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=540,
    )
    assert run.returncode == 0, run.stdout[-4000:]
