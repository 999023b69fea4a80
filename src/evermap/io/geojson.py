"""Maps as GeoJSON in a local metric frame, for tools that draw polygons.

GeoJSON (RFC 7946) means longitude and latitude unless both sides agree otherwise. Landmark maps live in a local frame,
so the file says so at its top: `"crs": null` (of the 2008 specification: coordinates of no known system) and `evermap`.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.io.atomic import write_atomic
from evermap.io.landmarks import about_map, checked_about, map_columns
from evermap.io.table import Table
from evermap.io.text import decode_text, reason
from evermap.types import FloatArray, Landmarks

_CORNERS = 36


def write_map_geojson(landmarks: Landmarks, path: str | Path) -> Path:
    """Writes a map as GeoJSON: two features a landmark. Returns the path.

    The first is a point with all columns of `map.parquet` as properties and `"kind": "landmark"`; the second, where the
    covariance is not zero, the polygon of its 2-sigma ellipse (Mahalanobis distance 2, 86.5 % of the probability) with
    `"kind": "ellipse_2sigma"` and the same `landmark_id`. `read_landmarks` gives back equal arrays.
    """
    columns = {
        name: cells if isinstance(cells, list) else cells.tolist() for name, cells in map_columns(landmarks).items()
    }
    ellipses = ellipse_polygons(landmarks.position_m, landmarks.covariance_m2)
    features: list[dict[str, Any]] = []
    for row, identity in enumerate(columns["landmark_id"]):
        properties = {name: _plain(cells[row]) for name, cells in columns.items()}
        point = [properties["x_m"], properties["y_m"]]
        features.append(_feature({"kind": "landmark", **properties}, "Point", point))
        if landmarks.covariance_m2[row].any():
            ellipse = {"kind": "ellipse_2sigma", "landmark_id": identity}
            features.append(_feature(ellipse, "Polygon", [np.round(ellipses[row], 6).tolist()]))
    about = about_map(landmarks) | {
        "units": "m",
        "coordinates": "x, y in metres in a local Cartesian frame; not longitude and latitude",
    }
    head = json.dumps({"type": "FeatureCollection", "crs": None, "evermap": about})[:-1]
    # one feature a line: maps stay readable and diff well
    body = ",\n".join(json.dumps(feature, allow_nan=False) for feature in features)
    return write_atomic(path, f'{head}, "features": [\n{body}\n]}}\n')


def ellipse_polygons(center_m: FloatArray, covariance_m2: FloatArray, sigmas: float = 2.0) -> FloatArray:
    """Closed counter-clockwise outlines of covariance ellipses. Shapes (L, 2), (L, 2, 2) -> (L, 37, 2)."""
    value, vector = np.linalg.eigh(covariance_m2)
    # eigenvectors may form a left-handed pair; GeoJSON wants outlines counter-clockwise
    vector[..., 1] *= np.sign(np.linalg.det(vector))[..., None]
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    circle[-1] = circle[0]
    half_axes = sigmas * np.sqrt(np.maximum(value, 0.0))
    outline = np.einsum("lij,lj,kj->lki", vector, half_axes, circle)
    return np.asarray(center_m[:, None, :] + outline)


def parse_geojson(data: bytes, path: Path) -> tuple[Table, dict[str, Any]]:
    """The point features of a map as a table, and the map's description. Lines of the table count features from 1.

    A point without the properties `x_m, y_m` takes them from its coordinates.

    Raises:
        InputError: not JSON, no feature collection, a feature without a position, or coordinates of another system.
    """
    try:
        document = json.loads(decode_text(data, path))
    except json.JSONDecodeError as error:
        raise InputError(f"not valid JSON: {error.msg}", path=path, line=error.lineno) from None
    except (ValueError, RecursionError) as error:
        raise InputError(f"not valid JSON: {reason(error)}", path=path) from None
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError("no GeoJSON feature collection", path=path, field="features")
    if "evermap" not in document:
        problem = "does not say that its coordinates are metres in a local frame"
        hint = 'a top-level member "evermap": {"frame": "prior_map"}'
        raise InputError(problem, path=path, field="evermap", hint=hint)
    about = checked_about(document["evermap"], path)
    points = [(number, feature) for number, feature in enumerate(document["features"], 1) if _is_landmark(feature)]
    rows = [_properties(feature, path, number) for number, feature in points]
    names = list(dict.fromkeys(name for row in rows for name in row)) or ["landmark_id", "x_m", "y_m"]
    columns = {name: _column([row.get(name) for row in rows], name) for name in names}
    return Table(path, columns, np.array([number for number, _ in points], dtype=np.int64)), about


def _is_landmark(feature: Any) -> bool:
    geometry = feature.get("geometry") if isinstance(feature, dict) else None
    return isinstance(geometry, dict) and geometry.get("type") == "Point"


def _properties(feature: dict[str, Any], path: Path, number: int) -> dict[str, Any]:
    properties = feature.get("properties") or {}
    position = feature["geometry"].get("coordinates")
    if not isinstance(properties, dict) or not isinstance(position, list) or len(position) < 2:
        raise InputError("a point without coordinates or properties", path=path, line=number, field="features")
    content = {name: value for name, value in properties.items() if name != "kind"}
    return {"x_m": position[0], "y_m": position[1]} | content


def _column(cells: list[Any], name: str) -> list[str] | FloatArray:
    if name not in ("class_id", "name") and all(_is_number(c) for c in cells):
        try:
            return np.array([np.nan if c is None else float(c) for c in cells], dtype=np.float64)
        except OverflowError:
            pass
    return ["" if c is None else str(c) for c in cells]


def _is_number(cell: Any) -> bool:
    return cell is None or (isinstance(cell, int | float) and not isinstance(cell, bool))


def _plain(value: Any) -> Any:
    return None if isinstance(value, float) and not np.isfinite(value) else value


def _feature(properties: dict[str, Any], kind: str, coordinates: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}
