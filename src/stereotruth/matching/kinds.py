"""The kinds of stereo methods as plain values, so that a workflow can plan with them."""

from __future__ import annotations

from importlib.util import find_spec

from ..errors import InputError

NETWORKS = ("stereonet", "psmnet", "hmsmnet")
FOLDER = "folder"
KINDS = ("sgm", *NETWORKS, "function", FOLDER)
MODULES = {"sgm": "matching.sgm", **dict.fromkeys(NETWORKS, "matching.networks.inference")}
LABELS = {"sgm": "SGM", "stereonet": "StereoNet", "psmnet": "PSM-Net", "hmsmnet": "HMSM-Net"}


def need_pytorch(name: str, kind: str) -> None:
    """Raise InputError unless ``kind`` is a network's and what trains it is installed."""
    if kind not in NETWORKS:
        raise InputError(
            f"method {name!r} is of kind {kind!r}, which is not trained",
            remedy=f"take one of kind {', '.join(NETWORKS)}, or give it weights",
        )
    if not all(map(find_spec, ("torch", "tqdm"))):
        raise InputError(
            f"{kind} needs PyTorch and tqdm, which are not installed",
            remedy="pip install '.[networks]'",
        )
