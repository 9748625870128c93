"""CNES's Pandora with libsgm (both Apache-2.0) as a stereo method: kind ``pandora``.

Without a pipeline of the user's, :data:`PIPELINE` is taken; its penalties and filter are those that
did best on parts of three training tiles of synthetic cities. ``pipeline: mccnn`` has the costs of
CNES's MC-CNN (fast; Apache-2.0) in the place of census, with the penalties that were published for
the fast network (Žbontar & LeCun, JMLR 2016).

Pandora's disparity is x_right − x_left: it searches (−high, −low], and its result changes sign.
Pixels that its validity mask calls invalid are NaN. Images in colour are matched as grey. Nodata
(0) is masked. Pandora works with one thread. config/README.md has the standard uncertainties.
"""

from __future__ import annotations

import copy
import gc
import json
import logging
from collections.abc import Mapping
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandora
import xarray as xr
from numpy.typing import NDArray
from pandora.check_configuration import check_pipeline_section
from pandora.constants import Criteria
from pandora.img_tools import add_disparity
from pandora.state_machine import PandoraMachine
from scipy.special import ndtri

from stereotruth.core.errors import InputError, install_extra

from .kinds import MCCNN, MCCNN_MODULES, mccnn_weights
from .matcher import DisparityRange, UncertainMatcher, called

MARGIN_PX = 128  # as OpenCV's SGM
AMBIGUITY_PX = 1.0
CONFIDENCE = "cost_volume_confidence"
PIPELINE = {
    "matching_cost": {"matching_cost_method": "census", "window_size": 5, "subpix": 1},
    "optimization": {
        "optimization_method": "sgm",
        "penalty": {"penalty_method": "sgm_penalty", "P1": 8, "P2": 20},
    },
    f"{CONFIDENCE}.interval": {"confidence_method": "interval_bounds"},
    "disparity": {"disparity_method": "wta", "invalid_disparity": "NaN"},
    "refinement": {"refinement_method": "vfit"},
    "filter": {"filter_method": "median", "filter_size": 5},
    "validation": {"validation_method": "cross_checking_fast"},
}
MCCNN_COST = {"matching_cost_method": "mc_cnn", "window_size": 11, "subpix": 1}
MCCNN_PENALTY = {"penalty_method": "sgm_penalty", "P1": 2.3, "P2": 55.9}


class PandoraMethod(UncertainMatcher):
    """A pipeline of Pandora as a Matcher; see the module.

    ``pipeline``: a JSON file of Pandora's; ``mccnn``: with MC-CNN's costs; None: :data:`PIPELINE`.

    Raises InputError if the file cannot be read, Pandora does not take its pipeline, or what
    ``mccnn`` needs is not installed.
    """

    margin_px = MARGIN_PX
    invalid_outside = True  # what matches outside the right image has no disparity

    def __init__(self, *, name: str, pipeline: str | None = None) -> None:
        steps = _steps_of(pipeline)
        _keep_quiet()
        pandora.import_plugin()
        self._name, self._steps = name, steps
        blank = dataset(np.ones((16, 16), np.float32), (-1, 1))
        try:
            self.checked(blank, blank)
        except (Exception, SystemExit) as error:  # of whatever kind each of its steps raises
            why = error.__context__ or error
            raise InputError(
                f"method {name!r}: Pandora does not take its pipeline: {why}",
                file=pipeline,
                remedy="mend the pipeline; Pandora's user guide has the steps and their order",
            ) from error

    def checked(self, left: xr.Dataset, right: xr.Dataset) -> tuple[PandoraMachine, dict]:
        """A machine for a pair, and the pipeline with all its settings."""
        machine = PandoraMachine()
        steps = copy.deepcopy(self._steps)
        bands = {"band_im": [None]}
        both = (image.assign_coords(bands) for image in (left, right))
        return machine, check_pipeline_section({"pipeline": steps}, *both, machine)

    def scaling(self, left: Any, right: Any) -> None:
        """None: Pandora takes grey values as they are."""

    def with_uncertainty(
        self,
        left: NDArray[Any],
        right: NDArray[Any],
        disparity_range: DisparityRange,
        scaling: Any = None,
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        """The disparity, and its standard uncertainty if the pipeline has a step that tells it."""
        try:
            return self._matched(left, right, disparity_range)
        finally:
            # its machine refers to itself, so that each pair's cost volumes would stay
            gc.collect()

    def _matched(
        self, left: NDArray[Any], right: NDArray[Any], disparity_range: DisparityRange
    ) -> tuple[NDArray[np.float32], NDArray[np.float32] | None]:
        low, high = disparity_range
        searched = dataset(_grey(left), (1 - high, -low)), dataset(_grey(right), (low, high - 1))
        machine, steps = self.checked(*searched)
        found, _ = pandora.run(machine, *searched, steps)
        disparity = -found["disparity_map"].data.astype(np.float32)
        valid = (found["validity_mask"].data & Criteria.PANDORA_MSK_PIXEL_INVALID.value) == 0
        disparity[~valid] = np.nan
        sigma = _uncertainty(found, steps["pipeline"])
        return disparity, None if sigma is None else np.where(valid, sigma, np.float32(np.nan))


def _keep_quiet() -> None:
    """Have Pandora log nothing to the terminal: it would open a handler of the root, through which
    a job's own lines went a second time."""
    if not logging.root.handlers:
        logging.root.addHandler(logging.NullHandler())


def _steps_of(pipeline: str | None) -> dict[str, Any]:
    """The steps of a pipeline, by its name or its file."""
    if pipeline is None:
        return PIPELINE
    if pipeline != MCCNN:
        return _read(Path(pipeline))
    if missing := [name for name in MCCNN_MODULES if not find_spec(name)]:
        raise InputError(
            f"pipeline mccnn needs {', '.join(missing)}, which is not installed",
            remedy=install_extra("mccnn"),
        )
    (weights,) = mccnn_weights()
    optimization = {**PIPELINE["optimization"], "penalty": MCCNN_PENALTY}
    cost = {**MCCNN_COST, "model_path": str(weights)}
    return {**PIPELINE, "matching_cost": cost, "optimization": optimization}


def _read(file: Path) -> dict[str, Any]:
    """The pipeline of a JSON file of Pandora's."""
    try:
        steps = json.loads(file.read_text(encoding="utf-8"))["pipeline"]
    except (OSError, ValueError, TypeError, KeyError) as error:
        what = "no section pipeline" if isinstance(error, (KeyError, TypeError)) else str(error)
        raise InputError(what, file=file, remedy="name a JSON file of Pandora's") from None
    return steps


def _grey(image: NDArray[Any]) -> NDArray[np.float32]:
    grey = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY) if image.ndim == 3 else image
    return grey.astype(np.float32)


def dataset(image: NDArray[np.float32], searched: tuple[int, int]) -> xr.Dataset:
    """An image [h, w] as Pandora has it; ``searched``: first and last disparity, px."""
    height, width = image.shape
    attrs = {"valid_pixels": 0, "no_data_mask": 1, "no_data_img": 0, "crs": None, "transform": None}
    made = xr.Dataset(
        {"im": (("row", "col"), image)},
        coords={"row": np.arange(height), "col": np.arange(width)},
        attrs=attrs,
    )
    if not image.all():
        made["msk"] = (("row", "col"), (image == 0).astype(np.int16))
    return add_disparity(made, list(searched), window=None)


def _uncertainty(
    found: xr.Dataset, steps: Mapping[str, Mapping[str, Any]]
) -> NDArray[np.float32] | None:
    """The standard uncertainty [h, w] px that the last step of the pipeline tells that can."""
    told = None
    for step, settings in steps.items():
        kind, _, suffix = step.partition(".")
        method = settings.get("confidence_method") if kind == CONFIDENCE else None
        ending = f".{suffix}" if suffix else ""
        if method == "interval_bounds":
            low, high = (
                found["confidence_measure"]
                .sel(indicator=f"confidence_from_interval_bounds_{end}{ending}")
                .data
                for end in ("inf", "sup")
            )
            k = float(ndtri(0.5 + settings["possibility_threshold"] / 2))
            told = (high - low) / (2 * k)
        elif method == "ambiguity":
            name = f"confidence_from_ambiguity{ending}"
            told = AMBIGUITY_PX * (1 - found["confidence_measure"].sel(indicator=name).data)
    return None if told is None else told.astype(np.float32)


def make(name: str, kind: str, settings: Mapping[str, Any], workers: int) -> PandoraMethod:
    """The method of a configuration entry."""
    return called(name, PandoraMethod, {**settings, "name": name})
