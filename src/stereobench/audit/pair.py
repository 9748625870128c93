"""Everything that is measured of one pair, from its files; no decision is taken here."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from stereotruth.core.products.rasters import read_image, read_labels
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from . import conventions, hidden
from .contradiction import REACH_PX, scan_labels
from .estimates import NOTHING, Estimate, cells, robust_fit, scale_of
from .matches import Matches, grey, label_offsets, match_pair, smooth
from .registration import better_place

Picture = NDArray[np.float32]
Floats = NDArray[np.float64]


OFF_ROW_PX = 1.0  # a match that is further off the rows' trend
GROSS_PX = 3.0  # a match that is further off the labels' bias
EXTRA_PX = 32.0  # disparities are looked for so far beyond the stated range
QUANTILES = (1, 50, 99)
SATURATED = {np.dtype(np.uint8): 255, np.dtype(np.uint16): 65535}
CERTAIN = 0.01  # level at which a convention or an order in depth is taken over


def measure(dataset: StereoDataset, pair: Pair) -> dict[str, Any]:
    """Figures of a pair, JSON-ready; estimates as [value, standard error, degrees of freedom].

    Raises InputError if a file cannot be read.
    """
    left, right = read_image(pair.left), read_image(pair.right)
    raw, stated = _raw_labels(pair)
    labels = None if raw is None else dataset.labels(pair)
    shapes = [left.shape, right.shape] + ([] if raw is None else [raw.shape])
    found: dict[str, Any] = {
        "shape": list(left.shape),
        "dtype": [str(left.dtype), str(right.dtype)],
        "same_shape": shapes[0] == shapes[1] and all(s[:2] == shapes[0][:2] for s in shapes),
        "hashes": [_hash(array) for array in (left, right, raw) if array is not None],
        "images": {name: _image(array) for name, array in (("left", left), ("right", right))},
    }
    found["identical_images"] = found["hashes"][0] == found["hashes"][1]
    if labels is not None:
        found["labels"] = stated | _values(labels, dataset)
    if not found["same_shape"] or found["identical_images"]:
        return found
    reach = max(abs(v) for v in dataset.disparity_range) + EXTRA_PX
    spikes = [value for value, _ in found.get("labels", {}).get("spikes", [])]
    matches = match_pair(left, right, reach, nodata=left.dtype != np.uint8)
    return found | measure_arrays(
        left, right, labels, matches, spikes=spikes, grows=dataset.grows_with_height
    )


def measure_arrays(
    left: NDArray[Any],
    right: NDArray[Any],
    labels: NDArray[np.float32] | None,
    matches: Matches,
    *,
    spikes: Sequence[float] = (),
    grows: bool = True,
) -> dict[str, Any]:
    """What images [h, w] or [h, w, 3] and labels (px, NaN: none) say of each other, JSON-ready.

    ``matches`` of the two images; ``spikes``: values of labels that are suspiciously frequent;
    ``grows``: whether disparities are said to grow with height.
    """
    found: dict[str, Any] = {"matches": len(matches)}
    if len(matches):
        found["disparity"] = [float(v) for v in np.percentile(matches.disparity, QUANTILES)]
    found["rows"], trend = _rows(matches, left.shape)
    if labels is not None:
        pictures = grey(left), grey(right)
        found |= _against_labels(*pictures, labels, matches, trend, spikes, grows)
    return found


def _against_labels(
    left: Picture,
    right: Picture,
    labels: NDArray[np.float32],
    matches: Matches,
    trend: tuple[float, float, float],
    spikes: Sequence[float],
    grows: bool,
) -> dict[str, Any]:
    meaning, more = conventions.convention(labels, matches)
    found: dict[str, Any] = {"convention": {"best": meaning, "more": _plain(more)}}
    taken = meaning if more.interval(CERTAIN)[0] > 0 else conventions.AS_STATED
    found["convention"]["taken"] = taken
    if taken in (conventions.SWAPPED, conventions.SWAPPED_SIGN):
        left, right, matches = right, left, conventions.swapped(matches)
        trend = tuple(-v for v in trend)
    if taken in (conventions.SIGN, conventions.SWAPPED_SIGN):
        labels, spikes = -labels, [-value for value in spikes]
    found["bias"], bias = _bias(label_offsets(left, right, labels, matches), matches, labels.shape)
    found["spikes"] = [
        _plain(conventions.wrong_at(labels, value, bias, matches)) for value in spikes
    ]
    aligned = _to_rows(right, trend)
    true = labels - np.float32(bias)
    found["contradicted"] = _contradicted(left, aligned, true, matches)
    found["hidden"] = _hidden(left, aligned, true, grows)
    move, gain = better_place(smooth(left), smooth(aligned), true)
    found["registration"] = {"move": list(move), "gain": _plain(gain)}
    return found


def _plain(estimate: Estimate) -> list[float | int | None]:
    error = estimate.error if np.isfinite(estimate.error) else None
    value = estimate.value if np.isfinite(estimate.value) else None
    return [value, error, estimate.freedom]


def _hash(array: NDArray[Any]) -> str:
    head = f"{array.dtype}{array.shape}".encode()
    return hashlib.sha256(head + np.ascontiguousarray(array).tobytes()).hexdigest()


def _raw_labels(pair: Pair) -> tuple[NDArray[Any] | None, dict[str, Any]]:
    """The label file as it is, and what it says of itself."""
    if pair.disparity is None:
        return None, {}
    values, nodata = read_labels(pair.disparity)
    return values, {"dtype": str(values.dtype), "nodata_tag": nodata}


def _image(image: NDArray[Any]) -> dict[str, Any]:
    top = SATURATED.get(image.dtype)
    return {
        "zero": float(np.mean(image == 0)),
        "saturated": 0.0 if top is None else float(np.mean(image == top)),
        "levels": int(np.unique(image).size),
    }


def _values(labels: NDArray[np.float32], dataset: StereoDataset) -> dict[str, Any]:
    facts = conventions.label_values(labels, dataset.disparity_range)._asdict()
    return {k: None if isinstance(v, float) and np.isnan(v) else v for k, v in facts.items()}


def _rows(
    matches: Matches, shape: tuple[int, ...]
) -> tuple[dict[str, Any], tuple[float, float, float]]:
    """The vertical parallax: at the middle, and from there to the edges along x and y."""
    height, width = shape[:2]
    u, v = (2 * matches.x - width) / width, (2 * matches.y - height) / height
    design = np.column_stack([np.ones(len(matches)), u, v])
    group = cells(matches.x, matches.y)
    tilted = robust_fit(design, matches.parallax, group) if len(matches) else [NOTHING] * 3
    known = np.isfinite([e.value for e in tilted]).all()
    at = tuple(e.value for e in tilted) if known else (0.0, 0.0, 0.0)
    off = matches.parallax - design @ np.array(at)
    return {
        "parallax": _plain(tilted[0]),
        "tilt_x": _plain(tilted[1]),
        "tilt_y": _plain(tilted[2]),
        "spread": scale_of(off) if len(matches) else None,
        "off_row": float(np.mean(np.abs(off) > OFF_ROW_PX)) if len(matches) else None,
    }, (at[0] - at[1] - at[2], 2 * at[1] / width, 2 * at[2] / height)


def _to_rows(right: Picture, trend: tuple[float, float, float]) -> Picture:
    """The right image with its rows brought to the left ones: c + a x + b y px lower there."""
    level, along, down = trend
    matrix = np.array([[1.0, 0.0, 0.0], [along, 1.0 + down, level]])
    return cv2.warpAffine(
        right,
        matrix,
        right.shape[::-1],
        flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP,
        borderMode=cv2.BORDER_REFLECT,
    )


def _bias(errors: Floats, matches: Matches, shape: tuple[int, ...]) -> tuple[dict[str, Any], float]:
    """Labels less disparities, [n] for n matches (NaN where there is none)."""
    known = np.isfinite(errors)
    errors, x, y = errors[known], matches.x[known], matches.y[known]
    if not errors.size:
        return {"matches": 0, "bias": _plain(NOTHING)}, 0.0
    group = cells(x, y)
    height, width = shape
    u, v = (2 * x - width) / width, (2 * y - height) / height
    tilted = robust_fit(np.column_stack([np.ones(x.size), u, v]), errors, group)
    bias = tilted[0].value if np.isfinite(tilted[0].value) else float(np.median(errors))
    return {
        "matches": errors.size,
        "bias": _plain(tilted[0]),
        "median": float(np.median(errors)),
        "tilt_x": _plain(tilted[1]),
        "tilt_y": _plain(tilted[2]),
        "spread": scale_of(errors),
        "gross": float(np.mean(np.abs(errors - bias) > GROSS_PX)),
    }, bias


def _contradicted(
    left: Picture, right: Picture, labels: NDArray[np.float32], matches: Matches
) -> dict[str, Any]:
    known = np.concatenate([labels[np.isfinite(labels)], matches.disparity])
    if not known.size:
        return {"labels": 0, "share": _plain(NOTHING)}
    low, high = np.percentile(known, (0.5, 99.5))
    scan = scan_labels(smooth(left), smooth(right), labels, (low - 4.0, high + 4.0))
    if not scan.x.size:
        return {"labels": 0, "share": _plain(NOTHING)}
    return {
        "labels": scan.x.size,
        "share": _plain(scan.contradicted()),
        "beaten": float(scan.beaten.mean()),
        "beaten_by_chance": float(scan.beaten_by_chance.mean()),
        "correlation": float(np.median(scan.here)),
        "poor": float(np.mean(scan.here < 0.5)),
        "reach": min(float(high - low) + 8.0, float(REACH_PX)),
    }


def _hidden(
    left: Picture, right: Picture, labels: NDArray[np.float32], grows: bool
) -> dict[str, Any]:
    """Who is in front is as the images tell, else as stated."""
    front = hidden.who_is_in_front(left, right, labels)
    low, high = front.interval(CERTAIN)
    nearer = None
    if low > hidden.CLEAR or high < -hidden.CLEAR:
        nearer = hidden.LARGER if low > 0 else hidden.SMALLER
    count = max(int(np.isfinite(labels).sum()), 1)
    shares = {
        side: float(hidden.hidden_labels(labels, side).sum() / count)
        for side in (hidden.LARGER, hidden.SMALLER)
    }
    return {
        "nearer": nearer,
        "evidence": _plain(front),
        "share": shares[nearer or (hidden.LARGER if grows else hidden.SMALLER)],
        "shares": shares,
    }


def estimate(figures: Mapping[str, Any], *names: str) -> Estimate:
    """An estimate among the figures of :func:`measure`, by the names on the way to it."""
    at: Any = figures
    for name in names:
        at = (at or {}).get(name)
    if at is None or at[0] is None or at[1] is None:
        return NOTHING
    return Estimate(float(at[0]), float(at[1]), int(at[2]))
