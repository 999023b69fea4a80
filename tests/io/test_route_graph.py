"""Route graphs for Nav2: what is blocked is closed, what is doubtful costs more, by the rules of its own loader."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely.geometry

from evermap.errors import InputError
from evermap.geometry import se3
from evermap.io.nav2 import write_route_graph
from evermap.types import Landmarks, Up

NODES = {0: (0.0, 0.0), 1: (10.0, 0.0), 2: (10.0, 6.0), 7: (0.0, 6.0)}
EDGES = {10: (0, 1), 11: (1, 2), 12: (2, 7), 13: (7, 0), 14: (1, 0)}


def node(number: int, at: tuple[float, float]) -> dict[str, Any]:
    point = {"type": "Point", "coordinates": list(at)}
    return {"type": "Feature", "properties": {"id": number, "frame": "map"}, "geometry": point}


def edge(number: int, start: int, end: int, **more: Any) -> dict[str, Any]:
    line = {"type": "MultiLineString", "coordinates": [[list(NODES[start]), list(NODES[end])]]}
    return {"type": "Feature", "properties": {"id": number, "startid": start, "endid": end, **more}, "geometry": line}


def graph(path: Path, **more: Any) -> Path:
    features = [*(node(*one) for one in NODES.items()), *(edge(k, *ends) for k, ends in EDGES.items())]
    path.write_text(json.dumps({"type": "FeatureCollection", "name": "site", "features": features, **more}))
    return path


def loaded(path: Path) -> tuple[dict[int, Any], dict[int, dict[str, Any]]]:
    """Nodes and edges as nav2_route's GeoJSON loader takes them, with its checks."""
    nodes, edges = {}, {}
    features = json.loads(path.read_text())["features"]
    for feature in features:
        if feature["geometry"]["type"] == "Point":
            nodes[feature["properties"]["id"]] = tuple(feature["geometry"]["coordinates"][:2])
    for feature in features:
        if feature["geometry"]["type"] in ("MultiLineString", "LineString"):
            one = feature["properties"]
            assert one["startid"] in nodes
            assert one["endid"] in nodes
            penalty = one.get("metadata", {}).get("penalty", 0.0)
            assert isinstance(penalty, float)  # any_cast<float> of a whole number throws
            edges[one["id"]] = one
    assert nodes
    assert edges
    return nodes, edges


def test_edges_are_closed_or_cost_more_by_what_stands_near(tmp_path: Path) -> None:
    landmarks = Landmarks.at([1, 2, 3], [[5.0, 0.3], [10.4, 3.0], [5.0, 5.0]])
    landmarks.p_exists[:] = [0.97, 0.2, 0.9]
    told = write_route_graph(landmarks, graph(tmp_path / "in.json"), tmp_path / "out.geojson", clearance_m=0.5)
    assert [(one.number, one.closed) for one in told] == [
        (10, True), (11, False), (12, False), (13, False), (14, True),
    ]  # fmt: skip
    nodes, edges = loaded(tmp_path / "out.geojson")
    assert nodes == NODES
    assert sorted(edges) == [11, 12, 13]
    assert edges[11]["metadata"] == {"penalty": pytest.approx(6.0 * 0.2 / 0.8), "p_blocked": 0.2}
    assert "metadata" not in edges[12]
    document = json.loads((tmp_path / "out.geojson").read_text())
    assert document["evermap"]["closed_edges"] == [10, 14]
    # what is left is clear of what surely stands, by shapely
    ways = [one["geometry"] for one in document["features"] if one["geometry"]["type"].endswith("LineString")]
    sure = shapely.geometry.MultiPoint(landmarks.position_m[landmarks.p_exists > 0.5])
    assert len(ways) == 3
    assert all(shapely.geometry.shape(way).distance(sure) > 0.5 for way in ways)
    assert document["name"] == "site"


def test_a_penalty_is_added_to_what_is_there(tmp_path: Path) -> None:
    features = [node(0, NODES[0]), node(1, NODES[1]), edge(3, 0, 1, metadata={"penalty": 2, "speed_limit": 85.0})]
    path = graph(tmp_path / "in.json", features=features)
    landmarks = Landmarks.at([1], [[5.0, 0.0]])
    landmarks.p_exists[:] = 0.25
    write_route_graph(landmarks, path, tmp_path / "out.json")
    told = loaded(tmp_path / "out.json")[1][3]["metadata"]
    assert told == {"penalty": pytest.approx(2.0 + 10.0 / 3.0), "speed_limit": 85.0, "p_blocked": 0.25}


def test_near_is_near_the_body_of_a_landmark(tmp_path: Path) -> None:
    """Against the nearest of many points of boxes that are turned, and of points."""
    random = np.random.default_rng(1)
    path = graph(tmp_path / "in.json")
    for _ in range(40):
        turn = random.uniform(-np.pi, np.pi)
        rotation = se3.exp(np.array([[0.0, 0.0, 0.0, 0.0, 0.0, turn]]))[:, 3:]
        at, size = random.uniform([-2.0, -2.0], [12.0, 8.0]), random.uniform(0.2, 3.0, 2) * random.integers(0, 2)
        sizes = np.array([[*size, 1.0]]) if size.any() else np.full((1, 3), np.nan)
        box = Landmarks.in_space([1], [[*at, 0.5]], rotation=rotation, size_m=sizes)
        box = replace(box, up=Up(np.array([0.0, 0.0, 1.0]), 0.01, "stated"))
        inside = np.stack(np.meshgrid(*2 * [np.linspace(-0.5, 0.5, 61)]), axis=-1).reshape(-1, 2) * size
        body = at + inside @ np.array([[np.cos(turn), np.sin(turn)], [-np.sin(turn), np.cos(turn)]])
        for one in write_route_graph(box, path, tmp_path / "out.json", clearance_m=0.4):
            start, step = one.ends[0], one.ends[1] - one.ends[0]
            share = np.clip((body - start) @ step / (step @ step), 0.0, 1.0)
            far = np.linalg.norm(body - start - share[:, None] * step, axis=1).min()
            if abs(far - 0.4) > 0.03:
                assert one.closed == (far < 0.4), (at, size, turn, one)


@pytest.mark.parametrize(
    ("features", "match"),
    [
        (None, "field 'features': no GeoJSON"),
        ([1], r"features\[0\]': is neither a node nor an edge"),
        ([{"type": "Feature", "properties": {}, "geometry": None}], r"features\[0\]': is neither"),
        ([node(0, ("a", 1.0))], r"features\[0\]': has no coordinates"),  # type: ignore[arg-type]
        ([node(0, (1e300, 1.0))], "implausibly far away"),
        ([node(0, NODES[0]), node(0, NODES[1])], r"features\[1\]': has the id 0 of another node"),
        ([node(0, NODES[0]), edge(3, 0, 1)], r"features\[1\]': endid 1 is not a node"),
        (
            [node(0, NODES[0]), node(1, NODES[1]), edge(3, 0, 1) | {"properties": {"startid": 0, "endid": 1}}],
            "properties.id",
        ),
        ([node(-3, NODES[0])], "no whole number as properties.id"),
        ([node(0, NODES[0]), node(1, NODES[1]), edge(3, 0, 1, metadata={"penalty": "x"})], "metadata.penalty"),
        ([{**node(0, NODES[0]), "properties": {"id": 0, "frame": "odom"}}], "is in the frame 'odom'"),
    ],
)
def test_what_is_no_route_graph(features: Any, match: str, tmp_path: Path) -> None:
    near = Landmarks.at([1], [[5.0, 0.0]])
    near.p_exists[:] = 0.3
    with pytest.raises(InputError, match=match):
        write_route_graph(near, graph(tmp_path / "in.json", features=features), tmp_path / "out.json")
    assert not (tmp_path / "out.json").exists()


@pytest.mark.parametrize("text", ["", "{", "[]", "\x00", '{"features": [NaN]}', "[" * 100_000])
def test_what_is_no_json(text: str, tmp_path: Path) -> None:
    (tmp_path / "in.json").write_text(text)
    with pytest.raises(InputError, match=r"in\.json"):
        write_route_graph(Landmarks.at([1], [[5.0, 0.0]]), tmp_path / "in.json", tmp_path / "out.json")
