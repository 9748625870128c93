"""Two methods scored and compared, made once."""

from __future__ import annotations

import numpy as np
import pytest

from stereobench.scores.compare_methods import compare
from stereobench.scores.predictions import predict
from stereobench.scores.score_method import score
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.images import write
from ...synthetic.toy_benchmark import PLAN, SHAPE


@pytest.fixture(scope="session")
def compared(tmp_path_factory):
    """Two methods on six test pairs of two cities: one is off by 2 px, one by 0.5 px with holes."""
    folder = tmp_path_factory.mktemp("benchmark")
    rng = np.random.default_rng(0)
    for prefix, numbers in (("KM", (1, 2, 3, 9)), ("WH", (1, 2, 3))):
        for n in numbers:
            split = "train" if n == 9 else "test"
            truth = rng.uniform(-3, 3, SHAPE).astype(np.float32)
            truth[:, :4] = np.nan
            image = rng.integers(1, 900, SHAPE).astype(np.uint16)
            for kind, array in (("left", image), ("right", image), ("disparity", truth)):
                place = "disp" if kind == "disparity" else kind
                write(folder / "data" / split / place / f"{prefix}_{kind}_{n}.tiff", array)
            write(folder / "two" / f"{prefix}_{n}.tif", truth + 2)
            holes = truth + 0.5
            holes[:6] = np.nan
            write(folder / "half" / f"{prefix}_{n}.tif", holes)
    dataset = StereoDataset("toy", folder / "data", "whu", (-8, 8))
    methods = {
        "two": {"kind": "folder", "folder": str(folder / "two")},
        "half": {"kind": "folder", "folder": str(folder / "half")},
    }
    for name, of in methods.items():
        out = folder / "match" / name
        predict(dataset, "test", name, of, out, work=folder / ".work")
        more = {"fine_tuned_of": "two"} if name == "half" else {}
        score(dataset, "test", name.title(), out, folder / "benchmark" / name, PLAN, **more)
    compare(
        dataset,
        "test",
        [folder / "benchmark" / name for name in methods],
        [folder / "match" / name for name in methods],
        folder / "compared",
    )
    return folder
