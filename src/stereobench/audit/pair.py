"""Everything that is measured of one pair, from its files; no decision is taken here."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stereotruth.core.numerics.arrays import Floats
from stereotruth.core.products.rasters import read_image, read_labels
from stereotruth.epipolar.warping import warp_rows
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from . import label_checks
from .estimates import NOTHING, Estimate, cells, robust_fit, scale_of
from .label_checks import AS_STATED, LARGER, SIGN, SMALLER, SWAPPED, SWAPPED_SIGN
from .matches import Matches, grey, label_offsets, match_pair, smooth

Picture = NDArray[np.float32]
Labels = NDArray[np.float32]  # [h, w] px, NaN: none


OFF_ROW_PX = 1.0  # a match that is further off the rows' trend
GROSS_PX = 3.0  # a match that is further off the labels' bias
POOR = 0.5  # correlation, less of which counts as such
EXTRA_PX = 32.0  # disparities are looked for so far beyond the stated range
LEAST_REACH_PX = 1.0  # of labels about their middle, to tell their scale
CERTAIN = 0.01  # level at which a convention or an order in depth is taken over


def matches_of(dataset: StereoDataset, left: NDArray[Any], right: NDArray[Any]) -> Matches:
    """Matches of a dataset's pair [h, w] or [h, w, 3]."""
    reach = max(abs(v) for v in dataset.disparity_range) + EXTRA_PX
    return match_pair(left, right, reach, nodata=left.dtype != np.uint8)


def measure(dataset: StereoDataset, pair: Pair) -> dict[str, Any]:
    """Figures of a pair, JSON-ready; estimates as [value, standard error, degrees of freedom].

    Raises InputError if a file cannot be read.
    """
    left, right = read_image(pair.left), read_image(pair.right)
    arrays = [left, right]
    labels, of_labels = None, {}
    if pair.disparity is not None:
        raw, nodata = read_labels(pair.disparity)
        arrays.append(raw)
        labels = dataset.labels(pair)
        facts = label_checks.label_values(labels, dataset.disparity_range)._asdict()
        of_labels = {"labels": {"dtype": str(raw.dtype), "nodata_tag": nodata, **facts}}
    hashes = [_hash(array) for array in arrays]
    found: dict[str, Any] = {
        "shape": list(left.shape),
        "dtype": [str(left.dtype), str(right.dtype)],
        "same_shape": left.shape == right.shape
        and all(array.shape[:2] == left.shape[:2] for array in arrays),
        "hashes": hashes,
        "grey_values": {"left": np.unique(left).size, "right": np.unique(right).size},
        "identical_images": hashes[0] == hashes[1],
        **of_labels,
    }
    if not found["same_shape"] or found["identical_images"]:
        return found
    spikes = [value for value, _ in of_labels["labels"]["spikes"]] if of_labels else []
    return found | measure_arrays(
        left,
        right,
        labels,
        matches_of(dataset, left, right),
        spikes=spikes,
        grows=dataset.grows_with_height,
    )


def measure_arrays(
    left: NDArray[Any],
    right: NDArray[Any],
    labels: Labels | None,
    matches: Matches,
    *,
    spikes: Sequence[float] = (),
    grows: bool = True,
) -> dict[str, Any]:
    """What images [h, w] or [h, w, 3] and labels say of each other, JSON-ready.

    ``matches`` of the two images; ``spikes``: values of labels that are suspiciously frequent;
    ``grows``: whether disparities are said to grow with height.
    """
    found: dict[str, Any] = {"matches": matches.x.size}
    found["rows"], trend = _rows(matches, left.shape[:2])
    if labels is None:
        return found
    left, right = grey(left), grey(right)
    meaning, more = label_checks.convention(labels, matches)
    taken = meaning if more.interval(CERTAIN)[0] > 0 else AS_STATED
    found["convention"] = {"best": meaning, "more": _plain(more), "taken": taken}
    if taken in (SWAPPED, SWAPPED_SIGN):
        left, right, matches = right, left, label_checks.swapped(matches)
        trend = tuple(-v for v in trend)
    if taken in (SIGN, SWAPPED_SIGN):
        labels, spikes = -labels, [-value for value in spikes]
    errors = label_offsets(left, right, labels, matches)
    found["bias"], bias = _bias(errors, matches, labels)
    found["spikes"] = [
        _plain(label_checks.wrong_at(labels, value, bias, matches)) for value in spikes
    ]
    aligned = _to_rows(right, trend)
    true = labels - np.float32(bias)
    found["contradicted"] = _contradicted(smooth(left), smooth(aligned), true, matches)
    found["hidden"] = _hidden(left, aligned, true, grows)
    move, gain = label_checks.better_place(smooth(left), smooth(aligned), true)
    found["registration"] = {"move": list(move), "gain": _plain(gain)}
    return found


def _plain(estimate: Estimate) -> list[float | int | None]:
    value, error = (v if np.isfinite(v) else None for v in (estimate.value, estimate.error))
    return [value, error, estimate.freedom]


def _hash(array: NDArray[Any]) -> str:
    head = f"{array.dtype}{array.shape}".encode()
    return hashlib.sha256(head + np.ascontiguousarray(array).tobytes()).hexdigest()


def _trend(values: Floats, x: Floats, y: Floats, shape: tuple[int, ...]) -> list[Estimate]:
    """Values [n] in the middle of a pair, and what they change by to its right and lower edge."""
    if not values.size:
        return [NOTHING] * 3
    height, width = shape
    u, v = (2 * x - width) / width, (2 * y - height) / height
    return robust_fit(np.column_stack([np.ones(x.size), u, v]), values, cells(x, y))


def _rows(
    matches: Matches, shape: tuple[int, ...]
) -> tuple[dict[str, Any], tuple[float, float, float]]:
    """The vertical parallax; and as a plane: at column and row 0, by column, by row."""
    height, width = shape
    trend = _trend(matches.parallax, matches.x, matches.y, shape)
    at = np.array([of.value for of in trend])
    at = at if np.isfinite(at).all() else np.zeros(3)
    plane = (float(at[0] - at[1] - at[2]), float(2 * at[1] / width), float(2 * at[2] / height))
    off = matches.parallax - (plane[0] + plane[1] * matches.x + plane[2] * matches.y)
    return {
        **{name: _plain(of) for name, of in zip(("parallax", "tilt_x", "tilt_y"), trend)},
        "spread": scale_of(off) if off.size else None,
        "off_row": float(np.mean(np.abs(off) > OFF_ROW_PX)) if off.size else None,
    }, plane


def _to_rows(right: Picture, plane: tuple[float, float, float]) -> Picture:
    """The right image with its rows brought to the left ones, which lie as the plane says lower.

    Its first and last row go on beyond it; 0 is nodata.
    """
    level, along, down = plane
    rows, cols = right.shape
    y, x = np.mgrid[:rows, :cols]
    lower = np.clip(y + level + along * x + down * y, -1.0, float(rows))
    wide = np.pad(right, ((2, 3), (0, 0)), mode="edge")
    moved = warp_rows(np.ascontiguousarray(wide.T), np.ascontiguousarray(lower.T) + 2.0)
    return np.ascontiguousarray(np.nan_to_num(moved).T, np.float32)


def scale_of_labels(values: Floats) -> tuple[float, float]:
    """Middle of labels [n], and how far their 5 and 95 % quantiles lie from it, px."""
    low, middle, high = np.percentile(values, (5, 50, 95))
    return float(middle), float(high - low) / 2.0


def _bias(errors: Floats, matches: Matches, labels: Labels) -> tuple[dict[str, Any], float]:
    """Labels less disparities, [n] for n matches (NaN where there is none)."""
    known = np.isfinite(errors)
    errors, x, y = errors[known], matches.x[known], matches.y[known]
    if not errors.size:
        return {"matches": 0, "bias": _plain(NOTHING)}, 0.0
    trend = _trend(errors, x, y, labels.shape)
    values = labels[y.astype(int), x.astype(int)].astype(np.float64)
    middle, reach = scale_of_labels(values)
    scale = Estimate(0.0, 0.0, 1)
    if reach >= LEAST_REACH_PX:
        design = np.column_stack([np.ones(x.size), (values - middle) / reach])
        scale = robust_fit(design, errors, cells(x, y))[1]
    bias = trend[0].value if np.isfinite(trend[0].value) else float(np.median(errors))
    return {
        "matches": errors.size,
        **{name: _plain(of) for name, of in zip(("bias", "tilt_x", "tilt_y"), trend)},
        "scale": _plain(scale),
        "spread": scale_of(errors),
        "gross": float(np.mean(np.abs(errors - bias) > GROSS_PX)),
    }, bias


def wrong_labels(
    left: NDArray[Any], right: NDArray[Any], labels: Labels, matches: Matches, front: str
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Labels [h, w] on hidden pixels, and those that the images contradict; free of a bias.

    ``front``: LARGER or SMALLER disparities are in front.
    """
    a, b = grey(left), grey(right)
    hidden = label_checks.hidden_labels(labels, front)
    if (reach := _reach(labels, matches)) is None:
        return hidden, np.zeros(labels.shape, bool)
    b = _to_rows(b, _rows(matches, a.shape)[1])
    return hidden, label_checks.contradicted_labels(smooth(a), smooth(b), labels, reach) & ~hidden


def _reach(labels: Labels, matches: Matches) -> tuple[float, float] | None:
    """Least and greatest disparity that may be right in a pair, px; None: nothing is known."""
    known = np.concatenate([labels[np.isfinite(labels)], matches.disparity])
    if not known.size:
        return None
    low, high = np.percentile(known, (0.5, 99.5))
    return float(low) - 4.0, float(high) + 4.0


def _contradicted(
    left: Picture, right: Picture, labels: Labels, matches: Matches
) -> dict[str, Any]:
    if (reach := _reach(labels, matches)) is None:
        return {"labels": 0, "share": _plain(NOTHING)}
    scan = label_checks.scan_labels(left, right, labels, reach)
    if not scan.x.size:
        return {"labels": 0, "share": _plain(NOTHING)}
    return {
        "labels": scan.x.size,
        "share": _plain(scan.contradicted()),
        "poor": float(np.mean(scan.here < POOR)),
    }


def _hidden(left: Picture, right: Picture, labels: Labels, grows: bool) -> dict[str, Any]:
    """Who is in front is as the images tell, else as stated."""
    front = label_checks.who_is_in_front(left, right, labels)
    low, high = front.interval(CERTAIN)
    nearer = None
    if low > label_checks.IN_FRONT or high < -label_checks.IN_FRONT:
        nearer = LARGER if low > 0 else SMALLER
    stated = LARGER if grows else SMALLER
    hidden = label_checks.hidden_labels(labels, nearer or stated)
    return {
        "nearer": nearer,
        "share": float(hidden.sum() / max(int(np.isfinite(labels).sum()), 1)),
    }


def figure(figures: Mapping[str, Any], *names: str) -> Any:
    """What stands among the figures of :func:`measure`, by the names on the way to it; or None."""
    at: Any = figures
    for name in names:
        at = (at or {}).get(name)
    return at


def estimate(figures: Mapping[str, Any], *names: str) -> Estimate:
    """An estimate among the figures of :func:`measure`, by the names on the way to it."""
    at = figure(figures, *names)
    if at is None or at[0] is None or at[1] is None:
        return NOTHING
    return Estimate(float(at[0]), float(at[1]), int(at[2]))
