"""Maps in files: what others find in them, and what comes back."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
import shapely.geometry
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from evermap.errors import DataError, InputError
from evermap.io import read_landmarks, read_prior_map, write_map_geojson, write_map_parquet
from evermap.io.landmarks import ellipse_polygons
from evermap.types import Clock, Landmarks

WRITERS = {"map.parquet": write_map_parquet, "map.geojson": write_map_geojson}


def a_map() -> Landmarks:
    return Landmarks(
        landmark_id=np.array([2, 5, 9]),
        position_m=np.array([[1.0, 2.0], [-3.5, 0.1], [0.0, 0.0]]),
        covariance_m2=np.array(
            [[[0.04, 0.01], [0.01, 0.09]], [[0.01, -0.02], [-0.02, 0.25]], [[0.0, 0.0], [0.0, 0.0]]]
        ),
        class_id=np.array([1, -1, 0]),
        p_exists=np.array([0.99, 0.2, 1.0]),
        n_hits=np.array([12, 3, 1]),
        n_misses=np.array([1, 0, 7]),
        first_seen_s=np.array([1248444187.156, 5.0, np.nan]),
        last_seen_s=np.array([1248444199.25, 6.0, np.nan]),
        class_names=("pillar", "door"),
        frame="first_pose",
        clock=Clock.UNIX,
    )


@pytest.mark.parametrize("name", WRITERS)
def test_maps_read_back_the_same(name: str, tmp_path: Path, assert_same: Callable) -> None:
    path = WRITERS[name](a_map(), tmp_path / name)
    assert_same(a_map(), read_landmarks(path))
    assert_same(replace(a_map(), frame="prior_map"), read_prior_map(tmp_path))  # a run folder


@pytest.mark.parametrize("name", WRITERS)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_map_reads_back_the_same(name: str, data: st.DataObject, tmp_path: Path, assert_same: Callable) -> None:
    count = data.draw(st.integers(0, 5))
    factor = data.draw(hnp.arrays(np.float64, (count, 2, 2), elements=st.floats(-3, 3).map(lambda x: round(x, 4))))
    landmarks = replace(
        Landmarks.at(
            np.arange(count) * 7,
            data.draw(hnp.arrays(np.float64, (count, 2), elements=st.floats(-1e7, 1e7))),
            frame=data.draw(st.sampled_from(["first_pose", "prior_map", "truth"])),
        ),
        covariance_m2=np.matmul(factor, factor.transpose(0, 2, 1)),
        p_exists=data.draw(hnp.arrays(np.float64, count, elements=st.floats(0, 1))),
        class_names=("a", "b"),
        class_id=data.draw(hnp.arrays(np.int64, count, elements=st.integers(-1, 1))),
    )
    assert_same(landmarks, read_landmarks(WRITERS[name](landmarks, tmp_path / name)))


def test_parquet_as_others_see_it(tmp_path: Path) -> None:
    table = pq.read_table(write_map_parquet(a_map(), tmp_path / "map.parquet")).to_pydict()
    assert table["landmark_id"] == [2, 5, 9]
    assert table["x_m"] == [1.0, -3.5, 0.0]
    assert table["cov_xy_m2"] == [0.01, -0.02, 0.0]
    assert table["class_id"] == ["door", None, "pillar"]
    assert table["n_misses"] == [1, 0, 7]


def test_geojson_as_others_see_it(tmp_path: Path) -> None:
    document = json.loads(write_map_geojson(a_map(), tmp_path / "map.geojson").read_text())
    assert document["type"] == "FeatureCollection"
    assert document["crs"] is None
    assert document["evermap"]["frame"] == "first_pose"
    assert "not longitude and latitude" in document["evermap"]["coordinates"]
    kinds = [
        (f["properties"]["kind"], f["properties"]["landmark_id"], f["geometry"]["type"]) for f in document["features"]
    ]
    assert kinds == [
        ("landmark", 2, "Point"), ("ellipse_2sigma", 2, "Polygon"), ("landmark", 5, "Point"),
        ("ellipse_2sigma", 5, "Polygon"), ("landmark", 9, "Point"),
    ]  # fmt: skip
    point = document["features"][0]
    assert point["geometry"]["coordinates"] == [1.0, 2.0]
    assert point["properties"]["class_id"] == "door"
    assert point["properties"]["p_exists"] == 0.99
    assert document["features"][4]["properties"]["first_seen_s"] is None


def test_geojson_as_shapely_sees_it(tmp_path: Path) -> None:
    landmarks = a_map()
    document = json.loads(write_map_geojson(landmarks, tmp_path / "map.geojson").read_text())
    drawn = [
        (one["properties"]["landmark_id"], shapely.geometry.shape(one["geometry"])) for one in document["features"]
    ]
    points = {name: one for name, one in drawn if one.geom_type == "Point"}
    assert {name: list(one.coords[0]) for name, one in points.items()} == dict(
        zip(landmarks.landmark_id.tolist(), landmarks.position_m.tolist(), strict=True)
    )
    for name, ellipse in drawn:
        if ellipse.geom_type == "Polygon":
            assert ellipse.is_valid
            assert ellipse.exterior.is_ccw
            assert ellipse.centroid.distance(points[name]) < 1e-9


def test_ellipses_lie_at_two_sigmas_and_turn_left() -> None:
    landmarks = a_map()
    outline = ellipse_polygons(landmarks.position_m, landmarks.covariance_m2)[:2]
    assert np.array_equal(outline[:, 0], outline[:, -1])
    away = outline - landmarks.position_m[:2, None]
    distance2 = np.einsum("lki,lij,lkj->lk", away, np.linalg.inv(landmarks.covariance_m2[:2]), away)
    np.testing.assert_allclose(distance2, 4.0, rtol=1e-9)
    x, y = outline[:, :-1, 0], outline[:, :-1, 1]
    area = 0.5 * np.sum(x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1), axis=1)
    exact = 4.0 * np.pi * np.sqrt(np.linalg.det(landmarks.covariance_m2[:2]))
    np.testing.assert_allclose(area, exact, rtol=0.01)  # positive: counter-clockwise
    assert np.all(ellipse_polygons(landmarks.position_m, landmarks.covariance_m2)[2] == 0.0)


def test_a_hand_written_prior_map(tmp_path: Path) -> None:
    path = tmp_path / "site.csv"
    path.write_text("# surveyed in May\nlandmark_id,x_m,y_m,sigma_m\n8,1,2,0.5\n3,-1,0,\n")
    landmarks = read_prior_map(path, sigma_m=0.1)
    np.testing.assert_array_equal(landmarks.landmark_id, [3, 8])
    np.testing.assert_array_equal(landmarks.position_m, [[-1, 0], [1, 2]])
    np.testing.assert_allclose(landmarks.covariance_m2, [np.eye(2) * 0.01, np.eye(2) * 0.25])
    assert landmarks.frame == "prior_map"


BAD = {
    "missing": (None, "no such map"),
    "site.csv": ("landmark_id,x_m\n1,2\n", r"site\.csv:1: field 'y_m': missing column"),
    "twice.csv": (
        "landmark_id,x_m,y_m\n1,2,3\n1,2,3\n",
        r"twice\.csv:3: field 'landmark_id': landmark 1 is listed twice",
    ),
    "noid.csv": ("landmark_id,x_m,y_m\n,2,3\n", r"noid\.csv:2: field 'landmark_id': is empty"),
    "cut.csv": ("landmark_id,x_m,y_m\n1,2,3\n2,5", r"cut\.csv: the last line is unfinished"),
    "both.csv": ("landmark_id,x_m,y_m,sigma_m,cov_xx_m2\n1,2,3,1,1\n", r"both sigma_m and cov_"),
    "cov.csv": ("landmark_id,x_m,y_m,cov_xx_m2,cov_xy_m2,cov_yy_m2\n1,2,3,1,2,1\n", r"cov\.csv:2: .*semidefinite"),
    "part.csv": ("landmark_id,x_m,y_m,cov_xx_m2\n1,2,3,1\n", r"part\.csv:1: field 'cov_xy_m2': missing column"),
    "p.csv": ("landmark_id,x_m,y_m,p_exists\n1,2,3,1.5\n", r"p\.csv:2: field 'p_exists': 1.5 is outside"),
    "map.xlsx": ("", "unknown map format '.xlsx'"),
    "a.geojson": ("{", r"a\.geojson:1: not valid JSON"),
    "b.geojson": ('{"features": []}', "local frame"),
    "c.geojson": (
        '{"features": [{"type": "Feature", "geometry": {"type": "Point"}}], "evermap": {}}',
        r"c\.geojson:1: .*coordinates",
    ),
    "d.geojson": ('{"features": [], "evermap": {"schema_version": 99}}', "schema version 99"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_maps_are_refused(name: str, tmp_path: Path) -> None:
    content, words = BAD[name]
    if content is not None:
        (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=words):
        read_prior_map(tmp_path / name)


def test_empty_maps_and_bad_sigmas(tmp_path: Path) -> None:
    (tmp_path / "empty.csv").write_text("landmark_id,x_m,y_m\n")
    with pytest.raises(DataError, match="no landmark"):
        read_prior_map(tmp_path / "empty.csv")
    with pytest.raises(InputError, match="positive"):
        read_prior_map(tmp_path / "empty.csv", sigma_m=0.0)
    with pytest.raises(InputError, match=r"looked for map\.parquet"):
        read_prior_map(tmp_path)
