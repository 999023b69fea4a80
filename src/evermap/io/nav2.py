"""Maps as Nav2 reads them: grids (an image and its YAML), for map_server and costmap filters, and route graphs.

Of a route graph, nodes are points with `id`; edges are lines with `id`, `startid` and `endid`, straight between their
nodes whatever their coordinates are. Those that a map says are blocked are left out. Numbers in `metadata` are for
scorers: `PenaltyScorer` adds `penalty` to the cost of an edge.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, Self

import numpy as np

from evermap.errors import ConfigError, DataError, InputError
from evermap.geometry import se3
from evermap.geometry.upright import level_map, level_pose
from evermap.io.files import content_of, write_atomic
from evermap.io.text import is_number, parse_json
from evermap.types import FloatArray, Landmarks
from evermap.types.mark import MARK

MOST_CELLS = 50_000_000
MARGIN_M = 1.0
"""Margin of free space around all landmarks."""
WAYS_TO_UP = (
    "`--up X,Y,Z` with the direction in the map's frame, `slam.space.up.direction` for a session, or a session with "
    "`gravity`, with odometry of a level frame, or that moves in a plane"
)
LEAST_SPEED = 0.1
"""Minimum share of the maximum speed: Nav2 reads a limit of 0 as no limit."""


class Footprints(NamedTuple):
    """Footprints of landmarks on the floor: centres (L, 2), directions (L, 2) of their lengths, halves (L, 2) of their
    sizes; points have no size.
    """

    at: FloatArray
    ahead: FloatArray
    half: FloatArray

    @classmethod
    def of(cls, landmarks: Landmarks) -> Self:
        """Return those of a map; one in space is seen from above (`check_floor`)."""
        landmarks = level_map(landmarks)
        at = landmarks.position_m[:, :2]
        size = np.zeros((len(landmarks), 2)) if landmarks.size_m is None else np.nan_to_num(landmarks.size_m[:, :2])
        ahead = np.tile([1.0, 0.0], (len(at), 1))
        if landmarks.rotation is not None:
            known = np.isfinite(landmarks.rotation).all(axis=1)
            axis = se3.rotation_of(np.hstack([np.zeros((known.sum(), 3)), landmarks.rotation[known]]))[:, :2, 0]
            ahead[known] = axis / np.maximum(np.linalg.norm(axis, axis=1, keepdims=True), 1e-9)
        return cls(at, ahead, size / 2.0)

    def distance(self, row: int, x: FloatArray, y: FloatArray) -> FloatArray:
        """Return how far points are from one of them, 0 within it; the shapes of x and y broadcast."""
        dx, dy = x - self.at[row, 0], y - self.at[row, 1]
        along = dx * self.ahead[row, 0] + dy * self.ahead[row, 1]
        across = dy * self.ahead[row, 0] - dx * self.ahead[row, 1]
        beyond = (np.maximum(np.abs(a) - b, 0.0) for a, b in zip((along, across), self.half[row], strict=True))
        return np.asarray(np.hypot(*beyond))


def check_floor(landmarks: Landmarks, path: str | Path | None = None) -> None:
    """Refuse a map in space of which it is not known where up is: what is above what, and where a floor is.

    Raises:
        ConfigError: names the ways to tell it.
    """
    if not landmarks.up.is_known:
        problem = f"the map has no floor, since up is {landmarks.up.text}"
        raise ConfigError(problem, path=path, field="up", hint=WAYS_TO_UP)


def write_grid(landmarks: Landmarks, path: str | Path, *, cell_m: float = 0.05, radius_m: float = 0.25) -> Path:
    """Write `path` (.yaml) and its image (.pgm): the occupancy of a cell is P(exists) of its landmarks.

    With `mode: scale` a cell gets 100 times the greatest probability to exist of the landmarks that cover it: what is
    certain is kept out by Nav2's keepout filter, what is doubtful costs more.

    Args:
        landmarks: a map; one in space is seen from above.
        path: the YAML.
        cell_m: edge of a cell [m].
        radius_m: of the disc that stands for a landmark without a size, and the margin around a box [m].

    Raises:
        DataError: there is no landmark.
        ConfigError: the grid would have more than `MOST_CELLS` cells, or it is not known where up is.
    """
    occupied, origin_m = _draw_cells(landmarks, landmarks.p_exists, Path(path), cell_m, radius_m)
    return _write_image(Path(path), occupied, origin_m, cell_m, (0.01, 0.99), _frame_of(landmarks))


def write_speed_mask(
    landmarks: Landmarks, p_wrong: FloatArray, path: str | Path, *, cell_m: float = 0.05, radius_m: float = 1.0
) -> Path:
    """Write `path` (.yaml) and its image (.pgm) as the mask of Nav2's speed filter: slow where the map may be wrong.

    A cell says by how many per cent of the greatest speed to drive slower (type 1, base 100, multiplier -1): 100 times
    the greatest `p_wrong` of the landmarks that are near it, and never so much that less than `LEAST_SPEED` remains.

    Args:
        landmarks: and `path`, `cell_m`, as of `write_grid`.
        p_wrong: (L,) probability of each that it is not as the map says: gone, or there after all.
        path: the YAML.
        cell_m: edge of a cell [m].
        radius_m: how far around a landmark it is slow [m].

    Raises:
        DataError, ConfigError: as `write_grid`.
    """
    slower = np.rint(100.0 * np.minimum(p_wrong, 1.0 - LEAST_SPEED)) / 100.0
    drawn, origin_m = _draw_cells(landmarks, slower, Path(path), cell_m, radius_m)
    about = "Mask of Nav2's speed filter; its CostmapFilterInfo: type 1, base 100.0, multiplier -1.0"
    return _write_image(Path(path), drawn, origin_m, cell_m, (0.0, 1.0), f"# {about}\n{_frame_of(landmarks)}")


def _draw_cells(
    landmarks: Landmarks, value: FloatArray, path: Path, cell_m: float, radius_m: float
) -> tuple[FloatArray, list[float]]:
    """(H, W) the greatest value (L,) of what covers each cell, from south to north, and the corner of the first."""
    if not len(landmarks):
        raise DataError("there is no landmark to draw", path=path, hint="a smaller --p-least")
    check_floor(landmarks, path)
    feet = Footprints.of(landmarks)
    at, reach = feet.at, np.hypot(*feet.half.T) + radius_m
    low, high = (at - reach[:, None]).min(axis=0) - MARGIN_M, (at + reach[:, None]).max(axis=0) + MARGIN_M
    width, height = (max(math.ceil(span / cell_m), 1) for span in high - low)
    if width * height > MOST_CELLS:
        problem = f"the grid would have {width} x {height} cells"
        raise ConfigError(problem, path=path, field="cell_m", hint=f"larger cells than {cell_m:g} m")
    drawn = np.zeros((height, width), dtype=np.float32)
    for k, p in enumerate(value.tolist()):
        first = np.floor((at[k] - reach[k] - low) / cell_m).astype(int)
        last = np.ceil((at[k] + reach[k] - low) / cell_m).astype(int)
        x, y = (low[i] + (np.arange(first[i], last[i]) + 0.5) * cell_m for i in (0, 1))
        part = drawn[first[1] : last[1], first[0] : last[0]]
        np.maximum(part, np.where(feet.distance(k, x[None], y[:, None]) <= radius_m, p, 0.0), out=part)
    return drawn, low.tolist()


def _frame_of(landmarks: Landmarks) -> str:
    """A comment that tells the frame of what was projected, if that is not the map's."""
    turned = level_pose(landmarks.up)[3:].tolist()
    if not any(turned[:3]):
        return ""
    axes = ", ".join(f"{part + 0.0:.6f}" for part in turned)
    return f"# Frame: that of the map, turned so that up is z: qx, qy, qz, qw = {axes}\n"


def _write_image(
    path: Path,
    value: FloatArray,
    origin_m: list[float],
    cell_m: float,
    thresholds: tuple[float, float],
    head: str = "",
) -> Path:
    """The image, dark where the value (H, W) is 1, and its YAML."""
    shade = np.rint(255.0 * (1.0 - value[::-1])).astype(np.uint8)  # the first row is the northernmost
    image, (west_m, south_m), (free, occupied) = path.with_suffix(".pgm"), origin_m, thresholds
    write_atomic(image, f"P5\n{value.shape[1]} {value.shape[0]}\n255\n".encode() + shade.tobytes())
    return write_atomic(
        path,
        f"{head}# {MARK}\nimage: {image.name}\nmode: scale\nresolution: {cell_m!r}\n"
        f"origin: [{west_m!r}, {south_m!r}, 0.0]\nnegate: 0\noccupied_thresh: {occupied!r}\nfree_thresh: {free!r}\n",
    )


CLOSED = 0.5
"""Probability of an obstacle above which an edge is closed."""
SAMPLES = 201
"""Points of an edge, nearest to a landmark, that are compared with its footprint."""
FARTHEST_M = 1e8
_HINT = "a route graph of Nav2: points with properties.id, lines with id, startid and endid"


class RouteEdge(NamedTuple):
    """An edge of a graph.

    Attributes:
        number: its id.
        ends: (2, 2) positions of its nodes [m].
        p_blocked: probability that something stands within the clearance of it.
    """

    number: int
    ends: FloatArray
    p_blocked: float

    @property
    def closed(self) -> bool:
        """Whether it is more probably blocked than not."""
        return self.p_blocked >= CLOSED

    @property
    def penalty_m(self) -> float:
        """How much longer the way is on average if it is tried until it is free, p / (1 - p) times its length."""
        return float(np.hypot(*np.diff(self.ends, axis=0)[0])) * self.p_blocked / (1.0 - self.p_blocked)


def write_route_graph(
    landmarks: Landmarks, graph: str | Path, path: str | Path, *, clearance_m: float = 0.5
) -> list[RouteEdge]:
    """Write a route graph without its blocked edges, with a penalty on the doubtful ones; return all of its edges.

    What is left out is listed by id in the top-level member `evermap`, as the service of `DynamicEdgesScorer` takes it.

    Args:
        landmarks: a map in the frame of the graph; one in space is seen from above, turned so that up is z.
        graph: the graph as it was drawn, which stays as it is.
        path: of the file to write.
        clearance_m: how far from an edge something may stand so that a robot cannot pass [m].

    Raises:
        InputError: no route graph; the message names the feature.
        ConfigError: it is not known where up is in the map.
    """
    graph, path = Path(graph), Path(path)
    check_floor(landmarks, path)
    document = _read(graph)
    nodes = _nodes(document, graph)
    edges, kept = list[RouteEdge](), list[dict[str, Any]]()
    feet = Footprints.of(landmarks)
    for number, feature in enumerate(document["features"]):
        if feature["geometry"]["type"] == "Point":
            kept.append(feature)
            continue
        edge = _edge(feature, nodes, landmarks, feet, clearance_m, graph, number)
        edges.append(edge)
        if not edge.closed:
            kept.append(_doubtful(feature, edge, graph, number))
    closed = [edge.number for edge in edges if edge.closed]
    blocked = {str(edge.number): edge.p_blocked for edge in edges}
    about: dict[str, Any] = {"closed_edges": closed, "clearance_m": clearance_m, "blocked": blocked}
    turned = level_pose(landmarks.up)
    if turned[:6].any():
        about["graph_from_map"] = dict(zip(("qx", "qy", "qz", "qw"), turned[3:].tolist(), strict=True))
    write_atomic(
        path,
        json.dumps({"generator": MARK, **document, "evermap": about, "features": kept}, indent=1, allow_nan=False)
        + "\n",
    )
    return edges


def _read(path: Path) -> dict[str, Any]:
    """The document, with a list of features that have a geometry and properties."""
    document = parse_json(content_of(path), path, parse_constant=_refuse)
    features = document.get("features") if isinstance(document, dict) else None
    if not isinstance(features, list):
        raise InputError("no GeoJSON feature collection", path=path, field="features", hint=_HINT)
    for number, feature in enumerate(features):
        parts = [feature.get(name) if isinstance(feature, dict) else None for name in ("geometry", "properties")]
        kind = parts[0].get("type") if isinstance(parts[0], dict) else None
        if kind not in ("Point", "LineString", "MultiLineString") or not isinstance(parts[1], dict):
            raise _wrong("is neither a node nor an edge", path, number)
    return {**document}


def _refuse(word: str) -> None:
    raise ValueError(f"{word} is not a number in JSON")


def _nodes(document: Mapping[str, Any], path: Path) -> dict[int, tuple[float, float]]:
    """Positions of the nodes by their ids."""
    found: dict[int, tuple[float, float]] = {}
    for number, feature in enumerate(document["features"]):
        geometry, properties = feature["geometry"], feature["properties"]
        if geometry["type"] != "Point":
            continue
        at = geometry.get("coordinates")
        if not isinstance(at, list) or len(at) < 2 or not all(map(is_number, at[:2])):
            raise _wrong("has no coordinates x, y", path, number)
        if max(map(abs, at[:2])) > FARTHEST_M:
            raise _wrong("is implausibly far away", path, number)
        if properties.get("frame", "map") != "map":
            raise _wrong(f"is in the frame '{properties['frame']}', not in that of the map", path, number)
        identity = _whole(properties, "id", path, number)
        if identity in found:
            raise _wrong(f"has the id {identity} of another node", path, number)
        found[identity] = float(at[0]), float(at[1])
    return found


def _edge(
    feature: Mapping[str, Any],
    nodes: Mapping[int, tuple[float, float]],
    landmarks: Landmarks,
    feet: Footprints,
    clearance_m: float,
    path: Path,
    number: int,
) -> RouteEdge:
    properties = feature["properties"]
    ends = []
    for name in ("startid", "endid"):
        node = _whole(properties, name, path, number)
        if node not in nodes:
            raise _wrong(f"{name} {node} is not a node", path, number)
        ends.append(nodes[node])
    way = np.array(ends)
    step = way[1] - way[0]
    length_m = max(float(np.hypot(*step)), 1e-9)
    reach = np.hypot(*feet.half.T) + clearance_m
    nearest = (feet.at - way[0]) @ step / length_m
    p_blocked = 0.0
    for row in np.flatnonzero((nearest >= -reach) & (nearest <= length_m + reach)):
        along = np.clip(nearest[row] + reach[row] * np.linspace(-1.0, 1.0, SAMPLES), 0.0, length_m) / length_m
        x, y = way[0, :, None] + step[:, None] * along
        if feet.distance(int(row), x, y).min() <= clearance_m:
            p_blocked = max(p_blocked, float(landmarks.p_exists[row]))
    return RouteEdge(_whole(properties, "id", path, number), way, p_blocked)


def _doubtful(feature: dict[str, Any], edge: RouteEdge, path: Path, number: int) -> dict[str, Any]:
    """The feature with a penalty, added to one that it has; floats, for Nav2 reads whole numbers as another type."""
    if not edge.p_blocked:
        return feature
    metadata = feature["properties"].get("metadata", {})
    own: Any = metadata.get("penalty", 0.0) if isinstance(metadata, dict) else None
    if not is_number(own):
        raise _wrong("has no number as properties.metadata.penalty", path, number)
    told = {**metadata, "penalty": float(own) + edge.penalty_m, "p_blocked": edge.p_blocked}
    return {**feature, "properties": {**feature["properties"], "metadata": told}}


def _whole(properties: Mapping[str, Any], name: str, path: Path, number: int) -> int:
    value = properties.get(name)
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**32:
        raise _wrong(f"has no whole number as properties.{name}", path, number)
    return value


def _wrong(problem: str, path: Path, number: int) -> InputError:
    return InputError(problem, path=path, field=f"features[{number}]", hint=_HINT)
