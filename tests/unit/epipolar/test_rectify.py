"""Resampling on images whose pixels say where they come from, and on pairs of one known plane."""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.image_reader import Source
from stereotruth.epipolar.rectify import rectify
from stereotruth.epipolar.resampling import resample
from stereotruth.epipolar.rpc import SensorModel
from stereotruth.errors import InputError
from stereotruth.products.grids import open_grid

from .test_epipolar import BACKWARD, FORWARD, HEIGHT, LAT, LON, METRES, camera
from .test_rpc import write_image

SIZE = (520, 460)  # cols, rows


def pair(left_angle: float = 90.0, right_angle: float = 92.0, right_gsd: float = 0.8):
    left = camera(BACKWARD, angle=left_angle, size=SIZE, bend=3.0)
    right = camera(FORWARD, angle=right_angle, gsd=right_gsd, size=SIZE, bend=-2.0)
    return left, right


def pattern(east: np.ndarray, north: np.ndarray) -> np.ndarray:
    """A smooth texture on the ground (waves of 5 to 40 m), digital numbers near 1000."""
    rng = np.random.default_rng(5)
    value = np.full(np.shape(east), 1000.0)
    for length in (5.0, 6.0, 8.0, 11.0, 17.0, 40.0):
        angle, phase = rng.uniform(0, np.pi, 2)
        wave = np.cos(angle) * east + np.sin(angle) * north
        value += 80.0 * np.sin(2 * np.pi / length * wave + phase)
    return value


def render(sensor: SensorModel, height: float) -> np.ndarray:
    """What a camera sees of the textured plane at a height, uint16."""
    col, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    lon, lat = sensor.localize(col, row, height)
    return np.round(pattern((lon - LON) * METRES[0], (lat - LAT) * METRES[1])).astype(np.uint16)


def run(folder: Path, left: np.ndarray, right: np.ndarray, sensors=None, **options):
    """Rectify two arrays; returns the model and both images."""
    sensors = sensors or pair()
    source = folder / "source"
    source.mkdir(exist_ok=True)
    images = [
        write_image(source / f"{name}.tif", None, pixels, **options.pop(f"{name}_tags", {}))
        for name, pixels in (("left", left), ("right", right))
    ]
    out = [folder / name for name in ("epipolar.json", "left.zarr", "right.zarr")]
    model = rectify(*images, *sensors, HEIGHT, *out, **options)
    return model, *(open_grid(path).image.values for path in out[1:])


def constant(value: int = 500) -> np.ndarray:
    return np.full(SIZE[::-1], value, dtype=np.uint16)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("angles", [(90.0, 92.0), (-37.0, 143.0)])
def test_every_pixel_comes_from_where_the_model_says(
    tmp_path: Path, axis: int, angles: tuple[float, float]
) -> None:
    """Values are 120 per source px: rounding to whole values leaves 0.0042 px."""
    ramp = (np.indices(SIZE[::-1])[1 - axis] * 120 + 500).astype(np.uint16)
    model, left, right = run(tmp_path, ramp, ramp, pair(*angles))
    y, x = np.indices(model.shape)
    for image, inverse in ((left, model.epipolar_to_left), (right, model.epipolar_to_right)):
        source = np.array(inverse(x, y))
        valid = image > 0
        assert valid.mean() > 0.3
        error = (image[valid] - 500.0) / 120 - source[axis][valid]
        assert np.abs(error).max() < 0.0042 + 0.002  # measured 0.0045
        # filled wherever all six taps lie in the image, and nowhere outside
        col, row = source
        inner = (np.minimum(col, row) > 2.01) & (col < SIZE[0] - 3.01) & (row < SIZE[1] - 3.01)
        assert valid[inner].all()
        assert not valid[(col < -0.5) | (row < -0.5) | (col > SIZE[0]) | (row > SIZE[1])].any()


@pytest.mark.parametrize("angles", [(0.0, 0.0), (90.0, 92.0), (-90.0, 90.0), (20.0, 200.0)])
def test_a_plane_at_the_reference_height_has_no_disparity(
    tmp_path: Path, angles: tuple[float, float]
) -> None:
    sensors = pair(*angles)
    _, left, right = run(tmp_path, *(render(s, HEIGHT) for s in sensors), sensors)
    both = (left > 0) & (right > 0)
    assert both.mean() > 0.2
    difference = left[both].astype(float) - right[both]
    # measured 5.0 rms on a texture of 139 rms: interpolation of 5 m waves from 0.8 m pixels
    assert np.sqrt(np.mean(difference**2)) < 8.0
    assert np.corrcoef(left[both], right[both])[0, 1] > 0.998


def test_a_higher_plane_moves_to_the_left_in_the_right_image(tmp_path: Path) -> None:
    sensors = pair()
    rise = 20 / (np.hypot(*np.subtract(BACKWARD, FORWARD)) / 0.65)  # 20 px of disparity
    _, left, right = run(tmp_path, *(render(s, HEIGHT + rise) for s in sensors), sensors)
    left, right = left[:, 20:], right[:, :-20]  # d = x_left - x_right = 20
    both = (left > 0) & (right > 0)
    assert both.mean() > 0.2
    assert np.corrcoef(left[both], right[both])[0, 1] > 0.998


def test_interpolation_error_of_the_kernel() -> None:
    """Against the exact wave; bicubic (a = -0.5) and OpenCV's for comparison, in the comments."""
    col, row = np.meshgrid(np.arange(200.0), np.arange(200.0))
    rng = np.random.default_rng(0)
    at = rng.uniform(5, 190, (2, 9, 9))
    for length, tolerance in ((4.0, 0.045), (6.0, 0.008), (10.0, 0.0015)):
        wave = 10000 + 8000 * np.sin(2 * np.pi / length * (col + 0.3 * row))
        got = np.empty(81)
        for k in range(81):
            lattice = np.repeat(np.repeat(at.reshape(2, 81)[:, k, None, None], 2, 1), 2, 2)
            out = np.zeros((1, 1), dtype=np.uint16)
            assert resample(wave.astype(np.float32), lattice, 16, (1.0, 1.0), out) == 1
            got[k] = out[0, 0]
        c, r = at.reshape(2, 81)
        exact = 10000 + 8000 * np.sin(2 * np.pi / length * (c + 0.3 * r))
        assert np.sqrt(np.mean((got - exact) ** 2)) / 8000 < tolerance


def keys_value(source: np.ndarray, col: float, row: float, scale: tuple[float, float]) -> float:
    """Keys (1981), section VI, as a double sum; NaN where a tap with weight has no value."""

    def kernel(s: np.ndarray) -> np.ndarray:
        s = np.abs(s)
        pieces = [
            (s < 1, 4 / 3 * s**3 - 7 / 3 * s**2 + 1),
            (s < 2, -7 / 12 * s**3 + 3 * s**2 - 59 / 12 * s + 15 / 6),
            (s < 3, 1 / 12 * s**3 - 2 / 3 * s**2 + 21 / 12 * s - 3 / 2),
        ]
        return np.select(*zip(*pieces), 0.0)

    taps = []
    for axis, at in enumerate((col, row)):
        reach = int(np.ceil(3 * scale[axis])) + 1
        first = int(np.floor(at)) - reach
        numbers = np.arange(first, first + 2 * reach + 1)
        weights = kernel((at - numbers) / scale[axis])
        taps.append((numbers, weights / weights.sum()))
    total = 0.0
    for c, across in zip(*taps[0]):
        for r, down in zip(*taps[1]):
            if min(abs(across), abs(down)) > 1e-6:
                there = 0 <= c < source.shape[1] and 0 <= r < source.shape[0]
                total += across * down * source[r, c] if there else np.nan
    return total


@pytest.mark.parametrize("scale", [(1.0, 1.0), (1.7, 1.3)])
@pytest.mark.parametrize("angle", [0.0, 3.0, 90.4, 200.0])
def test_values_are_those_of_the_formula(angle: float, scale: tuple[float, float]) -> None:
    """With holes of nodata, and past all four edges; of white noise over all of uint16."""
    rng = np.random.default_rng(1)
    source = rng.integers(1, 65535, (29, 37)).astype(np.float32)
    source[rng.random(source.shape) < 0.004] = np.nan
    step = 16
    x, y = np.meshgrid(*2 * [np.arange(0, 64 + step, step) - 32.0])
    turn = np.radians(angle)
    lattice = np.stack(
        [
            18.3 + scale[0] * (np.cos(turn) * x - np.sin(turn) * y),
            14.4 + scale[1] * (np.sin(turn) * x + np.cos(turn) * y),
        ]
    )
    out = np.zeros((58, 61), dtype=np.uint16)
    count = resample(source, lattice, step, scale, out)
    assert count == np.count_nonzero(out) > 100
    y, x = np.indices(out.shape)
    fine = [np.array([[bilinear(a, i, j, step) for i in x[0]] for j in y[:, 0]]) for a in lattice]
    expected = np.array(
        [[keys_value(source, c, r, scale) for c, r in zip(*line)] for line in zip(*fine)]
    )
    inside = (
        (fine[0] >= -0.5)
        & (fine[1] >= -0.5)
        & (fine[0] <= source.shape[1] - 0.5)
        & (fine[1] <= source.shape[0] - 0.5)
    )
    assert np.array_equal(out > 0, inside & np.isfinite(expected))
    error = out[out > 0] - np.clip(expected[out > 0], 1, 65535)
    assert np.abs(error).max() < 0.53  # float32 sums; measured 0.517


def bilinear(nodes: np.ndarray, x: int, y: int, step: int) -> float:
    (i, f), (j, g) = divmod(x, step), divmod(y, step)
    f, g = f / step, g / step
    near, far = ((1 - f) * nodes[k, i] + f * nodes[k, i + 1] for k in (j, j + 1))
    return (1 - g) * near + g * far


def test_the_window_of_the_source_does_not_matter() -> None:
    """Bits are the same wherever the source's window begins, and where a tile's row does."""
    rng = np.random.default_rng(3)
    source = rng.integers(1, 65535, (400, 400)).astype(np.float32)
    source[150:153, 220] = np.nan
    x, y = np.meshgrid(*2 * [np.arange(0.0, 208, 16)])
    lattice = np.stack([320.1 - 1.013 * y + 0.01 * x, 93.7 + 0.987 * x - 0.02 * y])
    whole = np.zeros((192, 192), dtype=np.uint16)
    resample(source, lattice, 16, (1.0, 1.0), whole)
    assert (whole == 0).any()
    window = np.ascontiguousarray(source[86:300, 105:331])
    moved = lattice - np.array([105, 86])[:, None, None]
    part = np.zeros((160, 176), dtype=np.uint16)
    resample(window, moved[:, 2:, 1:], 16, (1.0, 1.0), part)
    assert np.array_equal(part, whole[32:, 16:])


def test_whole_pixels_are_copied() -> None:
    """No tap but the pixel's own has weight there: nodata beside it and edges do not matter."""
    source = np.random.default_rng(0).integers(1, 60000, (16, 16)).astype(np.float32)
    source[7, 7] = np.nan
    lattice = np.stack(np.meshgrid([0.0, 16.0], [0.0, 16.0]))
    out = np.zeros((16, 16), dtype=np.uint16)
    assert resample(source, lattice, 16, (1.0, 1.0), out) == 255
    expected = np.nan_to_num(source)
    assert np.array_equal(out, expected)


def test_nodata_spreads_to_whatever_it_touches(tmp_path: Path) -> None:
    hole = constant()
    hole[200:210, 220:240] = 0
    sensors = pair()
    model, left, _ = run(tmp_path, hole, constant(), sensors)
    y, x = np.indices(model.shape)
    col, row = model.epipolar_to_left(x, y)
    touched = (col > 217) & (col < 242) & (row > 197) & (row < 212)
    assert (left[touched] == 0).all()
    around = (np.abs(col - 230) < 40) & (np.abs(row - 205) < 40)
    near = (col > 216.5) & (col < 242.5) & (row > 196.5) & (row < 212.5)
    assert (left[around & ~near] == 500).all()


def test_nodata_tag_and_the_lowest_value(tmp_path: Path) -> None:
    left = constant(0)
    left[:, 300:] = 60000
    _, image, _ = run(tmp_path, left, constant(), left_tags={"nodata": 60000})
    values, counts = np.unique(image, return_counts=True)
    assert set(values) == {0, 1}  # a true 0 becomes 1, since 0 stands for no value
    assert counts[1] > 50000


@pytest.mark.parametrize(
    ("dtype", "top", "expected", "gain"),
    [("uint8", 200, 200, 1.0), ("float32", 0.5, 10000, 20000.0), ("float32", 3000.0, 3000, 1.0)],
)
def test_other_pixel_types(
    tmp_path: Path, dtype: str, top: float, expected: int, gain: float
) -> None:
    left = np.full(SIZE[::-1], top, dtype=dtype)
    _, image, _ = run(tmp_path, left, constant())
    assert set(np.unique(image)) == {0, expected}
    assert open_grid(tmp_path / "left.zarr").attrs["resampling"]["value_gain"] == gain


def test_a_finer_view_is_smoothed_before_it_is_thinned(tmp_path: Path) -> None:
    checks = (np.indices(SIZE[::-1]).sum(0) % 2 * 2000 + 1000).astype(np.uint16)
    sensors = pair(right_gsd=0.3)
    _, _, right = run(tmp_path, constant(), checks, sensors)
    scale = open_grid(tmp_path / "right.zarr").attrs["resampling"]["kernel_widening_col_row"]
    assert np.allclose(scale, 0.65 / 0.3, rtol=0.02)
    inside = right[right > 0].astype(float)
    assert abs(inside.mean() - 2000) < 2
    assert inside.std() < 30  # of 1000 in the source


def test_several_bands(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "rgb.tif"
    shape = {"width": 9, "height": 8, "count": 3, "dtype": "uint8", "photometric": "RGB"}
    with (
        pytest.warns(NotGeoreferencedWarning),
        rasterio.open(path, "w", driver="GTiff", **shape) as dataset,
    ):
        dataset.write(np.full((3, 8, 9), 5, dtype=np.uint8))
    with caplog.at_level(logging.WARNING, "stereotruth"), Source(path) as source:
        assert source.size == (9, 8)
        assert source.read(2, 1, 4, 3).shape == (3, 4)
    assert "rgb.tif has 3 bands; band 1 (red) is used" in caplog.text


def digest(store: Path) -> str:
    files = sorted(path for path in store.rglob("*") if path.is_file())
    record = b"".join(str(p.relative_to(store)).encode() + p.read_bytes() for p in files)
    return hashlib.sha256(record).hexdigest()


def test_the_same_bytes_for_any_number_of_workers(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("stereotruth.epipolar.rectify.SHARD", 256)
    monkeypatch.setattr("stereotruth.epipolar.rectify.CHUNK", 64)
    rng = np.random.default_rng(2)
    images = [rng.integers(1, 3000, SIZE[::-1]).astype(np.uint16) for _ in range(2)]
    digests = []
    for workers in (1, 3):
        folder = tmp_path / str(workers)
        folder.mkdir()
        _, one, _ = run(folder, *images, workers=workers, provenance={"software": "x"})
        digests.append([digest(folder / f"{side}.zarr") for side in ("left", "right")])
    assert digests[0] == digests[1]
    monkeypatch.undo()
    (tmp_path / "whole").mkdir()
    _, whole, _ = run(tmp_path / "whole", *images)
    assert np.array_equal(one, whole)  # nor does the size of the blocks matter


def test_stores_say_what_they_are(tmp_path: Path) -> None:
    sensors = pair()
    model, _, _ = run(tmp_path, constant(), constant(), sensors, provenance={"software": "x"})
    assert model.to_dict() == fit_epipolar(*sensors, SIZE, SIZE, HEIGHT).to_dict()
    for side in ("left", "right"):
        facts = open_grid(tmp_path / f"{side}.zarr").attrs["resampling"]
        assert facts["coordinate_error_px"] < 0.002
        assert facts["source"] == f"{side}.tif"
    grid = open_grid(tmp_path / "right.zarr")
    assert grid.attrs["epipolar"] == model.to_dict()
    assert grid.attrs["provenance"] == {"software": "x"}
    assert grid.attrs["view"] == "right"
    assert grid.image.dims == ("y", "x") and grid.image.shape == model.shape
    assert grid.image.attrs["nodata"] == 0 and grid.image.attrs["units"] == "1"


def products(folder: Path) -> list[str]:
    """What is there but the source, and the blocks that wait to be taken over."""
    names = (path.name for path in folder.iterdir())
    return sorted(name for name in names if name != "source" and not name.endswith(".work"))


def test_nothing_but_nodata_is_refused_and_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"right.tif: image has nothing but nodata"):
        run(tmp_path, constant(), constant(0))
    assert products(tmp_path) == []


def test_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    noise = rng.integers(1, 3000, SIZE[::-1]).astype(np.uint16)
    left = write_image(tmp_path / "left.tif", None, noise, compress="deflate")
    right = write_image(tmp_path / "right.tif", None, noise)
    left.write_bytes(left.read_bytes()[: left.stat().st_size // 2])
    out = tmp_path / "out"
    with pytest.raises(InputError, match=r"left.tif: (rows|not a raster)"):
        rectify(left, right, *pair(), HEIGHT, out / "e.json", out / "l.zarr", out / "r.zarr")
    assert not out.exists() or products(out) == []


def test_complex_images_are_refused(tmp_path: Path) -> None:
    radar = write_image(tmp_path / "sar.tif", None, np.ones((8, 8), dtype=np.complex64))
    with pytest.raises(InputError, match=r"sar.tif: complex image"):
        Source(radar)
