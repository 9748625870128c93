"""The command in an empty folder, the workflow as a module and from elsewhere, and the wheel."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import sysconfig
import textwrap
from pathlib import Path

import pytest
import yaml

from stereotruth.project.main import main

from ..synthetic.project import ROOT, SIZE, Project, Run

COMMAND = [sys.executable, "-m", "stereotruth.project.main"]


def call(*arguments: str, folder: Path, command: list[str] = COMMAND) -> Run:
    done = subprocess.run(
        [*command, *arguments],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=900,
    )
    return Run(done.returncode, done.stdout)


@pytest.fixture(scope="module")
def own(made, tmp_path_factory) -> Path:
    """A project of the command: a city's files, and copies of what was made of them elsewhere."""
    folder = tmp_path_factory.mktemp("empty") / "own"
    assert call("init", "own", folder=folder.parent).status == 0
    for name in ("in", "results", "tiles", ".snakemake"):
        shutil.copytree(made.folder / name, folder / name)
    for name in ("scenes", "cities"):
        shutil.copy(made.folder / f"tiny_{name}.tsv", folder / f"{name}.tsv")
    with (folder / "config.yaml").open("a") as stream:
        yaml.safe_dump(SIZE, stream)
    return folder


OWN_RULE = """
rule mine:
    default_target: True
    input:
        "tiles/Demo",
    output:
        "mine.txt",
    shell:
        "ls {input}/disp > {output}"
"""


def module() -> str:
    """The Snakefile that config/README.md shows, and a rule after it."""
    guide = (ROOT / "config/README.md").read_text(encoding="utf-8")
    block = re.search(r"## In other workflows\n\n((?: {4}.*\n|\n)+)", guide)[1]
    return textwrap.dedent(block) + OWN_RULE


@pytest.mark.slow
def test_a_module_of_another_workflow_makes_the_same(own):
    """What the command has made stays; the other workflow's own rule goes on from it."""
    (own / "Snakefile").write_text(module().replace("Demo", "Tiny"))
    project = Project(own)
    assert project.plan() == {"mine": 1}
    run = project.snakemake()
    assert run.status == 0, run.text[-4000:]
    assert "_disparity" in (own / "mine.txt").read_text()
    assert project.plan("report", "evaluate")["report_city"] == 1


@pytest.mark.slow
def test_snakemake_from_elsewhere_reads_the_defaults_and_the_folder(own, tmp_path):
    snakefile = ("--snakefile", str(ROOT / "Snakefile"))
    elsewhere = Project(tmp_path)
    (tmp_path / "w").mkdir()
    jobs = elsewhere.plan(*snakefile, "--directory", "w", "tiles/Qichun")
    assert jobs["export"] == 1 and jobs["align"] == 2
    there = ("--directory", str(own), "--configfile", str(own / "config.yaml"))
    assert elsewhere.plan("tiles/Tiny", *snakefile, *there) == {}
    (tmp_path / "w/config").mkdir()
    (tmp_path / "w/config/config.yaml").write_text("tile: 3\n")
    run = elsewhere.snakemake("--dry-run", *snakefile, "--directory", "w", "tiles/Qichun")
    assert run.status != 0 and "unknown key 'tile'" in run.text


@pytest.mark.slow
def test_what_is_out_of_date_is_said_with_the_cause(own):
    gcps = own / "in/gcps.csv"
    text = gcps.read_text()
    try:
        gcps.write_text(text.replace(text.splitlines()[3] + "\n", ""))
        status = call("status", "Tiny", folder=own)
        assert "out of date" in status.text and "changed: gcps" in status.text, status.text
        assert "align 1, refine 1, rectify 1, project 1, export 1" in status.text
    finally:
        gcps.write_text(text)


def in_process(monkeypatch, capsys, *arguments: str) -> Run:
    """A call whose imports are there already."""
    monkeypatch.setattr(sys, "argv", ["stereotruth", *arguments])
    with pytest.raises(SystemExit) as end:
        main()
    said = capsys.readouterr()
    return Run(int(end.value.code or 0), said.out + said.err)


def test_errors_of_what_is_not_there(own, monkeypatch, capsys):
    monkeypatch.chdir(own)
    run = in_process(monkeypatch, capsys, "status", "Qichun")
    assert run.status == 1 and run.text.startswith("error: ") and "Qichun" in run.text
    run = in_process(monkeypatch, capsys, "open")
    assert run.status == 1 and "no page" in run.text


def test_help_shows_examples(monkeypatch, capsys):
    for words in ([], ["run"], ["scene", "add"], ["gcps", "import"], ["check"]):
        run = in_process(monkeypatch, capsys, *words, "--help")
        assert run.status == 0 and "Examples" in run.text
        assert " ".join(["stereotruth", *words]) in run.text


def test_the_command_starts_quickly(tmp_path):
    """Nothing heavy is imported before a stage is asked."""
    words = "import stereotruth.project.main, sys; print(*sys.modules)"
    loaded = set(call("-c", words, folder=tmp_path, command=[sys.executable]).text.split())
    assert "typer" in loaded
    assert not loaded & {"numpy", "numba", "rasterio", "snakemake", "xarray", "pydantic"}


@pytest.mark.slow
def test_the_wheel_brings_the_workflow_to_an_empty_environment(tmp_path):
    """Built of what a clone holds, installed alone; the dependencies are this environment's."""
    source, empty, python = tmp_path / "source", tmp_path / "empty", tmp_path / "venv/bin/python"
    source.mkdir()
    empty.mkdir()
    for name in ("pyproject.toml", "setup.py", "MANIFEST.in", "README.md", "LICENSE", "Snakefile"):
        shutil.copy(ROOT / name, source)
    for name in ("src", "workflow", "config", "profiles"):
        ignore = shutil.ignore_patterns("__pycache__", "*.egg-info")
        shutil.copytree(ROOT / name, source / name, ignore=ignore)
    (source / "kernels/made").mkdir(parents=True)
    (source / "kernels/made/file.nbi").touch()
    unwanted = ("PYTHONPATH", "NUMBA_CACHE_DIR")
    environment = {name: v for name, v in os.environ.items() if name not in unwanted}
    environment["PATH"] = f"{tmp_path / 'venv/bin'}:/usr/bin:/bin"
    environment["STEREOTRUTH_KERNELS"] = str(source / "kernels")

    def do(*command: str | Path) -> str:
        done = subprocess.run(
            command,
            cwd=empty,
            env=environment,
            text=True,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )
        assert done.returncode == 0, done.stdout
        return done.stdout

    quiet = ("--quiet", "--no-deps", "--no-index", "--disable-pip-version-check")
    pip = (sys.executable, "-m", "pip")
    do(*pip, "wheel", *quiet, "--no-build-isolation", "-w", tmp_path / "wheel", source)
    (wheel,) = (tmp_path / "wheel").glob("*.whl")
    shutil.rmtree(source)
    do(sys.executable, "-m", "venv", "--without-pip", tmp_path / "venv")
    do(*pip, "--python", python, "install", *quiet, "--ignore-installed", wheel)
    (site,) = (tmp_path / "venv/lib").glob("python*/site-packages")
    (site / "others.pth").write_text(sysconfig.get_path("purelib") + "\n")

    assert (site / "stereotruth/core/compiled/made/file.nbi").is_file()
    assert str(site) in do(python, "-c", "import stereotruth; print(stereotruth.__file__)")
    (said,) = site.glob("stereotruth-*.dist-info/METADATA")
    links = re.findall(r"\]\(([^)]*)\)", said.read_text("utf-8"))
    assert links and all(link.startswith("https:") for link in links)
    plan = do("stereotruth", "run", "--example", "tiles/Qichun", "--dry-run", "--cores", "1")
    assert re.search(r"^simulate_lidar +12 ", plan, re.M) and "shipped/profiles/default" in plan
    do("stereotruth", "init", "mine")
    assert (empty / "mine/config.yaml").is_file()
