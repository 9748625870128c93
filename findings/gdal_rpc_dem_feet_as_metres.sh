#!/usr/bin/env bash
# GDAL takes a terrain model in feet for one in metres when it places ground by an RPC.
#
# Guess: a terrain model whose system says that its heights are US survey feet gives metres to the RPC:
#   PROJ needs no grid for that, and converts feet of the same system to metres even where the geoid's
#   grid is missing. A scale of the band (int16 in decimetres) is applied, too.
# What happens: RPC_DEM takes the numbers as they stand, over the ellipsoid: 1000 ft counts as 1000 m,
#   and 3000 dm as 3000 m. The vertical part of the system is dropped as a whole where its grid is
#   missing, its unit with it; the scale is never looked at. Nothing is said.
# Source: rasterio 1.4.4 with GDAL 3.10.3 (RPCTransformer, RPC_DEM); pyproj 3.7.2 with PROJ 9.5.1.
# Why it matters: county and state models are in feet. Orthoimages, and control points predicted by
#   them, are off by hundreds of pixels, or, in flat country near the sea, by a few that look like a
#   poor RPC.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
export PROJ_NETWORK=OFF
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check rasterio==1.4.4 pyproj==3.7.2 numpy==2.2.6
venv/bin/python - <<'PYTHON'
import numpy as np
import pyproj
import rasterio
from pyproj import Transformer
from rasterio.rpc import RPC
from rasterio.transform import RPCTransformer, from_origin

line, samp, denominator = ([0.0] * 20 for _ in range(3))
line[2], samp[1], samp[3], denominator[0] = -1.0, 1.0, -0.2, 1.0
rpc = RPC(
    height_off=100.0, height_scale=500.0, lat_off=45.0, lat_scale=0.1, long_off=-120.0,
    long_scale=0.1, line_off=500.0, line_scale=500.0, samp_off=500.0, samp_scale=500.0,
    line_num_coeff=line, line_den_coeff=denominator, samp_num_coeff=samp,
    samp_den_coeff=denominator, err_bias=None, err_rand=None,
)


def height_used(name, values, crs, scale=1.0):
    """Height in m that GDAL gave the RPC, by the column it found at the RPC's middle."""
    with rasterio.open(
        name, "w", driver="GTiff", width=20, height=20, count=1, dtype=values.dtype, crs=crs,
        transform=from_origin(-120.1, 45.1, 0.01, 0.01),
    ) as file:
        file.write(values, 1)
        file.scales = (scale,)
    with rasterio.open(name) as file:
        assert ("foot" in file.crs.to_wkt()) == ("+" in crs)
    with RPCTransformer(rpc, RPC_DEM=name) as transform:
        _, (col,) = transform.rowcol([-120.0], [45.0], [0.0], op=lambda v: v)
    return 100.0 - (col - 0.5 - 500.0) / 500.0 / 0.2 * 500.0


print("rasterio", rasterio.__version__, "GDAL", rasterio.__gdal_version__, "pyproj", pyproj.__version__)
feet = Transformer.from_crs("EPSG:4326+6360", "EPSG:4979", always_xy=True)
by_proj = feet.transform(-120.0, 45.0, 1000.0)[2]
by_gdal = height_used("feet.tif", np.full((20, 20), 1000.0, np.float32), "EPSG:4326+6360")
scaled = height_used("decimetres.tif", np.full((20, 20), 3000, np.int16), "EPSG:4326", scale=0.1)
print(f"1000 ft: {by_proj:.1f} m by PROJ, {by_gdal:.1f} m by GDAL; 3000 dm: {scaled:.1f} m by GDAL")
assert abs(by_proj - 304.8) < 0.01
assert abs(by_gdal - 1000.0) < 0.01 and abs(scaled - 3000.0) < 0.01
PYTHON
