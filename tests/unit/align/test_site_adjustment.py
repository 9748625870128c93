"""Adjusted images as files: figures, what is named, alignments of pairs, fixed images."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from stereotruth.align.alignment import Alignment, ViewFit, over_the_image, parameters_of
from stereotruth.align.control_points import LONG
from stereotruth.align.records import (
    Equations,
    PairEquations,
    ScenePair,
    pair_alignment,
    read_site,
    write_equations,
)
from stereotruth.align.site_adjustment import adjust_site
from stereotruth.core.errors import InputError
from stereotruth.core.products.files import write_sealed, write_table

from ...synthetic.cameras import HEIGHT, LAT, LON, camera

SIZE = (1000, 900)
NAMES = tuple("ABCDEF")
TILTS = np.linspace(-0.4, 0.4, len(NAMES))
CAMERAS = {name: camera((0.02, t), size=SIZE) for name, t in zip(NAMES, TILTS)}
TIES = 140


def fit_of(name: str, view: str = "left") -> ViewFit:
    """By the RPC alone."""
    fit = ViewFit(
        view, f"{name}.tif", SIZE, np.eye(2, 3), (), np.nan, 0, (0.0, 0.0), 1.0, np.eye(6)
    )
    return over_the_image(fit)


class Site:
    """Files of all pairs of six images whose true corrections are known."""

    def __init__(self, folder: Path, shifts: dict[str, tuple[float, float]] | None = None) -> None:
        self.folder, rng = folder, np.random.default_rng(11)
        self.rng = rng
        self.truth = {n: rng.normal(0, [0.1, 0.1, 0.0] * 2) for n in NAMES}
        for name in NAMES:
            shift = (shifts or {}).get(name, rng.normal(0, 1.5, 2))
            self.truth[name][[2, 5]] = shift
        self.gcps = folder / "gcps.csv"
        self.write_points(NAMES)
        self.pairs = [self.pair(*names) for names in combinations(NAMES, 2)]

    def write_points(self, images: Sequence[str]) -> None:
        rng, rows = np.random.default_rng(5), []
        for k in range(8):
            lon, lat = LON + rng.uniform(-0.002, 0.002), LAT + rng.uniform(-0.002, 0.002)
            for name in NAMES:
                at = np.array(CAMERAS[name].project(lon, lat, HEIGHT + 3.0 * k))
                at = at + fit_of(name).design(*at) @ self.truth[name] + rng.normal(0, 0.2, 2)
                if name in images:
                    cells = f"G{k}", lon, lat, HEIGHT + 3.0 * k, name, *at.tolist()
                    rows.append(dict(zip(LONG, cells)))
        write_table(self.gcps, rows)

    def pair(self, left: str, right: str, reason: str = "") -> ScenePair:
        """Files of a pair; without tie points for a ``reason``."""
        rng, scene = self.rng, f"{left}-{right}"
        at = rng.uniform(0, SIZE, (TIES, 2))
        basis = fit_of(left).design(*at.T)
        slopes = np.eye(2) * (1.0 + rng.normal(0, 0.05, (TIES, 1, 1)))
        design = np.concatenate([-slopes @ basis, basis], axis=-1)
        truth = np.concatenate([self.truth[left], self.truth[right]])
        observed = design @ truth + rng.normal(0, 0.03, (TIES, 2))
        equations = Equations(
            design, observed, np.full(TIES, 0.03), (at // 150).astype(int) @ [10, 1], at, at
        )
        ties = None if reason else PairEquations(equations, 0 * truth, truth, 160, 0.0)
        made = self.folder / scene
        made.mkdir(exist_ok=True)
        write_equations(made / "equations.json", ties, reason)
        alignment = Alignment(
            scene, "affine", CAMERAS[left], CAMERAS[right], fit_of(left),
            replace(fit_of(right), view="right"), HEIGHT, ("of its own",), {},
            refinement={"applied": False, "reason": reason},
        )  # fmt: skip
        alignment.save(made / "alignment.json")
        files = made / "alignment.json", made / "equations.json", self.gcps
        return ScenePair(scene, left, right, *files)

    def spoil(self, name: str, **how) -> None:
        """All pairs of an image anew."""
        self.pairs = [self.pair(*p.names, **how) if name in p.names else p for p in self.pairs]


def named(site: dict) -> dict[str, list[str]]:
    return {name: image["doubts"] for name, image in site["images"].items() if image["doubts"]}


def worst_error(site: dict, truth: dict[str, np.ndarray], names: Sequence[str]) -> float:
    """Largest error px at the corners of images."""
    return max(
        float(
            np.abs(
                fit_of(n).design(0, 0) @ (np.array(site["images"][n]["parameters"]) - truth[n])
            ).max()
        )
        for n in names
    )


def test_one_image_has_one_correction_in_all_of_its_pairs(tmp_path):
    made = Site(tmp_path)
    site = adjust_site("Town", made.pairs)
    assert named(site) == {}
    assert worst_error(site, made.truth, NAMES) < 0.25
    write_sealed(site, tmp_path / "site.json")
    assert read_site(tmp_path / "site.json") == site
    affines = {}
    for pair in made.pairs:
        alignment = Alignment.from_dict(pair_alignment(site, pair))
        for name, sensor, fit in zip(pair.names, (alignment.left, alignment.right), alignment.fits):
            affines.setdefault(name, sensor.affine)
            assert (sensor.affine == affines[name]).all() and (fit.affine == affines[name]).all()
            assert parameters_of(fit) == pytest.approx(site["images"][name]["parameters"])
            assert len(fit.gcps) == 8 and fit.rms("after") < 0.5
        after = alignment.refinement["after"]["disparity"]["rms"]
        assert after < 0.05 < alignment.refinement["before"]["disparity"]["rms"]
        assert "of its own" in alignment.warnings
        # what two images share they owe to the same points: their covariance is far from nothing
        assert np.linalg.eigvalsh(alignment.covariance).min() > -1e-9
        assert np.abs(alignment.cross_covariance).max() > 1e-4


@pytest.mark.slow
def test_order_of_the_pairs_plays_no_part(tmp_path):
    made = Site(tmp_path)
    assert adjust_site("Town", made.pairs) == adjust_site("Town", made.pairs[::-1])


@pytest.mark.slow
def test_an_rpc_that_is_far_off_is_named_and_corrected(tmp_path):
    made = Site(tmp_path, {"C": (12.0, -9.0)})
    site = adjust_site("Town", made.pairs)
    assert list(named(site)) == ["C"]
    with pytest.raises(InputError, match="image C of Town"):
        adjust_site("Town", made.pairs, strict=True)
    assert worst_error(site, made.truth, NAMES) < 0.25


@pytest.mark.slow
def test_an_image_that_nothing_places_is_refused_and_the_others_are_made(tmp_path):
    made = Site(tmp_path)
    clean = adjust_site("Town", made.pairs)
    made.write_points([name for name in NAMES if name != "D"])
    made.spoil("D", reason="no shift stands out")
    site = adjust_site("Town", made.pairs)
    assert list(named(site)) == ["D"]
    assert "neither tie points nor control points" in site["images"]["D"]["refused"]
    others = [name for name in NAMES if name != "D"]
    assert worst_error(site, made.truth, others) < worst_error(clean, made.truth, others) + 0.03
    for pair in made.pairs:
        record = pair_alignment(site, pair)
        file = tmp_path / pair.scene / "adjusted.json"
        write_sealed(record, file)
        if "D" in pair.names:
            with pytest.raises(InputError, match=f"{pair.scene}: image D: neither.*Remedy: remove"):
                Alignment.read(file)
        else:
            assert Alignment.read(file).scene == pair.scene


def test_an_image_without_tie_points_rests_on_its_control_points(tmp_path):
    made = Site(tmp_path)
    made.spoil("D", reason="only 3 places of smooth, textured ground")
    site = adjust_site("Town", made.pairs)
    (text,) = named(site)["D"]
    assert "no tie points in any of its pairs (5): only 3 places" in text
    assert site["images"]["D"]["refused"] == ""
    assert worst_error(site, made.truth, NAMES) < 0.6
    assert site["images"]["D"]["sigma"] > 2.0 * site["images"]["A"]["sigma"]


def test_a_later_image_leaves_those_that_are_fixed(tmp_path):
    made = Site(tmp_path)
    first = adjust_site("Town", [pair for pair in made.pairs if "F" not in pair.names])
    kept = tmp_path / "kept.json"
    write_sealed(first, kept)
    fixed = dict.fromkeys(NAMES[:5], kept)
    later = adjust_site("Town", made.pairs, fixed=fixed)
    for name in NAMES[:5]:
        assert later["images"][name]["fixed"]
        for what in ("parameters", "affine"):
            assert later["images"][name][what] == first["images"][name][what]
    assert worst_error(later, made.truth, ["F"]) < 0.3
    assert not later["images"]["F"]["fixed"]
    with pytest.raises(InputError, match="F: the file has no image of this name"):
        adjust_site("Town", made.pairs, fixed={"F": kept})
