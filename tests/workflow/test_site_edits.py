"""What a site's control points make due: alignment and labels of their group, and no LiDAR."""

from __future__ import annotations

from pathlib import Path

import pytest

from ..synthetic.hollow_workflow import make_hollow
from ..synthetic.project import row_of
from .failing import Failures

pytestmark = pytest.mark.slow
SCENES = ("Own-1", "Own-2", "Own-3")  # two that share an image, and one of images of its own


class Site(Failures):
    """The labels of a site's pairs."""

    call = (
        *(f"results/project/Own/{scene}.zarr" for scene in SCENES),
        *("--configfile", "site.yaml", "--cores", "16"),
    )


@pytest.fixture(scope="module")
def site(tmp_path_factory) -> Site:
    project = make_hollow(tmp_path_factory.mktemp("hollow") / "project")
    for name in ("third.tif", "other_left.tif", "other_right.tif", "other.csv"):
        (project.folder / "in" / name).write_text(f"{name}\n")
    first = row_of(Path("in"), scene="Own-1", city="Own")
    second = first | {"scene": "Own-2", "right_image": "in/third.tif"}
    images = {f"{view}_image": f"in/other_{view}.tif" for view in ("left", "right")}
    third = first | images | {"scene": "Own-3", "gcps": "in/other.csv"}
    project.add_scene("site", [first, second, third])
    site = Site(project, seed=1)
    assert site.run()[0] == 0, site.said()[-4000:]
    return site


def made_again(site: Site, file: str) -> set[str]:
    """Stages and scenes whose products a run makes after an edit of a file."""

    def products() -> dict[Path, tuple[int, int]]:
        found = (site.folder / "results").glob("*/Own/**/*")  # a number may be given again
        states = {path: path.stat() for path in found if path.is_file()}
        return {path: (state.st_ino, state.st_mtime_ns) for path, state in states.items()}

    before = products()
    site.edit(file)
    assert site.run()[0] == 0, site.said()[-4000:]
    changed = [path for path, state in products().items() if before.get(path) != state]
    names = [path.relative_to(site.folder / "results").parts for path in changed]
    return {f"{stage} {name.split('.')[0]}" for stage, _, name, *_ in names}


def test_control_points_make_their_group_again_and_read_no_lidar(site):
    stages = ("align", "refine", "adjust", "rectify", "project")
    assert made_again(site, "in/gcps.csv") == {
        f"{stage} {scene}" for stage in stages for scene in ("Own-1", "Own-2")
    }


def test_control_points_of_a_pair_alone_move_no_other(site):
    stages = ("align", "refine", "rectify", "project")
    assert made_again(site, "in/other.csv") == {f"{stage} Own-3" for stage in stages}
