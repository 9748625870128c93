"""What a job imports before it does anything: most of the time that a small one takes."""

from __future__ import annotations

import subprocess
import sys

import pytest

from ..synthetic.rules import FOLDER

HEAVY = {"cv2", "dask", "geopandas", "laspy", "matplotlib", "numba", "pandas", "pydantic"} | {
    "pyproj", "rasterio", "scipy.spatial", "scipy.special", "scipy.stats", "shapely", "torch",
} | {"xarray", "zarr"}  # fmt: skip
# What the job of each script uses in every run; a new one costs each of its jobs its import.
STARTS = {
    "simulate_image": {"numba", "rasterio"},
    "simulate_lidar": {"laspy", "numba", "pyproj"},
    "simulate_truth": {"numba", "rasterio", "scipy.spatial", "scipy.special", "zarr"},
    "ingest": {"laspy", "numba", "pyproj"},
    "align": {"cv2", "numba", "pyproj", "rasterio"},
    "refine": {"cv2", "numba", "pydantic", "pyproj", "rasterio", "scipy.special"},
    "adjust": {"cv2", "numba", "pydantic", "pyproj", "rasterio", "scipy.special"},
    "adjusted_alignment": {"numba"},
    "rectify": {"dask", "numba", "pydantic", "rasterio", "zarr"},
    "project": {"dask", "numba", "pydantic", "zarr"},
    "grid_truth": {"numba", "rasterio", "zarr"},
    "match": {"pydantic", "rasterio", "zarr"},
}


@pytest.mark.slow
@pytest.mark.parametrize("script", STARTS)
def test_a_job_imports_what_it_uses(script) -> None:
    words = f"import runpy, sys; runpy.run_path({str(FOLDER / f'scripts/{script}.py')!r})"
    shown = f"{words}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", shown], capture_output=True, text=True, check=True)
    assert set(done.stdout.split()) & HEAVY == STARTS[script]
