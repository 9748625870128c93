"""Labels of a real site, judged by what owes nothing to them.

python bench/real.py ../shared/real/jacksonville [--pairs J001-J002 J002-J013]
                     [--folder results/real] [--panels FOLDER] [--json FILE]

The site's folder has images (`images.tsv`, or `left.tif` and `right.tif`), LiDAR in `points/` or
`lidar/`, and, where there are such, `gcps.csv`, `checkpoints_<image>_<image>.csv` or
`checkpoints.csv` (positions in both images) and `rpc_ba/<image>_ba.json` (RPCs by an independent
bundle adjustment). Labels are made by the workflow in a project of the bench's own; a run that was
stopped is carried on. A folder that is absent is skipped with a reason.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from figures import check_point_errors, draw_panels, print_records
from numpy.typing import NDArray

from stereotruth.align.control_points import ControlPoints
from stereotruth.core.config.configuration import LabelSettings
from stereotruth.core.numerics.geometry import metres_per_degree
from stereotruth.core.products.grids import require_complete
from stereotruth.core.status import Status, is_labelled
from stereotruth.epipolar.intersection import intersect
from stereotruth.epipolar.model import EpipolarModel
from stereotruth.epipolar.warping import warp_rows
from stereotruth.evaluate.labels_against_images import warp_scene
from stereotruth.labels.recipe import lidar_labels
from stereotruth.labels.scene_inputs import SceneInputs
from stereotruth.sensor.rpc import RPC, SensorModel
from stereotruth.tiles.sift_matches import match_tile
from stereotruth.tiles.tile_checks import WarpedTile

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

GROUND_CLASSES, BUILDING_CLASS = (0, 1, 2), 6  # ASPRS: never classified, unclassified, ground
PLANE_PX = 0.1  # px: by which the disparities up to 2 px around differ from a plane at most
BRIGHT = 99.5  # percentile of an image that counts as bright
SHADES = 0.0, 0.16, 0.24, 0.35, 0.51, 0.78  # of it, from which the classes of brightness begin
MATCH_PX = 1.0  # SIFT matches that differ from the labels by more
COLUMNS_OF_SCENES = (
    "scene", "city", "left_image", "right_image", "lidar", "lidar_crs", "geoid", "gcps",
)  # fmt: skip

PERCENT = (
    "seen_labelled",
    "ground_changed",
    "roof_changed",
    "matches_off_ground",
    "matches_off_roof",
)
HEADER = {
    "pair": "pair", "seen_labelled": "seen labelled, %", "ground_changed": "ground changed, %",
    "roof_changed": "roofs changed, %", "check_points": "check points", "bias": "bias, px",
    "nmad": "NMAD, px", "y_parallax": "y, px", "sigma_median": "σ, px",
    "correlation": "correlation", "matches_off_ground": "matches off, ground, %",
    "matches_off_roof": "roofs, %", "east": "east, m", "north": "north, m", "up": "up, m",
}  # fmt: skip


@dataclass(frozen=True)
class Site:
    """A folder of the form that the module describes, and the bench's project for it."""

    folder: Path
    project: Path

    @property
    def city(self) -> str:
        """Name of the site in the sheets."""
        return self.folder.name.capitalize()

    @cached_property
    def images(self) -> dict[str, Path]:
        """Files by the image's name."""
        sheet = self.folder / "images.tsv"
        if not sheet.is_file():
            return {side: self.folder / f"{side}.tif" for side in ("left", "right")}
        with sheet.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream, delimiter="\t"))
        return {row["image"]: self.folder / row["file"] for row in rows}

    def check_points(self, pair: str) -> Path | None:
        """Those that both images of a pair have; None without any."""
        left, right = pair.split("-")
        for file in sorted(self.folder.glob("checkpoints*.csv")):
            names = file.stem.split("_")[1:]
            if not names or (left.endswith(names[0]) and right.endswith(names[1])):
                return file
        return None

    @property
    def judged_pairs(self) -> list[str]:
        """Pairs that have check points."""
        names = list(self.images)
        pairs = (f"{left}-{right}" for left in names for right in names if left != right)
        return [pair for pair in pairs if self.check_points(pair)][: None if len(names) > 2 else 1]

    def adjusted(self, image: str) -> SensorModel | None:
        """The sensor of an image by the independent adjustment; None without one."""
        file = self.folder / "rpc_ba" / f"{self.images[image].stem}_ba.json"
        if not file.is_file():
            return None
        given = json.loads(file.read_text(encoding="utf-8"))["rpc"]
        names = {"row": "line", "col": "samp", "lat": "lat", "lon": "long", "alt": "height"}
        fields = {
            f"{names[axis]}_{short}": given[f"{axis}_{word}"]
            for axis in names
            for word, short in (("offset", "off"), ("scale", "scale"))
        }
        fields |= {
            f"{names[axis]}_{part}_coeff": given[f"{axis}_{part}"]
            for axis in ("row", "col")
            for part in ("num", "den")
        }
        return SensorModel(RPC.from_dict(fields))

    def make(self, pairs: list[str], lidar_crs: str, tile_px: int, cores: int) -> None:
        """Labels of the pairs, by the workflow."""
        self.project.mkdir(parents=True, exist_ok=True)
        lidar = next(self.folder / name for name in ("points", "lidar") if self._has(name))
        gcps = self.folder / "gcps.csv"
        config: dict[str, Any] = {
            "scenes": "scenes.tsv", "cities": "cities.tsv", "tiles": {"size": tile_px},
        }  # fmt: skip
        is_stack = self._has("images.tsv")
        if is_stack:
            config["images"] = "images.tsv"
            with (self.folder / "images.tsv").open(encoding="utf-8", newline="") as stream:
                rows = list(csv.DictReader(stream, delimiter="\t"))
            for row in rows:
                row["file"] = str((self.folder / row["file"]).absolute())
            _write_sheet(self.project / "images.tsv", list(rows[0]), rows)
        scenes = []
        for pair in pairs:
            left, right = pair.split("-")
            given = (
                (left, right) if is_stack else (self.images[v].absolute() for v in (left, right))
            )
            values = (pair, self.city, *given, lidar.absolute(), lidar_crs, "",
                      gcps.absolute() if gcps.is_file() else "")  # fmt: skip
            scenes.append(dict(zip(COLUMNS_OF_SCENES, values)))
        _write_sheet(self.project / "scenes.tsv", [*COLUMNS_OF_SCENES], scenes)
        city = dict.fromkeys(("training", "validation", "testing"), 0)
        city = {"city": self.city, "prefix": self.city[:2].upper(), **city}
        _write_sheet(self.project / "cities.tsv", list(city), [city])
        (self.project / "config.yaml").write_text(yaml.safe_dump(config), encoding="utf-8")
        targets = [f"results/project/{self.city}/{pair}.zarr" for pair in pairs]
        program = Path(sys.executable).with_name("stereotruth")
        command = [str(program), "run", *targets, "--cores", str(cores), "--quiet"]
        subprocess.run(command, cwd=self.project, check=True)

    def _has(self, name: str) -> bool:
        return (self.folder / name).exists()


def _write_sheet(file: Path, columns: list[str], rows: list[dict[str, Any]]) -> None:
    with file.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, columns, delimiter="\t", lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


@dataclass(frozen=True)
class Pair:
    """Products of a pair of a site."""

    site: Site
    name: str

    def product(self, stage: str, name: str = "") -> Path:
        """A folder or file of a stage of the workflow."""
        scene = Path("results") / stage / self.site.city / self.name
        return self.site.project / (scene / name if name else scene.with_suffix(".zarr"))

    @cached_property
    def images(self) -> tuple[Floats, Floats]:
        """Left and right epipolar image [y, x]."""
        stores = (self.product("rectify", f"{view}.zarr") for view in ("left", "right"))
        left, right = (require_complete(store)["image"][:].astype(np.float64) for store in stores)
        return left, right

    @cached_property
    def layers(self) -> dict[str, NDArray[Any]]:
        """Of the disparity store, [y, x]."""
        store = require_complete(self.product("project"))
        return {name: store[name][:] for name in ("status", "disparity", "uncertainty")}

    @property
    def labelled(self) -> Bools:
        """Pixels with a label [y, x]."""
        return is_labelled(self.layers["status"])

    @cached_property
    def model(self) -> EpipolarModel:
        """Of the pair's epipolar grid."""
        return EpipolarModel.from_dict(require_complete(self.product("project")).attrs["epipolar"])

    @cached_property
    def lidar_only(self) -> tuple[Floats, NDArray[np.uint8]]:
        """Disparity that the LiDAR gives to pixels that both images see, NaN elsewhere, and its
        class; [y, x], before any image is looked at."""
        results = self.site.project / "results"
        points = (results / "ingest" / self.site.city).rglob("*.points")
        surface = (results / "surface" / self.site.city).glob("*.surface")
        stores = (self.product("rectify", f"{view}.zarr") for view in ("left", "right"))
        inputs = SceneInputs.of(
            *stores,
            list(points),
            LabelSettings(),
            alignment=_alignment(self),
            surface=next(surface),
        )
        rows, cols = (slice(0, side) for side in inputs.pair.model.shape)
        labels, _ = lidar_labels(inputs, rows, cols)
        by_facets = is_labelled(labels.status) & (labels.status != Status.LABELLED_CROWN)
        return np.where(by_facets, labels.disparity, np.nan), labels.surface_class

    def figures(self) -> dict[str, Any]:
        """All that the tables show."""
        out: dict[str, Any] = {"pair": self.name}
        status = self.layers["status"]
        on_surface, surface_class = self.lidar_only
        changed = status == Status.CHANGED
        # what crowns show, too, is seen by both images: a label, or none for a change
        seen = np.isfinite(on_surface) | self.labelled | changed
        out["seen_labelled"] = _share(self.labelled, seen)
        out |= {
            f"{name}_changed": _share(changed, pixels)
            for name, pixels in self.plane_pixels(on_surface, surface_class).items()
        }
        out["sigma_median"] = float(np.median(self.layers["uncertainty"][self.labelled]))
        warped = warp_scene(
            self.product("rectify", "left.zarr"),
            self.product("rectify", "right.zarr"),
            self.product("project"),
        )
        out["correlation"] = warped.sums.coefficient
        out |= self.matches(surface_class) | self.at_check_points() | self.place()
        return out

    def plane_pixels(self, disparity: Floats, surface_class: NDArray[np.uint8]) -> dict[str, Bools]:
        """Pixels of plane ground and of roofs that both images see, [y, x]."""
        steps = np.full((2, *disparity.shape), np.inf)
        steps[0, :, 2:-2] = disparity[:, 4:] - 2.0 * disparity[:, 2:-2] + disparity[:, :-4]
        steps[1, 2:-2] = disparity[4:] - 2.0 * disparity[2:-2] + disparity[:-4]
        with np.errstate(invalid="ignore"):
            plane = (np.abs(steps) <= PLANE_PX).all(axis=0)
        return {
            "ground": plane & np.isin(surface_class, GROUND_CLASSES),
            "roof": np.isfinite(disparity) & (surface_class == BUILDING_CLASS),
        }

    def by_brightness(self) -> Iterator[dict[str, str]]:
        """Rows of a table: share of plane ground and roofs `changed`, by the darker image."""
        disparity, surface_class = self.lidar_only
        left, right = self.images
        bright = float(np.percentile(left[left > 0], BRIGHT))
        cols = np.arange(left.shape[1]) - np.nan_to_num(disparity)
        there = np.clip(np.rint(cols), 0, left.shape[1] - 1).astype(np.int64)
        darker = np.minimum(left, np.take_along_axis(right, there, axis=1))
        pixels = self.plane_pixels(disparity, surface_class)
        changed = self.layers["status"] == Status.CHANGED
        limits = [*(share * bright for share in SHADES), left.max()]
        for low, high in pairwise(limits):
            here = (darker > low) & (darker <= high)
            row = {"grey value": f"{low:.0f}–{high:.0f}"}
            for name, of in pixels.items():
                row[f"{name}, px"] = str(int((of & here).sum()))
                row[f"{name} changed, %"] = f"{100 * _share(changed, of & here):.1f}"
            yield row

    def matches(self, surface_class: NDArray[np.uint8]) -> dict[str, float]:
        """SIFT matches of this bench that differ from the labels by more than MATCH_PX, of plane
        ground and of roofs."""
        disparity = self.layers["disparity"].astype(np.float64)
        found = match_tile(*self.images, disparity, surface_class)
        far = np.abs(found.error) > MATCH_PX
        return {
            f"matches_off_{name}": _share(far, found.in_row & np.isin(found.surface_class, classes))
            for name, classes in (("ground", GROUND_CLASSES), ("roof", BUILDING_CLASS))
        }

    def at_check_points(self) -> dict[str, float]:
        """Label less measured disparity at check points, and their y-parallax, px."""
        file = self.site.check_points(self.name)
        if file is None:
            return {}
        with file.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(stream))
        left, right = (
            np.array([[float(row[f"{view}_{axis}"]) for axis in ("col", "row")] for row in rows])
            for view in ("left", "right")
        )
        ids = tuple(row["id"] for row in rows)
        lines = tuple(range(2, len(rows) + 2))
        points = ControlPoints(file, ids, lines, *np.zeros((3, len(rows))), left, right)
        figures = check_point_errors(self.model, self.layers["disparity"], points).figures()
        names = {"count": "check_points", "median": "bias", "nmad": "nmad"}
        return {ours: figures[name] for name, ours in names.items()} | {
            "y_parallax": figures["y_parallax_median"]
        }

    def place(self) -> dict[str, float]:
        """Median place of the labels less that by the independent adjustment: east, north, up (m).
        The heights of that adjustment as a whole are free."""
        sensors = [self.site.adjusted(image) for image in self.name.split("-")]
        if None in sensors:
            return {}
        disparity = self.layers["disparity"]
        ours = intersect(self.model, disparity)
        theirs = intersect(replace(self.model, left=sensors[0], right=sensors[1]), disparity)
        lon, lat, up = (ours - theirs).reshape(3, -1)
        per_lon, per_lat = metres_per_degree(float(np.nanmedian(ours[1])))
        values = lon * per_lon, lat * per_lat, up
        return {name: float(np.nanmedian(v)) for name, v in zip(("east", "north", "up"), values)}

    def draw(self, folder: Path) -> None:
        """Left, warped right, difference and disparity."""
        folder.mkdir(parents=True, exist_ok=True)
        disparity = self.layers["disparity"].astype(np.float64)
        left, right = self.images
        warped = warp_rows(right, np.arange(left.shape[1])[None, :] - disparity)
        draw_panels(WarpedTile(self.name, left, warped, disparity), folder / f"{self.name}.png")


def _alignment(pair: Pair) -> Path:
    """The file whose corrections a pair was rectified with."""
    stages = ("adjust", "refine", "align")
    files = (pair.product(stage, "alignment.json") for stage in stages)
    return next(file for file in files if file.is_file())


def _share(part: Bools, of: Bools) -> float:
    return float((part & of).sum() / max(of.sum(), 1))


def _cell(name: str, value: Any) -> str:
    if value is None:
        return "–"
    if isinstance(value, (str, int)):
        return str(value)
    return f"{100 * value:.1f}" if name in PERCENT else f"{value:.3f}"


def main() -> None:
    """Make, judge, print."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("site", type=Path, help="folder of the real site")
    parser.add_argument("--pairs", nargs="+", help="names of images; default: with check points")
    parser.add_argument("--folder", type=Path, default=Path("results/real"))
    parser.add_argument("--lidar-crs", default="", help="of LiDAR files that have none")
    parser.add_argument("--tile-px", type=int, default=256)
    parser.add_argument("--cores", type=int, default=2)
    parser.add_argument("--panels", type=Path, help="folder for pictures")
    parser.add_argument("--json", type=Path, help="file for all figures")
    given = parser.parse_args()
    if not given.site.is_dir():
        print(f"skipped: {given.site} is absent")
        return
    site = Site(given.site, given.folder / given.site.name)
    pairs = given.pairs or site.judged_pairs
    site.make(pairs, given.lidar_crs, given.tile_px, given.cores)
    found = [Pair(site, name) for name in pairs]
    figures = [pair.figures() for pair in found]
    rows = [{HEADER[name]: _cell(name, of.get(name)) for name in HEADER} for of in figures]
    print_records(str(given.site), rows)
    for pair in found:
        print_records(f"{pair.name}, by grey value of the darker image", list(pair.by_brightness()))
        if given.panels:
            pair.draw(given.panels)
    if given.json:
        given.json.write_text(json.dumps(figures, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
