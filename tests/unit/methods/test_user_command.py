"""Programs of their own as methods: the bytes of the method in them, what fails, what stays."""

from __future__ import annotations

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from stereobench.methods.kinds import KINDS
from stereobench.methods.matcher import BatchMatcher, ImagePair
from stereobench.methods.methods import make_method
from stereobench.scores.predictions import predict
from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import read_image
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.images import write

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
SHAPE = (60, 150)
RANGE = (-16, 16)
SGM = """
import csv, sys
from pathlib import Path
import numpy as np
from stereobench.methods.sgm import SemiGlobalMatcher
from stereotruth.core.products.rasters import read_image, write_disparity

def infer(left, right, out, low, high):
    found = SemiGlobalMatcher()(read_image(left), read_image(right), (int(low), int(high)))
    write_disparity(Path(out), found)

if len(sys.argv) == 6:
    infer(*sys.argv[1:])
else:
    with open(sys.argv[1], newline="") as stream:
        for row in csv.reader(stream):
            infer(*row, *sys.argv[2:])
"""
EACH = {
    "kind": "command",
    "command": f"'{sys.executable}' infer.py {{left}} {{right}} {{out}} {{low}} {{high}}",
}
FILE = {
    "kind": "command",
    "command": f"'{sys.executable}' infer.py {{pairs}} {{low}} {{high}}",
    "pairs": "file",
}
# writes constant disparities; it fails at images that have 9 in their first pixel
TOY = """
import csv, os, sys, time
import numpy as np, cv2
(*_, name) = sys.argv
for left, right, out in csv.reader(open(sys.argv[1])):
    image = cv2.imread(left, -1)
    open("calls.txt", "a").write(f"{os.path.basename(left)} ")
    if image.flat[0] == 9 and not os.path.exists("mended"):
        print("all weights loaded")
        print("out of memory: no such luck", file=sys.stderr)
        sys.exit(3)
    np.save(out, np.full(image.shape[:2], float(image.flat[0])))
"""


def images(seed):
    rng = np.random.default_rng(seed)
    texture = gaussian_filter(rng.uniform(size=(SHAPE[0], SHAPE[1] + 40)), 0.8)
    texture = (500 + 3000 * (texture - texture.min()) / np.ptp(texture)).astype(np.uint16)
    return texture[:, 20 - 7 : 20 - 7 + SHAPE[1]], texture[:, 20 : 20 + SHAPE[1]]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def dataset(here):
    for n in (1, 2, 3):
        for kind, image in zip(("left", "right"), images(n)):
            write(Path(f"data/test/{kind}/KM_{kind}_{n}.tiff"), image)
        write(Path(f"data/test/disp/KM_disparity_{n}.tiff"), np.full(SHAPE, 7, np.float32))
    return StereoDataset("toy", Path("data"), "whu", RANGE)


def run(dataset, settings, out, name="theirs"):
    files = KINDS[settings["kind"]].files(settings)
    return predict(dataset, "test", name, settings, out, work=f".{out}", files=files)


def maps(folder):
    return {file.name: file.read_bytes() for file in sorted(Path(folder).glob("*.tiff"))}


@pytest.mark.slow
@pytest.mark.parametrize("moved", [{}, {"polarity": "positive", "outside": "invalid"}])
@pytest.mark.parametrize("settings", [EACH, FILE], ids=["each", "file"])
def test_a_program_around_sgm_gives_the_bytes_of_sgm(dataset, settings, moved):
    Path("infer.py").write_text(SGM)
    if moved:  # of images of 8 bits, since the grey values of deeper ones are mapped by statistics
        for file in Path("data").rglob("KM_[lr]*.tiff"):
            write(file, (read_image(file) // 16).astype(np.uint8))
    run(dataset, {"kind": "sgm", **moved}, "sgm")
    record = run(dataset, settings | moved, "theirs")
    assert maps("theirs") == maps("sgm") and len(maps("sgm")) == 3
    for pair in record["pairs"].values():
        assert 0 <= pair["seconds"] < 60 and pair["memory_mb"] > 20
    if settings is EACH:  # with the start of Python and its imports
        assert record["median_seconds"] > 0.1
    json.dumps(record)


def constant(value, shape=(4, 6), dtype=np.uint16):
    image = np.full(shape, value, dtype)
    return ImagePair(f"p{value}", image, image)


def toy(**more):
    command = f"'{sys.executable}' toy.py {{pairs}}"
    settings = {"kind": "command", "command": command, "pairs": "file", "suffix": ".npy"}
    return make_method("toy", settings | more)


def test_many_pairs_are_one_call_in_their_order(here, monkeypatch):
    Path("toy.py").write_text(TOY)
    method = toy()
    assert isinstance(method, BatchMatcher)
    found = list(method.many([constant(n) for n in (5, 3, 4)], RANGE))
    assert [float(of.disparity[0, 0]) for of in found] == [5, 3, 4]
    assert found[0].disparity.dtype == np.float32
    assert Path("calls.txt").read_text().split() == [f"p{n}_left.tif" for n in (5, 3, 4)]
    monkeypatch.setattr("stereobench.methods.user_methods.MOST_PAIRS", 2)
    found = list(toy().many([constant(n) for n in (5, 3, 4)], RANGE))
    assert [float(of.disparity[0, 0]) for of in found] == [5, 3, 4]


def test_colour_and_floats_reach_the_program_as_they_are(here):
    code = "import rasterio, sys, numpy as np; a = rasterio.open(sys.argv[1]).read()[-1]; "
    Path("last.py").write_text(code + "np.save(sys.argv[3], a)")
    command = f"'{sys.executable}' last.py {{left}} {{right}} {{out}}"
    method = make_method("m", {"kind": "command", "command": command, "suffix": ".npy"})
    rng = np.random.default_rng(1)
    colour = rng.integers(0, 255, (5, 7, 3), np.uint8)
    assert np.array_equal(method(colour, colour, RANGE), colour[..., 2])
    grey = rng.uniform(0, 9, (5, 7)).astype(np.float32)
    assert np.array_equal(method(grey, grey, RANGE), grey)


def test_a_program_that_fails_is_named_with_its_last_words_and_keeps_what_it_did(dataset):
    Path("toy.py").write_text(TOY)
    for side in ("left", "right"):
        image = np.full(SHAPE, 9, np.uint16)
        write(Path(f"data/test/{side}/KM_{side}_3.tiff"), image)
    command = f"'{sys.executable}' toy.py {{pairs}}"
    settings = {"kind": "command", "command": command, "pairs": "file", "suffix": ".npy"}
    Path("mended").touch()
    assert len(run(dataset, settings, "whole")["pairs"]) == 3
    Path("mended").unlink()
    Path("calls.txt").unlink()
    with pytest.raises(InputError) as caught:
        run(dataset, settings, "out")
    text = str(caught.value)
    assert "'theirs', pair KM_3: the program ended with status 3" in text
    assert "out of memory: no such luck" in text and "toy.py" in text
    assert not Path("out").exists()
    Path("mended").touch()
    Path("calls.txt").unlink()
    run(dataset, settings, "out")
    # KM_1 was there; KM_2, the last that was written, might have been half written
    assert Path("calls.txt").read_text().split() == ["KM_2_left.tif", "KM_3_left.tif"]
    assert maps("out") == maps("whole")


def test_what_is_wrong_with_a_program_is_told(here):
    pair = np.ones((4, 6), np.uint16), np.ones((4, 6), np.uint16), RANGE

    def command(code, **more):
        Path("own.py").write_text(code)
        words = f"'{sys.executable}' own.py {{left}} {{right}} {{out}}"
        return make_method("m", {"kind": "command", "command": words, **more})

    with pytest.raises(InputError, match=r"wrote no disparities of pair pair; it said nothing"):
        command("")(*pair)
    with pytest.raises(InputError, match=r"signal 9.*ends with:\nhello"):
        command("import os; print('hello', flush=True); os.kill(os.getpid(), 9)")(*pair)
    small = "import sys, numpy as np; np.save(sys.argv[3], np.zeros((1, 2)))"
    with pytest.raises(InputError, match=r"disparities of \(1, 2\) px for images of \(4, 6\)"):
        command(small, suffix=".npy")(*pair)
    broken = "import sys; open(sys.argv[3], 'w').write('x')"
    for suffix in (".npy", ".tif", ".pfm"):
        with pytest.raises(InputError, match="no image that can be read"):
            command(broken, suffix=suffix)(*pair)
    words = "nowhere/python x.py {left} {right} {out}"
    with pytest.raises(InputError, match=r"cannot start nowhere/python: No such file"):
        make_method("m", {"kind": "command", "command": words})(*pair)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"command": "x {left} {out}"}, r"no \{right\}"),
        ({"command": "x {left} {right} {out}", "pairs": "file"}, r"no \{pairs\}"),
        ({"command": "x {left} {right} {out}", "pairs": "all"}, "pairs is 'all'"),
        ({"command": "x {left} {right} {out}", "suffix": ".png"}, "suffix is '.png'"),
        ({"command": "x '{left} {right} {out}"}, "No closing quotation"),
        ({}, "command"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, words):
    with pytest.raises(InputError, match=words):
        make_method("m", {"kind": "command", **settings})


def test_a_program_ends_with_its_caller(here):
    code = "import sys, time; open(sys.argv[3] + '.begun', 'w'); time.sleep(60)"
    Path("own.py").write_text(code)
    words = f"'{sys.executable}' own.py {{left}} {{right}} {{out}}"
    method = make_method("m", {"kind": "command", "command": words})
    started = method._started([sys.executable, "own.py", "", "", str(here / "x")], here / "log")
    with pytest.raises(KeyboardInterrupt), started as program:
        process = program._process
        assert process.poll() is None
        raise KeyboardInterrupt
    assert process.poll() is not None


def test_peak_memory_is_that_of_the_program_and_its_children(here):
    code = (
        "import subprocess, sys, time, numpy as np\n"
        "if len(sys.argv) > 2:\n"
        "    subprocess.run([sys.executable, sys.argv[0], '1'], check=True)\n"
        "    np.save(sys.argv[3], np.zeros((4, 6)))\n"
        "else:\n"
        "    held = np.ones(25 << 20); time.sleep(0.5)\n"
    )
    Path("own.py").write_text(code)
    words = f"'{sys.executable}' own.py {{left}} {{right}} {{out}}"
    method = make_method("m", {"kind": "command", "command": words, "suffix": ".npy"})
    (found,) = method.many([constant(1)], RANGE)
    assert 200 < found.memory_mb < 400 and 0.5 < found.seconds < 30


def test_the_files_of_a_program_are_the_words_that_are_files(here):
    for name in ("infer.py", "weights.pt", "more.py"):
        Path(name).touch()
    settings = {"command": "python infer.py --weights weights.pt {left}", "files": ["more.py"]}
    assert KINDS["command"].files(settings) == [
        Path(name) for name in ("infer.py", "more.py", "weights.pt")
    ]


@pytest.mark.parametrize("pairs", ["each", "file"])
def test_a_program_may_state_uncertainties(here, pairs):
    code = (
        "import csv, sys, numpy as np\n"
        "rows = csv.reader(open(sys.argv[1])) if len(sys.argv) == 2 else [sys.argv[1:]]\n"
        "for left, right, out, uncertainty in rows:\n"
        "    np.save(out, np.zeros((4, 6)))\n"
        "    np.save(uncertainty, np.full((4, 6), 0.5))\n"
    )
    Path("own.py").write_text(code)
    given = "{pairs}" if pairs == "file" else "{left} {right} {out} {uncertainty}"
    settings = {"kind": "command", "pairs": pairs, "suffix": ".npy", "uncertainty": True}
    settings["command"] = f"'{sys.executable}' own.py {given}"
    method = make_method("m", settings)
    for found in method.many([constant(1), constant(2)], RANGE):
        assert np.all(found.disparity == 0) and np.all(found.uncertainty == 0.5)
    Path("own.py").write_text(code.replace("np.save(uncertainty", "(lambda *_: 0)(uncertainty"))
    with pytest.raises(InputError, match="wrote no uncertainty of pair p1"):
        list(method.many([constant(1)], RANGE))
    with pytest.raises(InputError, match=r"no \{uncertainty\}"):
        make_method("m", {**settings, "pairs": "each", "command": "x {left} {right} {out}"})
