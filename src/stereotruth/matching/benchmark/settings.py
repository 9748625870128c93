"""Settings of the benchmark of stereo methods."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from ...dataset.stereo_dataset_settings import Settings as Dataset
from ...settings import Number, Text, Unit, Whole, each_once, name_of, over, settings
from ..kinds import KINDS
from ..networks.training_settings import Training

Name = name_of("A-Za-z0-9_-")


def _part_of_training(given: dict[str, Any]) -> dict[str, Any]:
    """Some keys of the section training, as they were given; InputError if they cannot be."""
    Training(**given)
    return given


@settings(more=True)
class Method:
    """An entry of benchmark.methods; each kind knows its own further settings."""

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

    trained_on: Annotated[tuple[Text, ...], Unit("names")] = ()
    """datasets that the method was trained on, named as in `benchmark.datasets`, for tables"""

    training: Annotated[dict[str, Any], AfterValidator(_part_of_training)] = field(
        default_factory=dict
    )
    """what its training has other than the section training"""

    @property
    def entry(self) -> dict[str, Any]:
        """The entry with what it has other than the defaults, further settings included."""
        own = type(self)(self.kind)
        given = vars(self).items()
        return {n: value for n, value in given if n == "kind" or value != vars(own).get(n)}


@settings
class Scoring:
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


@settings
class Settings(Scoring):
    """The configuration's section benchmark."""

    datasets: Annotated[dict[Name, Dataset | None], over(DATASETS), Unit("by name")] = field(
        default_factory=lambda: {name: Dataset(**entry) for name, entry in DATASETS.items()}
    )
    """datasets on which stereo methods are compared (`benchmark/<dataset>/<method>`), see
    [below](#stereo-methods); `synthetic` is what rule `dataset` makes, and is
    there if no dataset is named, or it is; null takes a dataset away"""

    methods: Annotated[dict[Name, Method | None], over(METHODS), Unit("by name")] = field(
        default_factory=lambda: {name: Method(**entry) for name, entry in METHODS.items()}
    )
    """methods, see [below](#stereo-methods); null takes a method away"""

    split: Literal["train", "val", "test"] | None = "test"
    """pairs that are matched and scored; null: all"""
