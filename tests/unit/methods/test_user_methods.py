"""The user's programs and functions as methods, and maps that other programs write."""

from __future__ import annotations

import os
import re
import signal
import sys
import time
import tracemalloc
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import EntryPoint
from pathlib import Path

import cv2
import numpy as np
import psutil
import pytest
import rasterio
from scipy.ndimage import gaussian_filter

from stereobench.methods import kinds
from stereobench.methods.kinds import KINDS
from stereobench.methods.matcher import BatchMatcher, ImagePair, Matcher
from stereobench.methods.methods import make_method
from stereobench.methods.user_methods import read_result
from stereobench.scores.predictions import predict
from stereotruth.core.errors import InputError
from stereotruth.core.products.rasters import image_shape, read_disparity, read_image
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.images import write

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
PAGE = Path(__file__).parents[3] / "docs" / "how-to" / "own_method.md"
MAP = np.arange(12, dtype=np.float32).reshape(3, 4)
SHAPE = (60, 150)
RANGE = (-16, 16)
PYTHON = f"'{sys.executable}'"


@pytest.fixture(autouse=True)
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    yield tmp_path
    sys.modules.pop("my_stereo", None)


def tiff(path, *bands, scale=1.0, offset=0.0, nodata=None):
    shape = {"width": 4, "height": 3, "count": len(bands), "dtype": bands[0].dtype}
    with rasterio.open(path, "w", driver="GTiff", nodata=nodata, **shape) as target:
        target.scales, target.offsets = (scale,) * len(bands), (offset,) * len(bands)
        target.write(np.array(bands))
    return path


def test_maps_of_each_format_are_read(tmp_path):
    np.save("a.npy", MAP)
    cv2.imwrite("a.pfm", MAP)
    for name in ("a.npy", "a.pfm"):
        assert np.array_equal(read_result(tmp_path / name), MAP)
    assert np.isnan(read_result(tmp_path / "a.npy", nodata=5.0)[1, 1])
    stored = (16 * MAP).astype(np.int16)
    stored[1, 2] = -32768
    found = read_result(tiff(tmp_path / "a.tif", stored, scale=1 / 16, offset=-8, nodata=-32768))
    assert np.isnan(found[1, 2])
    np.testing.assert_array_equal(np.delete(found.ravel(), 6), np.delete(MAP.ravel() - 8, 6))
    cv2.imwrite("a.png", (256 * MAP).astype(np.uint16))
    found = read_disparity(tmp_path / "a.png")
    assert np.isnan(found[0, 0]) and np.array_equal(found.ravel()[1:], MAP.ravel()[1:])


@pytest.mark.parametrize("scale", [-1 / 255, 256.0])
def test_the_scale_of_a_pfm_is_the_order_of_its_bytes(tmp_path, scale):
    """-1/255 is the default of Middlebury's SDK; the format knows no unit."""
    data = (MAP + 10.5)[::-1].astype("<f4" if scale < 0 else ">f4").tobytes()
    Path("a.pfm").write_bytes(b"Pf\n4 3\n%f\n" % scale + data)
    assert np.array_equal(read_result(tmp_path / "a.pfm"), MAP + 10.5)


def sparse(path, side):
    """A small TIFF of many pixels."""
    shape = {"width": side, "height": side, "count": 1, "dtype": "float32"}
    blocks = {"tiled": True, "blockxsize": 8192, "blockysize": 8192, "sparse_ok": True}
    rasterio.open(path, "w", driver="GTiff", **shape, **blocks, BIGTIFF="YES").close()


def not_maps() -> dict[str, bytes | None]:
    """Content of files that hold no map; None: they are written already."""
    np.save("objects.npy", np.array([{}]), allow_pickle=True)
    np.save("text.npy", np.array([["a"]]))
    huge = np.lib.format.header_data_from_array_1_0(MAP) | {"shape": (10**6, 10**6)}
    with Path("huge.npy").open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, huge)
    sparse("sparse.tif", 400_000)
    tiff("two.tif", MAP, MAP)
    tiff("complex.tif", MAP.astype(np.complex64))
    written = ("objects.npy", "text.npy", "huge.npy", "sparse.tif", "two.tif", "complex.tif")
    return dict.fromkeys(written) | {
        "short.npy": b"\x93NUMPY",
        "empty.pfm": b"",
        "words.pfm": b"Pf\nx y\n1\n",
        "large.pfm": b"Pf\n99999999 99999999\n-1\n" + bytes(100),
        "cut.pfm": b"Pf\n16000 16000\n-1\n" + bytes(100),
        "negative.pfm": b"Pf\n-3 4\n-1\n" + bytes(100),
    }


def test_what_is_no_map_is_refused_before_it_fills_the_memory(tmp_path):
    for name, content in not_maps().items():
        if content is not None:
            Path(name).write_bytes(content)
        tracemalloc.start()
        with pytest.raises(InputError, match=rf"{re.escape(name)}.*Remedy"):
            read_result(tmp_path / name)
        assert tracemalloc.get_traced_memory()[1] < 10e6
        tracemalloc.stop()
    for read in (read_image, image_shape):
        with pytest.raises(InputError, match="sparse"):
            read(tmp_path / "sparse.tif")
    cv2.imwrite("b.png", MAP.astype(np.uint8))
    with pytest.raises(InputError, match="b\\.png"):
        read_disparity(tmp_path / "b.png")


MODULE = """
import numpy as np

def constant(left, right, disparity_range, value=3):
    return np.full(left.shape[:2], value, np.int32)

def holes(left, right, disparity_range):
    return np.ma.masked_less(np.ones(left.shape), 2), np.full(left.shape, 0.5)

def small(left, right, disparity_range):
    return np.zeros((1, 1))

class Whole:
    margin_px = 7
    def __init__(self, gain=1):
        self.gain = gain
    def scaling(self, left, right):
        return self.gain
    def __call__(self, left, right, disparity_range, scaling=None):
        return np.full(left.shape, self.gain, np.float32)
"""
IMAGE = np.ones((2, 3), np.uint16)


def function(name, **more):
    return make_method("mine", {"kind": "function", "function": name, **more})


def test_functions_and_classes_of_modules_files_and_entry_points(here, monkeypatch):
    for place in ("my_stereo.py", "sub/my_stereo.py"):
        Path(place).parent.mkdir(exist_ok=True)
        Path(place).write_text(MODULE)
    for place in ("my_stereo", "my_stereo.py", "sub/my_stereo.py"):
        method = function(f"{place}:constant", options={"value": 5}, margin_px=9)
        found = method(IMAGE, IMAGE, (0, 8))
        assert found.dtype == np.float32 and np.all(found == 5)
        assert method.margin_px == 9 and method.scaling(IMAGE, IMAGE) is None
        assert isinstance(method, Matcher)
    found, sigma = function("my_stereo:holes").with_uncertainty(IMAGE, IMAGE, (0, 8))
    assert np.isnan(found).all() and np.all(sigma == 0.5)
    method = function("my_stereo:Whole", options={"gain": 4})
    assert method.margin_px == 7 and method.scaling(None, None) == 4
    assert method(IMAGE, IMAGE, (0, 8))[0, 0] == 4
    point = EntryPoint("theirs", "my_stereo:constant", kinds.ENTRY_POINTS)
    monkeypatch.setattr(kinds, "entry_points", lambda group, name: [point])
    assert np.all(function("theirs")(IMAGE, IMAGE, (0, 8)) == 3)
    for wrong in ("no_such_module:f", "nothing.py:f", "my_stereo:missing"):
        with pytest.raises(InputError, match=wrong.partition(":")[0]):
            function(wrong)
    with pytest.raises(InputError, match=r"'mine'.*\(1, 1\)"):
        function("my_stereo:small")(IMAGE, IMAGE, (0, 8))


def test_the_method_of_the_page_finds_a_shift_up_to_the_borders():
    code = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)[1]
    names: dict = {}
    exec(code, names)
    texture = np.random.default_rng(3).integers(200, 2000, (96, 160)).astype(np.uint16)
    left, right = texture[:, :128], texture[:, 5 : 5 + 128]  # x_left - x_right = 5
    found = names["match"](left, right, [-64, 128])
    assert found.dtype == np.float32 and found.shape == left.shape
    assert np.isfinite(found).mean() > 0.8
    assert np.nanmean(np.abs(found - 5) < 0.5) > 0.9


SGM = """
import csv, sys
from pathlib import Path
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
EACH = {"command": f"{PYTHON} infer.py {{left}} {{right}} {{out}} {{low}} {{high}}"}
FILE = {"command": f"{PYTHON} infer.py {{pairs}} {{low}} {{high}}", "pairs": "file"}
# writes constant disparities; it fails at images that have 9 in their first pixel
TOY = """
import csv, os, sys
import numpy as np, cv2
for left, right, out in csv.reader(open(sys.argv[1])):
    image = cv2.imread(left, -1)
    open("calls.txt", "a").write(f"{os.path.basename(left)} ")
    if image.flat[0] == 9 and not os.path.exists("mended"):
        print("out of memory: no such luck", file=sys.stderr)
        sys.exit(3)
    np.save(out, np.full(image.shape[:2], float(image.flat[0])))
"""
TOY_ENTRY = {
    "kind": "command", "command": f"{PYTHON} toy.py {{pairs}}", "pairs": "file", "suffix": ".npy",
}  # fmt: skip


def images(seed):
    rng = np.random.default_rng(seed)
    texture = gaussian_filter(rng.uniform(size=(SHAPE[0], SHAPE[1] + 40)), 0.8)
    texture = (50 + 200 * (texture - texture.min()) / np.ptp(texture)).astype(np.uint8)
    return texture[:, 20 - 7 : 20 - 7 + SHAPE[1]], texture[:, 20 : 20 + SHAPE[1]]


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
@pytest.mark.parametrize(
    ("settings", "moved"),
    [(EACH, {}), (FILE, {"polarity": "positive", "outside": "invalid"})],
    ids=["each", "file, moved"],
)
def test_a_program_around_sgm_gives_the_bytes_of_sgm(dataset, settings, moved):
    Path("infer.py").write_text(SGM)
    run(dataset, {"kind": "sgm", **moved}, "sgm")
    record = run(dataset, {"kind": "command", **settings, **moved}, "theirs")
    assert maps("theirs") == maps("sgm") and len(maps("sgm")) == 3
    for pair in record["pairs"].values():  # memory: of the program and its children
        assert 0 <= pair["seconds"] < 60 and pair["memory_mb"] > 20


def constant(value):
    image = np.full((4, 6), value, np.uint16)
    return ImagePair(f"p{value}", image, image)


def own(code, **more):
    """A method that calls the code for each pair, with files of NumPy."""
    Path("own.py").write_text(code)
    words = f"{PYTHON} own.py {{left}} {{right}} {{out}}"
    return make_method("m", {"kind": "command", "command": words, "suffix": ".npy"} | more)


def test_many_pairs_are_few_calls_in_their_order(monkeypatch):
    Path("toy.py").write_text(TOY)
    monkeypatch.setattr("stereobench.methods.user_methods.MOST_PAIRS", 2)
    method = make_method("toy", TOY_ENTRY)
    assert isinstance(method, BatchMatcher)
    found = list(method.many([constant(n) for n in (5, 3, 4)], RANGE))
    assert [float(of.disparity[0, 0]) for of in found] == [5, 3, 4]
    assert found[0].disparity.dtype == np.float32
    assert Path("calls.txt").read_text().split() == [f"p{n}_left.tif" for n in (5, 3, 4)]


def test_a_program_that_fails_is_named_with_its_last_words_and_keeps_what_it_did(dataset):
    Path("toy.py").write_text(TOY)
    for side in ("left", "right"):
        write(Path(f"data/test/{side}/KM_{side}_3.tiff"), np.full(SHAPE, 9, np.uint16))
    with pytest.raises(InputError) as caught:
        run(dataset, TOY_ENTRY, "out")
    for words in ("'theirs', pair KM_3", "status 3", "out of memory: no such luck", "toy.py"):
        assert words in str(caught.value)
    assert not Path("out").exists()
    Path("mended").touch()
    Path("calls.txt").unlink()
    run(dataset, TOY_ENTRY, "out")
    # KM_1 was there; KM_2, the last that was written, might have been half written
    assert Path("calls.txt").read_text().split() == ["KM_2_left.tif", "KM_3_left.tif"]
    assert len(maps("out")) == 3


@pytest.mark.parametrize(
    ("code", "suffix", "words"),
    [
        ("", ".npy", "no disparities of pair"),
        ("import os; print('hello', flush=True); os.kill(os.getpid(), 9)", ".npy", "9.*\nhello"),
        ("import sys, numpy as np; np.save(sys.argv[3], np.zeros((1, 2)))", ".npy", r"\(1, 2\)"),
        ("import sys; open(sys.argv[3], 'w').write('x')", ".tif", r"\.tif"),
    ],
)
def test_what_is_wrong_with_a_program_is_told(code, suffix, words):
    with pytest.raises(InputError, match=words):
        own(code, suffix=suffix)(*constant(1)[1:], RANGE)
    with pytest.raises(InputError, match="nowhere/python"):
        own(code, command="nowhere/python {left} {right} {out}")(*constant(1)[1:], RANGE)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"command": "x {left} {out}"}, r"\{right\}"),
        ({"command": "x {left} {right} {out}", "pairs": "file"}, r"\{pairs\}"),
        ({"command": "x {left} {right} {out}", "pairs": "all"}, "'all'"),
        ({"command": "x {left} {right} {out}", "suffix": ".png"}, r"'\.png'"),
        ({"command": "x {left} {right} {out}", "uncertainty": True}, r"\{uncertainty\}"),
        ({"command": "x '{left} {right} {out}"}, "quot"),
    ],
)
def test_settings_that_cannot_work_are_refused(settings, words):
    with pytest.raises(InputError, match=words):
        make_method("m", {"kind": "command", **settings})


def test_a_program_ends_with_its_caller():
    """Interrupted by a signal that is not pytest's own, which ends a test that hangs."""

    def stop(*_):
        raise KeyboardInterrupt

    def interrupt():
        while not Path("pid").exists():
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGUSR1)

    code = "import os, time; open('new', 'w').write(str(os.getpid())); os.rename('new', 'pid')"
    method = own(f"{code}; time.sleep(60)")
    before = signal.signal(signal.SIGUSR1, stop)
    try:
        with ThreadPoolExecutor(1) as pool, pytest.raises(KeyboardInterrupt):
            pool.submit(interrupt)
            method(*constant(1)[1:], RANGE)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert not psutil.pid_exists(int(Path("pid").read_text()))


@pytest.mark.parametrize("pairs", ["each", "file"])
def test_a_program_may_state_uncertainties(pairs):
    Path("own.py").write_text(
        "import csv, sys, numpy as np\n"
        "rows = csv.reader(open(sys.argv[1])) if len(sys.argv) == 2 else [sys.argv[1:]]\n"
        "for left, right, out, uncertainty in rows:\n"
        "    np.save(out, np.zeros((4, 6)))\n"
        "    np.save(uncertainty, np.full((4, 6), 0.5))\n"
    )
    given = "{pairs}" if pairs == "file" else "{left} {right} {out} {uncertainty}"
    settings = {"kind": "command", "pairs": pairs, "suffix": ".npy", "uncertainty": True}
    method = make_method("m", {**settings, "command": f"{PYTHON} own.py {given}"})
    for found in method.many([constant(1), constant(2)], RANGE):
        assert np.all(found.disparity == 0) and np.all(found.uncertainty == 0.5)
