"""Sections of stereo methods: datasets, benchmark, training, whole scenes; and of the audit."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import AfterValidator, ConfigDict, Field, model_validator

from ..errors import InputError
from .section import (
    Count,
    FilePath,
    Flag,
    NotNegative,
    Number,
    Range,
    Section,
    Share,
    Text,
    Unit,
    Whole,
    check,
    each_once,
    name_of,
    over,
)

# Entries that there are without being written; their keys hold where an own entry lacks them.
DATASETS = {
    "synthetic": {  # what rule dataset makes
        "root": "dataset",
        "layout": "stereotruth",
        "disparity_range": [-64, 128],
        "methods": ["sgm"],
    }
}
METHODS = {kind: {"kind": kind} for kind in ("sgm", "stereonet", "psmnet", "hmsmnet")}

CHUNK = 256  # px of the result

Pixels = Annotated[Number, Field(gt=0), Unit("px")]

Name = name_of("A-Za-z0-9_-")
KINDS = (
    "sgm",
    "pandora",
    "stereonet",
    "psmnet",
    "hmsmnet",
    "densemapnet",
    "function",
    "command",
    "folder",
)


class StereoDatasetEntry(Section):
    """An entry of the configuration's benchmark.datasets."""

    root: Annotated[FilePath, Unit("path")]
    """its folder"""

    layout: Literal["stereotruth", "whu", "kitti", "us3d"]
    """where its files lie and what they are called"""

    disparity_range: Range
    """disparities that methods look for and labels that count, the second excluded"""

    nodata: Annotated[Number, Unit("px")] = -999
    """value of unlabelled pixels, −999 if it is not given"""

    grows_with_height: Flag = True
    """whether the larger of two disparities is the higher place (true if it is not given): holes of
    a disparity map are filled with the lower one"""

    protocol: Literal["whu-2023", "us3d-track2", "exact-2026"] | None = None
    """frozen definition of its scores, see [below](#protocols); null or not given: what the section
    says"""

    methods: Annotated[tuple[Text, ...] | None, Unit("names")] = None
    """methods that the target `benchmark` compares; null or not given: all that need no training
    (no networks without `weights`)"""


class Augmentation(Section):
    """Random changes of training pairs; as it stands, none (the paper uses none)."""

    flip_rows: Flag = False
    """upside down, every other time"""

    contrast: Annotated[NotNegative, Unit("standard deviation")] = 0
    """of the logarithm of a random factor on the contrast of each image by itself"""

    brightness: Annotated[NotNegative, Unit("standard deviations of the image")] = 0
    """of a random offset to each image by itself"""

    noise: Annotated[NotNegative, Unit("standard deviations of the image")] = 0
    """of each pixel of both images, at most: each pair has its own, from 0 to this"""

    blur: Annotated[Share, Unit("share of the pairs")] = 0
    """one image, left or right, out of focus, by up to 2.3 px"""

    shadows: Annotated[Share, Unit("share of the pairs")] = 0
    """patches of shadow in one image, as where the sun has moved"""

    haze: Annotated[Share, Unit("share of the pairs")] = 0
    """less contrast and more light in one image, by places"""


class Training(Section):
    """The configuration's section training; the defaults are the paper's."""

    epochs: Count = 120
    """passes over all pairs"""

    batch_size: Annotated[Count, Unit("pairs")] = 1
    """of each process"""

    learning_rate: Annotated[Number, Field(gt=0)] = 0.001
    """of Adam"""

    halve_every_epochs: Annotated[Count, Unit("epochs")] = 10
    """after so many the learning rate is halved"""

    crop_px: Annotated[
        tuple[Annotated[Whole, Field(ge=8)], Annotated[Whole, Field(ge=8)]] | None, Unit("px, px")
    ] = None
    """rows and columns of random windows that are trained on, multiples of 8 (StereoNet,
    DenseMapNet), 64 (HMSM-Net), 256 (PSM-Net); null: whole tiles"""

    crops_per_pair: Annotated[Count, Unit("windows")] = 1
    """of each pair in an epoch"""

    augmentation: Augmentation = Field(default_factory=Augmentation)
    """random changes of the training pairs; none as it stands:"""

    initial_weights: Annotated[Text | None, Unit("file")] = None
    """weights to start from (fine-tuning): a `.pt` that rule `train` made, also of another dataset
    (`results/train/us3d/stereonet/best.pt` is made if need be), or Keras' `.h5`"""

    frozen: Annotated[tuple[Text, ...], Unit("names")] = ()
    """parts of the network that keep the initial weights, such as `features`, with their batch
    statistics"""

    hours: Annotated[Annotated[Number, Field(gt=0)] | None, Unit("h")] = None
    """of training at most, all runs together; it ends after the epoch in which they are over"""

    device: Annotated[Text | None, Unit("cpu, cuda or another of PyTorch")] = None
    """null: the GPUs that there are"""

    precision: Literal["float32", "bfloat16", "float16"] | None = None
    """null: mixed with bfloat16 on a GPU, float32 on a CPU; processors with matrix units (AMX) are
    three times as fast with `bfloat16`, those that have no such numbers take float32"""

    processes: Count | None = None
    """that share each step; null: one for each GPU"""

    loader_workers: Annotated[Whole, Field(ge=0), Unit("processes")] = 0
    """that read tiles beside the training"""

    checkpoint_minutes: Annotated[NotNegative, Unit("min")] = 5
    """a killed training goes on from its last checkpoint, at the latest from the last epoch"""


def _part_of_training(given: dict[str, Any]) -> dict[str, Any]:
    """Some keys of the section training, as they were given; InputError if they cannot be."""
    check(given, Training, None)
    return given


class Method(Section):
    """An entry of benchmark.methods; each kind knows its own further settings."""

    model_config = ConfigDict(extra="allow")

    kind: Literal[*KINDS]

    label: Text = ""
    """how tables call the method"""

    fine_tuned_of: Text = ""
    """name of the method whose training was carried on"""

    weights: Annotated[Text | None, Unit("path")] = None
    """of a network; null: those that rule train makes"""

    polarity: Literal["any", "positive", "mirrored"] = "any"
    """of the disparities x_left − x_right that the method sees by itself: positive ones only, as
    most networks, or any; the images of the former are moved and widened for ranges that begin
    below 0; mirrored: likewise, with both images flipped from left to right, for pairs whose
    disparity falls with height"""

    outside: Literal["kept", "invalid"] | None = None
    """with `polarity: positive` or `mirrored`, disparities of pixels whose match lies
    outside the right image; null: invalid for SGM, kept for others"""

    licence: Text = ""
    """of the method and its weights, for `scores.json`"""

    version: Text = ""
    """of the method, for `scores.json`"""

    trained_on: Annotated[tuple[Text, ...] | None, Unit("names")] = None
    """datasets that the method was trained on, named as in `benchmark.datasets`, for tables; []: it
    learns nothing; null: not stated"""

    seed: Annotated[Whole | None, Unit("whole number")] = None
    """of the training; methods of one label whose seeds differ are runs of one method on a
    [board](../docs/how-to/board.md)"""

    by: Text = ""
    """who submits its results to a [board](../docs/how-to/board.md)"""

    training: Annotated[dict[str, Any], AfterValidator(_part_of_training)] = Field(
        default_factory=dict
    )
    """what its training has other than the section training"""


class Scoring(Section):
    """How disparities are scored."""

    thresholds_px: Annotated[
        tuple[Annotated[Number, Field(gt=0)], ...],
        Field(min_length=1),
        AfterValidator(each_once),
        Unit("px"),
    ] = (3, 1)
    """errors above these count for D1; tables show the first"""

    bootstrap: Annotated[Whole, Field(ge=0), Unit("samples")] = 1000
    """of the tiles, for the 95 % confidence intervals; 0: none"""

    panels: Annotated[Whole, Field(ge=0), Unit("tiles")] = 24
    """that are drawn for each method, of all cities; figure 10 shows up to six"""


class Benchmark(Scoring):
    """The configuration's section benchmark."""

    datasets: Annotated[dict[Name, StereoDatasetEntry | None], over(DATASETS), Unit("by name")] = (
        Field(
            default_factory=lambda: {
                name: StereoDatasetEntry(**entry) for name, entry in DATASETS.items()
            }
        )
    )
    """datasets on which stereo methods are compared (`benchmark/<dataset>/<method>`), see
    [below](#stereo-methods); `synthetic` is what rule `dataset` makes, and is
    there if no dataset is named, or it is; null takes a dataset away"""

    methods: Annotated[dict[Name, Method | None], over(METHODS), Unit("by name")] = Field(
        default_factory=lambda: {name: Method(**entry) for name, entry in METHODS.items()}
    )
    """methods, see [below](#stereo-methods); null takes a method away"""

    split: Literal["train", "val", "test"] | None = "test"
    """pairs that are matched and scored; null: all"""


class SceneMatching(Section):
    """How a method goes over a scene."""

    disparity_range: Range | None = None
    """of one block: the smallest disparity, the one after the largest; null: that of the dataset"""

    offset: Annotated[Whole | Literal["auto"], Unit("px")] = "auto"
    """by which the right image is moved before matching. auto: found from the images for each
    block, so that a scene may have more relief than the range holds"""

    block_px: Annotated[Whole, Field(ge=CHUNK, multiple_of=CHUNK), Unit("px")] = 1024
    """side of the blocks; memory grows with its square. With steep relief, smaller blocks keep
    within the range"""

    overlap_px: Annotated[Whole, Field(ge=0), Unit("px")] = 64
    """by which blocks reach into their neighbours, where both are blended; at most half a block"""

    margin_px: Annotated[Annotated[Whole, Field(ge=0)] | None, Unit("px")] = None
    """that a method sees around a block and its overlap; null: as far as anything matters to it. A
    smaller one costs less, and more at the seams"""

    @model_validator(mode="after")
    def _overlap_fits(self) -> SceneMatching:
        if 2 * self.overlap_px > self.block_px:
            raise InputError(
                f"blocks of {self.block_px} px with an overlap of {self.overlap_px} px",
                remedy=f"take a multiple of {CHUNK}, and an overlap of half of it at most",
            )
        return self


class SurfaceModel(Section):
    """The configuration's section predict.dsm."""

    resolution_m: Annotated[Annotated[Number, Field(gt=0)] | None, Unit("m")] = None
    """side of a cell of the surface model; null: a pixel of the coarser image on the ground, to two
    digits"""


class Predict(SceneMatching):
    """The configuration's section predict."""

    methods: Annotated[
        tuple[Text, ...], AfterValidator(each_once), Unit("names of `benchmark.methods`")
    ] = ("sgm",)
    """that the target `predict` goes over all scenes with;
    `results/predict/<city>/<scene>/<method>_dsm.tif` asks for any one"""

    dataset: Annotated[Text | None, Unit("name of `benchmark.datasets`")] = None
    """whose disparity range is taken, and the networks trained on which; null: the first"""

    dsm: SurfaceModel = Field(default_factory=SurfaceModel)
    """of the surface models:"""


class AuditLimits(Section):
    """Tolerances (px, shares) and the rate of false alarms per check and dataset."""

    parallax_px: Pixels = 0.3
    """[audit](#audit): a pair whose vertical parallax is larger, in its middle or from there to an
    edge, is faulty, as is what exceeds the limits below"""

    label_bias_px: Pixels = 0.3
    """label - match of the images, likewise"""

    contradicted_share: Share = 0.03
    """labels that the images contradict: they correlate better elsewhere"""

    hidden_share: Share = 0.02
    """labels on pixels that other labels hide from the right view"""

    false_alarms: Annotated[Number, Field(gt=0, lt=1), Unit("rate")] = 0.01
    """how often a check may call any pair of a faultless dataset faulty; the confidence intervals
    of the verdicts follow from it"""


class Audit(AuditLimits):
    """The configuration's section audit."""

    worst: Annotated[Whole, Field(ge=0), Unit("pairs")] = 12
    """that have pictures on the page"""
