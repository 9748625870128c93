"""The corrected camera of a crop in the forms of multi-view work: satnerf, EOGS, COLMAP.

A satnerf record holds the RPC itself, to all digits. EOGS and COLMAP know no RPCs: an affine and a
perspective camera are fitted to it over the crop and the heights that it shows, and what they leave
is measured on other points. Formats: the JSON of github.com/centreborelli/satnerf, whose RPC is
that of the package rpcm; ``affine_models.json`` of EOGS (Savant Aira et al. 2025); COLMAP's text
model (colmap.github.io/format.html).

A satellite's rows and columns meet at a right angle neither on the ground nor in the focal plane,
and COLMAP's pinhole has no skew. As in VisSat (Zhang et al. 2019), the skew is taken out of the
image: each row moves along itself, by :meth:`Pinhole.columns`.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.polynomial.chebyshev import chebpts1
from pyproj import Transformer
from scipy.spatial.transform import Rotation

from ..core.numerics.arrays import Floats
from ..core.numerics.geometry import for_readers
from ..epipolar.intersection import utm_epsg
from ..sensor.deliveries import Acquisition
from ..sensor.rpc import RPC, SCALARS, VECTORS

FIT, CHECK = chebpts1(8), np.linspace(-1.0, 1.0, 11)  # places on each axis, in [-1, 1]
# What is known of a camera before it is fitted: how far it is. A fit moves 1 / distance and the
# direction of its axis, by PULL_PX_M, only for what it gains in the image; then small crops of flat
# ground, which tell nothing of both, get a camera of a satellite.
DISTANCE_M, PULL_PX_M = 7e5, 5e3
FARTHEST_M = 1e7
CART = "+proj=pipeline +step +proj=unitconvert +xy_in=deg +xy_out=rad +step +proj=cart +ellps=WGS84"
ECEF = Transformer.from_pipeline(CART)
BANDS = "CDEFGHJKLMNPQRSTUVWXX"  # of latitude, 8 degrees each from 80 south on
NAMES = {"line": "row", "samp": "col", "long": "lon", "height": "alt", "off": "offset"}
NAMES |= {"coeff": ""}
GREY = "128 128 128"  # of all points: their colour is that of the images


def local_frame(lon: float, lat: float) -> Transformer:
    """From (lon, lat, height) to metres to the east, the north and up of a place on the ellipsoid.

    Degrees, degrees, m; the axes are those of the place, at right angles, not on a map.
    """
    return Transformer.from_pipeline(
        f"{CART} +step +proj=topocentric +ellps=WGS84 +lon_0={lon} +lat_0={lat} +h_0=0"
    )


@dataclass(frozen=True, eq=False)
class Crop:
    """``name``: path of the file in the folder of crops; ``rpc``: that of the crop; ``size``:
    (cols, rows) px; ``heights``: lowest and highest that it shows, ellipsoidal m."""

    name: str
    rpc: RPC
    size: tuple[int, int]
    heights: tuple[float, float]

    @property
    def json_name(self) -> str:
        """Name of its file among those of satnerf."""
        return self.name.replace("/", "_").removesuffix(".tif") + ".json"

    def points(self, places: Floats) -> tuple[Floats, Floats]:
        """Pixels [n, 2] (col, row) and their ground [n, 3] (lon, lat, height), over all heights.

        ``places`` on each axis, in [-1, 1]: the borders of the crop.
        """
        low, high = self.heights
        cols, rows = ((places + 1) / 2 * side - 0.5 for side in self.size)
        grid = np.meshgrid(cols, rows, low + (places + 1) / 2 * (high - low))
        col, row, height = (axis.ravel() for axis in grid)
        return np.stack([col, row], 1), np.stack([*self.rpc.localize(col, row, height), height], 1)


def satnerf_record(crop: Crop, taken: Acquisition) -> dict[str, Any]:
    """A crop as satnerf describes an image; what nothing tells of time and sun is None.

    Pixel (0, 0) is the centre of the upper-left one, as in our RPCs.
    """
    cols, rows = crop.size
    ring = np.array([[0, 0], [cols, 0], [cols, rows], [0, rows]]) - 0.5
    lon, lat = crop.rpc.localize(*ring.T, sum(crop.heights) / 2)
    azimuth, elevation = taken.sun or (None, None)
    corners = np.stack([for_readers(lon), lat], 1).tolist()
    names = {}
    for name in (*SCALARS, *VECTORS):
        words = [NAMES.get(word, word) for word in name.split("_")]
        names[name] = "_".join(filter(None, words))
    return {
        "img": crop.name,
        "height": rows,
        "width": cols,
        "sun_elevation": elevation,
        "sun_azimuth": azimuth,
        "acquisition_date": taken.time and taken.time.strftime("%Y%m%d%H%M%S"),
        "geojson": {
            "type": "Polygon",
            "coordinates": [corners],
            "center": [float(for_readers(lon.mean())), float(lat.mean())],
        },
        "min_alt": crop.heights[0],
        "max_alt": crop.heights[1],
        "rpc": {names[name]: value for name, value in crop.rpc.to_dict().items()},
    }


def eogs_models(crops: Sequence[Crop], records: Sequence[Mapping[str, Any]]) -> list[dict]:
    """The entries of EOGS' ``affine_models.json`` of crops with one world, and its view from above.

    World: (UTM east, UTM north, height) less ``center``, over ``scale`` (m). View: a pixel's centre
    (col, row) at (2 col + 1) / cols - 1, (2 row + 1) / rows - 1, and the height in m; view =
    ``coef_`` @ world + ``intercept_``. ``max_error_px``: the largest difference from the RPC.
    """
    lon, lat = records[0]["geojson"]["center"]
    utm = Transformer.from_crs(4326, code := utm_epsg(lon, lat), always_xy=True)

    def places(crop: Crop, on: Floats) -> tuple[Floats, Floats]:
        pixels, ground = crop.points(on)
        return pixels, np.stack([*utm.transform(ground[:, 0], ground[:, 1]), ground[:, 2]], 1)

    corners = np.concatenate([places(crop, np.array([-1.0, 1.0]))[1] for crop in crops])
    center = np.append(corners[:, :2].mean(axis=0), 0.0)
    scale = float(np.linalg.norm(corners - center, axis=1).max())
    world = {
        "scale": scale,
        "n": code % 100,
        "l": BANDS[int((lat + 80.0) // 8.0)],
        "center": center.tolist(),
        "min_world": ((corners.min(axis=0) - center) / scale).tolist(),
        "max_world": ((corners.max(axis=0) - center) / scale).tolist(),
    }
    entries = []
    for crop, record in zip(crops, records):
        half = np.array(crop.size) / 2
        (pixels, fit), (others, check) = (places(crop, on) for on in (FIT, CHECK))
        terms, tested = (np.c_[(v - center) / scale, np.ones(len(v))] for v in (fit, check))
        rows = np.linalg.lstsq(terms, (pixels + 0.5) / half - 1, rcond=None)[0]
        error = np.abs((tested @ rows + 1) * half - 0.5 - others).max()
        coef = np.vstack([rows[:3].T, [0.0, 0.0, scale]])
        model = {"coef_": coef.tolist(), "intercept_": [*rows[3].tolist(), 0.0], **world}
        entry = {**record, "centerofscene_UTM": [0.0] * 3, "max_error_px": float(error)}
        entries.append(entry | {"model": model, "sun_model": _sun_model(coef, rows[3], record)})
    nadir = {
        "coef_": [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, scale]],
        "intercept_": [0.0] * 3,
    }
    above = {**entries[0], "img": "Nadir", "max_error_px": 0.0}
    return [*entries, above | {"model": {**world, **nadir}}]


def _sun_model(coef: Floats, shift: Floats, record: Mapping[str, Any]) -> dict[str, Any] | None:
    """The camera of EOGS that looks from the sun, with the pixels of the image at height 0.

    ``sun_dir_ecef``: to the sun, in the world (its name is older), as long as one metre of height.
    """
    if record["sun_azimuth"] is None:
        return None
    azimuth, elevation = np.radians([record["sun_azimuth"], record["sun_elevation"]])
    level = np.cos(elevation)
    sun = np.array([np.sin(azimuth) * level, np.cos(azimuth) * level, np.sin(elevation)])
    sun /= (coef @ sun)[2]
    to_sun = np.eye(3)
    to_sun[:2, 2] = -(coef @ sun)[:2]
    return {
        "coef_": (to_sun @ coef).tolist(),
        "intercept_": [*shift.tolist(), 0.0],
        "sun_dir_ecef": sun.tolist(),
        "camera_to_sun": to_sun.tolist(),
    }


@dataclass(frozen=True, eq=False)
class Pinhole:
    """A perspective camera of a crop, and the image without skew that it has.

    ``focal`` (x, y) px; ``centre``: principal point (col, row) of the image without skew, from the
    centre of its upper-left pixel; ``rotation`` [3, 3], ``translation`` [3] m: from the local frame
    to the camera (right, down, ahead). ``skew``: columns that a row moves for each row below the
    middle. ``max_error_px``: the largest difference from the RPC, in the crop (of a crop that shows
    the ground mirrored, which no camera does, thousands).
    """

    crop: Crop
    focal: tuple[float, float]
    centre: tuple[float, float]
    rotation: Floats
    translation: Floats
    skew: float
    max_error_px: float = np.nan

    @cached_property
    def margin(self) -> int:
        """Columns by which the image without skew is wider than the crop, on either side."""
        return int(np.ceil(abs(self.skew) * (self.crop.size[1] - 1) / 2))

    @property
    def size(self) -> tuple[int, int]:
        """(cols, rows) px of the image without skew."""
        return self.crop.size[0] + 2 * self.margin, self.crop.size[1]

    def columns(self) -> Floats:
        """[rows, cols]: the column of the crop, in the same row, that each pixel shows."""
        row, col = np.indices(self.size[::-1], dtype=np.float64)
        return col + self.skew * (row - (self.size[1] - 1) / 2) - self.margin

    def without_skew(self, pixels: Floats) -> Floats:
        """Places [n, 2] (col, row) of the crop in the image without skew."""
        col, row = pixels.T
        return np.stack([col - self.skew * (row - (self.size[1] - 1) / 2) + self.margin, row], 1)

    def project(self, xyz: Floats) -> Floats:
        """Places [n, 2] of points [n, 3] of the local frame in the image without skew."""
        seen = xyz @ self.rotation.T + self.translation
        return seen[:, :2] / seen[:, 2:] * self.focal + self.centre

    @classmethod
    def fit(cls, crop: Crop, frame: Transformer) -> Pinhole:
        """To the RPC: all eleven parameters of a perspective, by least squares."""
        pixels, ground = crop.points(FIT)
        xyz = np.stack(frame.transform(*ground.T), 1)
        middle, there = xyz.mean(axis=0), pixels.mean(axis=0)
        terms, shown = np.c_[xyz - middle, np.ones(len(xyz))], pixels - there
        slopes = np.linalg.lstsq(terms, shown, rcond=None)[0][:3].T
        ahead = np.cross(*slopes)
        axis = _axis(terms, shown, ahead / np.linalg.norm(ahead))
        weighted = shown * (terms[:, :3] @ axis + 1)[:, None]
        rows = np.linalg.lstsq(terms, weighted, rcond=None)[0].T
        # K R = rows / |axis|, with the axis as third row: K is triangular, R turns.
        distance = 1 / np.linalg.norm(axis)
        z = axis * distance
        down = rows[1, :3] - (rows[1, :3] @ z) * z
        y = down / np.linalg.norm(down)
        rotation = np.stack([np.cross(y, z), y, z])
        inner = np.vstack([rows[:, :3] @ rotation.T * distance, [0.0, 0.0, 1.0]])
        t = np.linalg.solve(inner, [*rows[:, 3] * distance, distance]) - rotation @ middle
        skew, focal = inner[0, 1] / inner[1, 1], (float(inner[0, 0]), float(inner[1, 1]))
        found = cls(crop, focal, (0.0, 0.0), rotation, t, float(skew))
        apart = inner[:2, 2] - (skew * inner[1, 2], 0.0)  # of the principal point and ``there``
        found = replace(found, centre=tuple((found.without_skew(there[None])[0] + apart).tolist()))
        pixels, ground = crop.points(CHECK)
        off = found.project(np.stack(frame.transform(*ground.T), 1)) - found.without_skew(pixels)
        off[:, 0] += skew * off[:, 1]  # as it is in the crop
        return replace(found, max_error_px=float(np.abs(off).max()))

    def line(self, number: int) -> str:
        """Its line of COLMAP's ``cameras.txt``, which counts from the corner of the first pixel."""
        values = (*self.focal, *(v + 0.5 for v in self.centre))
        return f"{number} PINHOLE {self.size[0]} {self.size[1]} {_numbers(values)}"

    def pose(self, number: int) -> str:
        """Its line of ``images.txt``: unit quaternion and translation, from the local frame."""
        turned = Rotation.from_matrix(self.rotation).as_quat(scalar_first=True)
        return f"{number} {_numbers((*turned, *self.translation))} {number} {self.crop.name}"


@dataclass(frozen=True, eq=False)
class Pair:
    """Cameras of a tile's left and right crop, and places of its labels that both show.

    ``ground`` [n, 3]: lon, lat, height (degrees, degrees, m); ``pixels``: (col, row) [n, 2] of the
    places in either crop.
    """

    pinholes: tuple[Pinhole, Pinhole]
    ground: Floats
    pixels: tuple[Floats, Floats]


def write_satnerf(
    folder: Path, pairs: Sequence[Pair], taken: Sequence[Sequence[Acquisition]]
) -> None:
    """Write a JSON file for each crop, and the places in ``pts3d.npy``.

    ``taken``: of both images, by pair. Places are geocentric WGS 84, m; a crop's ``keypoints`` have
    their pixels and numbers.
    """
    folder.mkdir()
    count = 0
    for pair, both in zip(pairs, taken):
        numbers = range(count, count + len(pair.ground))
        for hole, pixels, acquisition in zip(pair.pinholes, pair.pixels, both):
            record = satnerf_record(hole.crop, acquisition)
            seen = {"2d_coordinates": pixels.tolist(), "pts3d_indices": list(numbers)}
            record |= {"keypoints": seen}
            (folder / hole.crop.json_name).write_text(json.dumps(record), encoding="ascii")
        count = numbers.stop
    ground = np.concatenate([pair.ground for pair in pairs])
    np.save(folder / "pts3d.npy", np.stack(ECEF.transform(*ground.T), 1))


def write_eogs(folder: Path, pair: Pair, taken: Sequence[Acquisition]) -> list[float]:
    """Write a tile's ``affine_models.json``; both crops' errors, px."""
    folder.mkdir(parents=True)
    crops = [hole.crop for hole in pair.pinholes]
    models = eogs_models(crops, [satnerf_record(*both) for both in zip(crops, taken)])
    (folder / "affine_models.json").write_text(json.dumps(models), encoding="ascii")
    return [model["max_error_px"] for model in models[:2]]


def write_colmap(folder: Path, pairs: Sequence[Pair], frame: Transformer) -> None:
    """Write COLMAP's text model of all crops to ``folder``, in a local frame.

    Image and camera of pair k are 2 k + 1 (left) and 2 k + 2. A point's error is the mean distance
    (px) of its two places from those that the cameras have for it.
    """
    folder.mkdir(parents=True)
    cameras, images, points, count = [], [], [], 0
    for pair, left in zip(pairs, range(1, 2 * len(pairs), 2)):
        xyz = np.stack(frame.transform(*pair.ground.T), 1)
        places = [hole.without_skew(at) for hole, at in zip(pair.pinholes, pair.pixels)]
        errors = [hole.project(xyz) - at for hole, at in zip(pair.pinholes, places)]
        error = np.linalg.norm(errors, axis=2).mean(axis=0)
        for number, hole, at in zip((left, left + 1), pair.pinholes, places):
            low, high = hole.crop.heights
            cameras += [
                f"# {hole.crop.name}: at most {hole.max_error_px:.3f} px from the RPC, at heights "
                f"of {low:.1f} to {high:.1f} m",
                hole.line(number),
            ]
            seen = (f"{_numbers(place + 0.5)} {n}" for n, place in enumerate(at, count + 1))
            images += [hole.pose(number), " ".join(seen)]
        for n, at in enumerate(xyz):
            track = f"{left} {n} {left + 1} {n}"
            points.append(f"{count + n + 1} {_numbers(at)} {GREY} {error[n]:.4f} {track}")
        count += len(xyz)
    for name, lines in (("cameras", cameras), ("images", images), ("points3D", points)):
        (folder / f"{name}.txt").write_text("\n".join([*lines, ""]), encoding="ascii")


def _axis(terms: Floats, shown: Floats, ahead: Floats) -> Floats:
    """Third row [3] (1/m) of a perspective: shown * (1 + xyz @ axis) = terms @ numerators.

    ``terms`` [n, 4]: xyz and 1; ``shown`` [n, 2] px; ``ahead``: unit vector along the rays. What no
    numerators fit tells of the axis, which is pulled to that of a satellite (see PULL_PX_M).
    """
    basis = np.linalg.qr(terms)[0]
    sides = np.concatenate([shown[:, k : k + 1] * terms[:, :3] for k in (0, 1)])
    whole = np.c_[sides, shown.T.ravel()]
    left = np.concatenate([part - basis @ (basis.T @ part) for part in np.split(whole, 2)])
    pull = PULL_PX_M * np.sqrt(len(terms))
    equations = np.vstack([left[:, :3], pull * np.eye(3)])
    axis = np.linalg.lstsq(equations, np.append(-left[:, 3], pull * ahead / DISTANCE_M))[0]
    return axis + max(1 / FARTHEST_M - axis @ ahead, 0.0) * ahead


def _numbers(values: Iterable[float]) -> str:
    return " ".join(repr(float(v)) for v in values)
