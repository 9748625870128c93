"""Entwine Point Tiles made here, and what may be wrong with them."""

from __future__ import annotations

import json
from pathlib import Path

import laspy
import numpy as np

from .copc_server import CORNER, UTM, thinned_surface


def make_ept(
    folder: Path, points: int = 6000, side: float = 2048.0, levels: int = 4, seed: int = 0
) -> Path:
    """A dataset in a folder, its hierarchy in several files; all its points as ``all.las`` beside.

    The points of ``all.las`` are in the order of the nodes' keys. Returns the path of ept.json.
    """
    rng = np.random.default_rng(seed)
    key, xyz = thinned_surface(rng, points, side, levels)
    xyz += CORNER
    classes = rng.integers(2, 7, points).astype(np.uint8)
    (folder / "ept-data").mkdir(parents=True)
    (folder / "ept-hierarchy").mkdir()
    write(folder / "all.las", xyz, classes)
    counts = {}
    for one in np.unique(key, axis=0):
        inside = (key == one).all(axis=1)
        name = "-".join(map(str, one))
        counts[name] = int(inside.sum())
        write(folder / "ept-data" / f"{name}.laz", xyz[inside], classes[inside])
    pages: dict[str, dict[str, int]] = {"0-0-0-0": {}}
    for name, count in counts.items():
        depth, *at = map(int, name.split("-"))
        if depth < 2:
            pages["0-0-0-0"][name] = count
            continue
        top = "-".join(map(str, (2, *(v >> depth - 2 for v in at))))
        pages["0-0-0-0"][top] = -1
        pages.setdefault(top, {top: counts.get(top, 0)})[name] = count
    for name, page in pages.items():
        (folder / "ept-hierarchy" / f"{name}.json").write_text(json.dumps(page))
    about = {
        "bounds": [*CORNER.tolist(), *(CORNER + side).tolist()],
        "boundsConforming": [*xyz.min(axis=0).tolist(), *xyz.max(axis=0).tolist()],
        "dataType": "laszip",
        "hierarchyType": "json",
        "points": points,
        "schema": [],
        "span": 128,
        "srs": {"wkt": UTM.to_wkt()},
        "version": "1.0.0",
    }
    (folder / "ept.json").write_text(json.dumps(about))
    return folder / "ept.json"


def write(file: Path, xyz: np.ndarray, classes: np.ndarray) -> None:
    """A LAS or LAZ file with the scales and offsets of all of a dataset."""
    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales, header.offsets = [0.01] * 3, CORNER
    if file.suffix == ".las":
        wkt = UTM.to_wkt().encode() + b"\0"
        header.vlrs.append(laspy.VLR("LASF_Projection", 2112, "", wkt))
        header.global_encoding.wkt = True
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.classification = classes
    las.return_number = las.number_of_returns = np.ones(len(xyz), np.uint8)
    las.write(file)


def _about(folder: Path, **changes: object) -> None:
    file = folder / "ept.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | changes))


def _page(folder: Path, change, name: str = "0-0-0-0") -> None:
    file = folder / "ept-hierarchy" / f"{name}.json"
    page = json.loads(file.read_text())
    change(page)
    file.write_text(json.dumps(page))


def _some_node(folder: Path) -> Path:
    return max((folder / "ept-data").glob("*.laz"), key=lambda file: file.stat().st_size)


def _branch(folder: Path, at: int = 0) -> Path:
    return sorted((folder / "ept-hierarchy").glob("2-*.json"))[at]


def _other_scale(folder: Path) -> None:
    file = _some_node(folder)
    las = laspy.read(file)
    las.change_scaling(scales=[0.001] * 3)
    las.write(file)


def _in_feet(folder: Path) -> None:
    """Points of a node whose heights are in feet lie outside of its cube."""
    file = _some_node(folder)
    las = laspy.read(file)
    las.z = np.asarray(las.z) / 0.3048
    las.write(file)


FAULTS = {
    "ept.json cut": lambda f: (f / "ept.json").write_bytes((f / "ept.json").read_bytes()[:90]),
    "ept.json nested": lambda f: (f / "ept.json").write_text("[" * 99999),
    "no bounds": lambda f: _about(f, bounds=None),
    "bounds no cube": lambda f: _about(f, bounds=[0, 0, 0, 1, 2, 3]),
    "cube shifted": lambda f: _about(f, bounds=[9e5, 9e5, 0, 9e5 + 2048, 9e5 + 2048, 2048]),
    "cube too small": lambda f: _about(f, bounds=[*CORNER.tolist(), *(CORNER + 1000.0).tolist()]),
    "binary points": lambda f: _about(f, dataType="binary"),
    "other count": lambda f: _about(f, points=6001),
    "branch lacks": lambda f: _branch(f).unlink(),
    "branch empty": lambda f: _branch(f).write_text("{}"),
    "branch named twice": lambda f: _page(
        f, lambda p: p.update({_branch(f, 1).stem: -1}), _branch(f).stem
    ),
    "node left out": lambda f: _page(f, lambda p: p.pop("1-0-0-0", None)),
    "node counted otherwise": lambda f: _page(f, lambda p: p.update({"0-0-0-0": 7})),
    "key of another octree": lambda f: _page(f, lambda p: p.update({"1-5-0-0": 3})),
    "key that climbs": lambda f: _page(f, lambda p: p.update({"../../../etc/passwd": -1})),
    "count a truth value": lambda f: _page(f, lambda p: p.update({"0-0-0-0": True})),
    "root that leads to itself": lambda f: _page(f, lambda p: p.update({"0-0-0-0": -1})),
    "node lacks": lambda f: _some_node(f).unlink(),
    "node cut": lambda f: _some_node(f).write_bytes(_some_node(f).read_bytes()[:-300]),
    "node no LAZ": lambda f: _some_node(f).write_bytes(b"x" * 5000),
    "node of other scales": _other_scale,
    "node in feet": _in_feet,
}
