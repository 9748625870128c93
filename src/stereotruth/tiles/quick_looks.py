"""What people look at beside the tiles: figures, quick looks on a map, footprints.

- Coverage (figure 7 of the paper) and contact sheet of a city's tiles.
- Georeferenced quick looks of a scene: the left image and its labels, thinned, laid on the ground
  at the heights of the labels around; no orthophoto, but a map that fits to some of its pixels.
- Footprints as GeoJSON (RFC 7946): the border of a left tile on the ground, at the heights of the
  labels next to it (:func:`.orientation.footprint`); with a style, which QGIS takes by itself.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import cv2
import numpy as np
import pyproj
import rasterio
import zarr
from matplotlib.cm import ScalarMappable
from matplotlib.figure import Figure
from matplotlib.patches import Patch, Rectangle
from numpy.typing import NDArray
from rasterio.enums import ColorInterp
from scipy.ndimage import distance_transform_edt

from ..core.errors import in_number
from ..core.numerics.arrays import Floats
from ..core.products.rasters import read_disparity, read_image
from ..core.status import BY_LABEL
from ..epipolar.intersection import utm_epsg
from ..pages import pictures
from ..pages.pictures import colours, save_figure
from .manifest import FOOTPRINTS, STYLE

if TYPE_CHECKING:
    from .scene_stores import SceneStores

Picture = NDArray[np.uint8]

CONTACT_TILES = 16  # most tiles on the contact sheet
LINE_IN = 2.0  # inches of a line of them
GAP_PX = 36  # between them, for what they are called
SPLIT_COLOURS = {"train": "#0072b2", "val": "#e69f00", "test": "#6f0952", "none": "#8a8a8a"}
FLAGGED = "#e6007e"  # outline of tiles whose labels exceed a limit of quality
LONGEST_PX = 1000  # of a quick look
SMOOTH = 5  # px over which heights are smoothed
ROWS = 1024  # read at a time
NUMBERS = ("labelled_share", "disparity_min_px", "disparity_mean_px", "disparity_max_px")
TEXTS = ("tile", "city", "scene", "split", "complete", "class", "quality", "left", "right", "disp")
QML = """<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.22.0" styleCategories="Symbology|Labeling">
 <renderer-v2 type="RuleRenderer" symbollevels="0" forceraster="0" enableorderby="0">
  <rules key="{{tiles}}">
{rules}
  </rules>
  <symbols>
{symbols}
  </symbols>
 </renderer-v2>
 <labeling type="simple"><settings calloutType="simple">
  <text-style fieldName="tile" isExpression="0" fontSize="8" textColor="40,40,40,255">
   <text-buffer bufferDraw="1" bufferSize="0.7" bufferColor="255,255,255,255"/>
  </text-style><placement placement="1"/><rendering scaleVisibility="0"/>
 </settings></labeling>
</qgis>
"""


def draw_coverage(
    path: Path, city: str, rows: Sequence[Mapping[str, Any]], scans: Mapping[str, tuple]
) -> None:
    """Where a city's tiles lie (figure 7 of the paper), one panel per scene.

    ``rows`` of the manifest; ``scans`` by scene: small picture of the left image, mask of labels of
    the same shape, px of the epipolar grid per px of the picture.
    """
    tallest = max(picture.shape[0] / picture.shape[1] for picture, _, _ in scans.values())
    figure = Figure(figsize=(7.0 * len(scans), 6.2 * tallest + 1.4), layout="constrained")
    axes = figure.subplots(1, len(scans), squeeze=False)[0]
    for axis, (scene, (picture, labelled, scale)) in zip(axes, scans.items()):
        grey = pictures.stretch(picture)
        picture = np.repeat(grey[..., None], 3, axis=2)
        tint = np.array([40, 110, 255], np.float32)
        picture[labelled] = (0.6 * picture[labelled] + 0.4 * tint).astype(np.uint8)
        height, width = (n * float(scale) for n in grey.shape)
        axis.imshow(picture, extent=(-0.5, width - 0.5, height - 0.5, -0.5))
        for row in (row for row in rows if row["scene"] == scene):
            inset = row["size"] / 80  # neighbours do not hide each other's colour
            corner = row["col0"] - 0.5 + inset, row["row0"] - 0.5 + inset
            square = corner, *[row["size"] - 2 * inset] * 2
            drawn = {"linewidth": 1.0, "linestyle": "--", "edgecolor": "0.75", "zorder": 2}
            if row["complete"] == "yes":  # with a white casing, below the frames of all tiles
                axis.add_patch(Rectangle(*square, fill=False, linewidth=3.6, edgecolor="w"))
                drawn = {"linewidth": 1.8, "edgecolor": SPLIT_COLOURS[row["split"]], "zorder": 3}
            axis.add_patch(Rectangle(*square, fill=False, **drawn))
        axis.set(title=scene, xlabel="x in px of the epipolar grid", ylabel="y in px")
    legend = [Patch(fill=False, edgecolor=colour, label=s) for s, colour in SPLIT_COLOURS.items()]
    legend.append(Patch(fill=False, edgecolor="0.75", linestyle="--", label="incomplete pair"))
    legend.append(Patch(color=(0.45, 0.62, 1.0), label="labelled"))
    figure.legend(handles=legend, loc="outside lower center", ncols=len(legend), frameon=False)
    count = sum(row["complete"] == "yes" for row in rows)
    more = f"{len(rows) - count} without complete labels"
    figure.suptitle(f"{city}: {in_number(count, 'labelled pair')}, {more}")
    save_figure(path, figure)


def draw_contact_sheet(
    path: Path, city: str, rows: Sequence[Mapping[str, Any]], folder: Path, nodata: float
) -> None:
    """Some of a city's labelled pairs, evenly drawn from all: left, right and disparity in colour,
    two tiles to a line."""
    labelled = [row for row in rows if row["complete"] == "yes"]
    picked = np.unique(np.linspace(0, len(labelled) - 1, CONTACT_TILES).round().astype(int))
    tiles = []
    for row in (labelled[k] for k in picked):
        images = (read_image(folder / row[kind]) for kind in ("left", "right"))
        grey = [pictures.stretch(pictures.shrink(image, 256)) for image in images]
        picked_px = np.linspace(0, row["size"], len(grey[0]), endpoint=False).astype(int)
        disparity = read_disparity(folder / row["disp"], nodata)[np.ix_(picked_px, picked_px)]
        tiles.append((row["tile"], *grey, disparity))
    values = np.concatenate([tile[3][np.isfinite(tile[3])] for tile in tiles])
    limits = tuple(float(v) for v in np.percentile(values, (1, 99)))
    lines = -(-len(tiles) // 2)
    side = max(max(grey.shape) for _, grey, _, _ in tiles)
    step = side + GAP_PX
    # one picture of all: an axis for each would take most of the time
    sheet = np.full((lines * step, 6 * step, 3), 255, np.uint8)
    inches = LINE_IN * lines
    figure = Figure(figsize=(13.0, inches + 0.8))
    height = figure.get_figheight()
    axis = figure.add_axes((0.01, 0.05 / height, 6 * LINE_IN / 13.0, inches / height))
    for k, (caption, left, right, disparity) in enumerate(tiles):
        top = k // 2 * step + GAP_PX
        trio = (np.atleast_3d(left), np.atleast_3d(right), colours(disparity, limits))
        for n, (picture, name) in enumerate(zip(trio, (f"{caption}, left", "right", "disparity"))):
            col = (3 * (k % 2) + n) * step
            high, wide = picture.shape[:2]
            sheet[top : top + high, col : col + wide] = picture
            axis.text(col + side / 2, top - 4, name, fontsize=8, ha="center", va="bottom")
    axis.imshow(sheet)
    axis.set_axis_off()
    mappable = ScalarMappable(cmap=pictures.DISPARITIES)
    mappable.set_clim(*limits)
    scale = figure.add_axes((0.94, 0.05 / height, 0.012, (inches - 0.3) / height))
    figure.colorbar(mappable, cax=scale, label="disparity, px (offset removed)")
    title = f"{city}: {len(tiles)} of {len(labelled)} labelled pairs"
    figure.suptitle(title, y=1 - 0.25 / height)
    save_figure(path, figure)


def status_colours(names: Sequence[str]) -> dict[str, str]:
    """A colour, #rrggbb, for each reason; reasons that are not known get one of their own."""
    known = {name: BY_LABEL[name].colour for name in names if name in BY_LABEL}
    unknown = [name for name in names if name not in known]
    other = {name: pictures.SERIES[k % len(pictures.SERIES)] for k, name in enumerate(unknown)}
    return known | other


def write_status_colours(path: Path, flags: Mapping[int, str]) -> None:
    """The colours of status values as a colour map of QGIS: value, R, G, B, A, meaning by lines.

    It stands beside the tiles: some readers give colours, not values, of a TIFF with a table.
    """
    colours = status_colours(list(flags.values()))
    lines = ["INTERPOLATION:EXACT"]
    for value, name in flags.items():
        red, green, blue = bytes.fromhex(colours[name][1:])
        lines.append(f"{value},{red},{green},{blue},255,{name.replace('_', ' ')}")
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")


# ------------------------------------------------------------------ on a map


def write_ground_looks(folder: Path, source: SceneStores) -> list[Path]:
    """Write ``<scene>_left.tif`` and ``<scene>_disparity.tif`` to a folder that exists.

    UTM on WGS 84; red, green, blue and alpha; disparities in colour as on the contact sheet.
    """
    scale = max(1, math.ceil(max(source.left.shape) / LONGEST_PX))
    disparity, height = _thin(source.disparity, scale), _thin(source.height, scale)
    bands = source.colours[0] if source.colours else (source.left,)
    image = np.stack([_thin(band, scale) for band in bands], axis=-1)
    known = np.isfinite(height)
    if not known.any():
        return []
    y, x = (index[known] * float(scale) for index in np.indices(height.shape))
    lon, lat = source.model.epipolar_to_ground(x, y, height[known].astype(np.float64))
    crs = pyproj.CRS.from_epsg(utm_epsg(float(np.mean(lon)), float(np.mean(lat))))
    to_map = pyproj.Transformer.from_crs("EPSG:4326", crs, always_xy=True)
    east, north = to_map.transform(lon, lat)
    surface, origin, step = _heights(east, north, height[known], _spacing(known, east, north))
    rows, cols = np.indices(surface.shape)
    ground = to_map.transform(
        origin[0] + (cols + 0.5) * step, origin[1] - (rows + 0.5) * step, direction="INVERSE"
    )
    at = source.model.ground_to_epipolar(*(v.ravel() for v in ground), surface.ravel())[:2]
    x, y = (value.reshape(surface.shape) / scale for value in at)
    inside = (x >= 0) & (y >= 0) & (x <= height.shape[1] - 1) & (y <= height.shape[0] - 1)
    j, i = (np.where(inside, np.rint(value), 0).astype(int) for value in (y, x))
    left = np.stack([_linear(band, y, x) for band in np.moveaxis(image, -1, 0)], axis=-1)
    left[_linear((image != 0).any(axis=-1), y, x) < 1.0 - 1e-6] = 0
    labels = np.where(inside, disparity[j, i], np.nan)
    made = []
    for name, picture, alpha in (
        (
            "left",
            np.broadcast_to(pictures.stretch(left), (*left.shape[:2], 3)),
            (left != 0).any(axis=-1),
        ),
        ("disparity", pictures.colours(labels), np.isfinite(labels)),
    ):
        made.append(folder / f"{source.scene}_{name}.tif")
        _write(made[-1], picture, alpha, crs, origin, step)
    return made


def _thin(array: zarr.Array, scale: int) -> NDArray:
    """Every ``scale``-th pixel of a grid."""
    rows = ROWS // scale * scale
    parts = (array[r : r + rows][::scale, ::scale] for r in range(0, array.shape[0], rows))
    return np.concatenate(list(parts))


def _spacing(known: NDArray[np.bool_], east: Floats, north: Floats) -> float:
    """Metres between neighbouring pixels of the thinned grid, by the median."""
    at = np.full((2, *known.shape), np.nan)
    at[:, known] = east, north
    steps = [np.hypot(*np.diff(at, axis=axis)) for axis in (1, 2)]
    found = np.concatenate([s[np.isfinite(s)] for s in steps])
    return float(np.median(found)) if found.size else 1.0


def _heights(
    east: Floats, north: Floats, height: Floats, step: float
) -> tuple[Floats, tuple[float, float], float]:
    """Heights of a map's pixels, its upper-left corner and its pixel size, all in m."""
    span = max(np.ptp(east), np.ptp(north))
    step = max(step, span / LONGEST_PX)
    origin = math.floor(east.min() / step) * step, math.ceil(north.max() / step) * step
    cols = ((east - origin[0]) / step).astype(int)
    rows = ((origin[1] - north) / step).astype(int)
    shape = rows.max() + 1, cols.max() + 1
    where = rows * shape[1] + cols
    count = np.bincount(where, minlength=shape[0] * shape[1]).reshape(shape)
    total = np.bincount(where, height, minlength=shape[0] * shape[1]).reshape(shape)
    nearest = distance_transform_edt(count == 0, return_distances=False, return_indices=True)
    filled = (total / np.maximum(count, 1))[tuple(nearest)]
    low = filled.min()  # in 32 bits, heights are to be small
    smooth = cv2.medianBlur((filled - low).astype(np.float32), SMOOTH)
    return smooth.astype(np.float64) + low, origin, step


def _linear(band: NDArray, y: Floats, x: Floats) -> NDArray[np.float32]:
    """Bilinear values; beyond the border 0 has a say."""
    at = x.astype(np.float32), y.astype(np.float32)
    return cv2.remap(band.astype(np.float32), *at, cv2.INTER_LINEAR)


def _write(
    path: Path,
    picture: Picture,
    alpha: NDArray[np.bool_],
    crs: pyproj.CRS,
    origin: tuple[float, float],
    step: float,
) -> None:
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        width=picture.shape[1],
        height=picture.shape[0],
        count=4,
        dtype="uint8",
        crs=f"EPSG:{crs.to_epsg()}",
        transform=rasterio.Affine(step, 0.0, origin[0], 0.0, -step, origin[1]),
        photometric="RGB",
        alpha="YES",
        compress="deflate",
        predictor=2,
        tiled=True,
    ) as dataset:
        dataset.write(np.moveaxis(picture, -1, 0), [1, 2, 3])
        dataset.write(alpha.astype(np.uint8) * 255, 4)
        dataset.colorinterp = [ColorInterp[name] for name in ("red", "green", "blue", "alpha")]


# ------------------------------------------------------------------ footprints


def feature(row: Mapping[str, Any], ring: NDArray[np.float64]) -> dict[str, Any]:
    """A tile as a GeoJSON feature; ``row`` of the manifest, open ``ring`` [n, 2] of lon, lat."""
    x, y = ring.T
    if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) <= 0:
        ring = ring[::-1]  # counter-clockwise
    corners = [[round(float(v), 8) for v in point] for point in (*ring, ring[0])]
    values = {name: row[name] or None for name in TEXTS}
    values["right_offset_px"] = int(row["right_offset_px"])
    for name in NUMBERS:
        values[name] = float(row[name]) if row[name] != "" else None
    return {
        "type": "Feature",
        "id": row["tile"],
        "geometry": {"type": "Polygon", "coordinates": [corners]},
        "properties": values,
    }


def write_footprints(folder: Path, features: Iterable[Mapping[str, Any]]) -> None:
    """Write both files to a folder that exists; a feature on a line."""
    lines = ",\n".join(json.dumps(one, allow_nan=False) for one in features)
    text = f'{{"type": "FeatureCollection", "name": "footprints", "features": [\n{lines}\n]}}\n'
    (folder / FOOTPRINTS).write_text(text, encoding="utf-8")
    (folder / STYLE).write_text(_style(), encoding="utf-8")


def read_footprints(folder: Path) -> dict[str, dict[str, Any]]:
    """The features of a folder's footprints by tile; none where there is no such file."""
    if not (folder / FOOTPRINTS).is_file():
        return {}
    found = json.loads((folder / FOOTPRINTS).read_text(encoding="utf-8"))
    return {one["id"]: one for one in found["features"]}


def _style() -> str:
    """Filled by split; incomplete pairs grey and dashed, flagged ones with an outline."""
    labelled = "\"complete\" = 'yes'"
    rules = [  # label, which tiles, colour, line, opacity of the filling
        (split, f"{labelled} AND \"split\" = '{split}'", colour, "solid", 70)
        for split, colour in SPLIT_COLOURS.items()
    ]
    rules += [
        ("labels incomplete", "\"complete\" = 'no'", "#9a9a9a", "dash", 0),
        ("beyond a limit of quality", f"{labelled} AND \"quality\" <> 'ok'", FLAGGED, "dot", 0),
    ]
    lines = [
        f'   <rule key="{{tiles-{k}}}" symbol="{k}" label={quoteattr(rule[0])} '
        f"filter={quoteattr(rule[1])}/>"
        for k, rule in enumerate(rules)
    ]
    symbols = [_symbol(k, *rule[2:]) for k, rule in enumerate(rules)]
    return QML.format(rules="\n".join(lines), symbols="\n".join(symbols))


def _symbol(number: int, colour: str, line: str, fill: int) -> str:
    rgb = ",".join(str(v) for v in bytes.fromhex(colour[1:]))
    options = {
        "color": f"{rgb},{fill}",
        "style": "solid" if fill else "no",
        "outline_color": f"{rgb},255",
        "outline_style": line,
        "outline_width": "0.5",
        "outline_width_unit": "MM",
        "joinstyle": "miter",
    }
    lines = [f'   <symbol name="{number}" type="fill" alpha="1" force_rhr="0" clip_to_extent="1">']
    lines += ['    <layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">']
    lines += [f'     <Option name="{n}" type="QString" value="{v}"/>' for n, v in options.items()]
    return "\n".join([*lines, "    </Option></layer>", "   </symbol>"])
