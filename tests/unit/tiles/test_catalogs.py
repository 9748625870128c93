"""The dataset as a STAC collection, read by pystac, and as Croissant, loaded by mlcroissant."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from fnmatch import fnmatch
from pathlib import Path

import numpy as np
import pytest
import rasterio
from PIL import Image

mlc = pytest.importorskip("mlcroissant", reason="the extra catalog is not installed")
pystac = pytest.importorskip("pystac", reason="the extra catalog is not installed")

from pystac.extensions.file import FileExtension
from pystac.extensions.projection import ProjectionExtension
from pystac.extensions.raster import RasterExtension
from pystac.validation.stac_validator import JsonSchemaSTACValidator

from stereotruth.core.errors import InputError
from stereotruth.sensor.rpc import RPC
from stereotruth.sensor.rpc_files import rpc_text
from stereotruth.tiles.layouts import assemble_dataset
from stereotruth.tiles.verify import defects

from ...synthetic.tiled_scene import SIZE, read, rows_of

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


@pytest.fixture(scope="module")
def dataset(exported, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("stac")
    assemble_dataset([exported[0]], folder / "made", catalogs=["stac"])
    shutil.move(folder / "made", folder / "moved")  # links are relative
    return folder / "moved"


def test_the_collection_holds_an_item_of_each_pair(dataset) -> None:
    collection = pystac.Collection.from_file(str(dataset / "stac/collection.json"))
    items = {item.id: item for item in collection.get_items()}
    rows = rows_of(dataset)
    for asset in collection.assets.values():
        assert Path(asset.get_absolute_href()).is_relative_to(dataset)
        assert Path(asset.get_absolute_href()).is_file()
    assert defects(dataset) == []
    assert set(items) == {row["tile"] for row in rows}
    places = {
        one["id"]: one["geometry"]
        for one in json.loads((dataset / "footprints.geojson").read_text())["features"]
    }
    validator = JsonSchemaSTACValidator()
    kind = pystac.STACObjectType.COLLECTION
    validator.validate_core(collection.to_dict(), kind, pystac.get_stac_version())
    for row in rows:
        item = items[row["tile"]]
        found = json.loads((dataset / row["item"]).read_text())
        validator.validate_core(found, pystac.STACObjectType.ITEM, pystac.get_stac_version())
        assert item.geometry == places[row["tile"]]
        assert item.properties["stereotruth:split"] == row["split"]
        assert ProjectionExtension.ext(item).shape == [SIZE, SIZE]
        assert found["properties"]["proj:code"] is None
        assert not item.properties["stereotruth:acquisition_known"]
        wanted = {"left", "right", "orientation", "left_rpc", "right_rpc"}
        assert set(item.assets) == wanted | ({"disparity"} if row["disp"] else set())
        record = json.loads((dataset / row["orientation"]).read_text())
        for name, asset in item.assets.items():
            path = Path(asset.get_absolute_href())
            assert not Path(asset.href).is_absolute() and path.is_relative_to(dataset)
            if name.endswith("_rpc"):
                told = record[name.removesuffix("_rpc")]["corrected_rpc"]
                assert path.read_text() == rpc_text(RPC.from_dict(told))
            said = FileExtension.ext(asset)
            assert said.size == path.stat().st_size
            assert said.checksum == "1220" + hashlib.sha256(path.read_bytes()).hexdigest()
            if path.suffix == ".tiff":
                (band,) = RasterExtension.ext(asset).bands
                with rasterio.open(path) as raster:
                    assert (band.data_type, band.nodata) == (raster.dtypes[0], raster.nodata)
                assert (band.unit == "px") == (name == "disparity")
    boxes = np.array([item.bbox for item in items.values()])
    (whole,) = collection.extent.spatial.bboxes
    assert whole == [*boxes[:, :2].min(axis=0), *boxes[:, 2:].max(axis=0)]


def test_dates_are_told(exported, tmp_path) -> None:
    scene = rows_of(exported[0])[0]["scene"]
    out = tmp_path / "out"
    with pytest.raises(InputError):
        assemble_dataset([exported[0]], out, catalogs=["stac"], acquired={scene: "May"})
    assemble_dataset([exported[0]], out, catalogs=["stac"], acquired={scene: "2020-10-25"})
    collection = pystac.Collection.from_file(str(out / "stac/collection.json"))
    assert all(str(i.datetime.date()) == "2020-10-25" for i in collection.get_items())


# ------------------------------------------------------------------ Croissant


def test_the_pairs_are_loaded(exported, tmp_path: Path) -> None:
    folder = tmp_path / "dataset"
    assemble_dataset([exported[0]], folder, catalogs=["croissant"])
    assert defects(folder) == []
    dataset = mlc.Dataset(jsonld=str(folder / "croissant.json"))
    assert not dataset.metadata.issues.errors
    pairs = [
        {key.partition("/")[2]: value for key, value in one.items()}
        for one in dataset.records("pairs")
    ]
    rows = rows_of(folder)
    assert [one["tile"].decode() for one in pairs] == [row["tile"] for row in rows]
    for one, row in zip(pairs, rows):
        assert one["split"].decode() == row["split"]
        assert one["right_offset_px"] == int(row["right_offset_px"])
        assert (one["disp"] is None) == (row["disp"] == "")
        for kind in ("left", "right", *(("disp",) if row["disp"] else ())):
            with Image.open(folder / one[kind].decode()) as image:
                np.testing.assert_array_equal(np.asarray(image), read(folder / row[kind]))
    sets = {one.id: one.includes for one in dataset.metadata.distribution if one.id != "manifest"}
    files = [p.relative_to(folder).as_posix() for p in folder.rglob("*.tiff")]
    for kind, column in (("left", "left"), ("right", "right"), ("disparity", "disp")):
        found = [f for f in files if any(fnmatch(f, one) for one in sets[f"{kind}-files"])]
        assert sorted(found) == sorted(row[column] for row in rows if row[column])


def test_without_the_extra_it_is_said_how_to_get_it(exported, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "mlcroissant", None)
    monkeypatch.delitem(sys.modules, "stereotruth.tiles.catalogs", raising=False)
    monkeypatch.delattr("stereotruth.tiles.catalogs", raising=False)
    with pytest.raises(InputError, match=r"croissant needs mlcroissant.*the extra catalog"):
        assemble_dataset([exported[0]], tmp_path / "out", catalogs=["croissant"])
    assert not (tmp_path / "out").exists()
