"""Errata: planted faults are found and mended, right labels stay; a download takes them by sum."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest

from stereobench.audit.audit import audit
from stereobench.audit.errata import (
    Correction,
    apply_errata,
    fit_correction,
    read_errata,
    write_errata,
)
from stereobench.audit.pair import estimate, measure
from stereobench.audit.verdicts import Audited, judge
from stereotruth.core.config.configuration import Limits
from stereotruth.core.config.methods import Audit
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import sealed, write_table
from stereotruth.core.products.provenance import file_sha256
from stereotruth.core.products.rasters import read_disparity, write_tiff
from stereotruth.tiles.layouts import assemble_dataset
from stereotruth.tiles.seals import seal_dataset
from stereotruth.tiles.stereo_dataset import StereoDataset, find_pairs
from stereotruth.tiles.tile_checks import SIGMA_COLUMNS
from stereotruth.tiles.verify import defects, write_export

from ...synthetic.pair_with_block import SIZE, make
from ...synthetic.tiled_scene import make_scene, rows_of, run

PUBLISHED = Path(__file__).parents[4] / "shared/published/us3d"
LIMITS = Audit(contradicted_share=0.05, hidden_share=0.01, worst=0)
ACROSS = np.linspace(-1.0, 1.0, SIZE)
SHAPE = (400, 600)
NO_CORRECTION = Correction()
WRONG = np.s_[195:285, 20:270]


def is_wrong(labels):
    labels[WRONG] += 6
    return labels


PLANTED = {  # what is done to the labels of visible, and of hidden pixels
    **{f"shift of {s} px": lambda d, s=s: d + s for s in (0.5, -1.0, 2.0, -4.3, 7.0)},
    **{f"scale of {s}": lambda d, s=s: s * d for s in (1.1, 0.8, 2.0, 0.5)},
    "sign": lambda d: -d,
    "sign and shift": lambda d: 1.5 - d,
    "tilt to the right": lambda d: d + ACROSS,
    "tilt down": lambda d: d - 2 * ACROSS[:, None],
    "wave": lambda d: d + 1 + np.cos(2 * ACROSS),
    "hidden labels": lambda d: d,
    "hidden labels and shift": lambda d: d + 1,
    "hidden labels and sign": lambda d: -d,
    "wrong labels": is_wrong,
    "nothing": lambda d: d,
    "nothing at all": lambda d: d,
}


def whu(root):
    return StereoDataset("mine", root, "whu", (-64, 64))


def write_pair(root, name, number, left, right, labels):
    for kind in ("left", "right", "disp"):
        (root / kind).mkdir(parents=True, exist_ok=True)
    for kind, image in (("left", left), ("right", right)):
        write_tiff(root / kind / f"{name}_{kind}_{number}.tiff", image)
    stored = np.where(np.isfinite(labels), labels, -999).astype(np.float32)
    write_tiff(root / "disp" / f"{name}_disparity_{number}.tiff", stored, nodata=-999)


@pytest.mark.slow
def test_planted_faults_are_mended_and_right_labels_stay(tmp_path):
    scenes, root = {}, tmp_path / "data"
    for number, (name, fault) in enumerate(PLANTED.items()):
        scene = scenes[f"KM_{number}"] = make(100 + number)
        given = scene.exact if name.startswith("hidden") else scene.labels
        write_pair(root, "KM", number, scene.left, scene.right, fault(given.copy()))
    dataset, audited = whu(root), []
    for pair in dataset.pairs():
        figures = measure(dataset, pair)
        audited.append(Audited(pair, figures, judge(figures, LIMITS, len(PLANTED))))
    write_errata(tmp_path / "delta", dataset, audited, LIMITS)
    said = read_errata(tmp_path / "delta")
    kinds = {tile["pair"]: tile["kind"] for tile in said["tiles"]}
    assert not said["not_mended"] and len(kinds) == len(PLANTED) - 2
    assert apply_errata(tmp_path / "delta", root, tmp_path / "mended") == len(kinds)
    mended = whu(tmp_path / "mended")
    for pair, name in zip(mended.pairs(), PLANTED):
        scene, labels = scenes[pair.name], mended.labels(pair)
        there = np.isfinite(labels)
        error = np.abs(labels - scene.exact)
        seen = np.isfinite(scene.labels)
        if name == "wrong labels":
            wrong = np.zeros(seen.shape, bool)
            wrong[WRONG] = True
            assert (there & seen & wrong).sum() < 0.02 * wrong.sum(), name
            assert (there & seen & ~wrong).sum() > 0.95 * (seen & ~wrong).sum(), name
            there &= ~wrong
        else:
            assert (there & seen).sum() >= 0.999 * seen.sum(), name
        assert error[there].max() <= (0.05 if kinds.get(pair.name) else 0.0), name
        if name.startswith("hidden"):  # a fold of less than 1 px is none
            assert (there & scene.hidden).sum() < 0.1 * scene.hidden.sum(), name
        if name.startswith(("hidden labels", "wrong")) and "shift" not in name:
            assert error[there].max() <= 1e-6, name
    assert kinds["KM_11"] == kinds["KM_12"] == "affine" and kinds["KM_13"] == "field"
    size = sum(file.stat().st_size for file in (tmp_path / "delta").rglob("*") if file.is_file())
    assert size < 0.1 * sum(file.stat().st_size for file in (root / "disp").iterdir())


@pytest.mark.slow
@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="the published pairs are not here")
def test_published_labels_agree_with_the_images_after_the_errata(tmp_path):
    given = StereoDataset("us3d", PUBLISHED, "us3d", (-96, 96))
    delta = tmp_path / "delta"
    audit(given, tmp_path / "a", Audit(worst=0), work=tmp_path / "work", delta=delta)
    tiles = read_errata(delta)["tiles"]
    assert len(tiles) == 2 and all(not tile["left"] for tile in tiles)
    apply_errata(delta, PUBLISHED, tmp_path / "mended")
    mended = StereoDataset("us3d", tmp_path / "mended", "us3d", (-96, 96))
    for pair in mended.pairs():
        figures = measure(mended, pair)
        for name in ("bias", "tilt_x", "tilt_y"):
            low, high = estimate(figures, "bias", name).interval()
            assert low < 0 < high and high - low < 0.6, (pair.name, name)


@pytest.mark.parametrize(
    "gain, field, knots",
    [
        (1.0, lambda u, v: 0 * u + 1.3, 1),
        (1.04, lambda u, v: 0 * u - 0.7, 1),
        (1.0, lambda u, v: 0.4 + 0.5 * u - 0.3 * v, 2),
        (1.0, lambda u, v: 0.8 * np.cos(2 * u) * np.sin(1 + v), 5),
    ],
)
def test_a_correction_has_as_few_unknowns_as_it_takes(gain, field, knots):
    rng = np.random.default_rng(3)
    y, x = (rng.integers(8, size - 8, 2500).astype(float) for size in SHAPE)
    labels = rng.normal(5, 8, x.size)
    across, down = np.linspace(-1, 1, SHAPE[1])[None], np.linspace(-1, 1, SHAPE[0])[:, None]
    true = np.broadcast_to(field(across, down) + 0 * down, SHAPE)
    offsets = gain * labels + true[y.astype(int), x.astype(int)] - labels
    offsets += rng.normal(0, 0.1, x.size) + 20 * (rng.random(x.size) < 0.03)
    found = fit_correction(x, y, labels, offsets, SHAPE)
    assert len(found.field_px) == knots and (found.gain != 1) == (gain != 1)
    middle = found.apply(np.zeros(SHAPE, np.float32))
    assert np.abs(middle - true).max() <= 5 * np.max(found.sigma_px) <= 0.5
    assert abs(found.gain - gain) <= 4 * found.gain_sigma + 1e-12


def test_too_few_matches_tell_nothing():
    x = y = np.arange(5.0) * 60
    assert fit_correction(x, y, x, x, SHAPE) is None


def written(folder, file, correction=NO_CORRECTION, mask=None, path=None):
    """Errata of one file, as an audit writes them."""
    record = {
        "pair": "KM_1",
        "disparity": file.name,
        "disparity_sha256": file_sha256(file),
        **correction._asdict(),
    }
    (folder / "masks").mkdir(parents=True)
    if mask is not None:
        cv2.imwrite(str(folder / "masks/KM_1.png"), mask)
        record |= {"mask": "masks/KM_1.png", "mask_sha256": file_sha256(folder / "masks/KM_1.png")}
        record["mask"] = path or record["mask"]
    said = {"nodata": -999.0, "tiles": [record], "not_mended": {}}
    (folder / "errata.json").write_text(sealed(said))
    return folder


@pytest.fixture
def download(tmp_path):
    """A dataset of one pair and its disparities."""
    labels = np.full((6, 9), 3.25, np.float32)
    labels[0, 0] = np.nan
    root = tmp_path / "download/test"
    write_pair(root, "KM", 1, np.ones((6, 9), np.uint16), np.ones((6, 9), np.uint16), labels)
    return root.parent, root / "disp/KM_disparity_1.tiff"


def test_a_download_is_copied_with_its_labels_corrected(download, tmp_path):
    root, file = download
    before = file.read_bytes()
    mask = np.zeros((6, 9), np.uint8)
    mask[5, 8] = 2
    correction = Correction(2.0, 0.0, 1.0, [[0.5, 1.5], [0.5, 1.5]], [[0.1, 0.1], [0.1, 0.1]])
    delta, out = written(tmp_path / "delta", file, correction, mask), tmp_path / "out"
    assert apply_errata(delta, root, out) == 1
    found = read_disparity(out / file.relative_to(root))
    np.testing.assert_allclose(found[1], 4.5 + np.linspace(0.5, 1.5, 9), atol=1e-6)
    assert np.isnan(found[0, 0]) and np.isnan(found[5, 8]) and np.isfinite(found).sum() == 52
    assert file.read_bytes() == before
    for name in ("left/KM_left_1.tiff", "right/KM_right_1.tiff"):
        assert (out / "test" / name).read_bytes() == (root / "test" / name).read_bytes()


@pytest.fixture(scope="module")
def tiles(tmp_path_factory):
    """A city's tiles whose labels of one tile are 3 px off, and what they were."""
    top = tmp_path_factory.mktemp("tiles")
    right = top / "right/Town"
    run([make_scene(top / "s1", bare_from=240)], right, quality=Limits())
    rows = rows_of(right)
    row = next(row for row in rows if row["split"] == "test")
    shutil.copytree(right, wrong := top / "wrong/Town")
    labels = read_disparity(right / row["disp"], -999)
    write_tiff(wrong / row["disp"], np.where(np.isnan(labels), -999, labels + 3), nodata=-999)
    row |= {"disp_sha256": file_sha256(wrong / row["disp"])}
    write_table(wrong / "manifest.csv", rows)
    record = json.loads((wrong / "export.json").read_text())
    write_export(wrong, record, record["provenance"])
    return right, wrong, row


@pytest.mark.parametrize("kind", ["tiles", "dataset"])
def test_what_a_copy_states_of_its_labels_is_that_of_its_files(kind, tiles, tmp_path):
    """After errata that take 3 px away, it is what was stated of the labels that were right."""
    right, wrong, row = tiles
    if kind == "dataset":
        how = {"catalogs": ["stac", "croissant"], "acquired": {row["scene"]: "2020-10-25"}}
        for name in ("stac", "croissant"):
            pytest.importorskip({"stac": "pystac", "croissant": "mlcroissant"}[name])
        for folder, out in ((right, tmp_path / "good"), (wrong, tmp_path / "bad")):
            assemble_dataset([folder], out, licence="cc-by-4.0", **how)
        right, wrong = tmp_path / "good", tmp_path / "bad"
        seal_dataset(wrong, find_pairs(wrong, "stereotruth"), "test", tmp_path / "sealed")
        shutil.copyfile(tmp_path / "sealed/seal.json", wrong / "seal.json")
    (row,) = (of for of in rows_of(wrong) if of["tile"] == row["tile"])
    shift = Correction(field_px=[[-3.0]], sigma_px=[[0.1]])
    delta, out = written(tmp_path / "delta", wrong / row["disp"], shift), tmp_path / "out"
    assert apply_errata(delta, wrong, out) == 1
    assert defects(out) == [] and not (out / "seal.json").exists()
    dataset = StereoDataset("mine", out, "stereotruth", (-64, 64))
    assert not [*dataset.pairs()[0].changed()]
    unknown = {*SIGMA_COLUMNS, "doubt", "disp_sha256", "item_sha256"}
    for is_, was in zip(rows_of(out), rows_of(right)):
        there = {key for key in was if is_[key] != was[key]}
        assert there <= (unknown if was["tile"] == row["tile"] else {"doubt"})
    for file in ("footprints.geojson", f"stac/{row['tile']}/{row['tile']}.json"):
        if (right / file).is_file():
            is_, was = (json.loads((folder / file).read_text()) for folder in (out, right))
            if "assets" in is_:
                assets = [of["assets"].pop("disparity") for of in (is_, was)]
                sum_of_file = "1220" + file_sha256(out / row["disp"])
                assert assets[0]["file:checksum"] == sum_of_file
                assert assets[0]["file:size"] == (out / row["disp"]).stat().st_size
            assert is_ == was
    if kind == "dataset":
        said = json.loads((out / "croissant.json").read_text())
        (manifest,) = (of for of in said["distribution"] if "sha256" in of)
        assert manifest["sha256"] == file_sha256(out / "manifest.csv")
        assert said["license"] == json.loads((right / "croissant.json").read_text())["license"]
    else:
        is_, was = (json.loads((folder / "export.json").read_text()) for folder in (out, right))
        assert is_["disparity_px"] == was["disparity_px"] and "label_uncertainty" not in is_
        assert is_["quality"]["flagged_tiles"] == was["quality"]["flagged_tiles"]
        later = written(tmp_path / "later", out / row["disp"], shift)
        assert apply_errata(later, out, tmp_path / "again") == 1  # of a copy that was corrected
        assert defects(tmp_path / "again") == []


def test_kitti_files_stay_such(tmp_path):
    root = tmp_path / "kitti"
    root.mkdir()
    steps = np.full((4, 6), 1000, np.uint16)
    steps[0, 0] = 0
    cv2.imwrite(str(root / "000004_10.png"), steps)
    shift = Correction(field_px=[[0.5]], sigma_px=[[0.1]])
    apply_errata(written(tmp_path / "d", root / "000004_10.png", shift), root, tmp_path / "out")
    found = cv2.imread(str(tmp_path / "out/000004_10.png"), cv2.IMREAD_UNCHANGED)
    assert found.dtype == np.uint16 and found[0, 0] == 0 and (found.ravel()[1:] == 1128).all()


@pytest.mark.parametrize(
    "fault", ["other file", "no file", "other mask", "edited", "there", "path", "not listed"]
)
def test_what_does_not_fit_is_refused_by_name(fault, download, tmp_path):
    root, file = download
    path = "../mask.png" if fault == "path" else None
    delta = written(tmp_path / "delta", file, mask=np.zeros((6, 9), np.uint8), path=path)
    named, out = file, tmp_path / "out"
    if fault == "other file":
        write_tiff(file, np.ones((6, 9), np.float32), nodata=-999)
    elif fault == "no file":
        file.unlink()
        named = root
    elif fault == "other mask":
        named = delta / "masks/KM_1.png"
        named.write_bytes(named.read_bytes() + b"\0")
    elif fault == "not listed":  # of the manifest; the errata are not of it
        named = root / "test/left/KM_left_1.tiff"
        row = {"left": "test/left/KM_left_1.tiff", "left_sha256": 64 * "0"}
        write_table(root / "manifest.csv", [row])
    elif fault in ("edited", "path"):
        named = delta / "errata.json"
        if fault == "edited":
            named.write_text(named.read_text().replace("-999.0", "-998.0"))
    else:
        out.mkdir()
        named = out
        (out / "mine.csv").touch()
    with pytest.raises(InputError) as refusal:
        apply_errata(delta, root, out)
    assert str(named) in str(refusal.value)
    assert [*out.glob("*")] == [*out.glob("mine.csv")]
    assert (out / "mine.csv").exists() == (fault == "there")
    assert json.loads((delta / "errata.json").read_text())
