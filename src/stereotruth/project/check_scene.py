"""One scene before its run: images, RPCs, control points and LiDAR headers, each and together."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from rasterio.errors import RasterioError

from ..align.align import align, from_rpcs
from ..align.alignment import Alignment
from ..align.control_points import ControlPoints, TooFewPoints, read_gcps
from ..align.images import footprint_of, open_view
from ..core.config.configuration import Configuration
from ..core.errors import InputError
from ..core.products.rasters import open_raster
from ..core.sheets import Scene
from ..epipolar.fit import fit_epipolar
from ..epipolar.model import EpipolarModel
from ..lidar.frames import DEFAULT_EPOCH, Epoch
from ..lidar.ingest import SurveyedFile
from ..lidar.lattice import FAR, Box, Footprint, apart, refuse_apart
from ..sensor.images import MAX_PIXELS, Source, bands_of
from .check_lidar import check_geoid, check_lidar, check_strips
from .expected import Nodes, SceneFacts, check_frame, check_labels, pixel_m2
from .findings import Finding, Findings, Level
from .project import is_synthetic, lidar_of

STRIP_ROWS = 256
WHOLE_BYTES = 100_000_000  # of a compressed image that is read in full: some seconds
WHOLE_PIXELS = 200_000_000  # likewise: of one that is compressed well, or has no blocks at all
PLACES = 8  # along each side of a larger one that are looked at

Looked = dict[tuple[str, str], Findings]  # of images, by file and bands

log = logging.getLogger("stereotruth")


def check_scene(
    scene: Scene,
    settings: Configuration,
    found: Findings,
    names: tuple[str, str] = ("", ""),
    *,
    alone: bool = True,
    looked: Looked | None = None,
    epoch: Epoch = DEFAULT_EPOCH,
) -> SceneFacts:
    """Add what is found of a scene to ``found``; what one part refuses keeps no other from it.

    ``names`` of its images in the images sheet, where they stand in it. ``alone``: the images are
    not adjusted with those of other scenes, which may have the control points that it lacks.
    ``looked``: of images that scenes before it have, which are not read again. ``epoch``: of the
    city's places.
    """
    facts = SceneFacts(scene.scene)
    files: dict[str, Path] = {}
    with found.of("files"):
        files = lidar_of(scene, settings)
    images = _check_images(scene, settings, {} if looked is None else looked, found)
    alignment, gcps = _check_alignment(scene, settings, images, names, alone, epoch, found)
    model = None
    if alignment is not None:
        with found.of("images"):
            model = _check_pair(alignment, scene, found)
            facts.pixels = int(np.prod(model.shape))
            check_frame(Nodes.of(model), settings, found)
    footprint = ground_of(scene, settings) if files and images else None
    surveyed = []
    if files:
        surveyed = check_lidar(list(files.values()), scene, found, footprint, epoch)
    check_strips(surveyed, scene, found)
    facts.points, facts.lidar_files = sum(file.read[0] for file in surveyed), len(surveyed)
    placed = surveyed and alignment is not None and model is not None
    off = placed and check_geoid(surveyed, scene, alignment, float(np.sqrt(pixel_m2(model))), found)
    if surveyed and gcps is not None and not off:
        _hold_against_gcps(surveyed, gcps, found)
    if placed:
        with found.of("LiDAR"):
            facts.covered = _hold_against_images(surveyed, alignment, model, settings, found)
    return facts


def ground_of(scene: Scene, settings: Configuration) -> Footprint | None:
    """The ground of which a run reads LiDAR for a scene; None: everywhere."""
    margin_m = settings.ingest.margin_m
    if margin_m is None or is_synthetic(scene):
        return None
    return footprint_of([(scene.left_image, scene.right_image)], margin_m)


def _check_images(scene: Scene, settings: Configuration, looked: Looked, found: Findings) -> bool:
    """Whether both images and their RPCs can be used."""
    good = True
    with found.of("images"):
        bands = bands_of((scene.left_image, scene.right_image), settings.rectify)
    for view in ("left", "right"):
        image = Path(getattr(scene, f"{view}_image"))
        before, there = len(found), False
        with found.of("files"):
            there = image.is_file()
        if not there:
            good = False
            said = any(f.text.startswith(str(image)) for f in found[before:])
            if not said and not any(f"{view}_image" in f.text for f in found):
                found.fault(
                    "files",
                    f"{image}: {view}_image does not exist",
                    "correct the path (relative to the working directory, or absolute)",
                )
            continue
        with found.of("images"):
            open_view(view, image, "")
        with found.of("images"):
            found.extend(_looked_at(image, bands[view == "right"], looked, scene.scene))
        good &= not any(f.level is Level.ERROR for f in found[before:])
    return good


def _looked_at(
    image: Path, bands: Mapping[str, Any], looked: Looked, scene: str
) -> Iterator[Finding]:
    """What is found of the pixels of an image by those of its ``bands`` that are taken."""
    key = str(image), repr(bands)
    if key not in looked:
        looked[key] = Findings()
        with looked[key].of("images"):
            _check_pixels(image, bands)
    yield from (replace(finding, scene=scene) for finding in looked[key])


def _check_pixels(image: Path, bands: Mapping[str, Any]) -> None:
    """Raise InputError as rule rectify does; what would take long to read is left to it."""
    try:
        with open_raster(image) as dataset:
            pixels, dtype = dataset.width * dataset.height, (*dataset.dtypes, "")[0]
        # to scale values of these types, a source reads all over the image when it is opened
        sampled = dtype.startswith(("float", "int32", "uint32", "int64", "uint64"))
    except RasterioError:
        pixels, sampled = 0, False  # a source says what is wrong
    small = image.stat().st_size <= WHOLE_BYTES and pixels <= WHOLE_PIXELS
    if not small and pixels <= MAX_PIXELS and sampled:
        return
    with Source(image, **bands) as source:
        source.check_blocks(whole=small)
        _refuse_empty(source, whole=small)


def _refuse_empty(source: Source, *, whole: bool) -> None:
    """Raise InputError if no pixel has a value; reads on until one has.

    Not ``whole``: looks at some places only, and warns.
    """
    cols, rows = source.size
    if whole:
        places = ((row, 0, STRIP_ROWS, cols) for row in range(0, rows, STRIP_ROWS))
    else:
        steps = [np.linspace(0, max(n - STRIP_ROWS, 0), PLACES).astype(int) for n in (rows, cols)]
        places = ((row, col, STRIP_ROWS, STRIP_ROWS) for row in steps[0] for col in steps[1])
    for row, col, down, across in places:
        here = min(across, cols - col), min(down, rows - row)
        if np.isfinite(source.read(int(col), int(row), *map(int, here))).any():
            return
    if not whole:
        log.warning("%s: nodata at all of %d places", source.path, PLACES**2)
        return
    raise InputError(
        f"no pixel but nodata ({source.nodata})",
        file=source.path,
        remedy="check the image and its nodata value",
    )


@contextmanager
def _or_of_others(alone: bool, found: Findings) -> Iterator[None]:
    """Too few control points are a fact where images are adjusted with those of other scenes."""
    try:
        yield
    except TooFewPoints as error:
        if alone:
            raise
        found.fact("GCPs", f"{error.problem}: placed by other images and tie points")


def _check_alignment(
    scene: Scene,
    settings: Configuration,
    images: bool,
    names: tuple[str, str],
    alone: bool,
    epoch: Epoch,
    found: Findings,
) -> tuple[Alignment | None, ControlPoints | None]:
    """The alignment as rule align makes it, and the control points, if they can be read."""
    alignment = gcps = None
    if scene.gcps and Path(scene.gcps).is_file():
        with found.of("GCPs"), _or_of_others(alone, found):
            gcps = read_gcps(scene.gcps, scene.scene, names, epoch)
    pair = scene.left_image, scene.right_image
    model, name = settings.alignment.model, scene.scene
    with found.of("GCPs"), _or_of_others(alone, found):
        if name in settings.alignment.fixed:
            alignment = Alignment.read(settings.alignment.fixed[name])
        elif images and gcps is not None:
            alignment = align(
                *pair,
                scene.gcps,
                names=names,
                model=model,
                scene=name,
                strict=settings.strict,
                epoch=epoch,
                provenance={},
            )
            used = [sum(gcp.used for gcp in fit.gcps) for fit in alignment.fits]
            sigma = max(fit.rms("after") for fit in alignment.fits)
            text = f"{used[0]} and {used[1]} of {len(gcps.ids)} used, {sigma:.2f} px rms at most"
            found.fact("GCPs", text)
        elif images and not scene.gcps:
            alignment = from_rpcs(*pair, model=model, scene=name, provenance={})
    if alignment is None and images:  # to hold the LiDAR against the images all the same
        with Findings().of("images"):
            alignment = from_rpcs(*pair, model=model, scene=name, provenance={})
    return alignment, gcps


def _check_pair(alignment: Alignment, scene: Scene, found: Findings) -> EpipolarModel:
    """The epipolar model as rule rectify fits it. Raises InputError as it does."""
    model = fit_epipolar(
        alignment.left,
        alignment.right,
        alignment.left_fit.size,
        alignment.right_fit.size,
        alignment.reference_height,
        names=(scene.left_image, scene.right_image),
    )
    rows, cols = model.shape
    report = model.report
    pixel = np.sqrt(pixel_m2(model))
    found.fact(
        "images",
        f"{cols} x {rows} px of {pixel:.2f} m in common, convergence "
        f"{report['convergence_angle_deg']:.1f} degrees, {report['view_order']}",
    )
    if report["view_order"] == "left looks forward":
        found.doubt(
            "images",
            "the left image is the forward view; in the paper's data it is the backward one",
            "exchange left_image and right_image if disparities should be as the paper's",
        )
    return model


def _hold_against_gcps(
    surveyed: Sequence[SurveyedFile], gcps: ControlPoints, found: Findings
) -> None:
    """Doubt heights: control points below or above every point of the files that they lie in."""
    off, here = [], 0
    for lon, lat, height in zip(gcps.lon, gcps.lat, gcps.height):
        around = [
            file.heights
            for file in surveyed
            if file.box and file.heights and not apart(file.box, (lon, lat, lon, lat))
        ]
        if not around:
            continue
        here += 1
        low, high = min(h[0] for h in around), max(h[1] for h in around)
        if height < low:
            off.append(height - low)
        elif height > high:
            off.append(height - high)
    if here and 2 * len(off) > here:
        shift = float(np.median(off))
        found.doubt(
            "heights",
            f"{len(off)} of {here} GCPs lie {'below' if shift < 0 else 'above'} every LiDAR point "
            f"of their files, by {abs(shift):.1f} m in the middle",
            "check the LiDAR's vertical datum and unit (a geoid that is missing, or of the other "
            "sign: its heights are added; feet), and that the GCPs' heights are ellipsoidal metres",
        )


def boxes_of(placed: Sequence[SurveyedFile], nodes: Nodes) -> tuple[Box, Box, tuple[float, float]]:
    """Boxes (degrees) of LiDAR files, and of what the images see at their heights (m), and these.

    All files have a box and heights.
    """
    boxes = np.array([file.box for file in placed])
    heights = (min(f.heights[0] for f in placed), max(f.heights[1] for f in placed))
    ends = [nodes.ground(height) for height in heights]
    lon, lat = (np.concatenate([end[k].ravel() for end in ends]) for k in (0, 1))
    images = tuple(map(float, (np.nanmin(lon), np.nanmin(lat), np.nanmax(lon), np.nanmax(lat))))
    whole = tuple(map(float, (*boxes[:, :2].min(0), *boxes[:, 2:].max(0))))
    return whole, images, heights


def _hold_against_images(
    surveyed: Sequence[SurveyedFile],
    alignment: Alignment,
    model: EpipolarModel,
    settings: Configuration,
    found: Findings,
) -> float:
    """Share of the images that the LiDAR's boxes cover. Raises InputError if there is none."""
    placed = [file for file in surveyed if file.box and file.heights]
    if not placed:
        return 1.0
    nodes = Nodes.of(model)
    whole, images, heights = boxes_of(placed, nodes)
    if apart(whole, images):
        refuse_apart(whole, images, heights, placed[0].path.parent)
    outside = [file for file in placed if apart(file.box, images)]
    if outside and len(outside) < len(placed):
        around = (images[0] - FAR, images[1] - FAR, images[2] + FAR, images[3] + FAR)
        far = any(apart(file.box, around) for file in outside)
        found.say(
            "LiDAR",
            Level.DOUBT if far else Level.FACT,
            f"{len(outside)} of {len(placed)} files lie outside the images"
            + (f", by more than {FAR} degrees" * far)
            + f" ({outside[0].path.name} …)",
            "leave them out, or check their coordinate system" * far,
        )
    for sensor in (alignment.left, alignment.right):
        low, high = sensor.rpc.ground_box[4:]
        margin = (high - low) / 4
        middle = np.median([np.mean(file.heights) for file in placed])
        if not low - margin <= middle <= high + margin:
            found.doubt(
                "heights",
                f"the LiDAR, about {middle:.0f} m, is outside the {low:.0f} to {high:.0f} m of the "
                "RPC",
                "check that its heights are ellipsoidal metres",
            )
            break
    share = check_labels(nodes, placed, settings, found)
    if not share:
        refuse_apart(whole, images, heights, placed[0].path.parent)
    return share
