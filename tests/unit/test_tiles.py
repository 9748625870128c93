"""Tiles of a small scene with analytic cameras, terrain and texture; size 64."""

from __future__ import annotations

import csv
import json
import struct
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import rasterio
from PIL import Image
from scipy.ndimage import map_coordinates

from stereotruth.dataset.export import export_city
from stereotruth.dataset.orientation import evaluate
from stereotruth.dataset.published_layout import assemble_dataset
from stereotruth.dataset.scene_stores import SceneFiles
from stereotruth.dataset.settings import Limits, Settings
from stereotruth.dataset.splits import shared_ground
from stereotruth.dataset.summary import summary_lines
from stereotruth.dataset.tile_files import round_disparity
from stereotruth.dataset.verify import defects, verify
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.rpc import RPC, SensorModel
from stereotruth.errors import InputError
from stereotruth.products.grids import Layer, building, create_grid
from stereotruth.products.rasters import write_tiff

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")

SIZE = 64
PIXELS = 360  # side of the original images
FLAGS = ["no_points", "labelled", "hidden_in_left", "hidden_in_right", "low_correlation"]
LAT, LON = 30.2, 115.4
METRE_LAT = 1 / 111_000.0
METRE_LON = METRE_LAT / np.cos(np.radians(LAT))


def camera(lean: float, turn: float, metres_per_px: float) -> SensorModel:
    """Parallel camera that looks north, ``lean`` m of row shift per m of height, with some bend."""
    half = PIXELS / 2
    reach = half * 0.7
    zero = np.zeros(20)
    one = zero.copy()
    one[0] = 1.0
    samp, line = zero.copy(), zero.copy()
    samp[[1, 2, 3, 7]] = np.cos(turn), np.sin(turn), 0.002, 0.0005
    line[[1, 2, 3, 8]] = np.sin(turn), -np.cos(turn), lean * 60.0 / reach, 0.0004
    scale = reach / metres_per_px
    rpc = RPC(
        half, half, LAT, LON, 50.0,
        scale, scale, reach * METRE_LAT, reach * METRE_LON, 60.0,
        line, one, samp, one,
    )  # fmt: skip
    return SensorModel(rpc, np.array([[1.0, 1e-4, 3.25], [-2e-4, 1.0, -4.5]]))


def terrain(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    east, north = (lon - LON) / METRE_LON, (lat - LAT) / METRE_LAT
    return 40.0 + 12.0 * np.sin(east / 45.0) * np.cos(north / 60.0)


def texture(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    east, north = (lon - LON) / METRE_LON, (lat - LAT) / METRE_LAT
    waves = np.sin(east / 2.9) + np.sin(north / 3.7) + np.sin((east + 1.7 * north) / 6.1)
    return 500.0 + 120.0 * waves


def surface(sensor: SensorModel, col: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, ...]:
    """Ground point of each pixel's ray on the terrain, by fixed-point iteration."""
    height = np.full(col.shape, 40.0)
    for _ in range(12):
        lon, lat = sensor.localize(col, row, height)
        height = terrain(lon, lat)
    return lon, lat, height


def make_scene(
    folder: Path,
    *,
    bare_from: int = 10**6,
    turn: float = 0.02,
    texture: Callable[[np.ndarray, np.ndarray], np.ndarray] = texture,
    label_offset: float = 0.0,
    row_shift: float = 0.0,
) -> SceneFiles:
    """Stores of one scene; labels end at epipolar row ``bare_from``.

    Planted errors: of the labels (px), and of the right image's rows (px, down).
    """
    left, right = camera(0.09, turn, 0.70), camera(-0.48, -0.03, 0.75)
    model = fit_epipolar(left, right, (PIXELS, PIXELS), (PIXELS, PIXELS), 40.0)
    y, x = np.mgrid[: model.shape[0], : model.shape[1]].astype(np.float64)
    attrs = {"epipolar": model.to_dict(), "provenance": {"made": "by hand"}}
    layers = {"image": Layer("uint16", 0, {"units": "1", "long_name": "grey value"})}
    frames = []
    for name, to_sensor, sensor, shift in (
        ("left", model.epipolar_to_left, left, 0.0),
        ("right", model.epipolar_to_right, right, row_shift),
    ):
        col, row = to_sensor(x, y - shift)
        lon, lat, height = surface(sensor, col, row)
        inside = (abs(col - PIXELS / 2) < PIXELS / 2) & (abs(row - PIXELS / 2) < PIXELS / 2)
        grey = np.where(inside, np.rint(texture(lon, lat)), 0).astype(np.uint16)
        with building(folder / f"{name}.zarr") as path:
            array = create_grid(path, model.shape, layers, chunk=64, shard=128, attrs=attrs)
            array["image"][:] = grey
        frames.append((inside, lon, lat, height))
    inside, lon, lat, height = frames[0]
    ground = model.ground_to_epipolar(lon.ravel(), lat.ravel(), height.ravel())
    disparity = (ground[0] - ground[2]).reshape(model.shape)
    rng = np.random.default_rng(3)
    known = inside & (rng.random(model.shape) < 0.9) & (y < bare_from)
    meta = {"units": "px", "long_name": "test"}
    with building(folder / "scene.zarr") as path:
        arrays = create_grid(
            path,
            model.shape,
            {
                "disparity": Layer("float32", np.nan, meta),
                "height": Layer("float32", np.nan, meta | {"units": "m"}),
                "status": Layer(
                    "uint8",
                    0,
                    meta | {"flag_values": list(range(5)), "flag_meanings": " ".join(FLAGS)},
                ),
            },
            chunk=64,
            shard=128,
            attrs=attrs,
        )
        arrays["disparity"][:] = np.where(known, disparity + label_offset, np.nan)
        arrays["height"][:] = np.where(known, height, np.nan)
        arrays["status"][:] = np.where(known, 1, np.where(inside & (y < bare_from), 4, 0))
    stores = (folder / f"{name}.zarr" for name in ("scene", "left", "right"))
    return SceneFiles(folder.name, *stores)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> SceneFiles:
    return make_scene(tmp_path_factory.mktemp("scenes") / "s1", bare_from=240)


NO_LIMITS = Limits(*[None] * 6)
COUNTS = {"training": 600, "validation": 80, "testing": 200}


def run(scenes, out: Path, **options) -> dict:
    """Export with other settings than the configuration's; ``options``: settings and the rest."""
    given = {"size": SIZE, "min_labelled": 0.6, "quality": NO_LIMITS, "seed": 1} | options
    settings = {
        name: given.pop(name) for name in list(given) if name in Settings.__dataclass_fields__
    }
    return export_city("Town", "TN", scenes, out, settings=Settings(**settings), **COUNTS | given)


@pytest.fixture(scope="module")
def exported(scene: SceneFiles, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    folder = tmp_path_factory.mktemp("out")
    looks = {"coverage": folder / "coverage.png", "contact_sheet": folder / "contact.png"}
    return folder / "Town", run([scene], folder / "Town", workers=2, **looks)


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "manifest.csv").open(newline="") as stream:
        return list(csv.DictReader(stream))


def read(path: Path) -> np.ndarray:
    with rasterio.open(path) as dataset:
        return dataset.read(1)


def labels(path: Path) -> np.ndarray:
    values = read(path).astype(np.float64)
    return np.where(values == -999, np.nan, values)


def test_folder_is_as_the_contract_says(exported: tuple[Path, dict]) -> None:
    folder, summary = exported
    rows = rows_of(folder)
    assert summary["labelled_pairs"] >= 12 and summary["unlabelled_pairs"] >= 4
    assert [int(row["number"]) for row in rows] == list(range(len(rows)))
    for row in rows:
        n, complete = row["number"], row["complete"] == "yes"
        group = "" if complete else "unlabelled/"
        assert row["left"] == f"{group}left/TN_left_{n}.tiff"
        assert row["right"] == f"{group}right/TN_right_{n}.tiff"
        assert row["disp"] == (f"disp/TN_disparity_{n}.tiff" if complete else "")
        assert row["status"] == (f"status/TN_status_{n}.tiff" if complete else "")
        assert row["orientation"] == f"orientation/TN_{n}.json"
        assert (row["split"] == "none") != complete
        with rasterio.open(folder / row["left"]) as left:
            assert (left.dtypes, left.shape, left.nodata) == (("uint16",), (SIZE, SIZE), 0)
            assert left.read(1).min() > 0
        share = float(row["labelled_share"])
        assert (share >= 0.6) == complete
        assert int(row["count_labelled"]) == round(share * SIZE**2)
        assert (row["quality"] == "ok") == (row["warp_correlation"] != "") == complete
        if complete:
            assert float(row["warp_correlation"]) > 0.999
            disparity = labels(folder / row["disp"])
            assert np.isfinite(disparity).mean() == pytest.approx(share, abs=1e-6)
            assert float(row["disparity_mean_px"]) == pytest.approx(np.nanmean(disparity), abs=1e-3)
            assert abs(np.nanmean(disparity)) < 0.51  # less than the offset's rounding
            assert np.array_equal(np.isfinite(disparity), read(folder / row["status"]) == 1)
    assert (folder.parent / "coverage.png").stat().st_size > 10_000
    assert (folder.parent / "contact.png").stat().st_size > 10_000
    assert not list(folder.parent.glob("*.partial"))
    assert any("labelled pairs" in line for line in summary_lines(summary, folder))


def test_right_tile_warped_by_the_disparity_is_the_left_tile(exported: tuple[Path, dict]) -> None:
    folder, _ = exported
    checked = 0
    for row in rows_of(folder):
        if row["complete"] == "yes":
            left, right = (read(folder / row[k]).astype(np.float64) for k in ("left", "right"))
            disparity = labels(folder / row["disp"])
            y, x = np.mgrid[:SIZE, :SIZE]
            match = x - disparity
            use = np.isfinite(disparity) & (match > 4) & (match < SIZE - 5)
            warped = map_coordinates(right, [y[use], match[use]], order=3)
            # Texture ±360, 0.02 px of float16 and of cubic interpolation: 1 to 2 grey values.
            assert np.abs(warped - left[use]).mean() < 2.5
            shifted = map_coordinates(right, [y[use], match[use] + 1.0], order=3)
            assert np.abs(shifted - left[use]).mean() > 10
            checked += 1
    assert checked >= 12


def test_sidecar_leads_back_to_sensor_pixels_and_ground(
    exported: tuple[Path, dict], scene: SceneFiles
) -> None:
    folder, _ = exported
    import zarr

    model = EpipolarModel.from_dict(zarr.open_group(scene.disparity).attrs["epipolar"])
    for row in rows_of(folder)[::5]:
        record = json.loads((folder / row["orientation"]).read_text())
        row0, col0, offset = (int(row[k]) for k in ("row0", "col0", "right_offset_px"))
        rng = np.random.default_rng(int(row["number"]))
        x, y = rng.uniform(-0.5, SIZE - 0.5, (2, 200))
        truth = {
            "left": model.epipolar_to_left(x + col0, y + row0),
            "right": model.epipolar_to_right(x + col0 - offset, y + row0),
        }
        for view, (col, line) in truth.items():
            got = evaluate(record[view]["tile_to_sensor"], x, y)
            assert np.abs(got["col"] - col).max() <= 0.01
            assert np.abs(got["row"] - line).max() <= 0.01
            back = evaluate(record[view]["sensor_to_tile"], col, line)
            assert max(np.abs(back["x"] - x).max(), np.abs(back["y"] - y).max()) <= 0.01
            rpc = RPC.from_dict(record[view]["corrected_rpc"])
            sensor = model.left if view == "left" else model.right
            point = (LON + 1e-4, LAT - 2e-4, 45.0)
            assert np.allclose(rpc.project(*point), sensor.project(*point), atol=1e-3)
        lon, lat = model.epipolar_to_ground(x + col0, y + row0, 44.0)
        xl, _, xr, _ = model.ground_to_epipolar(lon, lat, np.full(200, 44.0))
        ground = evaluate(record["ground"], x, y, xl - xr - offset)
        assert np.abs(ground["height"] - 44.0).max() < 0.01
        assert np.abs(ground["lon"] - lon).max() < 1e-8 and np.abs(ground["lat"] - lat).max() < 1e-8
        ring = np.array(record["footprint"]["coordinates"][0])
        assert np.array_equal(ring[0], ring[-1])
        corner = model.epipolar_to_ground(
            col0 - 0.5, row0 - 0.5, record["footprint"]["heights_m"][0]
        )
        assert np.allclose(ring[0], corner, atol=1e-7)


def test_height_from_stored_disparity(exported: tuple[Path, dict]) -> None:
    """From files and the polynomial alone: the terrain, within float16's rounding."""
    folder, _ = exported
    row = rows_of(folder)[0]
    record = json.loads((folder / row["orientation"]).read_text())
    disparity = labels(folder / row["disp"])
    y, x = np.nonzero(np.isfinite(disparity))
    got = evaluate(record["ground"], x, y, disparity[y, x])
    error = got["height"] - terrain(got["lon"], got["lat"])
    assert np.abs(error).max() < 0.03


def test_checksums_find_an_edited_file(scene: SceneFiles, tmp_path: Path) -> None:
    folder = tmp_path / "Town"
    run([scene], folder)
    assert defects(folder) == []
    assert verify([folder])[str(folder)] > 60
    victim = folder / "disp" / "TN_disparity_3.tiff"
    data = bytearray(victim.read_bytes())
    data[-1] ^= 1
    victim.write_bytes(data)
    (folder / "left" / "TN_left_0.tiff").unlink()
    (folder / "left" / "stray.txt").write_text("x")
    assert sorted(defects(folder)) == [
        "disp/TN_disparity_3.tiff: changed",
        "left/TN_left_0.tiff: missing",
        "left/stray.txt: not in the manifest",
    ]
    with pytest.raises(InputError, match="TN_disparity_3"):
        verify([folder])
    with pytest.raises(InputError, match=r"TN_disparity_3|TN_left_0"):
        assemble_dataset([folder], tmp_path / "dataset")
    assert not (tmp_path / "dataset").exists()


def test_same_bytes_with_any_number_of_workers(
    exported: tuple[Path, dict], scene: SceneFiles
) -> None:
    folder, _ = exported
    again = folder.parent / "again" / "Town"
    run([scene], again, workers=1)
    for path in sorted(p for p in folder.rglob("*") if p.is_file()):
        assert path.read_bytes() == (again / path.relative_to(folder)).read_bytes(), path


@pytest.mark.parametrize("right_offset", ["tile", "scene"])
def test_offset_is_whole_and_of_tile_or_scene(
    scene: SceneFiles, tmp_path: Path, right_offset: str
) -> None:
    run([scene], tmp_path / "T", right_offset=right_offset, disparity_dtype="float32")
    rows = [row for row in rows_of(tmp_path / "T") if row["complete"] == "yes"]
    offsets = {int(row["right_offset_px"]) for row in rows}
    assert (len(offsets) == 1) == (right_offset == "scene")
    # Per tile and per scene, the scene's own disparity is the same.
    row = rows[0]
    with rasterio.open(tmp_path / "T" / row["disp"]) as dataset:
        assert dataset.nodata == -999 and dataset.dtypes == ("float32",)
    import zarr

    window = np.s_[int(row["row0"]) :, int(row["col0"]) :]
    original = zarr.open_group(scene.disparity)["disparity"][window][:SIZE, :SIZE]
    back = labels(tmp_path / "T" / row["disp"]) + int(row["right_offset_px"])
    assert np.nanmax(np.abs(back - original)) < 1e-5


def test_overlapping_tiles_share_no_ground_across_splits(scene: SceneFiles, tmp_path: Path) -> None:
    summary = run([scene], tmp_path / "T", stride=SIZE // 2)
    assert summary["splits"]["realised"]["none"] > 0
    assert all(summary["splits"]["realised"][s] > 0 for s in ("train", "val", "test"))
    assert shared_ground(tmp_path / "T" / "manifest.csv") == []
    with pytest.raises(InputError, match="share ground"):
        run([scene], tmp_path / "S", stride=SIZE // 2, strict=True)
    assert not (tmp_path / "S").exists()


def test_two_scenes_of_one_city(scene: SceneFiles, tmp_path: Path) -> None:
    """A second pair over the same ground: its tiles count on, and share no ground across splits."""
    other = make_scene(tmp_path / "s2", turn=0.3)
    summary = run([scene, other], tmp_path / "T", workers=2)
    rows = rows_of(tmp_path / "T")
    assert {row["scene"] for row in rows} == {"s1", "s2"} == set(summary["scenes"])
    assert len({row["tile"] for row in rows}) == len(rows)
    assert shared_ground(tmp_path / "T" / "manifest.csv") == []
    realised = summary["splits"]["realised"]
    assert sum(realised.values()) == summary["labelled_pairs"] and realised["none"] > 0
    assert all(realised[name] for name in ("train", "val", "test"))


def test_nothing_to_export_is_refused(scene: SceneFiles, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"Town: not one labelled .*labels incomplete") as caught:
        run([scene], tmp_path / "T", min_labelled=0.99)
    assert "tiles.min_labelled" in caught.value.remedy
    with pytest.raises(InputError, match="grid smaller than a tile"):
        run([scene], tmp_path / "T", size=1024)
    with pytest.raises(InputError, match=r"tiles\.stride"):
        run([scene], tmp_path / "T", size=512, stride=511)
    with pytest.raises(InputError, match="nodata -9999 cannot be stored in float16"):
        run([scene], tmp_path / "T", nodata=-9999)
    with pytest.raises(InputError, match="true disparity of 1 px"):
        run([scene], tmp_path / "T", nodata=1)
    assert not (tmp_path / "T").exists()


def test_half_precision_tiff(tmp_path: Path) -> None:
    """16 bits of IEEE float as the TIFF tags say, bytes as NumPy's float16, read back by GDAL."""
    values = np.linspace(-200, 200, 64 * 64).reshape(64, 64)
    stored = round_disparity(values, "float16")
    assert np.abs(stored - values)[np.abs(values) < 128].max() <= 1 / 32
    assert np.abs(stored - values).max() <= 1 / 16
    path = tmp_path / "half.tiff"
    write_tiff(path, stored, nodata=-999, half=True)
    with rasterio.open(path) as dataset:
        assert np.array_equal(dataset.read(1), stored) and dataset.nodata == -999
    data = path.read_bytes()
    assert data[:4] == b"II*\0"
    (start,) = struct.unpack_from("<I", data, 4)
    tags = {}
    for k in range(struct.unpack_from("<H", data, start)[0]):
        tag, kind, _, value = struct.unpack_from("<HHII", data, start + 2 + 12 * k)
        tags[tag] = value & 0xFFFF if kind == 3 else value
    assert (tags[258], tags[339], tags[259], tags[317]) == (
        16,
        3,
        8,
        1,
    )  # bits, IEEE, deflate, none
    import zlib

    raw = zlib.decompressobj().decompress(data[tags[273] :])
    assert np.array_equal(np.frombuffer(raw, "<f2"), stored.astype("f2").ravel())


def test_other_readers(exported: tuple[Path, dict], scene: SceneFiles, tmp_path: Path) -> None:
    folder, _ = exported
    left = read(folder / "left" / "TN_left_0.tiff")
    for path in (folder / "left" / "TN_left_0.tiff",):
        assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), left)
        assert np.array_equal(np.asarray(Image.open(path)), left)
    run([scene], tmp_path / "T", disparity_dtype="float32")
    path = tmp_path / "T" / "disp" / "TN_disparity_0.tiff"
    wanted = read(path)
    assert np.array_equal(cv2.imread(str(path), cv2.IMREAD_UNCHANGED), wanted)
    assert np.array_equal(np.asarray(Image.open(path)), wanted)
