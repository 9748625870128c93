"""Training: the loss, what is kept, and that a killed training ends as an undisturbed one."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="PyTorch is not installed: make test-networks")
from stereobench.networks import training_state
from stereobench.networks.training import loss_of, train
from stereobench.networks.training_state import TrainingSettings, start
from stereobench.networks.weights import SavedNetwork, load_weights, save_weights
from stereotruth.core.errors import InputError
from stereotruth.tiles.stereo_dataset import StereoDataset

from ...synthetic.pictures import read_picture, share_of
from ...synthetic.small_pairs import RANGE

MODEL = SavedNetwork("stereonet", RANGE)
SHORT = TrainingSettings(epochs=2, crop_px=(32, 64), device="cpu", threads=1, seed=4)


def short(**values) -> TrainingSettings:
    return SHORT.model_copy(update=values)


def weights(out: Path) -> dict[str, torch.Tensor]:
    return load_weights(out / "best.pt")[1].state_dict()


def equal(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> bool:
    return all(torch.equal(a[name], b[name]) for name in a)


def test_training_lowers_the_loss_and_keeps_the_best(
    dataset: StereoDataset, tmp_path: Path
) -> None:
    out = tmp_path / "net"
    summary = train(MODEL, dataset, out, short(epochs=6), {"code": "x"})
    with (out / "curves.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    assert [int(row["epoch"]) for row in rows] == list(range(1, 7))
    assert [int(row["step"]) for row in rows] == [3, 6, 9, 12, 15, 18]
    assert float(rows[-1]["loss"]) < 0.7 * float(rows[0]["loss"])
    best = min(rows, key=lambda row: float(row["val_epe_px"]))
    assert summary["best"]["epoch"] == int(best["epoch"])
    assert json.loads((out / "training.json").read_text())["best"] == summary["best"]
    assert summary["parameters"] == 621380 and summary["pairs"] == {"train": 3, "val": 1}
    assert load_weights(out / "best.pt")[2]["code"] == "x"
    picture = read_picture(out / "curves.png")
    middle = picture.shape[1] // 2  # a curve of the loss, and one of the error beside it
    assert share_of(picture[:, :middle], "C0") > 1e-3 < share_of(picture[:, middle:], "C1")


SCRIPT = """
import sys
from pathlib import Path
from stereotruth.tiles.stereo_dataset import StereoDataset
from stereobench.networks.training import loss_of, train
from stereobench.networks.training_state import TrainingSettings
from stereobench.networks.weights import SavedNetwork
if __name__ == "__main__":
    root, out = map(Path, sys.argv[1:])
    train(
        SavedNetwork("stereonet", (-16, 16)),
        StereoDataset("small", root, "whu", (-16, 16)),
        out,
        TrainingSettings(
            epochs=2, crop_px=(32, 64), device="cpu", threads=1, seed=4, checkpoint_minutes=0,
        ),
    )
"""


def test_a_killed_training_ends_as_an_undisturbed_one(
    dataset: StereoDataset, tmp_path: Path
) -> None:
    train(MODEL, dataset, tmp_path / "whole", SHORT)
    out, script = tmp_path / "killed", tmp_path / "run.py"
    script.write_text(SCRIPT)
    last = tmp_path / ".killed.work/last.pt"
    run = subprocess.Popen([sys.executable, str(script), str(dataset.root), str(out)])
    deadline = time.monotonic() + 120
    while not last.exists() and time.monotonic() < deadline and run.poll() is None:
        time.sleep(0.01)
    run.send_signal(signal.SIGKILL)
    run.wait()
    assert last.exists() and not out.exists()
    done = torch.load(last, weights_only=True)["state"]
    assert (done["epoch"], done["step"]) < (2, 0)
    train(MODEL, dataset, out, SHORT)
    assert equal(weights(out), weights(tmp_path / "whole"))


def test_more_epochs_go_on_and_other_settings_begin_anew(
    dataset: StereoDataset, tmp_path: Path
) -> None:
    train(MODEL, dataset, tmp_path / "a", short(epochs=1))
    train(MODEL, dataset, tmp_path / "a", SHORT)
    train(MODEL, dataset, tmp_path / "b", SHORT)
    assert equal(weights(tmp_path / "a"), weights(tmp_path / "b"))
    other = short(learning_rate=1e-4, epochs=1)
    train(MODEL, dataset, tmp_path / "a", other)
    train(MODEL, dataset, tmp_path / "c", other)
    assert equal(weights(tmp_path / "a"), weights(tmp_path / "c"))


def test_a_dataset_of_any_range_can_be_trained_on(dataset: StereoDataset, tmp_path: Path) -> None:
    path = tmp_path / "first.pt"
    save_weights(path, MODEL, MODEL.build(), {})
    given = short(epochs=1, initial_weights=str(path))
    odd = replace(dataset, disparity_range=(-7, 10))
    model = training_state.model_of("stereonet", odd, given)
    assert model.disparity_range == (-8, 16)
    assert train(model, odd, tmp_path / "net", given)["model"]["disparity_range"] == (-8, 16)


def test_frozen_parts_keep_their_weights_and_statistics(
    dataset: StereoDataset, tmp_path: Path
) -> None:
    torch.manual_seed(8)
    network = MODEL.build()
    save_weights(tmp_path / "first.pt", MODEL, network, {})
    given = SHORT.model_copy(
        update={"epochs": 1, "initial_weights": str(tmp_path / "first.pt"), "frozen": ("features",)}
    )
    assert equal(network.state_dict(), start(MODEL, given).state_dict())
    train(MODEL, dataset, tmp_path / "net", given)
    before, after = network.state_dict(), weights(tmp_path / "net")
    changed = {name.split(".")[0] for name in before if not torch.equal(before[name], after[name])}
    assert changed == {"aggregation", "refinements"}
    with pytest.raises(InputError, match="feature"):
        train(MODEL, dataset, tmp_path / "no", given.model_copy(update={"frozen": ("feature",)}))


def test_several_processes_share_each_step(dataset: StereoDataset, tmp_path: Path) -> None:
    summary = train(MODEL, dataset, tmp_path / "net", short(epochs=1, processes=2))
    assert summary["steps"] == 1  # two of the three pairs at once, the third left over


def test_mistakes_are_named(dataset: StereoDataset, tmp_path: Path) -> None:
    with pytest.raises(InputError):
        train(MODEL, dataset, tmp_path / "net", short(crop_px=(30, 64)))
    none = short(epochs=1)
    object.__setattr__(none, "epochs", 0)  # which the configuration refuses
    with pytest.raises(InputError):
        train(MODEL, dataset, tmp_path / "net", none)
    save_weights(
        tmp_path / "p.pt", SavedNetwork("psmnet", RANGE), SavedNetwork("psmnet", RANGE).build(), {}
    )
    with pytest.raises(InputError):
        start(MODEL, short(initial_weights=str(tmp_path / "p.pt")))


def test_the_loss_counts_labelled_pixels_only() -> None:
    disparity = torch.full((1, 4, 4), float("nan"))
    disparity[0, 0, 0], disparity[0, 0, 1] = 4.0, 10.0
    output = torch.zeros(1, 4, 4)
    # smooth L1: |e| - 1/2 beyond one pixel
    assert loss_of([output], disparity, [1.0]).item() == pytest.approx((3.5 + 9.5) / 2)
    assert loss_of([output] * 2, disparity, [1.0, 0.5]).item() == pytest.approx(1.5 * 6.5)
    # at half the size: one pixel is labelled, by the mean of its two labels, in its own pixels
    assert loss_of([torch.zeros(1, 2, 2)], disparity, [1.0]).item() == pytest.approx(3.5 - 0.5)
    assert loss_of([output], torch.full((1, 4, 4), float("nan")), [1.0]).item() == 0
