"""A method over a dataset: what is kept, made again and refused, and what is told of the method."""

from __future__ import annotations

import hashlib
import json
from importlib.metadata import version
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereobench.scores.prediction_files import read_prediction, read_record, read_uncertainty
from stereobench.scores.predictions import identity, predict
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import write_table
from stereotruth.core.products.rasters import read_disparity
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.images import write

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SHAPE = (8, 12)
CODE = """
import numpy as np
from pathlib import Path

def match(left, right, disparity_range, fail_at=None):
    log = Path("calls.txt")
    log.write_text((log.read_text() if log.exists() else "") + f"{int(left[0, 0])} ")
    if fail_at == left[0, 0]:
        raise KeyboardInterrupt
    disparity = left.astype(np.float32) / 8
    disparity[0] = np.nan
    return disparity
"""
METHOD = {"kind": "function", "function": "mine.py:match"}


@pytest.fixture
def dataset(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("mine.py").write_text(CODE)
    for n in (1, 2, 3):
        image = np.full(SHAPE, n, np.uint16)
        image[:, 3] += 40
        for kind in ("left", "right"):
            write(Path(f"data/test/{kind}/KM_{kind}_{n}.tiff"), image)
        write(Path(f"data/test/disp/KM_disparity_{n}.tiff"), np.full(SHAPE, n, np.float32))
    return StereoDataset("toy", Path("data"), "whu", (-8, 8))


def run(dataset, settings=METHOD, **more):
    return predict(dataset, "test", "mine", settings, "out", work=".work", **more)


def calls():
    file = Path("calls.txt")
    found = file.read_text().split() if file.exists() else []
    file.unlink(missing_ok=True)
    return found


def test_every_pair_is_matched_and_the_first_one_twice(dataset):
    record = run(dataset)
    assert calls() == ["1", "1", "2", "3"]
    assert {p.name for p in Path("out").iterdir()} == {
        *(f"KM_{n}.tiff" for n in (1, 2, 3)),
        "predictions.json",
    }
    for pair in dataset.pairs():
        found = read_prediction("out", pair)
        assert np.isnan(found[0]).all()
        assert found[1, 3] == (int(pair.name[-1]) + 40) / 8
    assert record == read_record("out") == json.loads(Path("out/predictions.json").read_text())
    assert record["median_seconds"] >= 0 and record["peak_memory_mb"] > 10
    assert set(record["pairs"]) == {"KM_1", "KM_2", "KM_3"}


def test_an_interrupted_run_is_carried_on(dataset):
    with pytest.raises(KeyboardInterrupt):
        run(dataset, METHOD | {"options": {"fail_at": 3}})
    assert calls() == ["1", "1", "2", "3"] and not Path("out").exists()
    # the option is part of what the pairs are made of, so nothing of it is taken over
    with pytest.raises(KeyboardInterrupt):
        run(dataset, METHOD | {"options": {"fail_at": 2}})
    assert calls() == ["1", "1", "2"]
    write(Path("data/test/left/KM_left_2.tiff"), np.full(SHAPE, 5, np.uint16))
    run(dataset, METHOD | {"options": {"fail_at": 2}})
    assert calls() == ["5", "5", "3"]
    assert read_disparity("out/KM_2.tiff")[1, 1] == 5 / 8


@pytest.mark.slow
def test_only_what_a_pair_is_made_of_has_it_matched_again(dataset):
    files = {"files": ["mine.py"]}
    run(dataset, **files)
    assert len(calls()) == 4
    first = read_record("out")
    write(Path("data/test/disp/KM_disparity_2.tiff"), np.zeros(SHAPE, np.float32))  # a label
    assert run(dataset, **files) == first and calls() == []
    told = run(dataset, METHOD | {"licence": "MIT", "version": "3"}, **files)
    assert told["identity"]["licence"] == "MIT" and calls() == []
    assert list(told["identity"]["files"]) == ["mine.py"] and told["machine"]["cores"] >= 1
    run(dataset, **files, code="other")
    assert len(calls()) == 4
    Path("mine.py").write_text(CODE + "\n# another")
    run(dataset, **files, code="other")
    assert len(calls()) == 4
    for kind in ("left", "right", "disp"):
        next(Path(f"data/test/{kind}").glob("*_3.tiff")).unlink()
    Path("out/KM_2.tiff").write_bytes(b"spoilt")
    run(dataset, **files, code="other")
    assert calls() == ["2", "2"]
    assert {file.name for file in Path(".work").glob("*.tiff")} == {"KM_1.tiff", "KM_2.tiff"}
    assert read_prediction("out", dataset.pairs()[1])[1, 1] == 2 / 8


def test_a_folder_of_results_is_taken_over(dataset):
    folder = Path("theirs")
    folder.mkdir()
    truth = np.arange(96, dtype=np.float32).reshape(SHAPE)
    truth[0, 0], truth[0, 1] = -999, np.nan
    write(folder / "KM_1.tif", truth)
    np.save(folder / "KM_2.npy", truth.astype(np.float64))
    cv2.imwrite(str(folder / "KM_3.pfm"), np.nan_to_num(truth, nan=np.inf))
    record = run(dataset, {"kind": "folder", "folder": "theirs"})
    expected = np.where(truth >= 0, truth, np.nan)
    for pair in dataset.pairs():
        assert np.array_equal(read_prediction("out", pair), expected, equal_nan=True), pair.name
    assert record["median_seconds"] is None and record["peak_memory_mb"] is None


def test_what_a_folder_lacks_is_told(dataset):
    settings = {"kind": "folder", "folder": "theirs"}
    with pytest.raises(InputError, match="no such folder"):
        run(dataset, settings)
    write(Path("theirs/KM_1.tif"), np.zeros(SHAPE, np.float32))
    with pytest.raises(InputError, match="no result for pair KM_2"):
        run(dataset, settings)
    write(Path("theirs/KM_2.tif"), np.zeros((3, 3), np.float32))
    write(Path("theirs/KM_3.tif"), np.zeros(SHAPE, np.float32))
    with pytest.raises(InputError, match=r"KM_2 is \(3, 3\), its image \(8, 12\)"):
        run(dataset, settings)
    with pytest.raises(InputError, match="polarity cannot change a folder"):
        run(dataset, settings | {"polarity": "positive"})


UNCERTAIN = """
import numpy as np

def match(left, right, disparity_range, stated=True):
    disparity = left.astype(np.float32) / 8
    uncertainty = np.where(left > 20, np.nan, disparity + 1)
    return (disparity, uncertainty) if stated else disparity

def negative(left, right, disparity_range):
    return left * 0.0, left * 0.0 - 1
"""


@pytest.mark.slow
def test_uncertainties_are_kept_beside_the_disparities(dataset):
    Path("mine.py").write_text(UNCERTAIN)
    for moved in ({}, {"polarity": "positive"}):
        run(dataset, METHOD | moved)
        for number, pair in enumerate(dataset.pairs(), start=1):
            shift = 8 * bool(moved)  # of the range, which begins at -8 px
            assert np.all(read_prediction("out", pair)[:, 4:] == number / 8 - shift)
            found = read_uncertainty("out", pair)
            assert np.isnan(found[:, 3]).all() and np.all(found[:, 4:] == number / 8 + 1)
    Path("out/predictions.json").unlink()
    before = Path("out/uncertainty/KM_2.tiff").read_bytes()
    Path("out/uncertainty/KM_2.tiff").unlink()
    run(dataset, METHOD | {"polarity": "positive"})
    assert Path("out/uncertainty/KM_2.tiff").read_bytes() == before
    # one that states none leaves none of an earlier one
    run(dataset, METHOD | {"options": {"stated": False}})
    assert not Path("out/uncertainty").exists() and read_uncertainty("out", pair) is None
    with pytest.raises(InputError, match="uncertainty of pair KM_1 is below 0"):
        run(dataset, {"kind": "function", "function": "mine.py:negative"})


def test_a_dataset_of_somebody_else_overwrites_nothing(dataset):
    """Its manifest names a pair by a path to a file of the user."""
    mine = Path("mine.tiff")
    mine.write_bytes(b"mine")
    root = dataset.root / "test"
    row = {"tile": str(mine.absolute().with_suffix("")), "city": "x", "split": "test"}
    files = {"left": "left/KM_left_1.tiff", "right": "right/KM_right_1.tiff", "disp": ""}
    write_table(root / "manifest.csv", [row | files])
    given = StereoDataset("toy", root, "stereotruth", (-8, 8))
    with pytest.raises(InputError, match=r"manifest\.csv: line 2: tile"):
        predict(given, None, "mine", METHOD, "out", work=".work")
    assert mine.read_bytes() == b"mine" and not Path("out").exists()


@pytest.mark.parametrize(
    "text",
    ['{"pairs": {"../../x": {}}}', '{"pairs": {"/etc/x": {}}}', '{"pairs": []}', "[]", "{"],
)
def test_a_folder_of_predictions_of_somebody_else_names_no_other_place(tmp_path, text):
    (tmp_path / "predictions.json").write_text(text)
    with pytest.raises(InputError, match=r"predictions\.json: (the name of a pair|no record)"):
        read_record(tmp_path)


def test_sgm_is_that_of_opencv():
    found = identity({"kind": "sgm"}, code="abc")
    assert found["version"].startswith("opencv-python") and found["licence"].startswith("Apache")
    assert found["code"] == "abc" and found["files"] == {}


def test_a_function_is_of_its_distribution(tmp_path):
    found = identity({"kind": "function", "function": "scipy.ndimage:shift"})
    assert found["version"] == f"scipy {version('scipy')}" and "BSD" in found["licence"]
    of_a_file = identity({"kind": "function", "function": "mine.py:f"})
    assert of_a_file["version"] is of_a_file["licence"] is of_a_file["code"] is None


def test_what_the_entry_says_counts_and_files_have_checksums(tmp_path):
    for name in ("weights.pt", "code/infer.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(name)
    files = [tmp_path / "weights.pt", tmp_path / "code/infer.py"]
    found = identity({"kind": "command", "licence": "MIT", "version": "2.1"}, files)
    assert (found["licence"], found["version"]) == ("MIT", "2.1")
    assert found["files"] == {
        name: hashlib.sha256(name.encode()).hexdigest() for name in ("weights.pt", "code/infer.py")
    }
    other = identity({"kind": "command"})
    assert other["licence"] is other["version"] is None
