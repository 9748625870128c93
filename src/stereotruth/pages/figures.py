"""Charts by Matplotlib as SVG within a page, their values on hover and as CSV.

One style serves light and dark pages: nothing is filled behind, text takes the page's colour, and
all else has a contrast of 3:1 to either (``SERIES``, ``AXES``). Series differ in colour, marker and
dashes.
"""

from __future__ import annotations

import base64
import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any
from xml.etree import ElementTree

import numpy as np
from matplotlib import rc_context
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_svg import FigureCanvasSVG
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullLocator

from .pictures import SERIES, Picture, encode, show_texts

SVG = "{http://www.w3.org/2000/svg}"
HREF = "{http://www.w3.org/1999/xlink}href"
AXES = "#7b838f"  # axes, ticks and grid
MARKERS = ("o", "^", "s", "D", "v", "P")
DASHES = ("-", (0, (6, 2)), (0, (1, 1.5)), (0, (8, 2, 1, 2)), (0, (4, 1)), (0, (2, 1)))
STYLE = {
    "font.size": 10,
    "font.sans-serif": ["DejaVu Sans"],
    "axes.edgecolor": AXES,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.titlesize": 10,
    "axes.titlelocation": "left",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": AXES,
    "grid.alpha": 0.35,
    "grid.linewidth": 0.6,
    "xtick.color": AXES,
    "ytick.color": AXES,
    "xtick.labelcolor": "black",  # is the page's colour of text
    "ytick.labelcolor": "black",
    "image.composite_image": False,
    "legend.frameon": False,
    "legend.fontsize": 9,
    "svg.fonttype": "none",
    "svg.hashsalt": "stereotruth",
}
styled = rc_context(STYLE)  # decorates functions that draw a chart


@dataclass(frozen=True)
class Chart:
    """A chart of a page: ``svg`` to be shown as it is, ``csv`` a data URI of its values."""

    title: str
    caption: str
    svg: str
    csv: str = ""


@dataclass
class Plot:
    """A figure to draw a chart in, with axes [rows][columns] and what is said on hover."""

    title: str
    caption: str
    figure: Figure
    axes: list[list[Axes]]
    hovers: dict[str, tuple[list[str], list[str]]] = field(default_factory=dict)
    pictures: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(
        cls, title: str, caption: str, size: tuple[float, float], rows: int = 1, columns: int = 1,
        **options: Any,
    ) -> Plot:  # fmt: skip
        """A figure of ``size`` inches; ``options``: of :meth:`Figure.subplots`."""
        figure = Figure(figsize=size, layout="constrained")
        axes = figure.subplots(rows, columns, squeeze=False, **options)
        figure.patch.set_visible(False)
        for axis in axes.flat:
            axis.patch.set_visible(False)
        return cls(title, caption, figure, axes.tolist())

    @property
    def axis(self) -> Axes:
        """The first."""
        return self.axes[0][0]

    def hover(self, artist: Artist, texts: Sequence[str], links: Sequence[str] = ()) -> None:
        """What is said of each mark of an artist, or of the whole of it by one text.

        ``links``: where a click on each mark leads, "" for nowhere.
        """
        name = f"hover{len(self.hovers)}"
        artist.set_gid(name)
        self.hovers[name] = list(texts), list(links) or [""] * len(texts)

    def picture(self, axis: Axes, picture: Picture, extent: Sequence[float], limit: int) -> None:
        """Show a picture at (left, right, bottom, top), as WebP of ``limit`` bytes at most."""
        name = f"picture{len(self.pictures)}"
        shown = axis.imshow(np.zeros((2, 2, 4)), extent=extent, interpolation="none")
        shown.set_gid(name)
        self.pictures[name] = encode(picture, limit)

    def chart(self, values: Sequence[Mapping[str, Any]] = ()) -> Chart:
        """The chart; ``values``: rows of its CSV."""
        show_texts(self.figure)
        stream = io.StringIO()
        FigureCanvasSVG(self.figure)
        self.figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
        root = ElementTree.fromstring(stream.getvalue())
        for name in ("width", "height"):
            del root.attrib[name]
        root.attrib |= {"role": "img", "aria-label": self.title}
        for group in list(root.iter(f"{SVG}g")):
            if name := group.attrib.pop("id", ""):  # else twice in a page
                _say(group, *self.hovers.get(name, ([], [])))
        for image in root.iter(f"{SVG}image"):
            image.attrib |= {HREF: self.pictures[image.attrib.pop("id")]}
            image.set("preserveAspectRatio", "none")
        for metadata in root.findall(f"{SVG}metadata"):
            root.remove(metadata)
        for element in root.iter():  # as HTML has it: no namespaces
            element.tag = element.tag.removeprefix(SVG)
            if HREF in element.attrib:
                element.set("href", element.attrib.pop(HREF))
        svg = ElementTree.tostring(root, "unicode")
        if not values:
            return Chart(self.title, self.caption, svg)
        stream = io.StringIO()
        writer = csv.DictWriter(stream, list(values[0]), lineterminator="\n")
        writer.writeheader()
        writer.writerows(values)
        data = base64.b64encode(stream.getvalue().encode("utf-8")).decode("ascii")
        uri = f"data:text/csv;charset=utf-8;base64,{data}"
        return Chart(self.title, self.caption, svg, uri)


def _say(group: ElementTree.Element, texts: Sequence[str], links: Sequence[str]) -> None:
    """Give titles and links to the marks of a group, or one title to the whole of it."""
    if not texts:
        return
    if len(texts) == 1 and not links[0]:
        ElementTree.SubElement(group, f"{SVG}title").text = texts[0]
        return
    marks = [
        (parent, mark)
        for parent in group.iter()
        if parent.tag != f"{SVG}defs"
        for mark in parent
        if mark.tag in (f"{SVG}use", f"{SVG}path")
    ]
    for (parent, mark), text, link in zip(marks, texts, links, strict=bool(texts)):
        ElementTree.SubElement(mark, f"{SVG}title").text = text
        if link:
            place = list(parent).index(mark)
            parent.remove(mark)
            anchor = ElementTree.Element("a", href=link)
            anchor.append(mark)
            parent.insert(place, anchor)


def look(number: int) -> dict[str, Any]:
    """Colour, marker and dashes of the n-th series, as keywords of :meth:`Axes.plot`."""
    return {
        "color": SERIES[number % len(SERIES)],
        "marker": MARKERS[number % len(MARKERS)],
        "linestyle": DASHES[number % len(DASHES)],
    }


def on_the_ground(axes: Axes) -> None:
    """Axes in metres, north up."""
    axes.set(xlabel="m east", ylabel="m north", aspect="equal")
    axes.grid(visible=False)


def log_axis(axis: Axis) -> None:
    """Logarithmic ticks at 1, 2 and 5 as plain numbers."""
    axis.set_major_locator(LogLocator(10, (1, 2, 5)))
    axis.set_major_formatter(lambda value, _: f"{value:g}")
    axis.set_minor_locator(NullLocator())
