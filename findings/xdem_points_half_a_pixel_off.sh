#!/usr/bin/env bash
# xdem finds exact points half a pixel, or a whole one, beside an exact surface model.
#
# Guess: heights interpolated in a surface model at points, and its registration to LiDAR points, rest
#   on the pixels' centres, as GDAL has them: where model and points are of the same surface, the
#   shift is 0. AREA_OR_POINT=Point changes nothing, since GDAL's georeference tells of the corner.
# What happens: geoutils and xdem take the corner of a pixel for the place of its height: heights are
#   interpolated half a pixel to the south-east, and registration by Nuth and Kääb or by least
#   squares moves the model 0.5 px east and south of its place. Of a model tagged Point it is 1 px:
#   the half that GDAL has taken off already is taken off once more. Raster against raster is right.
# Source: xdem 0.2.3, geoutils 0.2.5, rasterio 1.4.4 with GDAL 3.10.3; interp_points, Coreg.fit.
# Why it matters: models made from disparities are judged by LiDAR points. On slopes and at roof edges
#   half a pixel looks like an error of the disparities; and it is twice as large for one of two
#   models whose files differ in nothing but that tag.
set -euo pipefail
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
cd "$folder"
python3 -m venv venv
venv/bin/pip install --quiet --disable-pip-version-check xdem==0.2.3 geoutils==0.2.5 rasterio==1.4.4
venv/bin/python - <<'PYTHON'
import warnings

import geopandas
import geoutils
import numpy as np
import rasterio
import xdem
from rasterio.transform import from_origin

warnings.simplefilter("ignore")
WEST, NORTH, SIZE = 500000.0, 4000000.0, 200  # metres, of pixels of 1 m


def height(east, north):
    x, y = east - WEST, NORTH - north
    return 100.0 + 20.0 * np.sin(x / 17.0) + 15.0 * np.cos(y / 13.0) + 0.05 * x


rows, cols = np.mgrid[:SIZE, :SIZE]
centres = height(WEST + cols + 0.5, NORTH - rows - 0.5)
rng = np.random.default_rng(0)
east, north = WEST + rng.uniform(5, 195, 20000), NORTH - rng.uniform(5, 195, 20000)
points = geopandas.GeoDataFrame(
    {"z": height(east, north)}, geometry=geopandas.points_from_xy(east, north), crs="EPSG:32633"
)
print("xdem", xdem.__version__, "geoutils", geoutils.__version__, "rasterio", rasterio.__version__)
shape = {"width": SIZE, "height": SIZE, "count": 1, "dtype": "float32", "crs": "EPSG:32633"}
found = {}
for tag in ("Area", "Point"):
    with rasterio.open(
        f"{tag}.tif", "w", driver="GTiff", transform=from_origin(WEST, NORTH, 1.0, 1.0), **shape
    ) as file:
        file.update_tags(AREA_OR_POINT=tag)
        file.write(centres.astype(np.float32), 1)
    with rasterio.open(f"{tag}.tif") as file:
        assert file.transform == from_origin(WEST, NORTH, 1.0, 1.0)
    model = xdem.DEM(f"{tag}.tif")
    fit = xdem.coreg.NuthKaab()
    fit.fit(points, model, z_name="z", random_state=0)
    shift = fit.meta["outputs"]["affine"]
    found[tag] = float(shift["shift_x"]), float(shift["shift_y"])
    print(f"{tag}: shift of the model to the points: east {found[tag][0]:+.2f}, north {found[tag][1]:+.2f} m")
assert np.allclose(found["Area"], (0.5, -0.5), atol=0.02)
assert np.allclose(found["Point"], (1.0, -1.0), atol=0.02)
PYTHON
