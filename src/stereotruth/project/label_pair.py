"""One stereo pair to labels, from Python: by the workflow, in a project of its own.

``stereotruth.label_pair`` is :func:`label_pair`. What it gives, and windows of that, have the
accessor ``stereotruth`` (:class:`PairAccessor`).
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import xarray as xr

from ..core.errors import InputError
from ..core.products.grids import open_grid
from ..core.products.remote_files import is_remote
from ..core.sheets import FILES, LIDAR_SEPARATOR
from ..epipolar.warping import warp_rows
from .new_project import begin, city_row
from .project import CONFIG

NAME, SCENE = "Pair", "Pair-1"
LABELS = f"results/project/{NAME}/{SCENE}.zarr"
IMAGES = f"results/rectify/{NAME}/{SCENE}"
SAID = 12  # lines of a run that failed


def label_pair(
    left: str | Path,
    right: str | Path,
    lidar: str | Path | Iterable[str | Path],
    gcps: str | Path | None = None,
    folder: str | Path | None = None,
    *,
    cores: int | None = None,
    **columns: str | Path,
) -> xr.Dataset:
    """Labels of a pair of images with RPCs, in the geometry of its left epipolar image.

    ``lidar``: files or folders; ``gcps``: control points as CSV, without any the LiDAR alone places
    the images; ``columns``: others of the scenes sheet, as ``lidar_crs`` or ``geoid``. All stages
    are those of a run; they write to ``folder``, a project whose ``config.yaml`` holds, and the
    same call there carries on where a run has ended. Without a folder all is made in a temporary
    one, and the dataset is in memory. ``cores``: all without it. Lines of the run are shown as
    they come.

    Of each pixel [y, x]: ``disparity`` (px), ``height`` (m), ``status``, ``uncertainty`` (px) and
    the other layers of ``results/project``, and the grey values ``left``; ``right`` [y, x_right].
    Raises InputError, with the last lines of the run, if it fails.
    """
    if folder is None:
        with TemporaryDirectory() as scratch:
            place = Path(scratch) / NAME
            return label_pair(left, right, lidar, gcps, place, cores=cores, **columns).load()
    folder = Path(folder).absolute()
    parts = [lidar] if isinstance(lidar, str | Path) else lidar
    cells = {"left_image": left, "right_image": right, "gcps": gcps or "", **columns}
    cells |= {key: _from_anywhere(cells[key]) for key in FILES if cells.get(key)}
    cells["lidar"] = LIDAR_SEPARATOR.join(map(_from_anywhere, parts))
    scene = {"scene": SCENE, "city": NAME, "lidar_crs": "", "geoid": ""} | cells
    if not (folder / CONFIG).is_file():
        begin(folder)
    for sheet, row in (("cities", city_row(NAME, "PR")), ("scenes", scene)):
        lines = "\t".join(row), "\t".join(map(str, row.values()))
        (folder / f"{sheet}.tsv").write_text("\n".join([*lines, ""]), encoding="utf-8")
    _run(folder, LABELS, cores)
    views = {
        view: open_grid(folder / IMAGES / f"{view}.zarr")["image"] for view in ("left", "right")
    }
    labels = open_grid(folder / LABELS)
    return labels.assign(left=views["left"], right=views["right"].rename(x="x_right"))


def _from_anywhere(path: str | Path) -> str:
    """A path that holds in any working directory; URLs stay."""
    return str(path) if is_remote(str(path)) else str(Path(path).absolute())


def _run(folder: Path, target: str, cores: int | None) -> None:
    words = [sys.executable, "-m", f"{__package__}.main", "run", target, "--cores"]
    lines = []
    with subprocess.Popen(
        [*words, str(cores or "all")],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    ) as run:
        for line in filter(str.strip, run.stdout or ()):
            print(line, end="", file=sys.stderr, flush=True)
            lines.append(line.rstrip())
    if run.returncode:
        told = dict.fromkeys(line for line in lines if "error:" in line) or lines[-SAID:]
        raise InputError(
            "\n".join(["the run ended without labels:", *told]),
            file=folder,
            remedy="correct what the lines name, and call it again with this folder",
        )


@xr.register_dataset_accessor("stereotruth")
class PairAccessor:
    """``dataset.stereotruth``: of what :func:`label_pair` gives, or a window of it by ``isel``."""

    def __init__(self, dataset: xr.Dataset) -> None:
        self._dataset = dataset

    def warp(self) -> xr.DataArray:
        """The right image as the left one shows it [y, x]: at x - disparity, by cubic convolution.

        NaN without a label, and where the right image has nothing. Where labels are right and
        nothing has changed, it looks as ``left`` does.
        """
        data = self._dataset
        columns = data["x"].values - data["disparity"].values.astype(np.float64)
        right = data["right"].values.astype(np.float64)
        values = warp_rows(right, columns - float(data["x_right"][0]))
        attrs = data["left"].attrs | {"long_name": "right image, warped to the left one"}
        return xr.DataArray(values, data["disparity"].coords, ("y", "x"), "warped", attrs)
