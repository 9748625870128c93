"""Control points of other programs, against the same points in this project's form."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pyproj
import pytest
import rasterio
from rasterio.transform import from_origin

from stereotruth.align.control_points import read_gcps
from stereotruth.core.errors import InputError
from stereotruth.project.import_gcps import import_gcps

from ...synthetic.las import write_gtx
from ...synthetic.surveyed_pair import LAT, LON, make_gcps, write_gcps

UTM = pyproj.Transformer.from_crs(4326, 32650, always_xy=True)


@pytest.fixture
def rows() -> list[dict]:
    rows = make_gcps(6)
    rows[1]["left_col"] = rows[1]["left_row"] = float("nan")
    return rows


@pytest.fixture
def truth(rows, tmp_path):
    written = [{k: "" if v != v else v for k, v in row.items()} for row in rows]
    return read_gcps(write_gcps(tmp_path / "truth.csv", written))


def agree(file, truth, ids=True):
    found = read_gcps(file)
    order = np.argsort(found.lon), np.argsort(truth.lon)
    for name, tolerance in (("lon", 1e-9), ("lat", 1e-9), ("height", 1e-3), ("left", 1e-3),
                            ("right", 1e-3)):  # fmt: skip
        here, there = (getattr(p, name)[k] for p, k in zip((found, truth), order))
        np.testing.assert_allclose(here, there, atol=tolerance, err_msg=name)
    if ids:
        assert found.ids == truth.ids


def qgis(path, rows, view, *, utm=True, ids=False, crs=True):
    """As QGIS writes it: rows count downward from 0 as negative numbers, from the upper edge."""
    wkt = pyproj.CRS("EPSG:32650" if utm else "EPSG:4326").to_wkt()
    lines = [f"#CRS: {wkt}"] if crs else []
    lines.append("mapX,mapY,sourceX,sourceY,enable,dX,dY,residual" + ",id" * ids)
    for row in rows:
        col, line = row[f"{view}_col"], row[f"{view}_row"]
        if col != col:
            continue
        x, y = UTM.transform(row["lon"], row["lat"]) if utm else (row["lon"], row["lat"])
        name = f",{row['id']}" if ids else ""
        lines.append(f"{x:.12f},{y:.12f},{col + 0.5},{-(line + 0.5)},1,0,0,0{name}")
    lines.append(lines[-1].replace(",1,0,0,0", ",0,0,0,0"))  # switched off
    path.write_text("\n".join(lines) + "\n")
    return path


def heights(path, rows, columns=("id", "height")):
    with path.open("w", newline="") as stream:
        writer = csv.DictWriter(stream, columns, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    return path


@pytest.mark.parametrize("ids", [True, False])
def test_points_of_qgis_are_joined(rows, truth, tmp_path, ids):
    files = [qgis(tmp_path / f"{v}.points", rows, v, ids=ids) for v in ("left", "right")]
    columns = ("id", "height") if ids else ("lon", "lat", "height")
    lines = import_gcps(files, tmp_path / "out.csv",
                        heights=heights(tmp_path / "h.csv", rows, columns))  # fmt: skip
    agree(tmp_path / "out.csv", truth, ids)
    assert ("their ids" if ids else "their map coordinates") in lines[0]
    assert "6 points, 5 of them in both views" in lines[-1]


def test_heights_of_a_raster_and_a_geoid(rows, truth, tmp_path):
    files = [qgis(tmp_path / f"{v}.points", rows, v, utm=False) for v in ("left", "right")]
    step = 0.0005
    grid = rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=100, height=100, count=1,
        dtype="float64", crs="EPSG:4326",
        transform=from_origin(LON - 0.025, LAT + 0.025, step, step),
    )  # fmt: skip
    with grid:
        row, col = np.mgrid[:100, :100]
        lon, lat = LON - 0.025 + (col + 0.5) * step, LAT + 0.025 - (row + 0.5) * step
        grid.write(100 + 1000 * (lon - LON) + 500 * (lat - LAT), 1)
    geoid = write_gtx(tmp_path / "geoid.gtx", np.full((3, 3), -20.0), 114.0, 29.0, 1.0)
    import_gcps(files, tmp_path / "out.csv", heights=tmp_path / "dem.tif", geoid=geoid)
    found = read_gcps(tmp_path / "out.csv")
    wanted = 80 + 1000 * (found.lon - LON) + 500 * (found.lat - LAT)
    np.testing.assert_allclose(found.height, wanted, atol=2e-4)


def asp(path, rows):
    lines = ["# id lat lon height sigmas image col row sigmas"]
    for row in rows:
        line = f"{row['id']} {row['lat']:.12f} {row['lon']:.12f} {row['height']:.6f} 1 1 1"
        for view in ("left", "right"):
            if row[f"{view}_col"] == row[f"{view}_col"]:
                line += f" in/{view}.tif {row[f'{view}_col']} {row[f'{view}_row']} 1 1"
        lines.append(line)
    path.write_text("\n".join(lines) + "\n")
    return path


def test_gcps_of_ames_stereo_pipeline(rows, truth, tmp_path):
    file = asp(tmp_path / "a.gcp", rows)
    import_gcps([file], tmp_path / "out.csv")
    agree(tmp_path / "out.csv", truth)
    lines = import_gcps([file], tmp_path / "turned.csv", left="right.tif", right="left.tif")
    assert "left: in/right.tif" in lines[0]
    turned = read_gcps(tmp_path / "turned.csv")
    np.testing.assert_allclose(turned.left, truth.right, atol=1e-3)


def test_tables_with_other_names(rows, truth, tmp_path):
    lines = ["Point;Easting;Northing;Z;left_x;left_y;right_x;right_y"]
    for row in rows:
        x, y = UTM.transform(row["lon"], row["lat"])
        values = [x, y, *(row[c] for c in list(row)[3:])]
        cells = [f"{v:.6f}".replace(".", ",") if v == v else "" for v in values]
        lines.append(";".join([row["id"], *cells]))
    (tmp_path / "a.csv").write_text("\n".join(lines))
    import_gcps([tmp_path / "a.csv"], tmp_path / "out.csv", crs="EPSG:32650")
    agree(tmp_path / "out.csv", truth)
    esri = pyproj.CRS("EPSG:32650").to_wkt("WKT1_ESRI")  # which is no national system either
    import_gcps([tmp_path / "a.csv"], tmp_path / "esri.csv", crs=esri)
    agree(tmp_path / "esri.csv", truth)


@pytest.mark.parametrize(
    "change",
    [lambda t: t.replace("#CRS", "#"), lambda t: t.replace("mapX", "map"),
     lambda t: t.replace(",-", ","), lambda t: "", lambda t: t.replace(",1,0,0,0", ",1,0,0,0,0"),
     lambda t: t.replace("3341", "33x41").replace("3342", "33x42")],
    ids=["no system", "no column", "rows upward", "empty", "a cell too many", "no number"],
)  # fmt: skip
def test_what_cannot_be_read_is_named(rows, tmp_path, change):
    files = [qgis(tmp_path / f"{v}.points", rows, v) for v in ("left", "right")]
    files[0].write_text(change(files[0].read_text()))
    with pytest.raises(InputError) as error:
        import_gcps(files, tmp_path / "out.csv", heights=heights(tmp_path / "h.csv", rows))
    assert "left.points" in str(error.value) and error.value.remedy
    assert not (tmp_path / "out.csv").exists()


def test_points_keep_a_frame_that_is_known(tmp_path):
    """NAD83(2011), of which PROJ says that it is WGS 84 to 2 m."""
    (tmp_path / "a.csv").write_text(
        "id,x,y,height,left_col,left_row,right_col,right_row\nA,550000,5272000,20,1,2,3,4\n"
    )
    import_gcps([tmp_path / "a.csv"], tmp_path / "out.csv", crs="EPSG:6339", epoch="2010.0",
                geoid=Path("none"))  # fmt: skip
    lines = (tmp_path / "out.csv").read_text().splitlines()
    assert lines[:2] == ["# frame: EPSG:6318", "# epoch: 2010.0"]
    found = read_gcps(tmp_path / "out.csv")
    assert found.height[0] - 20 == pytest.approx(-0.32, abs=0.01)
    text = (tmp_path / "a.csv").read_text().replace("5272000,20", "5272000,")
    (tmp_path / "b.csv").write_text(text)
    place = lines[3].split(",")
    (tmp_path / "h.csv").write_text(f"lon;lat;height\n{place[1]};{place[2]};20,0\n")
    import_gcps([tmp_path / "b.csv"], tmp_path / "out_b.csv", crs="EPSG:6339",
                heights=tmp_path / "h.csv", geoid=Path("none"))  # fmt: skip
    assert read_gcps(tmp_path / "out_b.csv").height[0] == found.height[0]
    import_gcps([tmp_path / "a.csv"], tmp_path / "wgs.csv", crs="EPSG:32610")
    assert not (tmp_path / "wgs.csv").read_text().startswith("#")


def paris(tmp_path, height="height"):
    file = tmp_path / "a.csv"
    file.write_text(HEAD.replace("height", height) + "A,652000,6862000,35,1,2,3,4\n")
    return file


def test_heights_of_a_national_plane_system_are_asked_for(tmp_path):
    """Of Lambert 93 without a vertical part: IGN 69, 44 m below the ellipsoid, or not."""
    file, out = paris(tmp_path), tmp_path / "out.csv"
    with pytest.raises(InputError) as refused:
        import_gcps([file], out, crs="EPSG:2154")
    assert "--geoid" in refused.value.remedy and "--geoid none" in refused.value.remedy
    assert not out.exists()


@pytest.mark.parametrize(
    ("crs", "column", "how", "lifted"),
    [
        ("EPSG:2154", "height", {"geoid": "geoid.gtx"}, 44.0),
        ("EPSG:2154+5720", "height", {"geoid": "geoid.gtx"}, 44.0),
        ("EPSG:2154", "height", {"geoid": "none"}, 0.0),
        ("EPSG:2154", "ellipsoidal_height", {}, 0.0),
        (pyproj.CRS("EPSG:2154").to_3d().to_wkt(), "height", {}, 0.0),
    ],
)
def test_stated_heights_of_a_national_plane_system(tmp_path, crs, column, how, lifted):
    file, out = paris(tmp_path, column), tmp_path / "out.csv"
    write_gtx(tmp_path / "geoid.gtx", np.full((9, 9), 44.0), 0.0, 46.0, 1.0)
    how = {k: Path(v) if v == "none" else tmp_path / v for k, v in how.items()}
    import_gcps([file], out, crs=crs, **how)
    height = float(out.read_text().splitlines()[-1].split(",")[3])
    assert height == pytest.approx(35.0 + lifted, abs=1e-3)


def test_a_table_of_heights_says_what_they_count_from(tmp_path):
    for view in ("left", "right"):
        (tmp_path / f"{view}.points").write_text(
            "mapX,mapY,sourceX,sourceY,enable\n652000,6862000,10,-10,1\n"
        )
    files, out = [tmp_path / f"{view}.points" for view in ("left", "right")], tmp_path / "out.csv"
    for column in ("height", "ellipsoidal_height"):
        heights = tmp_path / f"{column}.csv"
        heights.write_text(f"id,{column}\nG01,35\n")
        if column == "height":
            with pytest.raises(InputError):
                import_gcps(files, out, crs="EPSG:2154", heights=heights)
        else:
            import_gcps(files, out, crs="EPSG:2154", heights=heights)
    assert float(out.read_text().splitlines()[-1].split(",")[3]) == pytest.approx(35.0, abs=1e-3)


SEATTLE = (-122.3, 47.6)
HEAD = "id,lon,lat,height,left_col,left_row,right_col,right_row\n"


def test_heights_above_egm_are_in_itrf_whatever_the_frame_of_the_places(tmp_path):
    """EGM counts from WGS 84, not from NAD83(2011), which lies 0.32 m below it there."""
    crs = "EPSG:6318+5773"
    geoid = write_gtx(tmp_path / "egm96.gtx", np.full((9, 9), -22.0), -124.0, 46.0, 0.5)
    (tmp_path / "a.csv").write_text(f"{HEAD}A,{SEATTLE[0]},{SEATTLE[1]},120,1,2,3,4\n")
    import_gcps([tmp_path / "a.csv"], tmp_path / "out.csv", crs=crs, geoid=geoid)
    assert read_gcps(tmp_path / "out.csv").height[0] == pytest.approx(98.0, abs=1e-3)


@pytest.mark.parametrize(
    ("points", "raster"), [("EPSG:6318", "EPSG:4326"), ("EPSG:4326", "EPSG:6318")]
)
def test_heights_of_a_raster_are_brought_to_the_frame_of_the_points(tmp_path, points, raster):
    """Points of either frame, of a raster of either: the height that holds in ITRF2020."""
    with rasterio.open(
        tmp_path / "dem.tif", "w", driver="GTiff", width=50, height=50, count=1, dtype="float64",
        crs=pyproj.CRS(raster).to_3d().to_wkt(), transform=from_origin(-122.31, 47.61, 4e-4, 4e-4),
    ) as grid:  # fmt: skip
        grid.write(100.0 + np.mgrid[:50, :50][0], 1)
    (tmp_path / "a.csv").write_text(f"{HEAD}A,{SEATTLE[0]},{SEATTLE[1]},,1,2,3,4\n")
    import_gcps(
        [tmp_path / "a.csv"], tmp_path / "out.csv", crs=points, heights=tmp_path / "dem.tif"
    )
    found = read_gcps(tmp_path / "out.csv")
    north_m = {"EPSG:6318": 0.322, "EPSG:4326": 0.0}  # that places move by to ITRF2020
    row = (47.61 - 47.6) / 4e-4 - 0.5 + (north_m[raster] - north_m[points]) / 44.5
    lifted = -0.317 if raster == "EPSG:6318" else 0.0
    assert found.height[0] == pytest.approx(100.0 + row + lifted, abs=2e-3)
