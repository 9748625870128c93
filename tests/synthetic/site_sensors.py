"""Images of a simulated site as the pipeline knows them, but with exact sensor models."""

from __future__ import annotations

import numpy as np

from stereocities.sites import ImageSpec, SiteSpec, camera_of
from stereotruth.sensor.rpc import RPC, SensorModel
from stereotruth.sensor.site_pairs import SiteImage

SCALES = ("line_scale", "samp_scale", "lat_scale", "long_scale", "height_scale")
COEFFICIENTS = ("line_num_coeff", "line_den_coeff", "samp_num_coeff", "samp_den_coeff")


def exact_image(site: SiteSpec, image: ImageSpec) -> SiteImage:
    """The image with the RPCs that it ships, corrected by their own bias."""
    fitted = camera_of(site, image).rpc
    line_off, samp_off, lat_off, lon_off, h_off, *scales = map(float, fitted.numbers)
    rpc = RPC(
        line_off=line_off, samp_off=samp_off, lat_off=lat_off, long_off=lon_off, height_off=h_off,
        **dict(zip(SCALES, scales)), **dict(zip(COEFFICIENTS, fitted.coefficients)),
    )  # fmt: skip
    bias = np.vstack([fitted.bias, [0, 0, 1]])
    sensor = SensorModel(rpc, np.linalg.inv(bias)[:2])
    return SiteImage(image.name, sensor, (image.cols, image.rows), image.acquired, image.sun_deg)
