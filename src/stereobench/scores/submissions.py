"""What a board takes: folders of disparities, or of a program, held to what they state.

A folder of ``submissions/`` has ``submission.json`` (:mod:`.prediction_files`) with label, ``by``,
licence, training data, seed, dataset and the checksum of each file; and either a disparity map for
each pair, or a program with its lock file (``program``: a method's entry of kind ``command``, in
which ``{folder}`` stands for a copy of the folder, and ``lock``, the file's name). ``admitted.csv``
beside them has the checksum of each ``submission.json`` when its maintainer took it in, so that no
later edit passes, whatever it states of itself. Each refusal names a file.
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from stereotruth.core.errors import InputError
from stereotruth.core.products.files import is_foreign, plain_name, read_table
from stereotruth.core.products.provenance import file_sha256
from stereotruth.core.products.rasters import image_shape, open_raster
from stereotruth.tiles.stereo_dataset import Pair, StereoDataset

from ..methods.kinds import FOLDER
from ..methods.user_methods import SUFFIXES, read_result
from .prediction_files import FILE, UNCERTAINTY, Submission
from .published import NOT_STATED
from .scores import Doubts

ADMITTED = "admitted.csv"
STATED = ("label", "by", "licence", "trained_on", "dataset")
SEALED_REMEDY = "take the folder as it was admitted, or submit it anew under another name"


class Entry(Submission):
    """A submission whose files are those that it states."""

    @classmethod
    def read(cls, folder: Path, admitted: Mapping[str, str]) -> Entry:
        """The submission of a folder; raises InputError if it is none or was changed."""
        plain_name(folder.name, "the name of a submission,", folder)
        file = folder / FILE
        found = cls.of(folder)
        if found is None:
            raise InputError("no submission", file=file, remedy="pack it: submission/<dataset>/…")
        if folder.name not in admitted:
            raise InputError("not admitted", file=file, remedy="look at it, then give --admit")
        if admitted[folder.name] != file_sha256(file):
            raise InputError("not as it was admitted", file=file, remedy=SEALED_REMEDY)
        there = {path.relative_to(folder).as_posix(): path for path in sorted(folder.rglob("*"))}
        there = {n: p for n, p in there.items() if not p.is_dir() and not is_foreign(p.name)}
        for name in sorted({*found.files, *there} - {FILE}):
            if found.files.get(name) is None or name not in there:
                what = "missing" if name in found.files else f"not a file that {FILE} names"
                raise InputError(what, file=folder / name, remedy=SEALED_REMEDY)
            found.check([there[name]])
        found.check_facts()
        return found

    @property
    def name(self) -> str:
        """Of its folder."""
        return self.folder.name

    @property
    def method(self) -> tuple[str, str]:
        """Label and submitter: submissions that share both are runs of one method."""
        return self.facts["label"], self.facts["by"]

    @property
    def program(self) -> Mapping[str, Any]:
        """Command and lock file; empty of disparities."""
        return self.facts.get("program") or {}

    @property
    def is_random(self) -> bool:
        """Whether it states that another run of it gives other disparities."""
        return bool(self.facts.get("random"))

    def settings(self, work: Path) -> dict[str, Any]:
        """The entry of the method that takes its disparities, or runs a copy of its program."""
        if not self.program:
            return {"kind": FOLDER, "folder": str(self.folder)}
        shutil.rmtree(work, ignore_errors=True)  # so that nothing it leaves there counts
        shutil.copytree(self.folder, work)
        kept = {key: value for key, value in self.program.items() if key != "lock"}
        command = str(kept.get("command", "")).replace("{folder}", shlex.quote(str(work)))
        return {"kind": "command", **kept, "command": command}

    def check_facts(self) -> None:
        """Raise InputError unless it states all that a board shows."""
        stated = {key: self.facts.get(key) for key in STATED}
        if missing := [
            key
            for key, value in stated.items()
            if not isinstance(value, str) or value.strip() in ("", NOT_STATED)
        ]:
            names = ", ".join(missing)
            self.refuse(f"{names}: not stated", f"write {names} into it, before it is admitted")
        if not isinstance(self.facts.get("seed"), int | None):
            self.refuse("seed is no whole number", "write the seed of the training, or null")
        if not isinstance(self.program, dict):
            self.refuse("program is none", "give it command and lock")
        if self.program and self.program.get("lock") not in self.files:
            self.refuse("the program has no lock file", "name it as program.lock, and in files")

    def refuse(self, problem: str, remedy: str, file: Path | None = None) -> None:
        """Raise InputError about a file, by default ``submission.json``."""
        raise InputError(problem, file=file or self.folder / FILE, remedy=remedy)

    def check_maps(self, dataset: StereoDataset, pairs: Sequence[Pair]) -> None:
        """Raise InputError unless there is one map of disparities of each pair, and no other."""
        if self.program:
            return
        names = {pair.name for pair in pairs}
        for name in self.files:
            stem, dot, suffix = name.rpartition(".")
            if f"{dot}{suffix}" in SUFFIXES and stem.removesuffix(f"_{UNCERTAINTY}") not in names:
                self.refuse("no pair of this split", "leave it out", self.folder / name)
        for pair in pairs:
            file = self.folder / f"{pair.name}.tif"
            if file.name not in self.files:
                self.refuse("missing: each pair counts", "submit all pairs of the split", file)
            with open_raster(file) as source:
                raw, shape = source.read(), image_shape(pair.left)
            if len(raw) != 1:
                self.refuse(f"has {len(raw)} bands", "submit one, the disparity", file)
            if raw.shape[1:] != shape:
                self.refuse(f"is {raw.shape[1:]} px, its image {shape}", "submit its size", file)
            if np.isinf(raw).any():
                self.refuse("has infinite values", "write NaN where there is no disparity", file)
            if not np.isfinite(read_result(file, dataset.nodata)).any():
                self.refuse("has no disparity", "submit one that has", file)

    def refuse_doubts(
        self, doubts: Sequence[str], dataset: StereoDataset, maps: Iterable[tuple[str, Any, Any]]
    ) -> None:
        """Raise InputError if there are doubts (:class:`.scores.Doubts`), about the first map.

        ``maps``: name, disparity and truth of each pair.
        """
        if doubts:
            for name, found, truth in maps:
                of_map = Doubts(dataset.disparity_range)
                of_map.add(found, truth)
                if lines := of_map.lines():
                    file = self.folder / f"{name}.tif"
                    self.refuse(lines[0], "submit x_left − x_right, NaN where there is none", file)
            self.refuse(doubts[0], "submit x_left − x_right, NaN where there is none")


def read_admitted(folder: Path) -> dict[str, str]:
    """Checksums of ``submission.json`` by name of the folder, in the order of admission."""
    file = folder / ADMITTED
    if not file.is_file():
        return {}
    try:
        return {row["folder"]: row["sha256"] for row in read_table(file)}
    except (KeyError, UnicodeDecodeError):
        raise InputError(
            "no list of submissions", file=file, remedy="columns are folder and sha256"
        ) from None


def refuse_borrowed(
    entry: Entry, maps: Collection[str], earlier: Iterable[tuple[Entry, Collection[str]]]
) -> None:
    """Raise InputError if an earlier submission has its identity, or its disparities.

    ``maps``: digests of disparities as they are read.
    """
    for other, its_maps in earlier:
        if other.facts["dataset"] != entry.facts["dataset"]:
            continue
        same = other.method == entry.method
        if same and other.facts.get("seed") == entry.facts.get("seed"):
            entry.refuse(f"is {' by '.join(entry.method)}, as {other.name} is", "state its seed")
        if not same and not set(maps).isdisjoint(its_maps):
            entry.refuse(f"has the disparities of {other.name}", "submit one's own")
