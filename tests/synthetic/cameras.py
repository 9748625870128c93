"""Cameras of known geometry as RPCs."""

from __future__ import annotations

import numpy as np
from rasterio.rpc import RPC as RasterioRPC

from stereotruth.sensor.rpc import RPC, SensorModel


def make_rpc(seed: int, image_offset: float = 0.0) -> RPC:
    """A random RPC of realistic size: 20 km, ±500 m, 2 px of cubic terms, image rotated at will.

    ``image_offset`` moves the image away from the RPC's centre, in units of the image scale.
    """
    rng = np.random.default_rng(seed)
    angle = rng.uniform(-np.pi, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    numerators = []
    for axis in range(2):
        numerator = rng.normal(0, [1e-3, *[1e-2] * 3, *[5e-4] * 6, *[1e-4] * 10])
        numerator[1:3] += turn[axis] * (1.0, -1.0)
        numerator[3] += rng.uniform(-0.05, 0.05)
        numerator[0] += image_offset
        numerators.append(numerator)
    denominators = rng.normal(0, 2e-4, (2, 20))
    denominators[:, 0] = 1.0
    return RPC(
        line_off=15000.25 - image_offset * 14000,
        samp_off=17000.5 - image_offset * 16000,
        lat_off=rng.uniform(-60, 60),
        long_off=rng.uniform(-170, 170),
        height_off=250.0,
        line_scale=14000.0,
        samp_scale=16000.0,
        lat_scale=0.09,
        long_scale=0.12,
        height_scale=500.0,
        line_num_coeff=numerators[1],
        line_den_coeff=denominators[1],
        samp_num_coeff=numerators[0],
        samp_den_coeff=denominators[0],
    )


def to_rasterio(rpc: RPC) -> RasterioRPC:
    return RasterioRPC(**rpc.to_dict(), err_bias=None, err_rand=None)


def ground_points(rpc: RPC, n: int = 500) -> np.ndarray:
    box = rpc.ground_box
    t = np.random.default_rng(1).random((3, n))
    low, high = np.array([box[0], box[1], box[4]]), np.array([box[2], box[3], box[5]])
    return low[:, None] + t * (high - low)[:, None]


LON, LAT, HEIGHT = 114.3, 30.6, 60.0  # centre of the camera pairs below
METRES = np.array([111320.0 * np.cos(np.radians(LAT)), 110900.0])  # per degree of lon, lat


def camera(
    tilt: tuple[float, float],
    *,
    gsd: float = 0.65,
    angle: float = 0.0,
    size: tuple[int, int] = (6000, 5000),
    half_height: float = 400.0,
    bend: float = 0.0,
) -> SensorModel:
    """A parallel-ray camera as an RPC: image = turn . ((east, -north) + tilt h) / gsd + centre.

    ``tilt``: metres (east, north) that a point moves on the ground plane per metre of height;
    ``angle``: of the image in degrees. ``bend`` adds a quadratic distortion of that many px at the
    edge (as an agile satellite does), which RPC00B holds exactly: the true epipolar curves are
    then parabolas.
    """
    a = np.radians(angle)
    turn = np.array([[np.cos(a), -np.sin(a)], [np.sin(a), np.cos(a)]])
    half = 0.55 * gsd * max(size)  # metres from the centre to the edge of the ground box
    scales = half / METRES
    # normalised image coordinates as linear functions of normalised (lon, lat, height)
    image_scale = max(size) / 2
    ground = np.array([[half, 0.0, tilt[0] * half_height], [0.0, -half, -tilt[1] * half_height]])
    linear = turn @ ground / gsd / image_scale
    samp, line = np.zeros(20), np.zeros(20)
    samp[1:4], line[1:4] = linear
    for numerator, (p, q) in ((samp, linear), (line, linear[::-1])):
        # + bend (p q + q² / 2), spread over the terms LP LH PH, L² P² H²
        pairs = ((0, 1), (0, 2), (1, 2))
        for term, (i, j) in zip((4, 5, 6), pairs):
            numerator[term] += bend / image_scale * (p[i] * q[j] + p[j] * q[i] + q[i] * q[j])
        for term, i in zip((7, 8, 9), range(3)):
            numerator[term] += bend / image_scale * (p[i] * q[i] + q[i] * q[i] / 2)
    one = np.eye(20)[0]
    return SensorModel(
        RPC(
            line_off=(size[1] - 1) / 2,
            samp_off=(size[0] - 1) / 2,
            lat_off=LAT,
            long_off=LON,
            height_off=HEIGHT,
            line_scale=image_scale,
            samp_scale=image_scale,
            lat_scale=scales[1],
            long_scale=scales[0],
            height_scale=half_height,
            line_num_coeff=line,
            line_den_coeff=one,
            samp_num_coeff=samp,
            samp_den_coeff=one,
        )
    )


BACKWARD, FORWARD = (0.02, 0.09), (-0.03, -0.49)  # GF-7: -5 and +26 degrees, nearly along track
