"""Weight files that lead elsewhere, in circles or to more than there is: refused by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

h5py = pytest.importorskip("h5py", reason="h5py is not installed: make test-networks")
from stereobench.networks.weights import read_weights
from stereotruth.core.errors import InputError

KERNEL = np.arange(6, dtype=np.float32).reshape(2, 3)


def weights(path: Path, *names: str) -> h5py.File:
    """A file of one layer whose arrays have these names; they are the caller's to make."""
    file = h5py.File(path, "w")
    group = file.create_group("layer")
    group.attrs["weight_names"] = [name.encode() for name in names]
    file.attrs["layer_names"] = [b"layer"]
    return file


def refused(path: Path, why: str) -> None:
    with pytest.raises(InputError, match=rf"w\.h5: .*{why}") as error:
        read_weights(path)
    assert "\n" not in str(error.value)


def test_arrays_are_read_in_the_order_of_their_names(tmp_path):
    with weights(tmp_path / "w.h5", "conv/kernel:0", "bias") as file:
        file["layer/conv/kernel:0"] = KERNEL
        file["layer/bias"] = KERNEL[0]
    ((kernel, bias),) = read_weights(tmp_path / "w.h5")
    assert np.array_equal(kernel, KERNEL) and np.array_equal(bias, KERNEL[0])


@pytest.mark.parametrize("link", ["/layer/there", "/layer/it"])
def test_soft_links_and_their_circles_are_refused(tmp_path, link):
    with weights(tmp_path / "w.h5", "it") as file:
        file["layer/there"] = KERNEL
        file["layer/it"] = h5py.SoftLink(link)
    refused(tmp_path / "w.h5", "'it' is a link to another place")


def test_links_to_other_files_are_refused(tmp_path):
    with h5py.File(tmp_path / "secret.h5", "w") as file:
        file["it"] = KERNEL
    with weights(tmp_path / "w.h5", "it") as file:
        file["layer/it"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "/it")
    refused(tmp_path / "w.h5", "'it' is a link to another file")
    with h5py.File(tmp_path / "w.h5", "w") as file:
        file["model_weights"] = h5py.ExternalLink(str(tmp_path / "secret.h5"), "/")
    refused(tmp_path / "w.h5", "'model_weights' is a link to another file")


def test_values_in_other_files_are_refused(tmp_path):
    (tmp_path / "secret").write_bytes(b"mine" * 6)
    with weights(tmp_path / "w.h5", "it") as file:
        file.create_dataset("layer/it", (6,), "f4", external=[(tmp_path / "secret", 0, 24)])
    refused(tmp_path / "w.h5", "values in other files")
    layout = h5py.VirtualLayout((2, 3), "f4")
    layout[:] = h5py.VirtualSource(tmp_path / "secret.h5", "it", (2, 3))
    with weights(tmp_path / "w.h5", "it") as file:
        file.create_virtual_dataset("layer/it", layout)
    refused(tmp_path / "w.h5", "values in other files")


def test_sizes_that_no_memory_holds_are_refused(tmp_path):
    with weights(tmp_path / "w.h5", "it") as file:
        file.create_dataset("layer/it", (10**6, 10**6), "f4", chunks=(1000, 1000))
    assert (tmp_path / "w.h5").stat().st_size < 100_000
    refused(tmp_path / "w.h5", "4000.0 GB")
    with weights(tmp_path / "w.h5", *["it"] * 3000) as file:  # one array, again and again
        file.create_dataset("layer/it", (1000, 1000), "f4", chunks=(1000, 1000))
    refused(tmp_path / "w.h5", "3000 arrays of 12.0 GB")


def test_circles_of_groups_are_refused(tmp_path):
    with weights(tmp_path / "w.h5", "loop/" * 1000 + "it") as file:
        file["layer/loop"] = file["layer"]
        file["layer/it"] = KERNEL
    refused(tmp_path / "w.h5", "1001 groups in each other")


def test_what_is_no_weight_file_is_refused(tmp_path):
    path = tmp_path / "w.h5"
    path.write_bytes(b"\x89HDF\r\n\x1a\n" + b"\0" * 100)
    refused(path, "not a weight file of Keras")
    with weights(path, "it") as file:
        file["layer/it"] = "text"
    refused(path, "holds no numbers")
    with weights(path, "it") as file:
        file.create_group("layer/it")
    refused(path, "not a weight file of Keras")
    path.unlink()
    refused(path, "no such weight file")
