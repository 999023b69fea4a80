"""Maps as tables: landmarks of the columns of a map, and the columns of landmarks, in CSV, Parquet and GeoJSON."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from evermap.errors import InputError
from evermap.io.arrow import pa, parquet_bytes, pq
from evermap.io.assemble import repeats
from evermap.io.files import write_atomic
from evermap.io.spatial import (
    AT,
    BOX,
    COVARIANCE,
    QUATERNION,
    TURN_COVARIANCE,
    boxes,
    covariances,
    positions,
    quaternions,
    upper_triangle,
)
from evermap.io.table import Table, csv_text
from evermap.io.text import is_number, parse_json
from evermap.types import UNKNOWN, Clock, FloatArray, IntArray, Landmarks, Up, json_number
from evermap.valid import FEATURES, P_EXISTS, STAMP_S, X_M, Y_M, Quantity

MAP_SCHEMA_VERSION = 1

COVARIANCE_COLUMNS = ("cov_xx_m2", "cov_xy_m2", "cov_yy_m2")
_IN_SPACE = (
    "z_m", *COVARIANCE, *QUATERNION, "sigma_rad", *TURN_COVARIANCE, *BOX, "tag_size_m",
)  # fmt: skip
_REQUIRED = ("landmark_id", "x_m", "y_m")
_OPTIONAL = (
    "sigma_m", *COVARIANCE_COLUMNS, "class_id", "p_exists", "n_hits", "n_misses", "first_seen_s", "last_seen_s",
    "name",
)  # fmt: skip
_MAP_FILES = (
    "map.parquet", "landmarks.parquet", "landmarks.csv", "landmarks.csv.gz", "map.geojson", "survey.csv",
    "survey.csv.gz",
)  # fmt: skip

_SIGMA_M = Quantity("sigma_m", 0.0, 1e6, optional=True, hint="standard deviation in metres, empty where unknown")
_SIGMA_RAD = Quantity("sigma_rad", 0.0, 1e3, optional=True, hint="standard deviation in radians")
_FIRST_SEEN_S = replace(STAMP_S, name="first_seen_s", optional=True, dates=False)
_LAST_SEEN_S = replace(_FIRST_SEEN_S, name="last_seen_s")
_FEATURES = {quantity.name: quantity for quantity in FEATURES}
_DESCRIPTOR, _NUMBERED = "descriptor_", re.compile(r"descriptor_(0|[1-9]\d{0,4})")


def landmarks_from_table(
    table: Table,
    *,
    sigma_m: float,
    sigma_rad: float = 0.0,
    class_names: tuple[str, ...] | None = None,
    frame: str = "truth",
    clock: Clock = Clock.RECORDING,
    names: dict[int, str] | None = None,
) -> Landmarks:
    """Return landmarks of a table with the columns of `docs/map-files.md`, sorted by id.

    Raises:
        InputError: a column or value is not what it must be, or an id appears twice.
    """
    in_space = "z_m" in table
    table.expect(_REQUIRED, (*_OPTIONAL, *(_IN_SPACE if in_space else ())))
    names = {} if names is None else names
    ids = table.ids("landmark_id", optional=False, names=names)
    if "name" in table:
        of_row, given = table.labels("name")
        names |= {int(ids[row]): given[k] for row, k in enumerate(of_row.tolist()) if given[k]}
    again = repeats(ids)
    if len(again):
        row = int(again[0])
        problem = f"landmark {names.get(int(ids[row]), ids[row])} is listed twice"
        raise table.error(problem, row=row, field="landmark_id")
    if class_names is None:
        class_names = distinct_labels(table)
    order = np.argsort(ids)
    landmarks = Landmarks(
        landmark_id=ids,
        position_m=positions(table) if in_space else np.stack([table.numbers(X_M), table.numbers(Y_M)], axis=1),
        covariance_m2=_covariance(table, sigma_m),
        class_id=class_ids(table, class_names),
        p_exists=table.filled(P_EXISTS, 1.0),
        n_hits=table.counts("n_hits"),
        n_misses=table.counts("n_misses"),
        first_seen_s=table.filled(_FIRST_SEEN_S, np.nan),
        last_seen_s=table.filled(_LAST_SEEN_S, np.nan),
        class_names=class_names,
        frame=frame,
        clock=clock,
        names=names,
        **(_pose_columns(table, sigma_rad) if in_space else {}),
    )
    return landmarks[order]


def survey_of(table: Table | None, **how: Any) -> Landmarks | None:
    """Return exact landmarks as `landmarks_from_table`; None without a table, or of an empty one."""
    return landmarks_from_table(table, sigma_m=0.0, **how) if table is not None and len(table) else None


def write_map_parquet(landmarks: Landmarks, path: str | Path) -> Path:
    """Write a map as Parquet, one row a landmark, columns as in `docs/map-files.md`. Returns the path.

    `read_landmarks` gives back equal arrays.
    """
    metadata = {"evermap": json.dumps(about_map(landmarks))}
    return write_atomic(path, parquet_bytes(map_columns(landmarks), metadata))


def write_map_csv(landmarks: Landmarks, path: str | Path) -> Path:
    """Write a map as CSV with the same columns. Returns the path.

    `read_landmarks` gives back equal numbers; frame and clock, for which CSV has no place, are not kept.
    """
    return write_atomic(path, csv_text(map_columns(landmarks)))


def map_columns(landmarks: Landmarks) -> dict[str, Any]:
    """Return the columns of a map, in the order of `docs/map-files.md`: classes as labels, `name` where any has one."""
    names = [landmarks.names.get(identity, "") for identity in landmarks.landmark_id.tolist()]
    return {
        **survey_columns(landmarks),
        "class_id": labels_of(landmarks.class_id, landmarks.class_names),
        "p_exists": landmarks.p_exists,
        "n_hits": landmarks.n_hits,
        "n_misses": landmarks.n_misses,
        "first_seen_s": landmarks.first_seen_s,
        "last_seen_s": landmarks.last_seen_s,
        **({"name": names} if any(names) else {}),
    }


def survey_columns(landmarks: Landmarks) -> dict[str, Any]:
    """Return ids, positions and covariances, in space also orientations and sizes where there are any."""
    in_space = landmarks.position_m.shape[1] == 3
    columns = {
        "landmark_id": landmarks.landmark_id,
        **dict(zip(AT, landmarks.position_m.T, strict=False)),
        **upper_triangle(landmarks.covariance_m2, COVARIANCE if in_space else COVARIANCE_COLUMNS),
    }
    if landmarks.rotation is not None:
        columns |= dict(zip(QUATERNION, landmarks.rotation.T, strict=True))
    if landmarks.rotation_covariance is not None:
        columns |= upper_triangle(landmarks.rotation_covariance, TURN_COVARIANCE)
    if landmarks.size_m is not None:
        columns |= dict(zip(BOX, landmarks.size_m.T, strict=True))
    return columns


def about_map(landmarks: Landmarks) -> dict[str, Any]:
    """Return what the columns cannot say: version, frame, clock and the order of the classes."""
    return {
        "schema_version": MAP_SCHEMA_VERSION,
        "frame": landmarks.frame,
        "clock": landmarks.clock.value,
        "class_names": list(landmarks.class_names),
        **({} if landmarks.position_m.shape[1] == 2 or not landmarks.up.source else {"up": up_dict(landmarks.up)}),
    }


def up_dict(up: Up) -> dict[str, Any]:
    """Return where up is as plain values, null where it is not known."""
    told = bool(np.isfinite(up.direction).all())
    return {
        "direction": up.direction.tolist() if told else None,
        "sigma_rad": json_number(up.sigma_rad),
        "source": up.source or "unknown",
        "known": up.is_known,
        "text": up.text,
    }


def up_of(about: Mapping[str, Any]) -> Up:
    """Return what `up_dict` gave, of a checked description."""
    up = about.get("up")
    return Up(np.array(up["direction"], dtype=np.float64), float(up["sigma_rad"]), up["source"]) if up else Up()


def _is_up(up: Any) -> bool:
    if not isinstance(up, dict) or not isinstance(up.get("source"), str) or not is_number(up.get("sigma_rad")):
        return False
    axes = up.get("direction")
    if not (isinstance(axes, list) and len(axes) == 3 and all(map(is_number, axes))):
        return False
    return abs(math.hypot(*axes) - 1.0) < 1e-6 and up["sigma_rad"] > 0.0


def check_about(about: Any, path: Path) -> dict[str, Any]:
    """Return `about_map` as read from a file.

    Raises:
        InputError: it is not what evermap writes.
    """
    names = about.get("class_names", []) if isinstance(about, dict) else None
    if (
        names is None
        or not isinstance(names, list)
        or not all(isinstance(name, str) for name in names)
        or not isinstance(about.get("frame", ""), str)
        or about.get("clock", Clock.RECORDING.value) not in list(Clock)
        or ("up" in about and not _is_up(about["up"]))
    ):
        raise InputError("damaged description of the map", path=path, field="evermap", hint="remove it")
    if about.get("schema_version", MAP_SCHEMA_VERSION) != MAP_SCHEMA_VERSION:
        problem = f"map of schema version {about['schema_version']}, this evermap reads {MAP_SCHEMA_VERSION}"
        raise InputError(problem, path=path, field="evermap", hint="a newer evermap")
    return dict(about)


def parquet_about(data: bytes, path: Path) -> dict[str, Any]:
    """Return the description that `write_map_parquet` leaves in a file; empty for files made by others."""
    metadata = pq.read_schema(pa.BufferReader(data)).metadata or {}
    if b"evermap" not in metadata:
        return {}
    try:
        about = json.loads(metadata[b"evermap"])
    except (ValueError, RecursionError):
        about = None
    return check_about(about, path)


def labels_of(class_id: IntArray, class_names: Sequence[str]) -> list[str]:
    """Return names of classes, '' for `UNKNOWN`; a class without a name is called by its number."""
    names = dict(enumerate(class_names))
    return ["" if number == UNKNOWN else names.get(number, str(number)) for number in class_id.tolist()]


def distinct_labels(*tables: Table | None) -> tuple[str, ...]:
    """Return all class labels of the tables, sorted."""
    labels = {label for table in tables if table is not None and "class_id" in table
              for label in table.labels("class_id")[1]}  # fmt: skip
    return tuple(sorted(labels - {""}))


def feature_columns(table: Table) -> tuple[str, ...]:
    """Return the names of the columns that may describe landmarks themselves: radius, colour, a descriptor as long as
    the table has it.

    Raises:
        InputError: one of the descriptor's numbers is missing.
    """
    numbers = sorted(int(name.removeprefix(_DESCRIPTOR)) for name in table.columns if _NUMBERED.fullmatch(name))
    if missing := [k for k, number in enumerate(numbers) if k != number][:1]:
        problem = f"{_DESCRIPTOR}{numbers[-1]} is given, and no {_DESCRIPTOR}{missing[0]}"
        raise table.error(problem, row=None, field=f"{_DESCRIPTOR}{missing[0]}", hint="count from 0 without a gap")
    return (*_FEATURES, *(f"{_DESCRIPTOR}{k}" for k in numbers))


def features_of(table: Table) -> dict[str, Any]:
    """Return `features` and `feature_names` of detections, of the columns that hold anything.

    Raises:
        InputError: a value that cannot be.
    """
    wanted = [_FEATURES.get(name, Quantity(name, optional=True)) for name in feature_columns(table) if name in table]
    found = {quantity.name: table.numbers(quantity) for quantity in wanted}
    found = {name: column for name, column in found.items() if not np.isnan(column).all()}
    return {"features": np.column_stack(list(found.values())), "feature_names": tuple(found)} if found else {}


def class_ids(table: Table, class_names: tuple[str, ...]) -> IntArray:
    """Return rows of `class_names` for the column `class_id`, `UNKNOWN` where it is empty or missing. Shape (R,).

    Raises:
        InputError: a label is not among the names.
    """
    if "class_id" not in table:
        return np.full(len(table), UNKNOWN, dtype=np.int64)
    number_of = {"": UNKNOWN, **{name: number for number, name in enumerate(class_names)}}
    of_row, labels = table.labels("class_id")
    for k, label in enumerate(labels):
        if label not in number_of:
            row, hint = int(np.argmax(of_row == k)), "one of " + ", ".join(class_names)
            raise table.error(f"class '{label}' is not among the class names", row=row, field="class_id", hint=hint)
    return np.array([number_of[label] for label in labels], dtype=np.int64)[of_row]


def _covariance(table: Table, sigma_m: float) -> FloatArray:
    names = COVARIANCE if "z_m" in table else COVARIANCE_COLUMNS
    if "sigma_m" in table and table.has_any(names):
        problem = "both sigma_m and cov_* columns are given"
        raise table.error(problem, row=None, field="sigma_m", hint="keep one of them")
    covariance = covariances(table, names)
    if covariance is not None:
        return covariance
    return table.filled(_SIGMA_M, sigma_m)[:, None, None] ** 2 * np.eye(3 if "z_m" in table else 2)


def _pose_columns(table: Table, sigma_rad: float) -> dict[str, Any]:
    """Orientations, their covariances and sizes, as far as a table in space has them."""
    found: dict[str, Any] = {}
    if table.has_any(QUATERNION):
        found["rotation"] = quaternions(table, optional=True)
        turn = covariances(table, TURN_COVARIANCE, optional=True)
        if turn is None:
            turn = table.filled(_SIGMA_RAD, sigma_rad)[:, None, None] ** 2 * np.eye(3)
        turn[np.isnan(found["rotation"]).any(axis=1)] = np.nan
        found["rotation_covariance"] = turn
    if table.has_any(BOX):
        found["size_m"] = boxes(table, flat=True)
    elif "tag_size_m" in table:
        edge = table.numbers(Quantity("tag_size_m", 0.0, 1e3, positive=True, optional=True, hint="metres"))
        found["size_m"] = edge[:, None] * [1.0, 1.0, 0.0]
    return found


def find_map_file(path: Path) -> Path:
    """Return the file of a map: itself, or that of a run or recording folder.

    Raises:
        InputError: there is none.
    """
    if not path.exists():
        raise InputError("no such map", path=path, hint="check the path")
    if not path.is_dir():
        return path
    for name in _MAP_FILES:
        if (path / name).is_file():
            return path / name
    raise InputError(f"no map in this folder: looked for {', '.join(_MAP_FILES)}", path=path)


_CORNERS = 36


def write_map_geojson(landmarks: Landmarks, path: str | Path) -> Path:
    """Write a map as GeoJSON (`map_geojson`). Returns the path."""
    return write_atomic(path, map_geojson(landmarks))


def map_geojson(landmarks: Landmarks) -> str:
    """Return a map as GeoJSON: two features a landmark.

    The first is a point with all columns of `map.parquet` as properties and `"kind": "landmark"`; the second, where the
    covariance is not zero, the polygon of its 2-sigma ellipse in x and y (Mahalanobis distance 2, 86.5 % of the
    probability) with `"kind": "ellipse_2sigma"` and the same `landmark_id`. `read_landmarks` gives back equal arrays.
    """
    columns = {name: _json_cells(cells) for name, cells in map_columns(landmarks).items()}
    ellipses = ellipse_polygons(landmarks.position_m[:, :2], landmarks.covariance_m2[:, :2, :2])
    features: list[dict[str, Any]] = []
    for row, identity in enumerate(columns["landmark_id"]):
        properties = {name: cells[row] for name, cells in columns.items()}
        point = [properties[name] for name in AT if name in properties]
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
    return f'{head}, "features": [\n{body}\n]}}\n'


def ellipse_polygons(center_m: FloatArray, covariance_m2: FloatArray) -> FloatArray:
    """Return the closed counter-clockwise outlines of 2-sigma ellipses. Shapes (L, 2), (L, 2, 2) -> (L, 37, 2)."""
    value, vector = np.linalg.eigh(covariance_m2)
    # eigenvectors may form a left-handed pair; GeoJSON wants outlines counter-clockwise
    vector[..., 1] *= np.sign(np.linalg.det(vector))[..., None]
    angle = np.linspace(0.0, 2.0 * np.pi, _CORNERS + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    circle[-1] = circle[0]
    half_axes = 2.0 * np.sqrt(np.maximum(value, 0.0))
    outline = np.einsum("lij,lj,kj->lki", vector, half_axes, circle)
    return np.asarray(center_m[:, None, :] + outline)


def parse_geojson(data: bytes, path: Path) -> tuple[Table, dict[str, Any]]:
    """Return the point features of a map as a table, and the map's description. Lines of the table count features
    from 1.

    A point without the properties `x_m, y_m` takes them from its coordinates.

    Raises:
        InputError: not JSON, no feature collection, a feature without a position, or coordinates of another system.
    """
    document = parse_json(data, path)
    if not isinstance(document, dict) or not isinstance(document.get("features"), list):
        raise InputError("no GeoJSON feature collection", path=path, field="features")
    if "evermap" not in document:
        problem = "does not state that its coordinates are metres in a local frame"
        hint = 'a top-level member "evermap": {"frame": "prior_map"}'
        raise InputError(problem, path=path, field="evermap", hint=hint)
    about = check_about(document["evermap"], path)
    points = [(number, one) for number, one in enumerate(document["features"], 1) if _is_point(one)]
    rows = [_properties(feature, path, number) for number, feature in points]
    names = list(dict.fromkeys(name for row in rows for name in row)) or ["landmark_id", "x_m", "y_m"]
    columns = {name: _column([row.get(name) for row in rows], name) for name in names}
    return Table(path, columns, np.array([number for number, _ in points], dtype=np.int64)), about


def _is_point(feature: Any) -> bool:
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
    if name not in ("class_id", "name") and {*map(type, cells)} <= {int, float, type(None)}:
        try:
            return np.array([np.nan if c is None else float(c) for c in cells], dtype=np.float64)
        except OverflowError:
            pass
    return ["" if c is None else str(c) for c in cells]


def _json_cells(cells: Any) -> list[Any]:
    values = cells if isinstance(cells, list) else cells.tolist()
    return [None if isinstance(value, float) and not np.isfinite(value) else value for value in values]


def _feature(properties: dict[str, Any], kind: str, coordinates: Any) -> dict[str, Any]:
    return {"type": "Feature", "properties": properties, "geometry": {"type": kind, "coordinates": coordinates}}
