"""Arrays to 8-bit pictures, pictures to data URIs, figures to files.

Disparities are drawn in ``DISPARITIES``, errors in ``ERRORS``, differences in ``DIFFERENCES``: what
is judged minus what it is judged by, red below and blue above. These maps of colours tell without
red and green. Pixels without a value are light grey.
"""

from __future__ import annotations

import base64
import math
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from matplotlib import colormaps
from matplotlib.axis import Tick
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.text import Text
from numpy.typing import ArrayLike, NDArray

from ..core.products.files import atomic_file

Picture = NDArray[np.uint8]

DISPARITIES, DIFFERENCES, ERRORS = "viridis", "RdBu", "inferno"
NO_VALUE = (226, 229, 233)
SUN = np.array([-1.0, -1.0, 2.0**0.5]) / 2.0  # of a hillshade: the top left, 45 degrees high
# Of methods, kinds and the like: apart for all eyes, with a contrast of 3:1 on white as on black
SERIES = ("#4693fa", "#c68505", "#653bfd", "#59a090", "#8b5a2e", "#226c95")

STOPS = 13  # of the colours of a scale in CSS
QUALITIES = (82, 70, 55, 40, 25)  # of WebP; where the last does not fit, the picture shrinks


def stretch(
    image: ArrayLike,
    *,
    nodata: float | None = 0,
    percent: tuple[float, float] = (1.0, 99.0),
    limits: tuple[float, float] | None = None,
) -> Picture:
    """Grey picture uint8[h, w] of an image, between percentiles (or ``limits``); nodata is 0."""
    image = np.asarray(image, dtype=np.float32)
    valid = np.isfinite(image) if nodata is None else np.isfinite(image) & (image != nodata)
    if not valid.any():
        return np.zeros(image.shape, np.uint8)
    low, high = limits or np.percentile(image[valid], percent)
    grey = np.clip((image - low) / max(high - low, 1e-9), 0.0, 1.0) * 254.0 + 1.0
    return np.where(valid, np.nan_to_num(grey), 0.0).astype(np.uint8)


def colours(
    values: ArrayLike, limits: tuple[float, float] | None = None, cmap: str = DISPARITIES
) -> Picture:
    """Colour picture uint8[h, w, 3]; NaN is light grey, limits default to percentiles 1 and 99."""
    values = np.asarray(values, dtype=np.float32)
    valid = np.isfinite(values)
    if limits is None:
        limits = tuple(np.percentile(values[valid], (1, 99))) if valid.any() else (0.0, 1.0)
    low, high = limits
    scaled = np.clip((np.nan_to_num(values) - low) / max(high - low, 1e-9), 0.0, 1.0)
    picture = (colormaps[cmap](scaled)[..., :3] * 255.0 + 0.5).astype(np.uint8)
    picture[~valid] = NO_VALUE
    return picture


def shrink(picture: Picture, side: int) -> Picture:
    """A picture scaled down (area mean) so that its longer side is at most ``side`` px."""
    factor = side / max(picture.shape[:2])
    if factor >= 1.0:
        return picture
    width, height = (max(1, round(n * factor)) for n in picture.shape[1::-1])
    return cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA)


def round_length(value: float) -> float:
    """The next of 1, 2, 5 times a power of ten at or below a positive value, for an arrow's key."""
    power = 10.0 ** math.floor(math.log10(value) + 1e-9)
    return max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9)) * power


def show_texts(figure: Figure) -> None:
    """Texts of a figure are shown as they are; powers of ten of logarithmic axes are formulas."""
    ticks = {id(label) for tick in figure.findobj(Tick) for label in (tick.label1, tick.label2)}
    for text in figure.findobj(Text):
        text.set_parse_math(id(text) in ticks)


def save_figure(path: str | Path, figure: Figure, dpi: int = 110) -> None:
    """Write a matplotlib figure without any global state; no time or version goes into the file.

    Texts are shown as they are: a ``$`` in a name begins no formula.
    """
    FigureCanvasAgg(figure)
    show_texts(figure)
    # a layout that leaves room for all needs no first drawing that finds what the texts take
    bounds = "tight" if figure.get_layout_engine() is None else None
    with atomic_file(path) as scratch:
        figure.savefig(scratch, dpi=dpi, metadata={"Software": None}, bbox_inches=bounds)


def encode(picture: Picture, limit: int) -> str:
    """A data URI of a grey, RGB or RGBA picture as WebP of at most ``limit`` bytes.

    Scaled down where even the lowest quality does not fit, then the best quality that fits (one
    pixel always does).
    """
    order = {2: cv2.COLOR_GRAY2BGR, 3: cv2.COLOR_RGB2BGR, 4: cv2.COLOR_RGBA2BGRA}
    channels = picture.shape[2] if picture.ndim == 3 else 2
    colour = cv2.cvtColor(np.ascontiguousarray(picture), order[channels])
    data = _webp(colour, QUALITIES[-1])
    while data.size > limit and (side := max(colour.shape[:2])) > 1:
        factor = min(0.9, np.sqrt(limit / data.size))
        colour = shrink(colour, max(1, int(side * factor)))
        data = _webp(colour, QUALITIES[-1])
    better = (_webp(colour, quality) for quality in QUALITIES[:-1])
    data = next((found for found in better if found.size <= limit), data)
    return "data:image/webp;base64," + base64.b64encode(data).decode("ascii")


def _webp(colour: Picture, quality: int) -> NDArray[np.uint8]:
    done, data = cv2.imencode(".webp", colour, [cv2.IMWRITE_WEBP_QUALITY, quality])
    if not done:
        raise RuntimeError("OpenCV without WebP")
    return data


def encode_file(path: Path, limit: int, side: int) -> str:
    """A data URI of a picture file, scaled down to ``side`` px at most."""
    return encode(shrink(cv2.imread(str(path))[..., ::-1], side), limit)


@dataclass(frozen=True)
class Scale:
    """A scale of colours: what stands at its ends, and the colours as a CSS gradient."""

    low: str
    high: str
    colours: str

    @classmethod
    def of(cls, cmap: str, low: str, high: str) -> Scale:
        """Of a matplotlib map."""
        rgb = (colormaps[cmap](np.linspace(0, 1, STOPS))[:, :3] * 255 + 0.5).astype(int)
        stops = ",".join(f"rgb({r},{g},{b})" for r, g, b in rgb)
        return cls(low, high, f"linear-gradient(90deg,{stops})")


@dataclass(frozen=True)
class Layer:
    """A picture of a slider: a data URI, and the scale of its colours."""

    uri: str
    scale: Scale | None = None


def hillshade(disparity: NDArray[np.floating], base_to_height: float) -> Picture:
    """Lambert's shading uint8[h, w, 3] of disparity[h, w] in px as heights in px of the ground.

    The sun stands at the top left, 45 degrees high. Light grey where a slope is not known.
    """
    height = np.asarray(disparity, np.float64) / base_to_height
    down, right = np.gradient(height)
    normal = np.stack([-right, -down, np.ones_like(height)])
    light = np.tensordot(SUN, normal, 1) / np.linalg.norm(normal, axis=0)
    known = np.isfinite(light) & np.isfinite(height)
    grey = np.rint(255 * np.clip(np.where(known, light, 0.0), 0.0, 1.0)).astype(np.uint8)
    picture = np.repeat(grey[..., None], 3, axis=2)
    picture[~known] = NO_VALUE
    return picture
