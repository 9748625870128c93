"""Without PyTorch the networks' targets say what to install."""

from __future__ import annotations

from importlib.util import find_spec

import pytest
import yaml

from ..synthetic.project import Project


@pytest.mark.slow
@pytest.mark.skipif(find_spec("torch") is not None, reason="PyTorch is installed here")
def test_a_network_says_what_to_install(project: Project) -> None:
    root = project.folder / "pairs"
    root.mkdir()
    for name in ("KM_left_1.tiff", "KM_right_1.tiff"):
        (root / name).touch()
    (project.folder / "weights.pt").touch()
    of = {"root": "pairs", "layout": "whu", "disparity_range": [0, 64]}
    methods = {"ready": {"kind": "psmnet", "weights": "weights.pt"}}
    config = {"benchmark": {"datasets": {"mine": of}, "methods": methods}}
    (project.folder / "my.yaml").write_text(yaml.safe_dump(config))
    targets = ("results/train/mine/stereonet/best.pt", "results/match/mine/ready")
    run = project.snakemake("--keep-going", *targets, "--configfile", "my.yaml")
    assert run.status != 0
    for log in ("train/mine/stereonet", "match/mine/ready"):
        said = (project.folder / f"logs/{log}.log").read_text()
        assert "not installed. Remedy: install the extra networks" in said, run.text
