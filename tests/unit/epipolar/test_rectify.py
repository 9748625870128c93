"""Resampling on images whose pixels say where they come from, and on pairs of one known plane."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from stereotruth.core.config.configuration import Rectify
from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import open_grid, require_complete
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.rectify import rectify
from stereotruth.sensor.images import open_pair
from stereotruth.sensor.rpc import SensorModel

from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, METRES, camera
from ...synthetic.images import pattern, write_image

SIZE = (520, 460)  # cols, rows


def pair(left_angle: float = 90.0, right_angle: float = 92.0, right_gsd: float = 0.8):
    left = camera(BACKWARD, angle=left_angle, size=SIZE, bend=3.0)
    right = camera(FORWARD, angle=right_angle, gsd=right_gsd, size=SIZE, bend=-2.0)
    return left, right


def render(sensor: SensorModel, height: float) -> np.ndarray:
    """What a camera sees of the textured plane at a height, uint16."""
    col, row = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    lon, lat = sensor.localize(col, row, height)
    return np.round(pattern((lon - LON) * METRES[0], (lat - LAT) * METRES[1])).astype(np.uint16)


def run(folder: Path, left: np.ndarray, right: np.ndarray, sensors=None, **options):
    """Rectify two arrays, with masks and bands as :func:`.images.open_pair` takes them; returns the
    model and both images. ``left_tags``, ``right_tags``: of their files."""
    sensors, masks = sensors or pair(), options.pop("masks", (None, None))
    source, bands = folder / "source", options.pop("bands", None)
    source.mkdir(exist_ok=True, parents=True)
    images = [
        write_image(source / f"{name}.tif", None, pixels, **options.pop(f"{name}_tags", {}))
        for name, pixels in (("left", left), ("right", right))
    ]
    out = [folder / name for name in ("epipolar.json", "left.zarr", "right.zarr")]
    model = fit_epipolar(*sensors, SIZE, SIZE, HEIGHT)
    with open_pair(*images, *masks, bands=bands) as opened:
        rectify(*opened, model, *out, **options)
    return model, *(open_grid(path).image.values for path in out[1:])


def constant(value: int = 500) -> np.ndarray:
    return np.full(SIZE[::-1], value, dtype=np.uint16)


@pytest.mark.parametrize(("axis", "angles"), [(0, (90.0, 92.0)), (1, (-37.0, 143.0))])
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


@pytest.mark.parametrize("angles", [(90.0, 92.0), (20.0, 200.0)])
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


def test_day_and_sun_of_an_image_are_those_of_its_delivery(tmp_path: Path) -> None:
    (tmp_path / "source").mkdir()
    (tmp_path / "source/left.IMD").write_text(
        "firstLineTime = 2020-10-25T23:12:45.000000Z;\nmeanSunAz = 151.2;\nmeanSunEl = 44.1;\n"
    )
    run(tmp_path, constant(), constant())
    left, right = (require_complete(tmp_path / f"{v}.zarr").attrs for v in ("left", "right"))
    assert (left["acquired"], left["sun"]) == ("2020-10-25", [151.2, 44.1])
    assert (right["acquired"], right["sun"]) == (None, None)


def test_nodata_tag_and_the_lowest_value(tmp_path: Path) -> None:
    left = constant(0)
    left[:, 300:] = 60000
    _, image, _ = run(tmp_path, left, constant(), left_tags={"nodata": 60000})
    values, counts = np.unique(image, return_counts=True)
    assert set(values) == {0, 1}  # a true 0 becomes 1, since 0 stands for no value
    assert counts[1] > 50000


@pytest.mark.parametrize(
    ("dtype", "top", "expected", "gain"),
    [("uint8", 200, 200, 1.0), ("float32", 0.5, 10000, 20000.0)],
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
    with pytest.raises(InputError, match=r"right.tif: "):
        run(tmp_path, constant(), constant(0))
    assert products(tmp_path) == []


def test_masks_go_where_their_pixels_go(tmp_path: Path) -> None:
    """A mask hides what any of its pixels has a say in; under a mask file the image stays."""
    sensors, cloud = pair(), np.zeros(SIZE[::-1], np.uint8)
    cloud[200:210, 220:240] = 1
    mask = write_image(tmp_path / "cloud.tif", None, cloud)
    images = [render(sensors[0], HEIGHT)] * 2
    model, clear, _ = run(tmp_path / "clear", *images, sensors)
    run(tmp_path / "masked", *images, sensors, masks=(mask, None))
    left, right = (open_grid(tmp_path / f"masked/{view}.zarr") for view in ("left", "right"))
    with xr.open_zarr(tmp_path / "masked/left.zarr") as alone:
        np.testing.assert_array_equal(alone["mask"], left.mask)
    assert "mask" not in right and "mask" not in open_grid(tmp_path / "clear/left.zarr")
    np.testing.assert_array_equal(left.image, clear)
    col, row = model.epipolar_to_left(*np.indices(model.shape)[::-1])
    inside = (col > 217.1) & (col < 241.9) & (row > 197.1) & (row < 211.9)
    outside = (col < 216.9) | (col > 242.1) | (row < 196.9) | (row > 212.1)
    hidden = left.mask.values == 1
    assert hidden[inside].all() and inside.sum() > 300
    assert not hidden[outside].any()
    assert left.mask.attrs["flag_meanings"] == "seen masked"


def test_colours_are_rectified_alike(tmp_path: Path) -> None:
    """A colour is what a grey image of its values alone would be; the image is the bands' mix."""
    sensors, tags = pair(), {"photometric": "RGB"}
    bands = [(render(sensors[0], HEIGHT) // k).astype(np.uint16) + 1 for k in (1, 2, 3)]
    mix = {"bands": Rectify(panchromatic={1: 1, 2: 1}), "left_tags": tags, "right_tags": tags}
    run(tmp_path / "rgb", *[np.stack(bands)] * 2, sensors, **mix)
    _, green, _ = run(tmp_path / "green", bands[1], bands[1], sensors)
    rgb = open_grid(tmp_path / "rgb/left.zarr")
    with xr.open_zarr(tmp_path / "rgb/left.zarr") as alone:
        np.testing.assert_array_equal(alone["green"], rgb.green)
    np.testing.assert_array_equal(rgb.green, green)
    assert rgb.green.attrs["nodata"] == 0 and rgb.green.attrs["units"] == "1"
    assert rgb.attrs["resampling"]["mix"] == {"band 1": 0.5, "band 2": 0.5}
    assert "mix" not in open_grid(tmp_path / "green/left.zarr").attrs["resampling"]
    mixed = (rgb.red.values.astype(float) + rgb.green.values) / 2
    assert np.abs(mixed - rgb.image).max() <= 1.0
    assert (rgb.red.values > rgb.blue.values)[rgb.image.values > 0].all()
