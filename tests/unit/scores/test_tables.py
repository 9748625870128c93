"""Tables in the form of the paper."""

from __future__ import annotations

import pytest

from stereobench.scores.published import TABLE7, training_data
from stereobench.scores.tables import by_city, of_fine_tuned, of_methods

from ...synthetic.toy_benchmark import rows, texts, titles

pytestmark = pytest.mark.filterwarnings("ignore::rasterio.errors.NotGeoreferencedWarning")


def test_tables_have_the_paper_s_form(compared):
    five = rows(compared / "compared/methods.csv")
    assert [row["method"] for row in five] == ["Two", "Half"]
    assert float(five[0]["filled_epe_px"]) == pytest.approx(2, abs=1e-5)
    assert float(five[0]["filled_d1_3_px_share"]) == 0
    assert float(five[0]["filled_d1_1_px_share"]) == 1
    six = rows(compared / "compared/by_city.csv")
    assert [(row["city"], row["group"], row["method"]) for row in six] == [
        ("Kunming", "cities with training tiles", "Two"),
        ("Wuhan", "cities without", "Two"),
    ]
    seven = rows(compared / "compared/fine_tuned.csv")
    assert [row["method"] for row in seven] == ["Two", "Half"] * 2
    text = (compared / "compared/methods.md").read_text()
    assert "| Two | 2.000 [2.000, 2.000] | **0.00 [0.00, 0.00]** | 100.00 |" in text
    assert "6 pairs, disparities [-8, 8) px" in text
    assert "| near step |" in (compared / "compared/strata.md").read_text()


def summary(method, kind, cities, fine_tuned_of=None):
    figures = ("epe_px", "d1_3_px_share", "filled_epe_px", "filled_d1_3_px_share")
    of = {
        name: dict(zip(figures, (e, d, e, d))) | {"tiles": 1, "labelled": n, "valid_share": 1}
        for name, (n, e, d) in cities.items()
    }
    return {
        "label": method.title(),
        "method": method,
        "fine_tuned_of": fine_tuned_of,
        "settings": {"kind": kind},
        "dataset": "d",
        "split": "test",
        "tiles": 9,
        "disparity_range": [-128, 64],
        "thresholds_px": [3.0],
        "median_seconds": 0.5061,
        "peak_memory_mb": 700.2,
        "device": "CPU",
        "threads": 1,
        "all": {"city": "all", **next(iter(of.values()))},
        "cities": [{"city": name, **row} for name, row in of.items()],
        "strata": [{"stratum": "all", **next(iter(of.values()))}],
    }  # fmt: skip


def tables_of(methods, trained, *, beside_paper):
    of_cities = (of(methods, trained, beside_paper=beside_paper) for of in (by_city, of_fine_tuned))
    return of_methods(methods, beside_paper=beside_paper), *of_cities


def test_the_paper_s_figures_stand_apart_and_groups_are_pooled_by_pixels(tmp_path):
    cities = {"Kunming": (100, 1.0, 0.1), "Qichun": (300, 3.0, 0.5), "Wuhan": (50, 4.0, 0.25)}
    methods = [summary("sgm", "sgm", cities), summary("net", "stereonet", cities)]
    methods.append(summary("tuned", "stereonet", cities, fine_tuned_of="net"))
    five, six, seven = tables_of(methods, ["Kunming", "Qichun"], beside_paper=True)
    caption, shown = five.shown[1]
    assert caption == "The paper's, on the real WHU-Stereo."
    assert texts(shown) == [
        ["SGM", "4.889", "50.79", "506"],
        ["StereoNet", "2.453", "25.12", "238"],
    ]
    assert texts(five.shown[0][1])[0][-5:-3] == ["506", "700"]
    assert "paper_epe_px" not in five.rows[2]  # the paper's StereoNet was not fine-tuned
    (_, ours), (_, published) = six.shown
    assert titles(ours) == [
        "city",
        "Sgm: EPE, px",
        "Sgm: > 3 px, %",
        "Net: EPE, px",
        "Net: > 3 px, %",
    ]
    assert [heading for heading, _ in ours.groups] == [
        "cities with training tiles",
        "cities without",
    ]
    lines = texts(ours)
    assert [line[0] for line in lines] == ["Kunming", "Qichun", "all of group", "Wuhan"]
    assert lines[2][1:] == ["2.500", "40.00"] * 2
    assert "| **cities without** |  |  |  |  |" in six.markdown()
    assert texts(published)[0] == ["Kunming", "3.065", "37.50", "1.225", "6.09"]
    pooled = next(row for row in six.rows if row["city"] == "all of group")
    assert pooled["filled_epe_px"] == 2.5 and pooled["labelled"] == 400
    assert titles(seven.shown[0][1])[1::2] == ["Net: EPE, px", "Tuned: EPE, px"]
    assert seven.rows[1]["paper_epe_px"] == TABLE7["Kunming"]["stereonet"][0]
    methods.append(summary("again", "stereonet", cities, fine_tuned_of="net"))
    both = of_fine_tuned(methods, [], beside_paper=False)
    names = [name.partition(":")[0] for name in titles(both.shown[0][1])[1::2]]
    assert names == ["Net", "Tuned", "Again"]
    five, six, seven = tables_of(methods[:2], [], beside_paper=False)
    assert len(five.shown) == len(six.shown) == 1
    seven.write(tmp_path)
    assert "fine_tuned_of" in (tmp_path / "fine_tuned.md").read_text()
    assert (tmp_path / "fine_tuned.csv").read_text() == "method\n"


@pytest.mark.parametrize(
    ("settings", "trained_on", "seen"),
    [
        ({"kind": "sgm"}, "nothing", "no"),
        ({"kind": "pandora", "pipeline": "mccnn"}, "US3D", "yes"),
        ({"kind": "function", "function": "a:b"}, "not stated", "not stated"),
        ({"kind": "folder", "trained_on": ["us3d", "whu"]}, "us3d; whu", "yes"),
        (
            {"kind": "stereonet", "weights": "results/train/us3d/stereonet/best.pt"},
            "us3d, training pairs",
            "training pairs only",
        ),
    ],
)  # fmt: skip
def test_what_is_known_or_stated_of_a_method(settings, trained_on, seen):
    found = training_data({"dataset": "us3d", "settings": settings})
    assert found == {"trained_on": trained_on, "licence": "not stated", "seen_in_training": seen}
