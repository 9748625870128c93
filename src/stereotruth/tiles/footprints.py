"""Where tiles lie: footprints as GeoJSON (RFC 7946), with a QGIS style beside it.

A footprint is the border of a left tile on the ground, at the heights of the labels next to it
(:func:`.orientation.footprint`). QGIS takes the style by itself when
it opens the GeoJSON.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from .quick_looks import SPLIT_COLOURS

FOOTPRINTS, STYLE = "footprints.geojson", "footprints.qml"
NUMBERS = ("labelled_share", "disparity_min_px", "disparity_mean_px", "disparity_max_px")
TEXTS = ("tile", "city", "scene", "split", "complete", "class", "quality", "left", "right", "disp")
FLAGGED = "#e6007e"  # outline of tiles whose labels exceed a limit of quality


def feature(row: Mapping[str, Any], ring: NDArray[np.float64]) -> dict[str, Any]:
    """A tile as a GeoJSON feature; ``row`` of the manifest, open ``ring`` [n, 2] of lon, lat."""
    ring = ring if _area(ring) > 0 else ring[::-1]  # counter-clockwise
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


def _area(ring: NDArray[np.float64]) -> float:
    x, y = ring.T
    return float(np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)))


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
    rules = [
        (split, f"{labelled} AND \"split\" = '{split}'", _symbol(k, colour, "solid", fill=70))
        for k, (split, colour) in enumerate(SPLIT_COLOURS.items())
    ]
    k = len(rules)
    rules += [
        ("labels incomplete", "\"complete\" = 'no'", _symbol(k, "#9a9a9a", "dash", fill=0)),
        (
            "beyond a limit of quality",
            f"{labelled} AND \"quality\" <> 'ok'",
            _symbol(k + 1, FLAGGED, "dot", fill=0),
        ),
    ]
    return "\n".join(_document(rules)) + "\n"


def _document(rules: list[tuple[str, str, str]]) -> Iterator[str]:
    yield "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
    yield '<qgis version="3.22.0" styleCategories="Symbology|Labeling">'
    yield ' <renderer-v2 type="RuleRenderer" symbollevels="0" forceraster="0" enableorderby="0">'
    yield '  <rules key="{tiles}">'
    for k, (label, chosen, _) in enumerate(rules):
        yield (
            f'   <rule key="{{tiles-{k}}}" symbol="{k}" label={quoteattr(label)} '
            f"filter={quoteattr(chosen)}/>"
        )
    yield "  </rules>"
    yield "  <symbols>"
    yield from (symbol for _, _, symbol in rules)
    yield "  </symbols>"
    yield " </renderer-v2>"
    yield ' <labeling type="simple"><settings calloutType="simple">'
    yield '  <text-style fieldName="tile" isExpression="0" fontSize="8" textColor="40,40,40,255">'
    yield '   <text-buffer bufferDraw="1" bufferSize="0.7" bufferColor="255,255,255,255"/>'
    yield '  </text-style><placement placement="1"/><rendering scaleVisibility="0"/>'
    yield " </settings></labeling>"
    yield "</qgis>"


def _symbol(number: int, colour: str, line: str, *, fill: int) -> str:
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
