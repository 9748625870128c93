"""Stereo datasets on disk: from a folder and the name of its layout to a list of pairs.

===========  ======================================================================================
stereotruth  what rule ``dataset`` makes: ``with ground truth/{train,val,test}/{left,right,disp}``,
             ``without ground truth/{left,right}``, and ``manifest.csv`` (used if there is one)
whu          the published WHU-Stereo, in any folders: ``<P>_left_<n>.tiff`` and, beside it or in
             the folders ``right`` and ``disp`` beside its folder ``left``, ``<P>_right_<n>.tiff``
             and ``<P>_disparity_<n>.tiff``
kitti        KITTI's, in any folders: ``image_2/<name>_10.png`` and, in the folders ``image_3`` and
             ``disp_occ_0`` (or ``disp_noc_0``) beside its own, files of the same name
us3d         US3D (DFC2019, track 2), in any folders: ``<P>_…_LEFT_RGB.tif``, ``…_RIGHT_RGB.tif``,
             ``…_LEFT_DSP.tif``
===========  ======================================================================================

The split is the nearest folder whose name begins with train, val or test; pairs outside such
folders are of split ``test``, in ``without ground truth`` of split ``none``. The city follows from
the prefix of the name.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import InputError, in_number, require_packages
from ..core.products.files import files_below, plain_name, read_sealed
from ..core.products.provenance import file_sha256
from ..core.products.rasters import read_disparity, read_image, read_labels
from .manifest import CHANGED, CHANGED_REMEDY, NO_TRUTH, NONE, PATHS, SPLITS, SUM, manifest_rows
from .manifest import column as column_of
from .seals import Seal

LAYOUTS = ("stereotruth", "whu", "kitti", "us3d")
LEFT_NAMES = {"us3d": "*_LEFT_RGB.tif", "kitti": "image_2/*_10.png"}
CITY_OF_PREFIX = {
    "SG": "Shaoguan",
    "KM": "Kunming",
    "YD": "Yingde",
    "QC": "Qichun",
    "WH": "Wuhan",
    "HY": "Hengyang",
    "JAX": "Jacksonville",
    "OMA": "Omaha",
}
TEST = "test"
_TIFF = re.compile(r"\.tiff?$", re.IGNORECASE)
_WHU_LEFT = re.compile(r"(?P<prefix>.+)_left_(?P<number>\d+)")
_US3D_LEFT = re.compile(r"(?P<pair>.+)_LEFT_RGB")
_SPLIT = re.compile("|".join(SPLITS), re.IGNORECASE)


@dataclass(frozen=True)
class Pair:
    """A stereo pair: ``name`` is unique in its dataset; ``disparity`` is None without labels.

    ``split`` is train, val, test or none. ``row`` is the pair's line of the manifest of layout
    ``stereotruth``, else empty. ``sealed``: checksum of labels that were sealed (:mod:`.seals`).
    """

    name: str
    city: str
    split: str
    left: Path
    right: Path
    disparity: Path | None
    row: Mapping[str, str] = field(default_factory=dict, repr=False, compare=False)
    sealed: str = field(default="", repr=False, compare=False)

    def changed(self) -> Iterator[InputError]:
        """What is to be said of files that are not those which the manifest or the seal lists."""
        for column, file in zip(PATHS, (self.left, self.right, self.disparity)):
            known = self.row.get(f"{column}{SUM}")
            if file is not None and known and file_sha256(file) != known:
                yield InputError(CHANGED, file=file, remedy=CHANGED_REMEDY)
        if self.sealed and self.disparity and file_sha256(self.disparity) != self.sealed:
            remedy = "open the seal again with the labels that it was made of"
            yield InputError("is not the label that was sealed", file=self.disparity, remedy=remedy)

    def refuse_changed(self) -> None:
        """Raise InputError if a file is not the one that the manifest has the checksum of."""
        for error in self.changed():
            raise error


@dataclass(frozen=True)
class StereoDataset:
    """A dataset as the configuration names it.

    ``disparity_range``: px, first inclusive, second exclusive; labels outside count nowhere.
    ``nodata``: value of unlabelled pixels (NaN and the file's own nodata are such too).
    ``grows_with_height``: whether, of two disparities, the larger is the higher place.
    """

    name: str
    root: str | Path
    layout: str
    disparity_range: tuple[int, int]
    nodata: float = -999.0
    grows_with_height: bool = True

    @classmethod
    def of(cls, name: str, settings: Mapping[str, Any]) -> StereoDataset:
        """From an entry of ``benchmark.datasets``."""
        given = dict(settings)
        low, high = given["disparity_range"]
        if low >= high:
            raise InputError(
                f"benchmark.datasets.{name}.disparity_range: [{low}, {high}] is empty",
                remedy="give the smallest disparity first",
            )
        more = {key: given[key] for key in ("nodata", "grows_with_height") if key in given}
        return cls(name, Path(given["root"]), given["layout"], (low, high), **more)

    def pairs(self, split: str | None = None, *, labelled: bool = False) -> list[Pair]:
        """The pairs of a split (None: all), only those with labels if ``labelled``.

        Raises InputError if there are none, or labels that are wanted are still sealed.
        """
        found = find_pairs(self.root, self.layout)
        shut = [p for p in found if p.sealed and p.disparity is None and split in (None, p.split)]
        if labelled and shut:
            raise InputError(
                f"labels of {in_number(len(shut), 'pair')} of split {shut[0].split!r} are sealed",
                file=self.root,
                remedy="wait until they are opened, or open them: stereotruth dataset --open",
            )
        chosen = [
            pair
            for pair in found
            if split in (None, pair.split) and (pair.disparity is not None or not labelled)
        ]
        if not chosen:
            counts = Counter(pair.split for pair in found)
            kind = "labelled pairs" if labelled else "pairs"
            raise InputError(
                f"dataset {self.name!r} has no {kind} of split {split!r}; pairs: {dict(counts)}",
                file=self.root,
                remedy="take another split, or another root",
            )
        return chosen

    @property
    def seal(self) -> str:
        """The id of the seal that its labels were published under; empty of none."""
        seal = Seal.of(self.root)
        return seal.id if seal else ""

    def labels(self, pair: Pair) -> NDArray[np.float32]:
        """Disparity of a labelled pair, float32[h, w] px; NaN unlabelled."""
        assert pair.disparity is not None
        return read_disparity(pair.disparity, self.nodata)

    def layer(self, pair: Pair, name: str) -> NDArray[Any]:
        """A layer of ``tiles.layers`` of a pair of layout ``stereotruth`` [h, w].

        float32 with NaN, or of ``class`` uint8 with 0, where nothing is known. Raises InputError if
        the dataset has no such layer.
        """
        if not pair.row.get(column_of(name)):
            raise InputError(
                f"pair {pair.name} has no layer {name}",
                file=self.root,
                remedy=f"make the tiles with tiles.layers: [{name}]",
            )
        values, nodata = read_labels(Path(self.root) / pair.row[column_of(name)])
        if values.dtype == np.uint8:
            return values
        return np.where(values == np.float32(nodata), np.float32(np.nan), values)


class StereoTiles:
    """The labelled pairs of a split by the conventions of torchgeo's datasets.

    A sample is a dict of tensors: ``image`` float32 [2, C, h, w], left and right in digital
    numbers; ``disparity`` float32 [h, w], x_left − x_right in px, NaN where there is no label;
    ``mask`` bool [h, w], where there is one. ``transforms`` takes and returns such a dict.

    Raises InputError if the split has no labelled pair, and without PyTorch.
    """

    def __init__(
        self,
        root: str | Path = "dataset",
        split: str = "train",
        transforms: Callable[[dict[str, Any]], dict[str, Any]] | None = None,
        *,
        layout: str = "stereotruth",
        nodata: float = -999.0,
    ) -> None:
        require_packages("StereoTiles", ["torch"], "networks")
        self.dataset = StereoDataset(Path(root).name, root, layout, (-(2**15), 2**15), nodata)
        self.pairs = self.dataset.pairs(split, labelled=True)
        self.transforms = transforms

    def __len__(self) -> int:
        return len(self.pairs)

    def __getitem__(self, index: int) -> dict[str, Any]:
        import torch  # which no other reader of datasets needs

        pair = self.pairs[index]
        views = np.stack([read_image(file) for file in (pair.left, pair.right)])
        views = views[:, None] if views.ndim == 3 else np.moveaxis(views, -1, 1)
        disparity = torch.from_numpy(self.dataset.labels(pair))
        image = torch.from_numpy(views.astype(np.float32))
        sample = {"image": image, "disparity": disparity, "mask": torch.isfinite(disparity)}
        return sample if self.transforms is None else self.transforms(sample)


def find_pairs(root: str | Path, layout: str) -> list[Pair]:
    """All pairs below a folder, sorted by split and name.

    Names and cities of pairs are plain names (:mod:`..core.products.files`), whoever made the
    dataset.

    Raises InputError if the folder or a file of a pair is missing, if nothing there has the
    layout's names, if two pairs of one split have one name, or if a name is no plain one.
    """
    root = Path(root)
    if layout not in LAYOUTS:
        raise InputError(
            f"no layout {layout!r}", file=root, remedy=f"take one of {', '.join(LAYOUTS)}"
        )
    if not root.is_dir():
        raise InputError("no such folder", file=root, remedy="name the root of the dataset")
    seal = Seal.of(root)
    if layout in ("us3d", "kitti"):
        found = list({"us3d": _us3d, "kitti": _kitti}[layout](root))
    elif layout == "stereotruth" and (root / "manifest.csv").is_file():
        found = list(_of_manifest(root, seal.files if seal else ()))
    else:
        found = list(_whu(root))
    if not found:
        names = LEFT_NAMES.get(layout, "*_left_*.tiff")
        others = [name for name in LAYOUTS if name != layout]
        raise InputError(
            f"no pair of layout {layout!r}: no file {names} below this folder",
            file=root,
            remedy=f"name the root of the dataset, or take layout {' or '.join(others)}",
        )
    named = list(_unique(found, root))
    if seal:
        sums = {name: seal.files[path] for name, path in seal.pairs.items()}
        named = [replace(pair, sealed=sums.get(pair.name, "")) for pair in named]
    return sorted(named, key=lambda pair: (pair.split, natural(pair.name)))


def natural(name: str) -> list[tuple[int, str]]:
    """Sorting key that takes runs of digits for numbers."""
    return [(int(part), "") if part.isdigit() else (-1, part) for part in re.split(r"(\d+)", name)]


def match_inside(disparity: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Whether a right image of the same width holds the match of each pixel; not where NaN."""
    match = np.arange(disparity.shape[1]) - disparity
    return (match >= 0) & (match <= disparity.shape[1] - 1)


def _of_manifest(root: Path, sealed: Collection[str]) -> Iterator[Pair]:
    """``sealed``: paths of files that may be held back (:mod:`.seals`)."""
    known = root / "export.json"  # of a folder of tiles
    sums = read_sealed(known) if known.is_file() else {}
    if sums.get("manifest_sha256") not in (None, file_sha256(root / "manifest.csv")):
        raise InputError(
            f"is not what {known} has the checksum of",
            file=root / "manifest.csv",
            remedy=f"make the folder again, or delete {known}, if the edit was yours",
        )
    for row in manifest_rows(root / "manifest.csv"):
        try:
            split = row["split"] if row["disp"] else NONE
            files = [root / row[kind] if row[kind] else None for kind in PATHS]
            if row["disp"] in sealed and not files[2].is_file():
                files[2] = None
            name, city = row["tile"], row["city"]
        except KeyError as error:
            raise InputError(
                f"no column {error}", file=root / "manifest.csv", remedy="make the dataset again"
            ) from None
        for file in filter(None, files):
            if not file.is_file():
                raise InputError(
                    f"{file} is missing", file=root / "manifest.csv", remedy="complete the dataset"
                )
        yield Pair(name, city, split, *files, row)


def _whu(root: Path) -> Iterator[Pair]:
    for left in _tiffs(root):
        match = _WHU_LEFT.fullmatch(left.stem)
        if match is None:
            continue
        prefix, number = match["prefix"], match["number"]
        in_folders = left.parent.name.lower() == "left"
        right, disparity = (
            _beside(left, f"{prefix}_{kind}_{number}", folder if in_folders else None)
            for kind, folder in (("right", "right"), ("disparity", "disp"))
        )
        if right is None:
            raise _partner(left, f"{prefix}_right_{number}.tiff")
        split = _split(root, left)
        if disparity is None and in_folders and (left.parent.parent / "disp").is_dir():
            raise _partner(left, f"{prefix}_disparity_{number}.tiff")
        yield Pair(f"{prefix}_{number}", _city(prefix), split, left, right, disparity)


def _us3d(root: Path) -> Iterator[Pair]:
    by_name: dict[str, Path] = {}
    for file in _tiffs(root):
        if (other := by_name.setdefault(file.stem, file)) != file:
            raise InputError(
                f"{other} has the same name", file=file, remedy="name a root that holds one dataset"
            )
    for stem, left in by_name.items():
        match = _US3D_LEFT.fullmatch(stem)
        if match is None:
            continue
        name = match["pair"]
        right = by_name.get(f"{name}_RIGHT_RGB")
        if right is None:
            raise _partner(left, f"{name}_RIGHT_RGB.tif")
        disparity = by_name.get(f"{name}_LEFT_DSP")
        city = _city(name.partition("_")[0])
        yield Pair(name, city, _split(root, left), left, right, disparity)


def _kitti(root: Path) -> Iterator[Pair]:
    for left in sorted(files_below(root)):
        if left.parent.name != "image_2" or not left.name.endswith("_10.png"):
            continue
        beside = left.parent.parent
        right = beside / "image_3" / left.name
        if not right.is_file():
            raise _partner(left, f"image_3/{left.name}")
        labels = (beside / kind / left.name for kind in ("disp_occ_0", "disp_noc_0"))
        name = left.stem.removesuffix("_10")
        city = _city(name.partition("_")[0]) if "_" in name else "KITTI"
        disparity = next(filter(Path.is_file, labels), None)
        yield Pair(name, city, _split(root, left), left, right, disparity)


def _tiffs(root: Path) -> list[Path]:
    return sorted(path for path in files_below(root) if _TIFF.search(path.name))


def _beside(left: Path, stem: str, folder: str | None) -> Path | None:
    place = left.parent if folder is None else left.parent.parent / folder
    candidates = (place / f"{stem}{end}" for end in (left.suffix, ".tiff", ".tif"))
    return next(filter(Path.is_file, candidates), None)


def _partner(left: Path, name: str) -> InputError:
    return InputError(f"its partner {name} is missing", file=left, remedy="complete the dataset")


def _split(root: Path, file: Path) -> str:
    for folder in reversed(file.relative_to(root).parts[:-1]):
        if folder.lower() == NO_TRUTH:
            return NONE
        if match := _SPLIT.match(folder):
            return match[0].lower()
    return TEST


def _city(prefix: str) -> str:
    return CITY_OF_PREFIX.get(prefix.upper(), prefix)


def _unique(pairs: Sequence[Pair], root: Path) -> Iterator[Pair]:
    """Names of which two splits have one are preceded by the split."""
    count = Counter(pair.name for pair in pairs)
    seen = set()
    for pair in pairs:
        if count[pair.name] > 1:
            pair = replace(pair, name=f"{pair.split}_{pair.name}")
        plain_name(pair.name, "the name of a pair,", pair.left)
        plain_name(pair.city, f"the city of pair {pair.name},", pair.left)
        if pair.name in seen:
            raise InputError(
                f"two pairs of split {pair.split!r} are named {pair.name}",
                file=root,
                remedy="name a root that holds one dataset",
            )
        seen.add(pair.name)
        yield pair
