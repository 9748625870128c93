"""Shards and Parquet, each read back by its own library: the bytes of the tiles."""

from __future__ import annotations

import io
import sys
import tarfile
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import read_image, read_labels
from stereotruth.tiles.layouts import assemble_dataset, write_layout
from stereotruth.tiles.verify import defects

from ...synthetic.tiled_scene import SIZE, rows_of

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
ARRAYS = {"left": "left", "right": "right", "disparity": "disp"}
FIRST_BATCH_S = 2.0


@pytest.fixture(scope="module", params=["grey", "colour"])
def dataset(request, exported, in_colour, tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("packages") / "dataset"
    assemble_dataset([(exported if request.param == "grey" else in_colour)[0]], out)
    return out


@pytest.fixture
def package(dataset, tmp_path, request) -> Path:
    out = tmp_path / request.param
    assert write_layout(dataset, out, request.param, licence="cc-by-4.0") >= 10
    assert defects(out) == []
    return out


def tiles_of(dataset: Path) -> dict[str, dict[str, np.ndarray]]:
    """Arrays of the labelled tiles, as they are stored."""
    return {
        row["tile"]: {
            "left": read_image(dataset / row["left"]),
            "right": read_image(dataset / row["right"]),
            "disparity": read_labels(dataset / row["disp"])[0],
        }
        for row in rows_of(dataset)
        if row["disp"]
    }


def same(found, wanted) -> bool:
    return found.dtype == wanted.dtype and found.tobytes() == wanted.tobytes()


@pytest.mark.parametrize("package", ["webdataset"], indirect=True)
def test_shards_hold_the_bytes_of_the_tiles(dataset, package) -> None:
    wanted, seen = tiles_of(dataset), set()
    for file in sorted((package / "data").iterdir()):
        with tarfile.open(file) as shard:
            for member in shard:
                tile, *name, kind = member.name.split(".")
                name = name[0] if name else "json"
                content = shard.extractfile(member).read()
                if kind == "npy":
                    assert same(np.load(io.BytesIO(content)), wanted[tile][name])
                elif kind in ("jpg", "png"):
                    look = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
                    assert look.dtype == np.uint8 and look.shape[:2] == (SIZE, SIZE)
                seen.add((tile, name))
    assert seen >= {(tile, name) for tile in wanted for name in ARRAYS}


@pytest.mark.parametrize("package", ["webdataset"], indirect=True)
def test_webdataset_decodes_the_shards(dataset, package) -> None:
    wds = pytest.importorskip("webdataset", reason="webdataset is not installed")
    wanted, began = tiles_of(dataset), time.monotonic()
    for file in sorted((package / "data").iterdir()):
        for sample in wds.WebDataset(str(file), shardshuffle=False).decode():
            assert time.monotonic() - began < FIRST_BATCH_S or sample is None
            for name in ARRAYS:
                assert same(sample[f"{name}.npy"], wanted[sample["json"]["tile"]][name])
            began = time.monotonic()


@pytest.mark.parametrize("package", ["parquet"], indirect=True)
def test_parquet_holds_the_values_of_the_tiles(dataset, package) -> None:
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    wanted, seen = tiles_of(dataset), []
    for file in sorted((package / "data").iterdir()):
        began = time.monotonic()
        whole = parquet.ParquetFile(file)
        first = whole.read_row_group(0)
        assert time.monotonic() - began < FIRST_BATCH_S and first.num_rows <= 4
        table = whole.read()
        for row in range(table.num_rows):
            tile = table["tile"][row].as_py()
            assert file.name.startswith(table["split"][row].as_py())
            for name in ARRAYS:
                values = table[name][row].values
                while hasattr(values, "flatten") and values.type.num_fields:
                    values = values.flatten()
                array = wanted[tile][name]
                assert same(values.to_numpy().reshape(array.shape), array)
            look = table["preview_left"][row].as_py()["bytes"]
            assert cv2.imdecode(np.frombuffer(look, np.uint8), -1).dtype == np.uint8
            seen.append(tile)
    assert sorted(seen) == sorted(wanted)


@pytest.mark.parametrize("package", ["parquet"], indirect=True)
def test_the_hubs_library_loads_the_folder_by_its_card(dataset, package, monkeypatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    datasets = pytest.importorskip("datasets", reason="datasets is not installed")
    wanted = tiles_of(dataset)
    where = {"cache_dir": str(package / "cache")}
    loaded = datasets.load_dataset(str(package), split="train", **where).with_format("numpy")
    began = time.monotonic()
    assert len(loaded[:2]["disparity"]) == 2 and time.monotonic() - began < FIRST_BATCH_S
    for row in loaded:
        for name in ARRAYS:
            array = wanted[str(row["tile"])][name]
            assert np.array_equal(row[name], array) and row[name].shape == array.shape
        assert same(row["disparity"], wanted[str(row["tile"])]["disparity"])


@pytest.mark.parametrize("package", ["parquet", "webdataset"], indirect=True)
def test_the_card_tells_splits_licence_and_features(dataset, package) -> None:
    _, front, text = (package / "README.md").read_text().split("---\n", 2)
    card = yaml.safe_load(front)
    assert card["license"] == "cc-by-4.0" and "-999" in text and "x_left - x_right" in text
    rows = [row for row in rows_of(dataset) if row["disp"]]
    (config,) = card["configs"]
    for data in config["data_files"]:
        assert list(package.glob(data["path"]))
    if package.name == "parquet":
        counts = {of["name"]: of["num_examples"] for of in card["dataset_info"]["splits"]}
        assert counts == {s: sum(row["split"] == s for row in rows) for s in counts}
        types = {of["name"]: of["dtype"] for of in card["dataset_info"]["features"]}
        assert set(types) >= {*ARRAYS, "preview_left"} and types["preview_left"] == "image"
        disparity = types["disparity"]["array2_d"]
        assert disparity == {"shape": [SIZE, SIZE], "dtype": "float32"}


def test_a_missing_library_is_named(dataset, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(InputError, match="pyarrow"):
        write_layout(dataset, tmp_path / "out", "parquet")
    assert not (tmp_path / "out").exists()
