"""A board of submissions: the same bytes anywhere, and what is forged is refused by its file."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import cv2
import numpy as np
import pytest
import yaml
import zarr

from stereobench.scores.board import make_board
from stereobench.scores.prediction_files import FILE, pack
from stereobench.scores.predictions import predict
from stereobench.scores.score_method import ScoringPlan, score
from stereobench.scores.submissions import ADMITTED
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import write_table
from stereotruth.core.products.grids import seal as seal_store
from stereotruth.core.products.provenance import file_sha256
from stereotruth.core.products.rasters import read_disparity
from stereotruth.tiles.seals import open_seal, seal_dataset
from stereotruth.tiles.stereo_dataset import StereoDataset, find_pairs

from ...synthetic.images import write

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SIZE, PAIRS = 16, range(1, 6)
SHAPE = (SIZE, SIZE)
OFF = {"near": 0.2, "mine": 0.3, "far": 2.0}  # px, what methods are off


def map_of(truth: np.ndarray, off: float, n: int) -> np.ndarray:
    found = truth + np.float32(off * (1 + n / 20))
    found[:2] = np.nan
    return found


def facts_of(name: str, **more) -> dict:
    of = {"label": name.title(), "by": f"Group {name}", "licence": "MIT", "trained_on": "nothing"}
    return {**of, "dataset": "toy", "seed": None, **more}


def seal(folder: Path, facts: dict) -> None:
    """Write ``submission.json`` with the checksums of what lies in the folder."""
    files = {f.name: file_sha256(f) for f in sorted(folder.iterdir()) if f.name != FILE}
    (folder / FILE).write_text(json.dumps({**facts, "files": files}))


def stated(folder: Path) -> dict:
    return json.loads((folder / FILE).read_text())


@pytest.fixture(scope="session")
def made(tmp_path_factory) -> Path:
    """A board of three submissions that are admitted; one states its scores."""
    top = tmp_path_factory.mktemp("board")
    rng = np.random.default_rng(0)
    truths = {}
    for n in (*PAIRS, 9):
        truth = truths[n] = rng.uniform(1, 6, SHAPE).astype(np.float32)
        truth[:, :2] = np.nan
        image = rng.integers(1, 900, SHAPE).astype(np.uint16)
        for kind, array in (("left", image), ("right", image), ("disparity", truth)):
            place = "disp" if kind == "disparity" else kind
            split = "train" if n == 9 else "test"
            write(top / "data" / split / place / f"KM_{kind}_{n}.tiff", array)
    for name, off in OFF.items():
        folder = top / ("results" if name == "mine" else "submissions") / name
        for n in PAIRS:
            write(folder / f"KM_{n}.tif", map_of(truths[n], off, n))
        seal(folder, facts_of(name)) if name != "mine" else None
    of = StereoDataset("toy", top / "data", "whu", (-8, 16))
    entry = {"kind": "folder", "folder": str(top / "results/mine"), "licence": "MIT"}
    entry |= {"trained_on": ["us3d"], "by": "Group mine", "seed": 1}
    predict(of, "test", "mine", entry, top / "match", work=top / "work")
    plan = ScoringPlan([3, 1], 0, 0, 0)
    score(of, "test", "Mine", top / "match", top / "scored", plan)
    pack(top / "match", top / "scored", top / "submissions/mine")
    datasets = {"toy": {"root": "data", "layout": "whu", "disparity_range": [-8, 16]}}
    (top / "board.yaml").write_text(yaml.safe_dump({"title": "Toy", "datasets": datasets}))
    assert make_board(top, take_in=True) == []
    return top


def bytes_of(site: Path) -> dict[str, bytes]:
    return {f.relative_to(site).as_posix(): f.read_bytes() for f in site.rglob("*") if f.is_file()}


def board_of(folder: Path) -> dict:
    return json.loads((folder / "site/board.json").read_text(encoding="utf-8"))


def test_methods_are_ranked_with_intervals_by_one_protocol(made):
    (of,) = board_of(made)["boards"]
    assert of["definition"]["id"].startswith("own-") and of["pairs"] == 5
    assert [(row["method"], row["rank"]) for row in of["methods"]] == [
        ("Near", 1), ("Mine", 2), ("Far", 3),
    ]  # fmt: skip
    first = of["methods"][0]
    assert first["filled_epe_px_low"] < first["filled_epe_px"] < first["filled_epe_px_high"]
    assert 0.2 < first["filled_epe_px"] < 0.5 and first["level_with"] == []
    assert [(row["method"], row["less"]) for row in of["differences"]] == [
        ("Mine", "Near"), ("Far", "Near"), ("Far", "Mine"),
    ]  # fmt: skip
    assert of["methods"][1]["seeds"] == [1] and of["methods"][1]["trained_on"] == "us3d"
    for name in OFF:
        badge = ElementTree.parse(made / f"site/badges/{name}.svg").getroot()
        assert of["definition"]["id"] in badge.get("aria-label")
        for n in PAIRS:
            picture = cv2.imread(str(made / f"site/errors/{name}/KM_{n}.png"), cv2.IMREAD_UNCHANGED)
            assert picture.dtype == np.uint8 and picture.shape[:2] == SHAPE
    (task,) = json.loads((made / "site/papers_with_code.json").read_text())
    sota = task["datasets"][0]["sota"]
    assert [row["model_name"] for row in sota["rows"]] == ["Near", "Mine", "Far"]
    assert all(set(row["metrics"]) == set(sota["metrics"]) for row in sota["rows"])


def test_a_board_by_exact_truth_needs_it_and_refuses_scores_by_labels(made, tmp_path):
    """The exact truth is a px above the labels: what was 0.2 px above them is 0.8 px below it."""
    top = copied(made, tmp_path)
    rows, store = [], top / "project/results/truth/Kunming/K-1.zarr"
    truth = np.full((SIZE * 6, SIZE), np.nan, np.float32)
    for n in PAIRS:
        row = {"tile": f"KM_{n}", "city": "Kunming", "scene": "K-1", "split": "test"}
        row |= {"row0": SIZE * n, "col0": 0, "size": SIZE, "right_offset_px": 0, "complete": "yes"}
        for kind, word in (("left", "left"), ("right", "right"), ("disp", "disparity")):
            row[kind] = f"test/{kind}/KM_{word}_{n}.tiff"
        rows.append(row)
        labels = cv2.imread(str(top / "data" / row["disp"]), cv2.IMREAD_UNCHANGED)
        truth[SIZE * n : SIZE * (n + 1)] = labels + 1
    write_table(top / "data/manifest.csv", rows)
    layers = dict.fromkeys(("changed", "changed_right", "hidden", "surface"), truth * 0)
    group = zarr.open_group(store, mode="w")
    group.attrs["complete"] = True
    for name, values in (layers | {"visible": np.isfinite(truth), "disparity": truth}).items():
        group.create_array(name, data=np.nan_to_num(values))
    seal_store(store)
    settings = yaml.safe_load((top / "board.yaml").read_text())
    of = settings["datasets"]["toy"]
    of |= {"layout": "stereotruth", "protocol": "exact-2026", "disparity_range": [-64, 128]}
    (top / "board.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(InputError):
        make_board(top)
    of["project"] = "project"
    (top / "board.yaml").write_text(yaml.safe_dump(settings))
    (line,) = make_board(top)
    assert line.startswith(f"mine/{FILE}: ")
    (board,) = board_of(top)["boards"]
    near, far = (row["filled_epe_px"] for row in board["methods"])
    assert board["definition"]["id"].startswith("exact-2026-")
    assert 0.8 < near < 1.0 < far < 1.6


def test_runs_of_a_method_are_one_row_and_a_program_is_run(made, tmp_path):
    top = copied(made, tmp_path)
    for seed in (2, 3):
        folder = top / f"submissions/mine-{seed}"
        shutil.copytree(top / "submissions/far", folder)
        for n in PAIRS:
            truth = cv2.imread(str(top / f"data/test/disp/KM_disparity_{n}.tiff"), -1)
            write(folder / f"KM_{n}.tif", map_of(truth, 0.3 + seed / 100, n))
        seal(folder, facts_of("mine", seed=seed))
    program = top / "submissions/program"
    program.mkdir()
    (program / "grey.py").write_text(
        "import csv, sys, cv2\nopen(__file__ + '.left', 'w')\n"
        "for left, _, out in csv.reader(open(sys.argv[1])):\n"
        "    cv2.imwrite(out, (cv2.imread(left, -1) % 7).astype('float32'))\n"
    )
    (program / "requirements.lock").write_text("opencv-python-headless==5 --hash=sha256:0\n")
    command = f"{sys.executable} {{folder}}/grey.py {{pairs}}"
    run = {"command": command, "pairs": "file", "lock": "requirements.lock"}
    seal(program, facts_of("program", program=run))
    assert make_board(top, take_in=True) == []
    rows = {row["method"]: row for row in board_of(top)["boards"][0]["methods"]}
    assert rows["Mine"]["submissions"] == ["mine", "mine-2", "mine-3"]
    assert rows["Program"]["rank"] > rows["Mine"]["rank"] and rows["Program"]["seeds"] == [None]
    seal(program, facts_of("program", program={"command": command}))
    (line,) = make_board(top)
    assert line.startswith(f"program/{FILE}: ")


def test_a_program_whose_runs_differ_is_refused_unless_it_states_so(made, tmp_path):
    top = copied(made, tmp_path)
    program = top / "submissions/dice"
    program.mkdir()
    (program / "dice.py").write_text(
        "import csv, os, sys, cv2\n"
        "for left, _, out in csv.reader(open(sys.argv[1])):\n"
        "    found = cv2.imread(left, -1) % 7 + int.from_bytes(os.urandom(4)) / 2**32\n"
        "    cv2.imwrite(out, found.astype('float32'))\n"
    )
    (program / "requirements.lock").write_text("")
    command = f"{sys.executable} {{folder}}/dice.py {{pairs}}"
    facts = facts_of("dice", program={"command": command, "pairs": "file"})
    facts["program"]["lock"] = "requirements.lock"
    seal(program, facts)
    (line,) = make_board(top, take_in=True)
    assert line.startswith(f"dice/{FILE}: ") and "KM_1" in line
    seal(program, facts | {"random": True})
    assert make_board(top, take_in=True) == []
    rows = {row["method"]: row for row in board_of(top)["boards"][0]["methods"]}
    assert rows["Dice"]["random"] and not rows["Mine"]["random"]


def copied(made: Path, to: Path) -> Path:
    to.mkdir(parents=True, exist_ok=True)
    for name in ("data", "submissions"):
        shutil.copytree(made / name, to / name)
    for name in ("board.yaml", ADMITTED):
        shutil.copyfile(made / name, to / name)
    return to


MACHINE = """
import os, sys, locale
os.umask(int(sys.argv[2], 8))
locale.setlocale(locale.LC_ALL, sys.argv[3])
from pathlib import Path
from stereobench.scores.board import make_board
make_board(Path(sys.argv[1]))
"""


def test_another_folder_has_the_same_bytes(made, tmp_path):
    top = copied(made, tmp_path / "zz other" / "deeper")
    (top / "submissions/mine/.DS_Store").write_text("of a file manager")
    before = os.umask(0o077)
    try:
        assert make_board(top) == []
    finally:
        os.umask(before)
    assert bytes_of(top / "site") == bytes_of(made / "site")


@pytest.mark.slow
def test_another_machine_makes_the_same_bytes(made, tmp_path):
    """Another folder, umask, locale, time zone, number of cores, and fewer vector units."""
    top = copied(made, tmp_path / "other")
    more = {"TZ": "Asia/Tokyo", "LC_ALL": "C.UTF-8", "OMP_NUM_THREADS": "2", "PYTHONHASHSEED": "7"}
    more |= {"NPY_DISABLE_CPU_FEATURES": "AVX512F AVX512_SKX AVX2 FMA3", "COLUMNS": "40"}
    words = [sys.executable, "-c", MACHINE, str(top), "077", "C"]
    subprocess.run(words, env=os.environ | more, check=True, capture_output=True, cwd=tmp_path)
    assert bytes_of(top / "site") == bytes_of(made / "site")


# ------------------------------------------------------------------------------- forgeries


def tile(change, n: int = 3):
    """An edit of a tile's values; its file is named."""

    def edit(folder: Path) -> str:
        file = folder / f"KM_{n}.tif"
        write(file, change(cv2.imread(str(file), cv2.IMREAD_UNCHANGED)))
        return file.name

    return edit


def fact(**values):
    """An edit of what is stated; ``submission.json`` is named."""

    def edit(folder: Path) -> str:
        (folder / FILE).write_text(json.dumps(stated(folder) | values))
        return FILE

    return edit


def without_tile(folder: Path) -> str:
    (folder / "KM_3.tif").unlink()
    return "KM_3.tif"


def of_another_split(folder: Path) -> str:
    shutil.copyfile(folder / "KM_3.tif", folder / "KM_9.tif")
    return "KM_9.tif"


def two_tiles_exchanged(folder: Path) -> str:
    for n, to in ((2, "x"), (3, 2), ("x", 3)):
        (folder / f"KM_{n}.tif").rename(folder / f"KM_{to}.tif")
    return "KM_2.tif"


def borrowed(folder: Path) -> str:
    for n in PAIRS:
        shutil.copyfile(folder.parent / f"near/KM_{n}.tif", folder / f"KM_{n}.tif")
    fact(scores=None)(folder)
    return FILE


def borrowed_with_nodata(folder: Path) -> str:
    for n in PAIRS:
        file = folder.parent / f"near/KM_{n}.tif"
        write(folder / f"KM_{n}.tif", np.nan_to_num(read_disparity(file), nan=-999.0))
    fact(scores=None)(folder)
    return FILE


def better_numbers(folder: Path) -> str:
    scores = stated(folder)["scores"]
    scores["cities"][0]["filled_epe_px"] -= 0.01
    return fact(scores=scores)(folder)


def other_protocol(folder: Path) -> str:
    scores = stated(folder)["scores"]
    scores["protocol"]["id"] = "whu-2023-00000000"
    return fact(scores=scores)(folder)


def no_json(folder: Path) -> str:
    (folder / FILE).write_text("{")
    return FILE


def leads_elsewhere(folder: Path) -> str:
    return fact(files=stated(folder)["files"] | {"../near/KM_1.tif": "0"})(folder)


def with_value(value: float):
    def change(values: np.ndarray) -> np.ndarray:
        values[4:9] = value
        return values

    return change


SINCE = {  # edits of a folder that was admitted
    "a changed tile": tile(lambda v: v + np.float32(0.001)),
    "other nodata": tile(lambda v: np.where(np.isnan(v), np.float32(-9999), v)),
    "a tile left out": without_tile,
    "a tile of another split": of_another_split,
    "two tiles exchanged": two_tiles_exchanged,
    "numbers edited": better_numbers,
    "other protocol": other_protocol,
    "other licence": fact(licence="CC0-1.0"),
    "another's name": fact(by="Group near"),
    "another method's label": fact(label="Near"),
    "other training data": fact(trained_on="nothing"),
    "other seed": fact(seed=2),
    "other dataset": fact(dataset="another"),
    "no submission left": no_json,
    "a path that leads elsewhere": leads_elsewhere,
}
AT_THE_DOOR = {  # folders that come so, with checksums that hold
    "a tile that its scores do not have": lambda f: (tile(lambda v: v + 1)(f), FILE)[1],
    "a tile left out": without_tile,
    "a tile of another split": of_another_split,
    "NaN everywhere": tile(lambda v: v * np.nan),
    "infinite": tile(with_value(np.inf)),
    "another size": tile(lambda v: v[:-1]),
    "two bands": tile(lambda v: np.dstack([v, v, v])),
    "the other sign": lambda f: [tile(np.negative, n)(f) for n in reversed(PAIRS)][-1],
    "nodata that nobody declares": tile(with_value(-9999.0)),
    "numbers edited": better_numbers,
    "other protocol": other_protocol,
    "no licence": fact(licence=" "),
    "no training data": fact(trained_on="not stated"),
    "another's identity": fact(label="Near", by="Group near", seed=None),
    "another's disparities": borrowed,
    "another's disparities, other nodata": borrowed_with_nodata,
    "another dataset": fact(dataset="another"),
    "a program without its lock": fact(program={"command": "x {left} {right} {out}"}),
    "a seed that is none": fact(seed="1"),
}
SCORELESS = ("the other sign", "nodata that nobody declares")  # else its scores tell it first


FORGED = [*SINCE, *(f"at the door: {name}" for name in AT_THE_DOOR)]


@pytest.fixture(scope="module")
def forged(made, tmp_path_factory):
    """A board with all forgeries side by side: file and sentence of each folder that is refused."""
    top = copied(made, tmp_path_factory.mktemp("forged"))
    mine = (top / "submissions/mine").rename(top / "mine")
    known = (top / ADMITTED).read_text().replace("mine", "since-0")
    known += "".join(
        known.splitlines()[2].replace("-0", f"-{k}") + "\n" for k in range(1, len(SINCE))
    )
    (top / ADMITTED).write_text(known)
    files = {}
    for k, (kind, edit) in enumerate([*SINCE.items(), *AT_THE_DOOR.items()]):
        since = k < len(SINCE)
        folder = top / "submissions" / (f"since-{k}" if since else f"door-{k}")
        shutil.copytree(mine, folder)
        files[FORGED[k]] = f"{folder.name}/{edit(folder)}"
        if not since:
            seal(folder, stated(folder) | ({"scores": None} if kind in SCORELESS else {}))
    refused = dict(line.split(": ", 1) for line in make_board(top, take_in=True))
    return files, refused, board_of(top)


@pytest.mark.parametrize("name", FORGED)
def test_what_is_forged_is_refused_by_its_file(forged, name):
    files, refused, board = forged
    assert files[name] in refused
    assert files[name] in [of["file"] for of in board["refused"]]
    assert [row["method"] for row in board["boards"][0]["methods"]] == ["Near", "Far"]


def test_what_is_not_admitted_is_refused_and_so_is_a_board_without_settings(made, tmp_path):
    top = copied(made, tmp_path)
    (top / ADMITTED).unlink()
    assert [line.partition(":")[0] for line in make_board(top)] == [
        f"{name}/{FILE}" for name in ("far", "mine", "near")
    ]
    (top / "board.yaml").write_text("title: 1\n")
    with pytest.raises(InputError):
        make_board(top)


def test_a_refused_submission_is_admitted_once_it_is_mended(made, tmp_path):
    top = copied(made, tmp_path)
    before = (top / ADMITTED).read_text()
    place = top / "submissions/later"
    shutil.copytree(top / "submissions/far", place)
    seal(place, facts_of("far") | {"label": "Later", "licence": ""})
    (line,) = make_board(top, take_in=True)
    assert line.startswith(f"later/{FILE}: ") and "Remedy: " in line
    assert (top / ADMITTED).read_text() == before
    for file in sorted(place.glob("*.tif")):  # no copy of the other's
        write(file, read_disparity(file) + np.float32(0.25))
    seal(place, facts_of("far") | {"label": "Later"})
    (place / ".snakemake_timestamp").touch()  # of the rule that packs
    assert make_board(top, take_in=True) == []
    assert (top / ADMITTED).read_text().startswith(before)
    shutil.rmtree(place)
    (line,) = make_board(top)
    assert line.startswith("later: ") and ADMITTED in line


def test_a_board_of_a_sealed_set_takes_no_other_labels(made, tmp_path):
    top = copied(made, tmp_path)
    (top / "data").rename(top / "whole")
    seal_dataset(top / "whole", find_pairs(top / "whole", "whu"), "test", top / "data")
    settings = yaml.safe_load((top / "board.yaml").read_text())
    with pytest.raises(InputError):  # sealed as yet
        make_board(top)
    open_seal(top / "data", top / "whole")
    settings["datasets"]["toy"]["seal"] = sealed = StereoDataset(
        "", top / "data", "whu", (0, 1)
    ).seal
    (top / "board.yaml").write_text(yaml.safe_dump(settings))
    assert make_board(top) == []
    assert board_of(top)["boards"][0]["seal"] == sealed
    label = top / "data/test/disp/KM_disparity_2.tiff"
    write(label, np.ones(SHAPE, np.float32))
    with pytest.raises(InputError) as refused:
        make_board(top)
    assert refused.value.file == str(label)
    settings["datasets"]["toy"]["seal"] = "0" * 64
    (top / "board.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(InputError):
        make_board(top)
