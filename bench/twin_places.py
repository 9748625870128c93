"""Real places whose twins take the place of drawn cities in benchmarks: named by the caller."""

from __future__ import annotations

import argparse
import hashlib
from dataclasses import dataclass
from pathlib import Path

from wooded_scenes import Draw

from stereotruth.simulate.cities import CitySpec
from stereotruth.simulate.twin_world import twin_city


@dataclass(frozen=True)
class Place:
    """A LAS or LAZ file, and the coordinate system of its points if it declares none."""

    file: Path
    crs: str = ""

    def city(self, name: str, seed: int) -> CitySpec:
        """The twin, whose orbit and textures a seed draws."""
        return twin_city(name, self.file, crs=self.crs, pose_seed=seed)

    @property
    def key(self) -> str:
        """A name that tells the places apart."""
        size = self.file.stat().st_size
        told = f"{self.file.name} {size} {self.crs}".encode()
        return f"{self.file.stem}-{hashlib.sha256(told).hexdigest()[:8]}"


@dataclass(frozen=True)
class TwinDraw:
    """What the scene of a twin is made of, in the place of a :class:`wooded_scenes.Draw`."""

    place: Place
    seed: int
    density: float
    noise: bool = False
    gain: bool = False
    key = Draw.key

    @property
    def city(self) -> CitySpec:
        """The twin and its one scene."""
        return self.place.city("Twin", self.seed)


def add_place(parser: argparse.ArgumentParser) -> None:
    """The arguments that name a place."""
    parser.add_argument("--twin", type=Path, help="LAS or LAZ file of a real place: its twin")
    parser.add_argument("--crs", default="", help="of the twin's points, if they declare none")


def place_given(arguments: argparse.Namespace) -> Place | None:
    """The place that is named and there; else None, with the reason if it is not there."""
    if arguments.twin is None:
        return None
    if not arguments.twin.is_file():
        print(f"twin skipped: there is no file {arguments.twin}")
        return None
    return Place(arguments.twin, arguments.crs)
