"""A method over a scene in blocks: what is taken over after a kill, the same bytes always."""

from __future__ import annotations

import shutil
from pathlib import Path

import dask.threaded
import numpy as np
import pytest
import zarr

from stereobench.methods import predict_scene as whole
from stereobench.methods.methods import make_method
from stereobench.methods.predict_scene import predict_scene
from stereotruth.core.config.methods import SceneMatching
from stereotruth.core.errors import InputError
from stereotruth.core.job import dask_scheduler
from stereotruth.core.products.grids import Layer, atomic_store, create_grid, open_grid

from ...synthetic.images import textured
from ...synthetic.stores import Killed, tree
from ...synthetic.whole_images import match

SHAPE = (300, 600)  # 2 by 3 tiles
SETTINGS = {"kind": "sgm", "mode": "sgbm"}
GIVEN = {
    "method": "sgm",
    "entry": SETTINGS,
    "disparity_range": (-16, 32),
    "block_px": 256,
    "overlap_px": 32,
    "code": "test",
}


def predict(
    left, right, out, *, method, entry, code, workers=1, scheduler=dask.threaded.get, **settings
):
    how = {"method": method, "entry": entry, "code": code, "settings": SceneMatching(**settings)}
    return predict_scene(left, right, out, **how, workers=workers, scheduler=scheduler)


def truth() -> np.ndarray:
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    return 0.08 * x - 30 + 5 * np.sin(y / 60)


def write(path: Path, image: np.ndarray) -> Path:
    layer = Layer("uint16", 0, {"units": "1", "long_name": "image"})
    with atomic_store(path) as scratch:
        attrs = {"content": f"of {path.stem} {int(image.sum())}", "epipolar": None}
        arrays = create_grid(
            scratch, image.shape, {"image": layer}, chunk=128, shard=256, attrs=attrs
        )
        arrays["image"][:] = image
    return path


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> tuple[Path, Path]:
    folder = tmp_path_factory.mktemp("images")
    left, right = textured(truth())
    left[:70, :200] = 0
    return write(folder / "left.zarr", left), write(folder / "right.zarr", right)


@pytest.fixture(scope="module")
def fresh(images, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("fresh") / "sgm.zarr"
    predict(*images, out, **GIVEN, workers=1)
    return out


@pytest.fixture
def carried(fresh, tmp_path) -> Path:
    """The scene with its finished pieces, in a folder of its own."""
    shutil.copytree(fresh.parent, tmp_path, dirs_exist_ok=True)
    return tmp_path / fresh.name


def tiles_made(monkeypatch, stop_after: int | None = None) -> list[tuple[int, int]]:
    """The places of the tiles that are made from here on; a kill after some of them."""
    made, tile = [], whole._ImagePair.tile

    def counted(self, out, key, place, offset):
        if stop_after is not None and len(made) == stop_after:
            raise Killed
        tile(self, out, key, place, offset)
        made.append(place)

    monkeypatch.setattr(whole._ImagePair, "tile", counted)
    return made


def test_a_scene_is_what_the_arrays_give(images, fresh):
    left, right = (zarr.open_group(path)["image"][:] for path in images)
    found = open_grid(fresh)
    assert found.attrs["kind"] == "prediction"
    offsets = np.array(found.attrs["block_offsets_px"])
    assert offsets.shape == (2, 3)
    assert np.ptp(offsets) > 30  # the relief of the scene is larger than the range
    given = {"block": 256, "overlap": 32, "offset": offsets}
    wanted = match(make_method("sgm", SETTINGS), left, right, (-16, 32), **given)
    disparity = found["disparity"].values
    assert np.array_equal(disparity, wanted, equal_nan=True)
    known = np.isfinite(disparity)
    assert known.mean() == pytest.approx(found.attrs["summary"]["valid_share"], abs=1e-6)
    assert known[:, 40:-40].mean() > 0.85
    assert np.median(np.abs(disparity - truth())[known]) < 0.1
    assert not known[:70, :200].any()
    assert found["disparity"].encoding["chunks"] == (256, 256)


def test_workers_of_a_dask_cluster_write_the_same_bytes(images, fresh, tmp_path):
    distributed = pytest.importorskip("distributed", reason="needs the extra `cluster`")
    options = {"n_workers": 1, "threads_per_worker": 2, "dashboard_address": None}
    with (
        distributed.LocalCluster(processes=False, protocol="tcp", **options) as cluster,
        dask_scheduler(cluster.scheduler_address) as client,
    ):
        predict(*images, tmp_path / "sgm.zarr", **GIVEN, scheduler=client)
    assert tree(tmp_path / "sgm.zarr") == tree(fresh)


@pytest.mark.slow
def test_a_killed_job_goes_on_where_it_was(images, fresh, tmp_path, monkeypatch):
    out = tmp_path / "sgm.zarr"
    with monkeypatch.context() as patch:
        before = tiles_made(patch, stop_after=4)
        with pytest.raises(Killed):
            predict(*images, out, **GIVEN, scheduler="synchronous")
        assert not out.exists()
    after = tiles_made(monkeypatch)
    predict(*images, out, **GIVEN, scheduler="synchronous")
    assert sorted(before + after) == [(i, j) for i in range(2) for j in range(3)]
    assert tree(out) == tree(fresh)
    assert {path.name for path in tmp_path.iterdir()} == {"sgm.zarr", ".sgm.zarr.work"}


def test_a_function_is_made_anew_when_its_file_changes(images, tmp_path, monkeypatch):
    module = tmp_path / "mine.py"
    text = "import numpy as np\n\ndef flat(left, right, r):\n    return np.full(left.shape, {})\n"
    module.write_text(text.format(3.0))
    settings = {"kind": "function", "function": f"{module}:flat", "margin_px": 8}
    given = {**GIVEN, "method": "mine", "entry": settings, "offset": 5}
    out = tmp_path / "mine.zarr"
    made = tiles_made(monkeypatch)
    predict(*images, out, **given)
    assert np.nanmax(open_grid(out)["disparity"].values) == 8.0
    module.write_text(text.format(2.0) + "\n")  # another size: Python looks at whole seconds
    del made[:]
    summary = predict(*images, out, **given)
    assert len(made) == 6
    predict(*images, out, **{**given, "code": "another"})
    assert len(made) == 12
    assert (summary["disparity_min_px"], summary["disparity_max_px"]) == (7.0, 7.0)


def test_mistakes_are_named(images, tmp_path):
    for other in ({"entry": {"kind": "sgm", "mode": "none"}}, {"offset": 5000}):
        with pytest.raises(InputError):
            predict(*images, tmp_path / "x.zarr", **{**GIVEN, **other})
