"""What two suns within one day cost: unchanged pixels called `changed`, by the evidence of one
light and of two, and which of these a pair gets.

python bench/lights.py [--seeds 51] [--kinds mixed nothing] [--folder FOLDER]

The cities are those of changes.py on one day, with the right image under a sun of its own.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

from changes import CONDITIONS, SHARES, Case, Labelled, Row, dated_truth, inputs_of

from stereotruth.disparity.project import project_scene
from stereotruth.disparity.scene_inputs import SceneInputs
from stereotruth.epipolar.acquisition import Acquisition
from stereotruth.epipolar.pair_light import PairLight, pair_light
from stereotruth.products.files import atomic_folder
from stereotruth.products.grids import require_complete
from stereotruth.simulate.cities import CitySpec, ViewSpec

# azimuth and elevation of the right image's sun less the left's, degrees
SUNS = ((0, 0), (2, 1), (12, 6), (35, -12))


@dataclass(frozen=True)
class TwoSuns(Case):
    """A case of one day, with the right image's ``sun`` so many degrees off the left's."""

    sun: tuple[float, float] = (0.0, 0.0)

    @cached_property
    def city(self) -> CitySpec:
        """The city, with its one scene."""
        city = super().city
        left, right = self.suns(city)
        return city if left == right else replace(city, right=ViewSpec(right))

    def suns(self, city: CitySpec) -> tuple[tuple[float, float], tuple[float, float]]:
        """Azimuth and elevation of the left and right image's sun, degrees."""
        left = city.sun_azimuth_deg, city.sun_elevation_deg
        return left, (left[0] + self.sun[0], left[1] + self.sun[1])

    def made(self, folder: Path) -> Path:
        """The folder of its images and points, made once."""
        path = folder / f"{self.kind}-{self.seed}-{self.sun[0]:g}_{self.sun[1]:g}"
        if not path.is_dir():
            with atomic_folder(path) as scratch:
                self.make(scratch)
        return path

    def light(self, inputs: SceneInputs) -> PairLight:
        """What the workflow would decide of it."""
        taken = (Acquisition(None, sun) for sun in self.suns(self.city))
        return pair_light(*taken, inputs.rays.pixel_m)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--folder", type=Path, default=Path("results/lights"))
    parser.add_argument("--seeds", type=int, nargs="+", default=[51])
    parser.add_argument("--kinds", nargs="+", default=["mixed", "nothing"], choices=list(SHARES))
    given = parser.parse_args()
    print(
        "| kind | suns apart, ° | shadow, px | one light: without a label, % | lost, % "
        "| two lights: without a label, % | lost, % | taken as |"
    )
    print("|---" * 8 + "|")
    for kind in given.kinds:
        for sun in SUNS:
            rows = {False: Row(), True: Row()}
            for seed in given.seeds:
                case = TwoSuns(kind, CONDITIONS[0], seed, 4.0, sun=sun)
                inputs, truth = inputs_of(case, given.folder), dated_truth(case, given.folder)
                light = case.light(inputs)
                for apart, row in rows.items():
                    settings = inputs.settings.model_copy(update={"diachronic": apart})
                    out = given.folder / "labels.zarr"
                    project_scene(replace(inputs, settings=settings), out, code="bench", workers=2)
                    grid = require_complete(out)
                    layers = {name: grid[name][:] for name in grid.array_keys()}
                    row.add(case, Labelled(layers, *truth))
            cells = [cell for row in rows.values() for cell in (row.cells()[1], row.cells()[4])]
            taken = "two" if light.diachronic else "one"
            angle, shadow = f"{light.sun_angle_deg:.1f}", f"{light.shadow_px:.1f}"
            print("| " + " | ".join([kind, angle, shadow, *cells, taken]) + " |", flush=True)


if __name__ == "__main__":
    main()
