"""The whole configuration, checked: sections of the stages that make labels, and all of them."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from .methods import DATASETS, Audit, Benchmark, Predict, Training
from .section import (
    FilePath,
    Flag,
    NotNegative,
    Number,
    Odd,
    Section,
    Share,
    Text,
    Unit,
    Whole,
    check,
    each_once,
)

Band = Annotated[Whole, Field(ge=1)]
Weight = Annotated[Number, Field(gt=0)]
Strips = Annotated[Whole, Field(ge=1, le=1000)]


class Simulate(Section):
    """The configuration's section simulate."""

    lidar_spacing_m: Annotated[Number, Field(ge=0.1, le=5), Unit("m")] = 0.4
    """distance between neighbouring pulses of the synthetic LiDAR"""


class Ingest(Section):
    """The configuration's section ingest."""

    drop_classes: Annotated[
        tuple[Annotated[Whole, Field(ge=0, le=255)], ...],
        AfterValidator(each_once),
        Unit("LAS classes"),
    ] = (7, 18)
    """points left out; 7 and 18 are noise, IGN files use 65 for artefacts"""

    margin_m: Annotated[Annotated[Number, Field(ge=0)] | None, Unit("m")] = 200
    """around the ground that a pair shows by its RPCs: points farther away are not read (of COPC),
    or not kept; null: all points of all files"""

    strips: Literal["named", "adjusted"] = "named"
    """strips of the LiDAR that disagree beyond noise where they overlap: `named` names them with
    their offsets and leaves the points where they are; the `uncertainty` of labels has what their
    strip is off, and pixels nearer to an edge than strips are off in plan have no label. `adjusted`
    moves the points by the offsets, which count from the strip with most ground; their
    `uncertainty` has what is left"""

    copies_gb: Annotated[Annotated[Number, Field(ge=0)], Unit("GB")] = 20
    """parts of LiDAR files from web servers and buckets that are kept in `results/copies`, so that
    a run that is made again reads nothing; 0: none"""


class Alignment(Section):
    """The configuration's section alignment."""

    model: Literal["affine", "similarity", "shift"] = "affine"
    """transformation from the RPC's projection to the image; needs 4, 3, 2 ground control points at
    least"""

    refine: Flag = True
    """true: tie points between LiDAR and both images are matched and what is left between them
    (disparity, y-parallax) is taken out of both corrections, with the ground control points'
    covariance as prior; if the tie points do not contradict the alignment it stays as it is.
    `results/refine/<city>/<scene>/` says what was seen and changed, and doubts heights of the LiDAR
    that do not fit the control points, the images or the RPCs; with false nothing checks them"""

    fixed: Annotated[dict[str, FilePath], Unit("scene or image: path")] = Field(
        default_factory=dict
    )
    """an `alignment.json` that a scene is made with as it is (a published one, or
    `results/refine/<city>/<scene>/alignment.json` put aside): neither control points nor LiDAR have
    a say any more, so that one more LiDAR file leaves all labels that it does not touch as they
    are, to the bit. Or an image of the images sheet and a copy of `results/adjust/<city>.json`: its
    correction stays as it is there, and images that came later are adjusted to it"""


class Rectify(Section):
    """The configuration's section rectify."""

    colour: Annotated[
        Literal["auto"] | tuple[Band, Band, Band] | None, Unit("[red, green, blue]")
    ] = "auto"
    """the bands of both images, numbered from 1, that make the tiles' images coloured; auto: those
    that both images call red, green and blue, if they do; null: none, tiles are grey"""

    panchromatic: Annotated[Band | dict[Band, Weight] | None, Unit("band, or band: weight")] = None
    """what is matched and correlated, searched for tie points, and shown by grey tiles: a band, or
    a mean of bands by weights, such as `{1: 0.3, 2: 0.6, 3: 0.1}`; null: the mean of the bands of
    `colour`, or band 1 without"""


class LabelSettings(Section):
    """What the labels of a grid follow from; see config/README.md."""

    recipe: Literal["surface", "paper"] = "surface"
    """how points become labels. `surface`: the points are triangles over the ground. Those that go
    on the plane of their neighbours, or bulge as crowns do, give labels. Those between two surfaces
    are cut at the breakline that the points on both sides of it determine. All others are swept
    vertically as what may hide a pixel in either view. All pixels on the surface have a label:
    those with points on it the status `labelled` (1), those between points `labelled_between` (9)
    and an `uncertainty` of their own. Rough surfaces, as crowns are, have labels where both views
    must see them, `labelled_crown` (12), with the `uncertainty` that the roughness of their points
    leaves; which of these are in the tiles, `tiles.max_uncertainty_px` says. Where a step lies
    between points, other pixels are `edge_in_pixel`. Where both images tell that what the LiDAR
    shows has probably changed, pixels are `changed`. A value is always the LiDAR's.
    `paper`: as in the WHU-Stereo paper, a pixel's label is that of mean X, mean Y and max Z of its
    points, and points around which the images do not correlate are dropped"""

    window: Annotated[Odd, Field(ge=3, le=31), Unit("px")] = 9
    """side of the correlation window; with `surface` that of the layer `correlation`, and of the
    pixels in it only those of the same surface count"""

    correlation_threshold: Annotated[Number, Field(ge=-1, le=1)] = 0.5
    """with `paper`: a point below is dropped"""

    edge_margin_px: Annotated[Number, Field(ge=0, le=1), Unit("px")] = 0
    """with `surface`: a pixel whose centre lies nearer to the edge between its surface (roof,
    crown) and another stays unlabelled, since noise of the alignment decides which one it meets;
    pixels on an edge itself always do"""

    min_points: Annotated[Whole, Field(ge=1, alias="min_points_per_px"), Unit("points")] = 1
    """a pixel with fewer stays unlabelled with `paper`, and is one between points with `surface`"""

    diachronic: Flag = False
    """with `surface`: whether both images of a pair were taken under different suns or in different
    seasons, where neither the column `diachronic` of the scenes sheet nor dates and suns of the
    images tell it. Shadows and leaves change their brightness then where no height has changed, so
    that the same evidence tells less of a change. The `uncertainty` of such labels has the
    probability of a change that the images do not show"""


class Project(LabelSettings):
    """The configuration's section project."""

    right_view: Flag = False
    """also the labels of the right images: `results/project/<City>/<scene>_right.zarr`, and
    `disp_right`, `status_right` of the tiles"""


class Tiles(Section):
    """The configuration's section tiles."""

    size: Annotated[Whole, Field(ge=16), Unit("px")] = 1024
    """side of a tile"""

    stride: Annotated[Annotated[Whole, Field(ge=1)] | None, Unit("px")] = None
    """distance between neighbouring tiles; null: the size"""

    min_labelled: Share = 0.5
    """a pair with fewer labelled pixels counts as incomplete and goes to `unlabelled/`"""

    right_offset: Literal["tile", "scene"] = "tile"
    """the right image is shifted by the mean disparity of the tile or of the scene"""

    disparity_dtype: Literal["float32", "float16"] = "float32"
    """type of the disparity files, compressed: 32-bit float, rounded to 1/1024 px (at most
    1/2048 px off), which every program opens, or the paper's 16-bit float, up to 1/128 px off
    below 32 px and 1/16 px from 128 px on, which OpenCV and Pillow cannot read"""

    nodata: Annotated[Number, Unit("px")] = -999
    """value of unlabelled pixels in the disparity files"""

    max_uncertainty_px: Annotated[Number, Field(ge=0), Unit("px")] = 0.5
    """of the labels of rough surfaces (`labelled_crown`, 12), those with a greater `uncertainty`
    are in the disparity store alone: in the tiles they have no disparity and the status
    `too_uncertain` (13). 0: none of them is in the tiles. All other labels are"""

    layers: Annotated[
        tuple[Literal["height", "class", "agl", "uncertainty", "lidar_date"], ...],
        AfterValidator(each_once),
    ] = ()
    """more files of each labelled tile, on the grid of `disp`: `height` (of what the label shows, m
    above the ellipsoid), `class` (LAS class), `agl` (m above the ground, by the LiDAR's class 2, or
    a morphological filter where it has none), `uncertainty` (of the disparity, px), `lidar_date`
    (when the LiDAR measured it, days since 1970-01-01); float32 with nodata -9999, `class` uint8
    and `lidar_date` uint16 with 0. They go into `dataset/` too, and `agl` and `class` into the
    truth of `dataset_us3d/`"""


NEEDED = {  # packages of the extra ``catalog``
    **dict.fromkeys(("stac", "croissant"), ("pystac", "mlcroissant")),
    "parquet": ("pyarrow",),
}


class Dataset(Section):
    """The configuration's section dataset."""

    layouts: tuple[Literal["whu", "kitti", "us3d", "webdataset", "parquet"], ...] = ("whu",)
    """what the target `dataset` writes: `dataset/` in the layout of the published WHU-Stereo
    (always); `dataset_kitti/` with 16-bit PNGs, which cannot hold negative disparities: right
    images are moved by `shift_px` of its manifest, so that the smallest disparity of each pair is 1
    to 2 px; `dataset_us3d/` with RGB images of 8 bits; `dataset_webdataset/` and `dataset_parquet/`
    with all labelled pairs in few large files, and a card for dataset hubs; `parquet` needs the
    extra `catalog`"""

    licence: Text = "other"
    """of the dataset, in its README, cards and catalogs: a name that dataset hubs know,
    such as `cc-by-4.0`; images and LiDAR have terms of their own, which bind it"""

    catalogs: tuple[Literal["stac", "croissant"], ...] = ()
    """descriptions of `dataset/` in it: STAC (`stac/collection.json` and an item for each pair,
    with orientation files and RPCs) and Croissant (`croissant.json`); they need
    the extra `catalog`"""

    acquired: Annotated[dict[str, Text], Unit("scene: date")] = Field(default_factory=dict)
    """when scenes were taken, such as `2020-10-25` or `2020-10-25T03:12:45Z`, for STAC; items of
    other scenes say that it is not known"""

    originals: Flag = False
    """true: crops of the original images for each tile with corrected cameras (RPC, satnerf, EOGS,
    COLMAP), in `originals/<city>/`, for multi-view and neural reconstruction"""

    original_heights: Flag = False
    """true: beside each crop in `originals/<city>/` the height of what each of its pixels shows,
    with its standard uncertainty, status and visibility in the other image; of images that have a
    name in the images sheet"""


class Evaluation(Section):
    """The configuration's section evaluation."""

    building_share: Share = 0.02
    """a tile of which as many of the classified pixels are building is of the class building, any
    other of the class vegetation; where the LiDAR has no classes, flat things that stand above the
    ground count as buildings"""


class Limits(Section):
    """The configuration's section quality; None switches a gate off."""

    max_gcp_rms_px: Annotated[NotNegative | None, Unit("px of the images")] = 1
    """a scene whose ground control points leave a larger residual (rms of either view) is flagged,
    as is what exceeds the limits below; null: no limit"""

    max_y_parallax_px: Annotated[NotNegative | None, Unit("px")] = 0.5
    """size of the median y-parallax of the SIFT matches of a tile or scene"""

    max_sift_error_px: Annotated[NotNegative | None, Unit("px")] = 0.5
    """size of the median of SIFT disparity less label"""

    max_sift_mean_absolute_error_px: Annotated[NotNegative | None, Unit("px")] = 1
    """mean of its size"""

    min_sift_matches: Annotated[Annotated[Whole, Field(ge=0)] | None, Unit("matches")] = 10
    """fewer are flagged themselves, and the two limits above not applied"""

    min_warp_correlation: Annotated[Number, Field(ge=-1, le=1)] | None = 0.5
    """correlation of the left and the right image warped by the labels"""

    min_agreement: Share | None = 0.01
    """probability that chance alone has the SIFT matches of a scene disagree so with its labels, by
    the standard errors of both: on open ground, on roofs, and of the rows. With less, the scene is
    in doubt, whatever the amount; so many scenes without fault are, too. null: no doubts"""


class Export(Evaluation, Tiles):
    """How tiles are cut, checked and split."""

    seed: Whole
    strict: Flag = False
    quality: Limits = Field(default_factory=Limits)


class Report(Section):
    """The configuration's section report."""

    sliders: Annotated[Whole, Field(ge=0), Unit("tiles")] = 30
    """of a city's page, evenly chosen, that have large pictures: a slider between left and warped
    right image, and their difference; all have thumbnails"""


class Dask(Section):
    """The configuration's section dask."""

    scheduler_address: Annotated[Text | None, Unit("address")] = None
    """Dask scheduler (`tcp://host:8786`) whose workers make the blocks of the rules `project`,
    `predict_scene` and `dsm`, for who has a Dask cluster that works on one scene with scheduling of
    its own; null: threads of the job. The workers need this package and the same paths"""


class Configuration(Section):
    """All keys of ``config/config.yaml``."""

    scenes: Annotated[Text, Unit("path")] = "config/scenes.tsv"
    """the scenes sheet, see below"""

    cities: Annotated[Text, Unit("path")] = "config/cities.tsv"
    """the cities sheet, see below"""

    images: Annotated[Text, Unit("path")] = ""
    """the images sheet of sites, see below; empty: scenes name files"""

    strict: Flag = False
    """true: warnings about the alignment (any ground control point left out), the splits or a limit
    of `quality` end the run"""

    seed: Annotated[Whole, Field(ge=0), Unit("whole number")] = 20230213
    """of everything random: measurement noise of the synthetic cities, splits"""

    simulate: Simulate = Field(default_factory=Simulate)
    ingest: Ingest = Field(default_factory=Ingest)
    alignment: Alignment = Field(default_factory=Alignment)
    rectify: Rectify = Field(default_factory=Rectify)
    project: Project = Field(default_factory=Project)
    tiles: Tiles = Field(default_factory=Tiles)
    evaluation: Evaluation = Field(default_factory=Evaluation)
    quality: Limits = Field(default_factory=Limits)
    dataset: Dataset = Field(default_factory=Dataset)

    strips: Annotated[Strips | dict[str, Strips], Unit("number, or scene: number")] = 1
    """jobs among which `rectify`, `surface` and `project` of a scene are shared, each for some
    of its blocks; for any cluster that Snakemake submits jobs to, without a Dask that runs there.
    The bytes are those of one job"""

    dask: Dask = Field(default_factory=Dask)
    report: Report = Field(default_factory=Report)
    benchmark: Benchmark = Field(default_factory=Benchmark)

    training: Training = Field(default_factory=Training)
    """how the networks are trained (`results/train/<dataset>/<method>/`), see [below](#training);
    an entry of `benchmark.methods` may have a `training` of its own, whose keys precede"""

    predict: Predict = Field(default_factory=Predict)
    audit: Audit = Field(default_factory=Audit)

    @classmethod
    def of(cls, config: Mapping[str, Any], file: str | Path = "config") -> Configuration:
        """What the user wrote. Raises InputError that names ``file`` and the first wrong key."""
        return check(_without_unnamed(config), cls, file)


def _without_unnamed(config: Mapping[str, Any]) -> Mapping[str, Any]:
    """The configuration without built-in datasets, if it names others and none of the built-in."""
    benchmark = config.get("benchmark")
    datasets = benchmark.get("datasets") if isinstance(benchmark, Mapping) else None
    if not isinstance(datasets, Mapping) or not datasets or set(datasets) & set(DATASETS):
        return config
    unnamed = dict.fromkeys(DATASETS)
    return {**config, "benchmark": {**benchmark, "datasets": {**unnamed, **datasets}}}
