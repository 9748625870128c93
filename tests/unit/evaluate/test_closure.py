"""Closure of triplets on exact labels of a hill that three cameras see."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import zarr

from stereotruth.align.alignment import Alignment, ViewFit
from stereotruth.align.records import write_equations
from stereotruth.core.errors import InputError
from stereotruth.core.products.grids import Layer, atomic_store, create_grid
from stereotruth.epipolar.fit import fit_epipolar
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.evaluate.closure import PairFiles, closure, closure_of_labels, triplets_of
from stereotruth.sensor.rpc import SensorModel

from ...synthetic.cameras import BACKWARD, FORWARD, HEIGHT, LAT, LON, METRES, camera

SIZE = (300, 280)
CAMERAS = {
    "A": camera(BACKWARD, angle=90.0, size=SIZE),
    "B": camera((-0.05, -0.25), angle=91.0, gsd=0.75, size=SIZE),
    "C": camera(FORWARD, angle=92.0, gsd=0.8, size=SIZE),
}
NOISE = 0.02  # px, of labels that are read, where a test gives them any
COVARIANCE = np.diag([0.0, 0.0, 0.09, 0.0, 0.0, 0.09])  # px², of a correction
META = {"units": "px", "long_name": "test"}


def hill(lon: np.ndarray, lat: np.ndarray) -> np.ndarray:
    """Heights (m) of smooth ground."""
    east, north = (lon - LON) * METRES[0], (lat - LAT) * METRES[1]
    return HEIGHT + 6.0 * np.sin(east / 35.0) * np.cos(north / 40.0)


@cache
def model_of(left: SensorModel, right: SensorModel) -> EpipolarModel:
    """The epipolar model of two cameras."""
    return fit_epipolar(left, right, SIZE, SIZE, HEIGHT, height_range=(HEIGHT - 20, HEIGHT + 20))


@cache
def labels(model: EpipolarModel, higher: float = 0.0) -> np.ndarray:
    """Exact disparities of the hill, or of one that is so many metres higher."""
    y, x = np.mgrid[: model.shape[0], : model.shape[1]].astype(float)
    col, row = model.epipolar_to_left(x, y)
    height = np.full(col.shape, HEIGHT)
    for _ in range(25):
        lon, lat = model.left.localize(col, row, height)
        height = hill(lon, lat) + higher
    return x - model.right_to_epipolar(*model.right.project(lon, lat, height))[0]


def aligned(left: str, right: str, cameras: dict[str, SensorModel]) -> Alignment:
    """Corrections of both cameras that are uncertain by tenths of a pixel."""
    fits = (
        ViewFit(view, "", SIZE, np.eye(2, 3), (), 0.3, 10, (150.0, 140.0), 150.0, COVARIANCE)
        for view in ("left", "right")
    )
    return Alignment("S", "affine", cameras[left], cameras[right], *fits, HEIGHT, (), {})


def pair(
    folder: Path,
    left: str,
    right: str,
    shift: float = 0.0,
    cameras: dict[str, SensorModel] = CAMERAS,
    higher: float = 0.0,
    noise: float = 0.0,
) -> PairFiles:
    """A pair with labels that are off by ``shift`` px, or of ground that is ``higher``, m, or with
    ``noise`` px of their own."""
    model = model_of(cameras[left], cameras[right])
    path = folder / f"{left}-{right}.zarr"
    layers = {"disparity": Layer("float32", np.nan, META)}
    disparity = labels(model, higher) + shift
    rng = np.random.default_rng(ord(left) + 256 * ord(right))
    disparity = disparity + rng.normal(0.0, noise, disparity.shape)
    with atomic_store(path) as scratch:
        attrs = {"epipolar": model.to_dict()}
        arrays = create_grid(scratch, model.shape, layers, chunk=64, shard=128, attrs=attrs)
        arrays["disparity"][:] = disparity
    file = folder / f"{left}-{right}.json"
    aligned(left, right, cameras).save(file)
    equations = folder / f"{left}-{right}-equations.json"
    write_equations(equations, None, "none are needed")
    return PairFiles(f"{left}-{right}", left, right, path, file, equations)


def triplet_of(folder: Path, shift: float = 0.0, **more: Any):
    """The triplet, the labels of B-C being off."""
    given = (("A", "B", 0.0), ("B", "C", shift), ("A", "C", 0.0))
    pairs = [pair(folder, *one, **more) for one in given]
    (found,) = triplets_of(pairs[::-1])
    assert found.images == ("A", "B", "C")
    return found


def shares(closures: np.ndarray, sigma: np.ndarray) -> tuple[float, float]:
    """Within one and two standard uncertainties, %."""
    return tuple(100 * float(np.mean(np.abs(closures) <= k * sigma)) for k in (1, 2))


@pytest.mark.slow
def test_errors_that_all_pairs_share_close(tmp_path):
    """Of an image's correction, and of the heights: they have no part in the uncertainty."""
    rpc = CAMERAS["B"].rpc
    moved = SensorModel(replace(rpc, samp_off=rpc.samp_off + 0.7, line_off=rpc.line_off - 0.4))
    triplet = triplet_of(tmp_path, cameras=CAMERAS | {"B": moved}, higher=0.5)
    closures, sigma = closure_of_labels(triplet)
    assert np.sqrt(np.mean(closures**2)) < 0.003
    assert np.sqrt(np.mean(sigma**2)) < 0.003


@pytest.mark.slow
def test_the_uncertainty_explains_labels_that_differ_by_their_reading(tmp_path):
    """White noise of known size in each pair, and the same ground four times as rough."""
    for k, noise in enumerate((NOISE, 4 * NOISE)):
        folder = tmp_path / str(k)
        folder.mkdir()
        closures, sigma = closure_of_labels(triplet_of(folder, noise=noise))
        one, two = shares(closures, sigma)
        assert 65 < one < 75 and 93 < two < 97
        # from bilinear reading of white noise: between 1/4 and all of its variance, thrice
        assert 0.5 * noise < np.sqrt(np.mean(sigma**2)) < 2.0 * noise
        assert np.sqrt(np.mean(sigma**2)) == pytest.approx(np.std(closures), rel=0.1)


def test_the_alignment_counts_where_an_image_has_two_corrections(tmp_path):
    triplet = triplet_of(tmp_path, noise=NOISE)
    _, alike = closure_of_labels(triplet)
    record = Alignment.read(triplet.bc.alignment)
    affine = record.left_fit.affine + np.array([[0.0, 0.0, 1e-3], [0.0, 0.0, 0.0]])
    fit = replace(record.left_fit, affine=affine)
    moved = replace(record, left=SensorModel(record.left.rpc, affine), left_fit=fit)
    moved.save(triplet.bc.alignment)
    _, differing = closure_of_labels(triplet)
    added = np.sqrt(np.mean(differing**2 - alike**2))
    # Two corrections of 0.3 px for each of three images of about the same pixel size: six
    # independent moves along the rows of A-C.
    assert added == pytest.approx(0.3 * np.sqrt(6), rel=0.2)


def test_pairs_without_a_triplet_are_refused_by_the_remedy():
    nowhere = Path("nowhere")
    pairs = [PairFiles(f"{a}-{b}", a, b, nowhere, nowhere, nowhere) for a, b in ("AB", "BC")]
    with pytest.raises(InputError, match="A-B, B-C and A-C"):
        closure("Town", pairs)


def test_an_offset_of_one_pair_is_beyond_the_uncertainty(tmp_path):
    """Three times the noise of a label, which pixels a few px apart share."""
    triplet = triplet_of(tmp_path, 3 * NOISE, noise=NOISE)
    one, two = shares(*closure_of_labels(triplet))
    assert one < 20 and two < 60


def test_labels_beside_a_height_step_are_not_compared(tmp_path):
    """Between two labels of different surfaces there is no label."""
    triplet = triplet_of(tmp_path)
    whole = len(closure_of_labels(triplet)[0])
    array = zarr.open_group(triplet.bc.disparity, mode="r+")["disparity"]
    values = array[:]
    values[:, ::4] += 3.0
    array[:] = values
    closures, _ = closure_of_labels(triplet)
    assert len(closures) < 0.6 * whole
    assert np.median(np.abs(closures)) < 0.003
