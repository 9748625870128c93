"""Ids of protocols: the same for the same, another one for whatever differs."""

from __future__ import annotations

from dataclasses import replace
from typing import get_args, get_type_hints

import numpy as np
import pytest

from stereobench.scores.compare_methods import compare
from stereobench.scores.protocols import PROTOCOLS, Protocol, one_id, pair_sha256, protocol_of
from stereobench.scores.published import PUBLISHED
from stereobench.scores.score_method import score
from stereotruth.core.config.methods import StereoDatasetEntry
from stereotruth.core.errors import InputError
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.toy_benchmark import PLAN, rows

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")
PAIRS = [("a", "1" * 64), ("b", "2" * 64)]
WHU = PROTOCOLS["whu-2023"]


def test_the_frozen_ones_keep_their_ids():
    """A changed definition has to change these: then give it a name of its own."""
    assert {name: of.identified(PAIRS)["id"] for name, of in PROTOCOLS.items()} == {
        "whu-2023": "whu-2023-8f43ba77",
        "us3d-track2": "us3d-track2-ba686ae3",
        "exact-2026": "exact-2026-84f216ff",
    }
    allowed = get_args(get_type_hints(StereoDatasetEntry)["protocol"])
    assert set(get_args(allowed[0])) == set(PROTOCOLS)
    assert set(PUBLISHED) <= set(PROTOCOLS)


@pytest.mark.parametrize(
    "change",
    [
        {"disparity_range": (-128, 65)},
        {"truth": "exact"},
        {"grows_with_height": False},
        {"pooling": "mean of pairs"},
    ],
    ids=lambda change: next(iter(change)),
)
def test_whatever_changes_has_another_id(change):
    assert replace(WHU, **change).identified(PAIRS)["id"] != WHU.identified(PAIRS)["id"]


def test_a_pair_is_its_pixels(compared):
    dataset = StereoDataset("toy", compared / "data", "whu", (-8, 8))
    pair, other = dataset.pairs("test")[:2]
    truth = dataset.labels(pair)
    found = pair_sha256(pair, [truth])
    assert pair_sha256(pair, [truth.copy()]) == found != pair_sha256(other, [truth])
    truth[10, 10] += np.float32(0.001)
    assert pair_sha256(pair, [truth]) != found


def dataset_of(low, high):
    return StereoDataset("d", "root", "whu", (low, high))


def test_a_dataset_or_split_that_a_protocol_does_not_have_is_refused():
    assert protocol_of("whu-2023", dataset_of(-128, 64), "test", [5]) == WHU
    with pytest.raises(InputError, match=r"datasets.d.disparity_range is \[-64, 64\], in protocol"):
        protocol_of("whu-2023", dataset_of(-64, 64), "test", [3])
    with pytest.raises(InputError, match=r"benchmark.split is val, in protocol .* it is test"):
        protocol_of("whu-2023", dataset_of(-128, 64), "val", [3])
    with pytest.raises(InputError, match="no protocol 'kitti'"):
        protocol_of("kitti", dataset_of(-128, 64), "test", [3])
    own = protocol_of(None, dataset_of(-5, 5), None, [2])
    assert own == Protocol("own", (-5, 5), None, (2.0,))


def test_tables_show_one_id_and_refuse_two(compared, tmp_path):
    """The second method scored with other thresholds is of another protocol."""
    five = rows(compared / "compared/methods.csv")
    (protocol,) = {row["protocol"] for row in five}
    assert protocol.startswith("own-")
    for name in ("methods", "by_city", "strata", "differences", "published"):
        assert f"({protocol})" in (compared / f"compared/{name}.md").read_text().splitlines()[0]
    assert protocol in (compared / "compared/index.html").read_text()
    dataset = StereoDataset("toy", compared / "data", "whu", (-8, 8))
    other = replace(PLAN, thresholds_px=[3, 2])
    score(dataset, "test", "Half", compared / "match/half", tmp_path / "half", other)
    folders = [compared / "benchmark/two", tmp_path / "half"]
    predictions = [compared / "match/two", compared / "match/half"]
    with pytest.raises(InputError, match=rf"several protocols .*Two: {protocol}; Half: own-"):
        compare(dataset, "test", folders, predictions, tmp_path / "out")
    assert one_id([]) == ""
