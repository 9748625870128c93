"""The audit of a dataset: planted faults are found, good pairs pass, killed runs are carried on."""

from __future__ import annotations

import csv
import html
import json
import re
import warnings

import numpy as np
import pytest
import rasterio
from rasterio.errors import NotGeoreferencedWarning

from stereobench.audit import audit
from stereobench.audit.verdicts import FAULT, GOOD
from stereotruth.core.config.methods import Audit
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import write_table
from stereotruth.pages.page import PAPER
from stereotruth.pages.tables import minus
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.pair_with_block import make

LIMITS = Audit(contradicted_share=0.05, hidden_share=0.01)
ONE_SHOWN = LIMITS.model_copy(update={"worst": 1})


def write(path, values, nodata=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    profile = {
        "driver": "GTiff",
        "height": values.shape[0],
        "width": values.shape[1],
        "count": 1,
        "dtype": values.dtype,
        "nodata": nodata,
    }
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", **profile) as file:
            file.write(values, 1)


def add(root, number, scene, *, split="test", labels=None, nodata=-999.0):
    folder = root / split
    write(folder / "left" / f"KM_left_{number}.tiff", scene.left)
    write(folder / "right" / f"KM_right_{number}.tiff", scene.right)
    values = scene.labels if labels is None else labels
    stored = np.where(np.isfinite(values), values, np.float32(nodata))
    write(folder / "disp" / f"KM_disparity_{number}.tiff", stored, -999.0)


def dataset(root):
    return StereoDataset("mine", root, "whu", (-64, 64))


def read(out):
    with (out / "pairs.csv").open(newline="") as stream:
        rows = {row["pair"]: row for row in csv.DictReader(stream)}
    return rows, json.loads((out / "summary.json").read_text())


@pytest.fixture(scope="module")
def audited(tmp_path_factory):
    """A good pair, and one for each of many faults."""
    root = tmp_path_factory.mktemp("data")
    good = make(20)
    add(root, 0, good)
    add(root, 1, make(21), labels=make(21).labels + 2)
    add(root, 2, make(22, shift=(0.0, 1.0)))
    add(root, 3, make(23), labels=-make(23).labels)
    swapped = make(24, slope=0.15)
    swapped.left, swapped.right = swapped.right, swapped.left
    add(root, 4, swapped)
    add(root, 6, good, split="train")
    holes = make(27, offset=9.0)
    holes.labels[:, :90] = np.nan
    add(root, 7, holes, nodata=0.0)
    add(root, 8, make(28), nodata=-9999.0)
    add(root, 9, make(29), labels=make(29).exact)
    wrong = make(30)
    wrong.labels[195:285, 20:270] += 6
    add(root, 10, wrong)
    same = make(32)
    same.right = same.left
    add(root, 12, same)
    out = root / "audit" / "mine"
    shown = LIMITS.model_copy(update={"worst": 3})
    summary = audit.audit(dataset(root), out, shown, work=root / "work", workers=2)
    return root, out, summary


FAULTS = {
    "KM_1": ("bias", "label - match"),
    "KM_2": ("rows", "vertical parallax"),
    "KM_3": ("convention", "agree with the images as"),
    "KM_4": ("convention", "agree with the images as"),
    "KM_7": ("values", "nodata?"),
    "KM_8": ("values", "nodata?"),
    "KM_9": ("hidden", "behind others"),
    "KM_10": ("contradicted", "contradict"),
    "KM_12": ("files", "same"),
}


@pytest.mark.slow
def test_each_planted_fault_is_found_by_its_check(audited):
    rows, figures = read(audited[1])
    for pair, (check, words) in FAULTS.items():
        assert figures["checks"][check]["fault"], check
        assert rows[pair]["verdict"] == FAULT and words in rows[pair]["faults"], pair
    for pair in ("KM_0", "KM_6"):  # duplicates in two splits
        assert "the same image as" in rows[pair]["faults"]
    (shared,) = figures["shared"]
    assert {shared["first"], shared["second"]} == {"KM_0", "KM_6"}
    assert shared["share"] == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_what_is_written(audited):
    _, out, summary = audited
    names = ["README.txt", "index.html", "pairs.csv", "summary.json"]
    assert sorted(f.name for f in out.iterdir()) == names
    page = (out / "index.html").read_text()
    assert page.count('<article class="tile"') == 3 and "data:image/webp" in page
    assert "http" not in page.replace("http-equiv", "").replace(PAPER, "")
    assert not list(out.parent.glob(".*"))
    assert summary["verdicts"] == {"good": 0, "undecided": 0, "fault": 11}


@pytest.mark.slow
def test_the_page_shows_all_pairs_in_one_picture_and_each_fault_in_a_line(audited):
    """A mark stands on the side of its label bias and parallax."""
    rows, _ = read(audited[1])
    page = (audited[1] / "index.html").read_text()
    chart = re.search(r'<figure class="chart">.*?</figure>', page, re.DOTALL)[0]
    said = dict(re.findall(r"<title>(\w+): (.*?)</title>", chart))
    both = {name for name, row in rows.items() if row["parallax_px"] and row["label_bias_px"]}
    assert set(said) == both and len(both) >= 8
    for name in both:
        parallax, bias = (float(rows[name][key]) for key in ("parallax_px", "label_bias_px"))
        assert said[name] == minus(f"parallax {parallax:+.2f} px, label - match {bias:+.2f} px")
    marks = re.findall(r'<use [^>]*?x="([\d.]+)" y="([\d.]+)"[^>]*><title>(\w+):', chart)
    at = {name: (float(x), float(y)) for x, y, name in marks}
    assert at["KM_2"][0] > at["KM_1"][0]  # more parallax
    assert at["KM_1"][1] < at["KM_2"][1]  # more bias: further up
    line = re.search(r">KM_4(?:</a>)?</td>.*?</tr>", page.partition('id="pairs"')[2], re.DOTALL)[0]
    faults = line.rpartition("<td")[2].partition(">")[2].partition("</td>")[0]
    expected = rows["KM_4"]["faults"].replace("; ", "\n")
    assert html.unescape(faults) == re.sub(r"-(?=\d)", "−", expected)


@pytest.mark.slow
def test_good_pairs_pass_and_nothing_is_measured_twice(tmp_path, monkeypatch):
    root, out = tmp_path / "data", tmp_path / "out"
    for seed in range(2):
        add(root, seed, make(40 + seed), split=("train", "test")[seed % 2])
    whole = audit.measure
    seen = []

    def killed(of, pair):
        if seen:
            raise KeyboardInterrupt
        seen.append(pair.name)
        return whole(of, pair)

    monkeypatch.setattr(audit, "measure", killed)
    with pytest.raises(KeyboardInterrupt):
        audit.audit(dataset(root), out, ONE_SHOWN, work=tmp_path / "work")
    assert not out.exists()
    seen.clear()
    monkeypatch.setattr(audit, "measure", lambda of, p: (seen.append(p.name), whole(of, p))[1])
    summary = audit.audit(dataset(root), out, ONE_SHOWN, work=tmp_path / "work")
    assert len(seen) == 1
    assert summary["verdicts"][GOOD] == 2 and not summary["shared"]
    seen.clear()
    strict = LIMITS.model_copy(update={"parallax_px": 0.001})
    work = tmp_path / "work"
    assert audit.audit(dataset(root), out, strict, work=work)["verdicts"][GOOD] < 2
    audit.audit(dataset(root), out, ONE_SHOWN, work=work)
    assert not seen
    fresh = {"work": tmp_path / "fresh", "workers": 2}
    again = audit.audit(dataset(root), tmp_path / "again", ONE_SHOWN, **fresh)
    assert again == summary
    for file in out.iterdir():
        assert file.read_bytes() == (tmp_path / "again" / file.name).read_bytes(), file.name


def test_files_that_do_not_fit_are_named(tmp_path):
    scene = make(51)
    add(tmp_path, 1, scene, labels=scene.labels[:-5])
    scene.right[:] = 7
    add(tmp_path, 2, scene)
    audit.audit(dataset(tmp_path), tmp_path / "out", LIMITS, work=tmp_path / "work")
    rows, _ = read(tmp_path / "out")
    assert "differ in size" in rows["KM_1"]["faults"]
    assert "the right image is empty" in rows["KM_2"]["faults"]
    (tmp_path / "test/left/KM_left_1.tiff").write_bytes(b"no image")
    with pytest.raises(InputError, match="KM_left_1"):
        audit.audit(dataset(tmp_path), tmp_path / "out", LIMITS, work=tmp_path / "work")


def test_a_dataset_of_somebody_else_overwrites_nothing(tmp_path):
    """Its manifest names a pair by a path to a file of the user."""
    mine = tmp_path / "home/mine.npz"
    mine.parent.mkdir()
    mine.write_bytes(b"mine")
    add(tmp_path / "data", 1, make(3))
    root = tmp_path / "data/test"
    files = {kind: next((root / kind).iterdir()).relative_to(root) for kind in ("left", "right")}
    row = {"tile": "../../home/mine", "city": "x", "split": "none", "disp": "", **files}
    write_table(root / "manifest.csv", [row])
    given = StereoDataset("mine", root, "stereotruth", (-64, 64))
    with pytest.raises(InputError, match=r"manifest\.csv: line 2: tile"):
        audit.audit(given, tmp_path / "audit/x", LIMITS, work=tmp_path / "audit/.x.work")
    assert mine.read_bytes() == b"mine"
    assert not (tmp_path / "audit").exists()
