"""Cameras of real images' RPCs in the forms of multi-view work, over whole crops."""

from __future__ import annotations

import json

import numpy as np
import pytest
from pyproj import Transformer

from stereotruth.sensor.deliveries import Acquisition
from stereotruth.sensor.rpc import RPC
from stereotruth.tiles.cameras import NAMES, Crop, Pinhole, eogs_models, local_frame, satnerf_record

from ...synthetic.real_data import SHARED

FOLDER = SHARED / "real/jacksonville/rpc_ba"


def crops() -> list[Crop]:
    """WorldView-3 over Jacksonville: whole images of 830 px, with satnerf's own RPCs."""
    if not FOLDER.is_dir():
        pytest.skip(f"{FOLDER} is not there")
    found = []
    for file in sorted(FOLDER.glob("*.json")):
        record = json.loads(file.read_text())
        names = {name: _theirs(name) for name in RPC.__dataclass_fields__}
        rpc = RPC.from_dict({mine: record["rpc"][other] for mine, other in names.items()})
        heights = float(record["min_alt"]), float(record["max_alt"])
        found.append(
            Crop(f"left/{file.stem}.tif", rpc, (record["width"], record["height"]), heights)
        )
    return found


def _theirs(name: str) -> str:
    return "_".join(filter(None, (NAMES.get(word, word) for word in name.split("_"))))


def test_perspectives_of_real_images_are_within_a_twentieth_of_a_pixel() -> None:
    """And off by no more than they state, at points that neither fit nor check has."""
    rng = np.random.default_rng(4)
    for crop in crops():
        lon, lat = crop.rpc.localize(*(n / 2 for n in crop.size), crop.heights[0])
        frame = local_frame(float(lon), float(lat))
        pinhole = Pinhole.fit(crop, frame)
        col, row = (rng.uniform(-0.5, n - 0.5, 2000) for n in crop.size)
        height = rng.uniform(*crop.heights, 2000)
        ground = *crop.rpc.localize(col, row, height), height
        found = pinhole.project(np.stack(frame.transform(*ground), 1))
        off = found - pinhole.without_skew(np.stack([col, row], 1))
        assert pinhole.max_error_px < 0.05
        assert np.abs(off).max() < 1.1 * pinhole.max_error_px
        np.testing.assert_allclose(pinhole.rotation @ pinhole.rotation.T, np.eye(3), atol=1e-12)
        centre = -pinhole.rotation.T @ pinhole.translation
        assert 3e5 < centre[2] < 3e6  # m: as high as satellites fly, give or take


def test_a_satnerf_record_gives_back_what_satnerf_had() -> None:
    for crop, file in zip(crops(), sorted(FOLDER.glob("*.json"))):
        theirs, mine = json.loads(file.read_text()), satnerf_record(crop, Acquisition())
        for name, value in theirs["rpc"].items():
            np.testing.assert_allclose(mine["rpc"][name], value, rtol=1e-15)
        ring = np.array([m["geojson"]["coordinates"][0] for m in (mine, theirs)])
        np.testing.assert_allclose(ring[0], ring[1], atol=2e-4)  # theirs is on a coarse terrain


def test_affine_cameras_of_real_images_state_what_they_leave() -> None:
    """The spread of the rays over 830 px, which no affine has: up to a tenth of a pixel."""
    rng = np.random.default_rng(5)
    for crop in crops():
        entry, _ = eogs_models([crop], [satnerf_record(crop, Acquisition())])
        model, size = entry["model"], np.array(crop.size)
        col, row = (rng.uniform(-0.5, n - 0.5, 2000) for n in crop.size)
        height = rng.uniform(*crop.heights, 2000)
        utm = Transformer.from_crs(4326, 32600 + model["n"], always_xy=True)
        xyz = np.stack([*utm.transform(*crop.rpc.localize(col, row, height)), height], 1)
        world = (xyz - model["center"]) / model["scale"]
        seen = world @ np.array(model["coef_"]).T + model["intercept_"]
        off = ((seen[:, :2] + 1) * size - 1) / 2 - np.stack([col, row], 1)
        assert np.abs(off).max() < 1.1 * entry["max_error_px"] < 0.12
